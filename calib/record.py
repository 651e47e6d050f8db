"""What a calibration decided and doubted on the way: one record, which stands in the rig's file.

Gates and error estimates read it, so nothing in it may be taken for "no doubt" because it is not
there: a record is complete, or it is refused. A rig that was made elsewhere has none, which is
another thing than a record without doubts.

In a rig.json each dataclass is an object with its fields as keys (`hybridve.calib.plain`). Whoever
adds a field adds it here, and where it is a doubt to `CalibrationRecord.doubts`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Final, Literal

from hybridve.calib.plain import Told

METHOD: Final = "joint bundle adjustment of lenses, poses and boards"

#: Decided by what cameras recognise around a still board that looks the same when turned.
BY_SCENE = "matches of the scene"

_WEAK_LABELLING = (
    "the board looks the same when turned, and hardly anything tells which way round each "
    "camera saw it; mark the corners by hand in one order, move the board, or use one with "
    "an odd sum of columns and rows."
)

#: A difference beyond the stated error is no chance from so many standard deviations on, and no
#: rounding if images differ by more than this (pixels): points without noise state next to none.
_DISAGREES_SIGMAS = 4.0
_NEGLIGIBLE_PX = 0.01


@dataclass(frozen=True, slots=True)
class Noise(Told):
    """How noisy the points of boards were.

    Attributes
    ----------
    rough_px : float
        Standard deviation of a coordinate from point to point: the noise of finding points.
    smooth_px : float
        The same as the smooth part of the residuals shows it; what moves the parameters. Equal to
        `rough_px` where model and boards are right.
    rms_px : float
        Root mean square length of the residuals.
    share_explained : float
        Share of the sum of squares that the noise of single points explains, up to 1.
    n_points, n_parameters : int
        Points seen, and parameters adjusted to them.
    """

    rough_px: float
    smooth_px: float
    rms_px: float
    share_explained: float
    n_points: int
    n_parameters: int


@dataclass(frozen=True, slots=True)
class BoardRecord(Told):
    """A board: its name, the body it is fixed to (None: one of its own), and what it is, in words.

    Attributes
    ----------
    name : str
    body : str or None
    is_ : str
    """

    name: str
    body: str | None
    is_: str


@dataclass(frozen=True, slots=True, kw_only=True)
class StillsRecord(Told):
    """What a lens was fitted to, and how well the rig explains it.

    Attributes
    ----------
    source : str or None
        Where the stills are.
    views_used : int
        Boards in stills that the rig was adjusted to.
    rms_px, max_px : float or None
        Lengths of the residuals of their points; None where there is no view.
    views_dropped, views_without_board : dict of str to str
        Views that do not fit, images that do not count, and why.
    outliers : int
        Points that were set aside in views that were used for the lens.
    """

    source: str | None
    views_used: int
    rms_px: float | None
    max_px: float | None
    views_dropped: dict[str, str]
    views_without_board: dict[str, str]
    outliers: int


@dataclass(frozen=True, slots=True, kw_only=True)
class ClipRecord(Told):
    """What a camera's place was found from, and how well the rig explains it.

    Attributes
    ----------
    source, corners_by_hand : str or None
        Where the clip and the corners marked by hand are.
    views_used : int
        Boards in frames of the clip that the rig was adjusted to.
    rms_px, max_px : float or None
        Lengths of the residuals of their points; None where there is no view.
    how : str
        How the points were found.
    spread_over_clip_px : float or None
        How far the worst point of a still clip strays from frame to frame.
    other_tilt_times_worse : float or None
        How many times worse the other pose that a plane allows fits a board that lies still; None
        where the boards move.
    """

    source: str | None
    corners_by_hand: str | None
    views_used: int
    rms_px: float | None
    max_px: float | None
    how: str
    spread_over_clip_px: float | None = None
    other_tilt_times_worse: float | None = None


@dataclass(frozen=True, slots=True)
class CandidateLens(Told):
    """One lens model among those tried.

    Attributes
    ----------
    bic : float
        Bayesian information criterion, above the lowest.
    rms_px : float
        Length of the residuals.
    n_params : int
        Of the model.
    unseen : float
        Share of the image where the lens sees nothing.
    """

    bic: float
    rms_px: float
    n_params: int
    unseen: float


@dataclass(frozen=True, slots=True)
class LensChoice(Told):
    """Why a lens has the model that it has.

    Attributes
    ----------
    model : str
        The model.
    reason : str
        One line.
    sigma_px : float
        Noise of a coordinate that all candidates are judged by.
    inflation : float
        Values that err together, by which their number is divided.
    n_effective : float
        The number that is left.
    candidates : dict of str to CandidateLens
        By model, the best first.
    """

    model: str
    reason: str
    sigma_px: float
    inflation: float
    n_effective: float
    candidates: dict[str, CandidateLens]


@dataclass(frozen=True, slots=True, kw_only=True)
class MountRecord(Told):
    """How a moving camera was put on its tracker.

    Attributes
    ----------
    instants, views : int
        Moments of its clip, and views of boards, that were used.
    middle_instant : int
        Where it stands in the rig: the middle one of them.
    looks_turned : int
        Views whose points were listed another way round than most.
    untracked : tuple of int
        Instants without a pose of the tracker.
    dropped : dict of str to str
        Views that were not used, and why.
    rms_px, closed_form_rms_px : float
        Lengths of the residuals, after the fit and before it.
    turn_deg : tuple of float
        How far the tracker turned about three axes, rms, the most first.
    tracker_scale, tracker_scale_std : float
        The tracker's unit in metres as the pictures show it, and its standard deviation.
    parameters : tuple of str
        What `covariance` is of.
    covariance : tuple of tuple of float
        Of the mount, radians and metres.
    covariance_from : str
        "instants left out" or "corners".
    offset_std_mm, offset_std_deg : float
        Standard deviations of the camera's place on the tracker (lengths).
    pose_covariance : tuple of tuple of float
        (6, 6): of the camera's pose at one instant, in its own frame, radians and metres.
    """

    instants: int
    middle_instant: int
    views: int
    looks_turned: int
    untracked: tuple[int, ...]
    dropped: dict[str, str]
    rms_px: float
    closed_form_rms_px: float
    turn_deg: tuple[float, ...]
    tracker_scale: float
    tracker_scale_std: float
    parameters: tuple[str, ...]
    covariance: tuple[tuple[float, ...], ...]
    covariance_from: str
    offset_std_mm: float
    offset_std_deg: float
    pose_covariance: tuple[tuple[float, ...], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraRecord(Told):
    """Where one camera's numbers come from.

    Attributes
    ----------
    model : str
        Of its lens.
    intrinsics : StillsRecord
        The stills.
    extrinsics : ClipRecord
        The clip.
    warnings, notes : tuple of str
        What its views leave open, and what is unusual about them.
    model_chosen : LensChoice or None
        Why the lens has this model; None where it was given.
    mount : MountRecord or None
        How it was put on its tracker; None for a camera that stands still.
    """

    model: str
    intrinsics: StillsRecord
    extrinsics: ClipRecord
    warnings: tuple[str, ...]
    notes: tuple[str, ...]
    model_chosen: LensChoice | None = None
    mount: MountRecord | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class ClocksRecord(Told):
    """By how much cameras were found to be late, in frames of the board clip.

    Attributes
    ----------
    reference : str
        The camera whose clock is the session's.
    offset_frames, std_frames : dict of str to (float or None)
        By camera how late it is, and the standard deviation; None where it is not known.
    notes : tuple of str
        Why an offset is not known.
    views_left_out : dict of str to tuple of int, or None
        By camera the instants at which a board is off its path; None in older files.
    advice : str or None
        What to write into the session; None where no camera is late.
    """

    reference: str
    offset_frames: dict[str, float | None]
    std_frames: dict[str, float | None]
    notes: tuple[str, ...]
    views_left_out: dict[str, tuple[int, ...]] | None = None
    advice: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Labelling(Told):
    """What decided which way round cameras saw boards.

    Attributes
    ----------
    looks : int
        In how many ways the most symmetric board looks the same.
    decided_by : str
        What decided; begins with `BY_SCENE` where cameras had to agree about a still board. Then
        all of the following is there, else nothing is.
    matches_by_look : dict of str to tuple of int, or None
        By pair of cameras the matches of the scene that speak for each turn.
    margin_sigma : dict of str to float, or None
        By camera, in standard deviations of chance, how clear it is.
    weakest_sigma : float or None
        The least of them.
    is_weak : bool or None
        Whether that is too little to be sure of. None: there was nothing to be decided.
    """

    looks: int
    decided_by: str
    matches_by_look: dict[str, tuple[int, ...]] | None = None
    margin_sigma: dict[str, float] | None = None
    weakest_sigma: float | None = None
    is_weak: bool | None = None

    def __post_init__(self) -> None:
        is_by_scene = self.decided_by.startswith(BY_SCENE)
        for name in ("matches_by_look", "margin_sigma", "weakest_sigma", "is_weak"):
            if (getattr(self, name) is not None) != is_by_scene:
                found = "is missing" if is_by_scene else "is told"
                raise ValueError(f"{name!r} {found}, though decided by {self.decided_by!r}")


@dataclass(frozen=True, slots=True, kw_only=True)
class WorldRecord(Told):
    """What the world was defined by.

    Attributes
    ----------
    kind : {"board", "points", "floor"}
        As a session says it.
    text : str
        In words.
    board : str or None
        The board that is the world.
    instant : int, str or None
        When it was: an instant of the clip, or a still.
    cameras : tuple of str, or None
        Who saw it then.
    residuals_mm : dict of str to float, or None
        By point how far it lies from where it is said to be.
    scale : float or None
        How many times too far apart points are in the rig.
    misses_px : dict of str to dict of str to float, or None
        By point and camera how far its rays miss one another.
    warnings : tuple of str
        What a person should look at.
    """

    kind: Literal["board", "points", "floor"]
    text: str
    board: str | None = None
    instant: int | str | None = None
    cameras: tuple[str, ...] | None = None
    residuals_mm: dict[str, float] | None = None
    scale: float | None = None
    misses_px: dict[str, dict[str, float]] | None = None
    warnings: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Outlier(Told):
    """A point that the joint adjustment set aside, and by how far it misses.

    Attributes
    ----------
    camera, image : str
    board, point : int
    missed_px : float
    """

    camera: str
    image: str
    board: int
    point: int
    missed_px: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Adjustment(Told):
    """The joint adjustment of the cameras that stand still.

    Attributes
    ----------
    steps, views, outliers : int
        How many there were.
    worst_outliers : tuple of Outlier
        The worst first; not all, if there are many.
    left_out : dict of str to str
        Views that contradict the others, and why.
    warnings : tuple of str
        What was found to contradict itself: doubts.
    start : str or None
        What it started from, in words, and if not from COLMAP's adjustment why; None in older
        files.
    """

    steps: int
    views: int
    outliers: int
    worst_outliers: tuple[Outlier, ...]
    left_out: dict[str, str]
    warnings: tuple[str, ...]
    start: str | None = None


@dataclass(frozen=True, slots=True)
class NoOpinion(Told):
    """That there is no second opinion on a rig, and why, as a sentence.

    Attributes
    ----------
    reason : str
    """

    reason: str


@dataclass(frozen=True, slots=True, kw_only=True)
class SecondOpinion(Told):
    """By how much COLMAP's own adjustment of the same points differs from a rig.

    Attributes
    ----------
    difference95_m : float
        How far apart the two place a point that both see, but for the 5 % of the working volume
        where they differ most.
    expected95_m : float
        The same for the stated error (95 %) of COLMAP's adjustment, for the noise that was found:
        chance makes the two differ by less.
    sigmas : float
        The difference in standard deviations of that error.
    difference95_px : float
        How far apart the two see a point, in the camera where they differ most.
    """

    difference95_m: float
    expected95_m: float
    sigmas: float
    difference95_px: float

    @property
    def disagrees(self) -> bool:
        """Whether the difference is beyond the stated error, and neither chance nor rounding."""
        return (
            self.difference95_m > self.expected95_m
            and self.sigmas > _DISAGREES_SIGMAS
            and self.difference95_px > _NEGLIGIBLE_PX
        )

    @property
    def doubt(self) -> str:
        """What a difference leaves open, in words."""
        return (
            "COLMAP's own adjustment of the same points places what the cameras see "
            f"{1000 * self.difference95_m:.2f} mm elsewhere, which is {self.sigmas:.1f} standard "
            f"deviations and beyond its stated error ({1000 * self.expected95_m:.2f} mm): one of "
            "the two is wrong, or the noise of stills and clip is not what it was taken for; "
            "compare a distance you know."
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationRecord(Told):
    """What a calibration by this program decided and doubted.

    Attributes
    ----------
    method : str
        `METHOD`.
    software : dict of str to str
        Versions by program.
    boards : tuple of BoardRecord
        In order of name.
    rms_px : float
        `noise.rms_px`, rounded.
    noise : Noise
        Of all points.
    cameras : dict of str to CameraRecord
        By name.
    clocks : ClocksRecord or None
        None where the session's clocks were taken as given.
    labelling : Labelling or None
        None where boards moved and look the same in no other way, or all cameras move.
    noise_by_group : dict of str to Noise, or None
        By kind of view; None where all cameras move, and in older files.
    world : WorldRecord or None
        None where all cameras move.
    settings : dict
        How it was done, as plain JSON values.
    adjustment : Adjustment or None
        None where all cameras move.
    second_opinion : SecondOpinion, NoOpinion or None
        None where all cameras move, and in older files.

    Raises
    ------
    ValueError
        If something is None though it applies.
    """

    method: Literal["joint bundle adjustment of lenses, poses and boards"]
    software: dict[str, str]
    boards: tuple[BoardRecord, ...]
    rms_px: float
    noise: Noise
    cameras: dict[str, CameraRecord]
    clocks: ClocksRecord | None = None
    labelling: Labelling | None = None
    noise_by_group: dict[str, Noise] | None = None
    world: WorldRecord | None = None
    settings: dict[str, dict[str, Any]]
    adjustment: Adjustment | None = None
    second_opinion: SecondOpinion | NoOpinion | None = None

    def __post_init__(self) -> None:
        still = [camera for camera in self.cameras.values() if camera.mount is None]
        if not still:
            return
        for name in ("world", "adjustment"):
            if getattr(self, name) is None:
                raise ValueError(f"{name!r} is missing, though cameras stand still")
        is_new = self.adjustment is not None and self.adjustment.start is not None
        if is_new and self.second_opinion is None:
            raise ValueError("'second_opinion' is missing, though cameras stand still")
        lay_still = all(one.extrinsics.other_tilt_times_worse is not None for one in still)
        if lay_still and self.labelling is None:
            raise ValueError("'labelling' is missing, though the boards lay still")

    @property
    def format(self) -> str:
        """The format of files that hold such a record."""
        return "json"

    @property
    def doubts(self) -> tuple[str, ...]:
        """What contradicted itself or could not be decided, in words: no gate may pass it."""
        contradictions = () if self.adjustment is None else self.adjustment.warnings
        undecided = self.labelling is not None and self.labelling.is_weak
        other = self.second_opinion
        return (
            *contradictions,
            *([_WEAK_LABELLING] if undecided else []),
            *([other.doubt] if isinstance(other, SecondOpinion) and other.disagrees else []),
        )

    @property
    def warnings(self) -> tuple[str, ...]:
        """What a person should look at beside the doubts, in words."""
        return () if self.world is None else self.world.warnings

    def renamed(self, names: Mapping[str, str]) -> "CalibrationRecord":
        """Return the record with cameras called anew; those without a new name keep theirs."""
        cameras = {names.get(name, name): told for name, told in self.cameras.items()}
        return replace(self, cameras=cameras)
