"""From pictures of boards to a rig that can be trusted: observe, fit, link, adjust, certify.

::

    pictures -> Observations -> lenses -> labels, clocks -> linked cameras -> joint adjustment
                                                                                   |
                                certificate <- rig with its covariance <- world <--+

Each camera's lens is fitted to all that it saw of the boards; views that are blurred or wrong show
by their own error and are dropped. The rig follows from a clip that shows boards to all cameras:
lying still, then the clip is averaged, or being moved, then each frame ties the cameras together.
Seeing (`observe_boards`) and solving (`solve_rig`) are apart, so that pictures are searched once.
"""

import importlib.metadata
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import combinations
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.board import Board, Observations, is_seen
from hybridve.calib.bundle import POSE, Adjusted, Bundle, BundleView, adjust, moved_pose
from hybridve.calib.camera import N_PARAMS, Camera
from hybridve.calib.clock import estimate_offsets, noise_shares, resampled
from hybridve.calib.consensus import common_pose
from hybridve.calib.corner_cache import CornerCache
from hybridve.calib.errors import CalibrationError
from hybridve.calib.hand_eye import mount_camera
from hybridve.calib.image_io import natural_order
from hybridve.calib.labelling import label_still_boards
from hybridve.calib.lens_choice import choose_shared_lens
from hybridve.calib.lens_fit import FittedLens, LensSettings, fit_shared_lens, locate_board, rms
from hybridve.calib.link import Linked, link_cameras
from hybridve.calib.observe import CameraInput, ObserveSettings, observe_boards
from hybridve.calib.pose import Pose, compose, invert
from hybridve.calib.rig import Mount, Rig, RigCovariance
from hybridve.calib.uncertainty import (
    Noise,
    camera_parameter_names,
    in_world,
    measure_group_noise,
    measure_noise,
    parameter_slices,
    rig_covariance,
)
from hybridve.calib.world import Mark, SeenBoards, place_world

logger = logging.getLogger(__name__)

Progress = Callable[[str, int, int], None]

#: A lens whose model is chosen by its views.
AUTO_MODEL = "auto"

#: A point is an outlier of the joint adjustment if it misses by so many times the noise of its
#: camera (a normal error does so once in 300,000 points), and by more than this.
_OUTLIER_SIGMAS = 5.0
_OUTLIER_PX = 0.2

#: A still board that misses its lens by more than this after all is another camera's.
_WRONG_CLIP_PX = 5.0

#: Where the two poses that a plane allows differ in error by less than this factor, its tilt is
#: not determined.
_TILT_FACTOR = 1.5

#: Points that lie outside the image (found there, or marked): a larger share is a mistake.
_OUTSIDE = 0.1

#: Cameras do not agree where the clip misses the rig by so many times what it misses their lenses
#: alone, and by more than this. The camera is named whose pairs with the others differ so many
#: times more than all other pairs.
_DISAGREES_FACTOR = 3.0
_DISAGREES_PX = 0.2
_ODD_FACTOR = 2.0

#: Standard deviation of a coordinate of a click, pixels, and the step (standard deviations of the
#: rig's parameters, pixels of clicks) by which derivatives of the world are taken.
_CLICK_PX = 0.5
_WORLD_STEP = 1e-2

#: Points are taken to be no less noisy than this.
_LEAST_SIGMA_PX = 1e-6

#: Outliers that are listed one by one.
_TOLD_OUTLIERS = 50


@dataclass(frozen=True, slots=True)
class CalibrationSettings:
    """How a calibration is done; the defaults serve.

    Attributes
    ----------
    observe : ObserveSettings
        How pictures are searched.
    lens : LensSettings
        How lenses are fitted.
    world : "board", "points" or "floor"
        What defines the world: the board (z up from its printed side), points whose places are
        known, or the floor.
    marks : tuple of Mark
        Points for the latter two.
    sync : "given" or "estimate"
        Whether the cameras' clocks are to be trusted, frame by frame.
    """

    observe: ObserveSettings = field(default_factory=ObserveSettings)
    lens: LensSettings = field(default_factory=LensSettings)
    world: Literal["board", "points", "floor"] = "board"
    marks: tuple[Mark, ...] = ()
    sync: Literal["given", "estimate"] = "given"


_DEFAULTS = CalibrationSettings()


@dataclass(frozen=True, slots=True, eq=False)
class LensRequest:
    """What is asked of one camera's lens beyond its model.

    Attributes
    ----------
    group : str or None
        Cameras of one group share a lens.
    params : tuple of float, or None
        Its parameters, if they are known.
    """

    group: str | None = None
    params: tuple[float, ...] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """A rig and what it was made from.

    Attributes
    ----------
    rig : Rig
        With its covariance; ``provenance`` holds errors per camera, what was dropped and why.
    noise : Noise
        How noisy the points of boards were.
    pixels, residuals_px : dict of str to (K, 2) float64
        By camera all points that were used, and observed minus projected.
    """

    rig: Rig
    noise: Noise
    pixels: dict[str, NDArray[np.float64]]
    residuals_px: dict[str, NDArray[np.float64]]


def calibrate_rig(
    boards: Sequence[Board],
    cameras: Sequence[CameraInput],
    settings: CalibrationSettings = _DEFAULTS,
    progress: Progress | None = None,
    cache: CornerCache | None = None,
    tracks: Mapping[str, Mapping[int, Pose]] | None = None,
) -> Calibration:
    """Calibrate lenses and poses of cameras from pictures of boards.

    Parameters
    ----------
    boards : sequence of Board
        The boards in all pictures.
    cameras : sequence of CameraInput
        The cameras; their order does not matter.
    settings : CalibrationSettings
        How it is done.
    progress : callable, optional
        Called with what is being done, how many of it are done, and how many there are.
    cache : CornerCache, optional
        What was found in the pictures before.
    tracks : mapping of str to mapping of int to (3, 4) float64, optional
        For cameras that move: tracking_from_tracker by frame of their board clip.

    Returns
    -------
    Calibration
        Its rig is in the order of `cameras`, in the world of `CalibrationSettings.world`, metres,
        Z up.

    Raises
    ------
    CalibrationError
        Naming the camera, what was found and what to do, where no board is found, too few views
        fit, a lens is not determined, or a camera cannot be linked to the others.
    """
    requests = {camera.name: LensRequest(camera.lens, camera.params) for camera in cameras}
    tracks = tracks or {}
    observe = settings.observe
    if settings.sync == "estimate":
        observe = replace(observe, every_clip_frame=True)
    # A board that lies still does not for a camera that moves: their clips are looked at apart.
    moving = [camera for camera in cameras if camera.name in tracks]
    seen = {
        observed.name: observed
        for together in ([camera for camera in cameras if camera.name not in tracks], moving)
        if together
        for observed in observe_boards(boards, together, observe, progress, cache)
    }
    observations = [seen[camera.name] for camera in cameras]
    return solve_rig(boards, observations, settings, progress, requests, tracks)


def solve_rig(
    boards: Sequence[Board],
    observations: Sequence[Observations],
    settings: CalibrationSettings = _DEFAULTS,
    progress: Progress | None = None,
    requests: Mapping[str, LensRequest] | None = None,
    tracks: Mapping[str, Mapping[int, Pose]] | None = None,
) -> Calibration:
    """Solve lenses and poses from the points that were seen: the quick half of `calibrate_rig`."""
    _check(boards, observations)
    report = progress or _no_progress
    requests, tracks = requests or {}, tracks or {}
    # The rig's numbers must not depend on the order in which cameras and boards are listed.
    ordered = sorted(observations, key=lambda seen: natural_order(seen.name))
    boards, ordered = _boards_by_name(boards, ordered)
    fixed = [seen for seen in ordered if seen.name not in tracks]
    moving = [seen for seen in ordered if seen.name in tracks]
    about: dict[str, Any] = {}
    shares: dict[str, float] = {}
    if settings.sync == "estimate" and fixed:
        fixed, shares = _synchronised(boards, fixed, settings, requests, about)
    lenses = _fit_lenses(boards, [*fixed, *moving], settings.lens, requests, report)
    report("adjusting everything", 0, 1)
    solved = None
    if fixed:
        solved = _solve_fixed(
            boards, fixed, lenses[: len(fixed)], requests, settings, about, shares
        )
    mounted = [
        _mount(boards, seen, lens, tracks[seen.name], solved)
        for seen, lens in zip(moving, lenses[len(fixed) :], strict=True)
    ]
    calibration = _put_together(boards, [*fixed, *moving], lenses, solved, mounted, about, settings)
    report("adjusting everything", 1, 1)
    names = [seen.name for seen in observations]
    return replace(calibration, rig=calibration.rig.only(names))


def _no_progress(what: str, done: int, total: int) -> None:
    del what, done, total


def _check(boards: Sequence[Board], observations: Sequence[Observations]) -> None:
    """Refuse what no camera can have seen.

    Raises
    ------
    CalibrationError
        Naming the camera.
    """
    if not observations:
        raise CalibrationError("there is no camera to calibrate; name at least one")
    names = [seen.name for seen in observations]
    for seen in observations:
        if names.count(seen.name) > 1:
            raise CalibrationError(f"camera {seen.name!r} is listed {names.count(seen.name)} times")
        if seen.model != AUTO_MODEL and seen.model not in N_PARAMS:
            raise CalibrationError(
                f"camera {seen.name!r}: unknown camera model {seen.model!r}; one of "
                f"{AUTO_MODEL}, {', '.join(N_PARAMS)}"
            )
        for sighting in seen.sightings:
            n_points = len(boards[sighting.board].points_board)
            if len(sighting.pixels) != n_points:
                raise CalibrationError(
                    f"camera {seen.name!r}: {sighting.image} has {len(sighting.pixels)} points, "
                    f"expected the {n_points} of {boards[sighting.board]}"
                )
        pixels = np.concatenate([np.zeros((0, 2)), *(s.pixels for s in seen.sightings)])
        pixels = pixels[is_seen(pixels)]
        outside = ((pixels < 0) | (pixels > seen.size_px)).any(axis=1)
        if outside.sum() > _OUTSIDE * len(pixels):
            raise CalibrationError(
                "camera {!r}: {} of {} points lie outside its images of {}x{} pixels; were stills, "
                "clip and corners recorded in the same mode?".format(
                    seen.name, outside.sum(), len(pixels), *seen.size_px
                )
            )


def _boards_by_name(
    boards: Sequence[Board], observations: Sequence[Observations]
) -> tuple[list[Board], list[Observations]]:
    """Return boards in order of name, and the same observations of them."""
    order = sorted(range(len(boards)), key=lambda index: natural_order(boards[index].name))
    rank = {index: place for place, index in enumerate(order)}
    return [boards[index] for index in order], [
        replace(
            seen,
            sightings=tuple(replace(one, board=rank[one.board]) for one in seen.sightings),
        )
        for seen in observations
    ]


# --- Lenses and clocks ------------------------------------------------------------------------


def _fit_lenses(
    boards: Sequence[Board],
    observations: Sequence[Observations],
    settings: LensSettings,
    requests: Mapping[str, LensRequest],
    report: Progress,
) -> list[FittedLens]:
    """Fit each lens to the views of all cameras that share it; one result a camera."""
    groups: dict[str, list[Observations]] = {}
    for seen in observations:
        group = requests.get(seen.name, LensRequest()).group
        # A lens of its own is called by a name that no group can have.
        groups.setdefault(f"{seen.name}/" if group is None else group, []).append(seen)
    fitted: dict[str, FittedLens] = {}
    for done, members in enumerate(groups.values()):
        report("fitting lenses", done, len(groups))
        params = _known_params(members, requests)
        if members[0].model == AUTO_MODEL:
            lenses = choose_shared_lens(boards, members, settings)
        else:
            known = None if params is None else np.array(params, np.float64)
            lenses = fit_shared_lens(boards, members, settings, known)
        fitted |= {seen.name: lens for seen, lens in zip(members, lenses, strict=True)}
    report("fitting lenses", len(groups), len(groups))
    return [fitted[seen.name] for seen in observations]


def _known_params(
    members: Sequence[Observations], requests: Mapping[str, LensRequest]
) -> tuple[float, ...] | None:
    """Return the parameters of a lens that any of its cameras was given."""
    given = [requests.get(seen.name, LensRequest()).params for seen in members]
    return next((params for params in given if params is not None), None)


def _synchronised(
    boards: Sequence[Board],
    observations: Sequence[Observations],
    settings: CalibrationSettings,
    requests: Mapping[str, LensRequest],
    about: dict[str, Any],
) -> tuple[list[Observations], dict[str, float]]:
    """Return observations as clocks that agree would have made them, and their `noise_shares`."""
    if all(seen.is_still for seen in observations):
        raise CalibrationError(
            "the cameras' clocks cannot be compared: the boards lie still in the clip; record a "
            'board that is moved about, or say sync = "given"'
        )
    lenses = _fit_lenses(boards, observations, settings.lens, requests, _no_progress)
    clocks = estimate_offsets(boards, lenses, observations)
    if any(known for name, known in clocks.is_known.items() if name != clocks.reference):
        # A lens that one camera tells alone is a little wrong, and bends the board's path in time.
        # All cameras together, once they agree, tell lenses better, and these the offsets.
        in_time = resampled(observations, clocks.offset_frames, boards)
        lenses = _fit_lenses(boards, in_time, settings.lens, requests, _no_progress)
        linked = link_cameras(boards, lenses, in_time, is_labelled=False)
        rough = adjust(_make_bundle(boards, lenses, linked, requests), settings.lens.loss_px)
        lenses = [
            replace(lens, camera=replace(camera, cam_from_world=lens.camera.cam_from_world))
            for lens, camera in zip(lenses, rough.bundle.cameras, strict=True)
        ]
        clocks = estimate_offsets(boards, lenses, observations)
    about["clocks"] = {
        "reference": clocks.reference,
        "offset_frames": {
            name: round(offset, 4) if np.isfinite(offset) else None
            for name, offset in clocks.offset_frames.items()
        },
        "std_frames": {
            name: round(std, 4) if np.isfinite(std) else None
            for name, std in clocks.std_frames.items()
        },
        "notes": list(clocks.notes),
        "views_left_out": {name: list(instants) for name, instants in clocks.left_out.items()},
    }
    for note in clocks.notes:
        logger.warning("clocks: %s; it is taken to be in time", note)
    for name, instants in clocks.left_out.items():
        if instants:
            logger.warning(
                "camera %r: %d frames of the board clip show a board off its path and are not used "
                "for clocks; the first is frame %d",
                name,
                len(instants),
                instants[0],
            )
    late = [
        f"{name} {offset:+.3f} +- {1.96 * clocks.std_frames[name]:.3f}"
        for name, offset in clocks.offset_frames.items()
        if clocks.is_known[name] and name != clocks.reference
    ]
    if late:
        about["clocks"]["advice"] = (
            f"frames by which cameras are later than {clocks.reference}: {', '.join(late)}; these "
            "hold for the board clip; where they hold for the recording, say "
            "offset_s = frames / fps"
        )
        logger.info("clocks: %s", about["clocks"]["advice"])
    return (
        resampled(observations, clocks.offset_frames, boards),
        noise_shares(observations, clocks.offset_frames),
    )


# --- Fixed cameras ----------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _Solved:
    """Fixed cameras in the world, and what they were adjusted to."""

    adjusted: Adjusted
    linked: Linked
    noise: Noise
    cameras: tuple[Camera, ...]
    covariance: RigCovariance
    world_from_rig: Pose
    outliers: list[dict[str, Any]]


def _solve_fixed(
    boards: Sequence[Board],
    observations: Sequence[Observations],
    lenses: Sequence[FittedLens],
    requests: Mapping[str, LensRequest],
    settings: CalibrationSettings,
    about: dict[str, Any],
    shares: Mapping[str, float],
) -> _Solved:
    is_still = all(seen.is_still for seen in observations)
    seen: Sequence[Observations] = observations
    if is_still:
        cameras = [lens.camera for lens in lenses]
        seen, about["labelling"] = label_still_boards(boards, cameras, observations)
        _warn_of_flat_views(boards, cameras, seen)
    elif any(len(board.looks) > 1 for board in boards):
        looks = max(len(board.looks) for board in boards)
        about["labelling"] = {"looks": looks, "decided_by": "poses common to all frames"}
    linked = link_cameras(boards, lenses, seen, is_labelled=is_still)
    bundle = _make_bundle(boards, lenses, linked, requests)
    rough = adjust(bundle, settings.lens.loss_px)
    if is_still:
        _refuse_wrong_clips(rough, linked)
    linked = replace(
        linked, warnings=(*linked.warnings, *_disagreeing(boards, lenses, linked, rough))
    )
    cleaned, outliers = _without_outliers(rough)
    adjusted, noise, groups = _adjust_weighed(cleaned, linked, shares)
    about["noise_by_group"] = {name: asdict(told) for name, told in groups.items()}
    placed = place_world(
        settings.world,
        adjusted.bundle.cameras,
        _seen_boards(boards, linked, adjusted.bundle),
        settings.marks,
    )
    about["world"] = placed.diagnostics
    for warning in placed.diagnostics["warnings"]:
        logger.warning("%s", warning)
    rig_from_world = invert(placed.world_from_rig)
    in_the_world = tuple(
        replace(camera, cam_from_world=_rigid(compose(camera.cam_from_world, rig_from_world)))
        for camera in adjusted.bundle.cameras
    )
    covariance = rig_covariance(adjusted, 1.0)
    if settings.world != "board":
        # The board is held, and so without error; a world found by the cameras shares theirs.
        covariance = in_world(
            covariance,
            in_the_world,
            *_world_errors(boards, linked, adjusted.bundle, covariance, settings),
        )
    return _Solved(
        adjusted, linked, noise, in_the_world, covariance, placed.world_from_rig, outliers
    )


def _adjust_weighed(
    bundle: Bundle, linked: Linked, shares: Mapping[str, float]
) -> tuple[Adjusted, Noise, dict[str, Noise]]:
    """Adjust a bundle with each view weighed by the noise of its kind; return that noise, too.

    The clip and the stills of each camera are kinds of their own: a board in hand is blurred where
    one on the floor, averaged over many frames, is not. Where the clip's points are interpolated,
    `shares` says which share of the noise of frames is left of each camera's: its views are weighed
    by the noise of frames.
    """
    even = adjust(bundle)
    groups = [
        "board clip"
        if isinstance(linked.pose_names[view.pose][0], int)
        else f"stills of {bundle.cameras[view.camera].name}"
        for view in bundle.views
    ]
    noise, by_group = measure_noise(even), measure_group_noise(even, groups)
    if shares and "board clip" in by_group:
        left, counts = np.array(
            [
                (shares[bundle.cameras[view.camera].name], is_seen(view.pixels).sum())
                for view, group in zip(bundle.views, groups, strict=True)
                if group == "board clip"
            ]
        ).T
        told, factor = by_group["board clip"], (left @ counts / counts.sum()) ** -0.5
        by_group["board clip"] = replace(
            told, rough_px=factor * told.rough_px, smooth_px=factor * told.smooth_px
        )
    # Points without noise (generated ones) are weighed alike, and leave no doubt.
    sigmas_px = [max(by_group[group].smooth_px, _LEAST_SIGMA_PX) for group in groups]
    weighed = replace(
        even.bundle,
        views=tuple(
            replace(view, sigma_px=sigma_px)
            for view, sigma_px in zip(even.bundle.views, sigmas_px, strict=True)
        ),
    )
    return adjust(weighed), noise, by_group


def _world_errors(
    boards: Sequence[Board],
    linked: Linked,
    bundle: Bundle,
    covariance: RigCovariance,
    settings: CalibrationSettings,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return how the world moves with the cameras' parameters (6, P), and by clicks (6, 6)."""

    def place(cameras: Sequence[Camera], marks: Sequence[Mark]) -> Pose:
        seen = _seen_boards(boards, linked, bundle)
        return place_world(settings.world, cameras, seen, marks).world_from_rig

    rig_from_world = invert(place(bundle.cameras, settings.marks))

    def moved(cameras: Sequence[Camera], marks: Sequence[Mark], step: float) -> NDArray[np.float64]:
        change = compose(place(cameras, marks), rig_from_world)
        rotation = change[:, :3] - change[:, :3].T
        omega = np.array([rotation[2, 1], rotation[0, 2], rotation[1, 0]]) / 2.0
        return np.concatenate([omega, change[:, 3]]) / step

    deviations = np.sqrt(np.diag(covariance.matrix))
    by_parameter = np.zeros((POSE, len(deviations)))
    for index, span in enumerate(parameter_slices(bundle.cameras)):
        camera = bundle.cameras[index]
        for column in range(span.start, span.stop):
            step = _WORLD_STEP * float(deviations[column])
            if step == 0:
                continue  # given, and without error
            nudge = np.zeros(span.stop - span.start)
            nudge[column - span.start] = step
            other = replace(
                camera,
                cam_from_world=moved_pose(camera.cam_from_world, nudge[:POSE]),
                params=camera.params + nudge[POSE:],
            )
            cameras = (*bundle.cameras[:index], other, *bundle.cameras[index + 1 :])
            by_parameter[:, column] = moved(cameras, settings.marks, step)
    of_clicks = np.zeros((POSE, POSE))
    for index, mark in enumerate(settings.marks):
        for name, (x, y) in mark.pixels.items():
            for click in ((x + _WORLD_STEP, y), (x, y + _WORLD_STEP)):
                other_mark = replace(mark, pixels={**mark.pixels, name: click})
                marks = (*settings.marks[:index], other_mark, *settings.marks[index + 1 :])
                twist = moved(bundle.cameras, marks, _WORLD_STEP)
                of_clicks += _CLICK_PX**2 * np.outer(twist, twist)
    return by_parameter, of_clicks


def _seen_boards(boards: Sequence[Board], linked: Linked, bundle: Bundle) -> SeenBoards:
    return SeenBoards(
        boards, bundle.body_from_board, bundle.rig_from_body, linked.pose_names, bundle.views
    )


def _make_bundle(
    boards: Sequence[Board],
    lenses: Sequence[FittedLens],
    linked: Linked,
    requests: Mapping[str, LensRequest],
) -> Bundle:
    """Return the start of the joint adjustment; its frame is that of the body most cameras saw."""
    held, _, _ = SeenBoards(
        boards, linked.body_from_board, linked.rig_from_body, linked.pose_names, linked.views
    ).main()
    rig_from_held = linked.rig_from_body[held]
    held_from_rig = invert(rig_from_held)
    groups: dict[str, int] = {}
    lens_of = []
    for lens in lenses:
        name = lens.camera.name
        group = requests.get(name, LensRequest()).group
        lens_of.append(groups.setdefault(f"{name}/" if group is None else group, len(groups)))
    given = {
        number
        for number, lens in zip(lens_of, lenses, strict=True)
        if requests.get(lens.camera.name, LensRequest()).params is not None
    }
    bodies: dict[str, int] = {}
    for board in sorted(range(len(boards)), key=lambda index: natural_order(boards[index].name)):
        bodies.setdefault(boards[board].body or f"{boards[board].name}/", board)
    return Bundle(
        points_board=tuple(board.points_board for board in boards),
        cameras=tuple(
            replace(lens.camera, cam_from_world=_rigid(compose(cam_from_rig, rig_from_held)))
            for lens, cam_from_rig in zip(lenses, linked.cam_from_rig, strict=True)
        ),
        rig_from_body=tuple(
            np.eye(3, 4) if index == held else compose(held_from_rig, pose)
            for index, pose in enumerate(linked.rig_from_body)
        ),
        body_from_board=linked.body_from_board,
        views=linked.views,
        held_pose=held,
        lens_of=tuple(lens_of),
        fixed_lenses=frozenset(given),
        held_boards=frozenset(bodies.values()),
    )


def _rigid(pose: Pose) -> Pose:
    u, _, vt = np.linalg.svd(pose[:, :3])
    return np.column_stack([u @ vt, pose[:, 3]])


def _refuse_wrong_clips(rough: Adjusted, linked: Linked) -> None:
    for view, missed in zip(rough.bundle.views, rough.residuals_px, strict=True):
        missed_px = rms(missed[is_seen(missed)])
        is_clip = isinstance(linked.pose_names[view.pose][0], int)
        if is_clip and missed_px > _WRONG_CLIP_PX:
            name = rough.bundle.cameras[view.camera].name
            raise CalibrationError(
                f"camera {name!r}: the board clip misses its lens by {missed_px:.1f} px; were clip "
                "and stills recorded by this camera, with the same zoom, and is the board the same?"
            )


def _disagreeing(
    boards: Sequence[Board], lenses: Sequence[FittedLens], linked: Linked, rough: Adjusted
) -> list[str]:
    """Return a warning if no rig explains what the cameras saw, though their lenses do."""
    squares: list[list[float]] = [[] for _ in lenses]
    for view, missed in zip(rough.bundle.views, rough.residuals_px, strict=True):
        if isinstance(linked.pose_names[view.pose][0], int):
            squares[view.camera] += (missed[is_seen(missed)] ** 2).sum(axis=1).tolist()
    missed_px = [float(np.sqrt(np.mean(own))) if own else 0.0 for own in squares]
    worst = max(
        range(len(lenses)),
        key=lambda index: missed_px[index] / max(lenses[index].rms_px, _DISAGREES_PX),
    )
    alone_px = lenses[worst].rms_px
    if missed_px[worst] < _DISAGREES_FACTOR * max(alone_px, _DISAGREES_PX):
        return []
    odd = _odd_one_out(boards, linked, rough.bundle)
    who = "the cameras do" if odd is None else f"camera {lenses[odd].camera.name!r} does"
    return [
        f"{who} not agree with {'one another' if odd is None else 'the others'}: the boards of the "
        f"clip are missed by {missed_px[worst]:.2f} px in {lenses[worst].camera.name!r}, whose "
        f"lens alone misses them by {alone_px:.2f} px; were the clips recorded at the same time, "
        'frame by frame (sync = "estimate" if some are late), of a board as it is described, and '
        "did no camera move?"
    ]


def _odd_one_out(boards: Sequence[Board], linked: Linked, bundle: Bundle) -> int | None:
    """Return the camera whose poses against all others change while those of the others do not."""
    placed: dict[tuple[int, int], dict[int, Pose]] = {}
    for view in bundle.views:
        camera = bundle.cameras[view.camera]
        located = locate_board(camera, boards[view.board].points_board, view.pixels)
        if located is not None and isinstance(linked.pose_names[view.pose][0], int):
            placed.setdefault((view.pose, view.board), {})[view.camera] = located[0]
    count = len(bundle.cameras)
    apart = np.full((count, count), np.nan)
    for one, other in combinations(range(count), 2):
        both = [seen for seen in placed.values() if one in seen and other in seen]
        if len(both) > 1:
            measured = [compose(seen[other], invert(seen[one]))[None] for seen in both]
            length_m = float(np.median([np.linalg.norm(seen[one][:, 3]) for seen in both]))
            error = common_pose(measured, np.ones(len(measured)), length_m).error
            apart[one, other] = apart[other, one] = error
    for index in range(count):
        own = apart[index][np.isfinite(apart[index])]
        others = np.delete(np.delete(apart, index, axis=0), index, axis=1)
        others = others[np.isfinite(others)]
        if len(own) and len(others) and own.min() > _ODD_FACTOR * others.max():
            return index
    return None


def _warn_of_flat_views(
    boards: Sequence[Board], cameras: Sequence[Camera], observations: Sequence[Observations]
) -> None:
    """Warn where a still board hardly tells how it is tilted."""
    for camera, seen in zip(cameras, observations, strict=True):
        factor = _other_tilt(boards, camera, seen)
        if factor is not None and factor < _TILT_FACTOR:
            logger.warning(
                "camera %s: the board clip hardly tells how the board is tilted (the other tilt "
                "fits %.1f times worse); use a larger board or bring it nearer",
                camera.name,
                factor,
            )


def _other_tilt(boards: Sequence[Board], camera: Camera, seen: Observations) -> float | None:
    """Return how many times worse the other pose of the clip's board fits that tells it best.

    None where no board of the clip can be located.
    """
    factors = []
    for sighting in seen.sightings:
        if sighting.instant is None:
            continue
        located = locate_board(camera, boards[sighting.board].points_board, sighting.pixels)
        if located is not None:
            factors.append(min(located[2] / max(located[1], 1e-9), 1e6))
    return max(factors, default=None)


def _without_outliers(rough: Adjusted) -> tuple[Bundle, list[dict[str, Any]]]:
    """Return a bundle without the points that miss by far, and these, the worst first."""
    bundle = rough.bundle
    limits_px = []
    for index in range(len(bundle.cameras)):
        missed = np.concatenate(
            [
                residuals[is_seen(residuals)]
                for view, residuals in zip(bundle.views, rough.residuals_px, strict=True)
                if view.camera == index
            ]
            or [np.zeros((0, 2))]
        )
        # 1.4826 times the median absolute value is the standard deviation of a normal error.
        sigma_px = 1.4826 * float(np.median(np.abs(missed))) if len(missed) else 0.0
        limits_px.append(max(_OUTLIER_SIGMAS * sigma_px, _OUTLIER_PX))
    views: list[BundleView] = []
    outliers: list[dict[str, Any]] = []
    for view, residuals in zip(bundle.views, rough.residuals_px, strict=True):
        misses_px = np.linalg.norm(residuals, axis=1)
        with np.errstate(invalid="ignore"):
            is_outlier = misses_px > limits_px[view.camera]
        if is_outlier.sum() > len(residuals) / 4:
            is_outlier[:] = False  # a whole view is judged by its lens and by the other views
        outliers += [
            {
                "camera": bundle.cameras[view.camera].name,
                "image": view.image,
                "board": view.board,
                "point": int(point),
                "missed_px": round(float(misses_px[point]), 2),
            }
            for point in np.flatnonzero(is_outlier)
        ]
        pixels = np.where(is_outlier[:, None], np.nan, view.pixels)
        views.append(replace(view, pixels=pixels))
    outliers.sort(key=lambda told: -told["missed_px"])
    return replace(bundle, views=tuple(views)), outliers


# --- Moving cameras ---------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _Mounted:
    """A moving camera on its tracker."""

    camera: Camera
    mount: Mount
    told: dict[str, Any]


def _mount(
    boards: Sequence[Board],
    seen: Observations,
    lens: FittedLens,
    track: Mapping[int, Pose],
    solved: "_Solved | None",
) -> _Mounted:
    world_from_board = None if solved is None else _still_boards(boards, seen, solved)
    mount, told = mount_camera(lens.camera, boards, seen.sightings, track, world_from_board)
    # A moving camera stands in the rig where it was in the middle of its clip.
    middle = mount.cam_from_world(track[told["middle_instant"]])
    return _Mounted(replace(lens.camera, cam_from_world=middle), mount, told)


def _still_boards(
    boards: Sequence[Board], seen: Observations, solved: "_Solved"
) -> dict[int, Pose]:
    """Return where the boards lie that were still in the clip of the fixed cameras."""
    bundle = solved.adjusted.bundle
    found: dict[int, Pose] = {}
    for view in bundle.views:
        instants = {
            name[0]
            for index, name in enumerate(solved.linked.pose_names)
            if isinstance(name[0], int) and name[1] == solved.linked.pose_names[view.pose][1]
        }
        if isinstance(solved.linked.pose_names[view.pose][0], int) and len(instants) == 1:
            rig_from_board = compose(
                bundle.rig_from_body[view.pose], bundle.body_from_board[view.board]
            )
            found[view.board] = compose(solved.world_from_rig, rig_from_board)
    if not found:
        raise CalibrationError(
            f"camera {seen.name!r} moves: the board must lie still in the clips of all cameras, "
            "so that its place is known; record such a clip"
        )
    return found


# --- What is told -----------------------------------------------------------------------------


def _put_together(
    boards: Sequence[Board],
    observations: Sequence[Observations],
    lenses: Sequence[FittedLens],
    solved: _Solved | None,
    mounted: Sequence[_Mounted],
    about: dict[str, Any],
    settings: CalibrationSettings,
) -> Calibration:
    cameras = (() if solved is None else solved.cameras) + tuple(one.camera for one in mounted)
    pixels: dict[str, NDArray[np.float64]] = {}
    residuals: dict[str, NDArray[np.float64]] = {}
    views: Sequence[tuple[BundleView, NDArray[np.float64]]] = ()
    if solved is not None:
        views = list(zip(solved.adjusted.bundle.views, solved.adjusted.residuals_px, strict=True))
    told = {}
    for index, (seen, lens) in enumerate(zip(observations, lenses, strict=True)):
        own = [(view, missed) for view, missed in views if view.camera == index]
        clip = [
            missed
            for view, missed in own
            if solved is not None and isinstance(solved.linked.pose_names[view.pose][0], int)
        ]
        alone = [
            missed
            for view, missed in own
            if solved is not None and isinstance(solved.linked.pose_names[view.pose][0], str)
        ]
        if own:
            every = np.concatenate([missed for _, missed in own])
            found = is_seen(every)
            residuals[seen.name] = every[found]
            pixels[seen.name] = np.concatenate([view.pixels for view, _ in own])[found]
        told[seen.name] = _told_of_camera(boards, seen, lens, alone, clip)
    for one in mounted:
        told[one.camera.name]["mount"] = one.told
    noise = (
        solved.noise
        if solved is not None
        else Noise(lenses[0].noise_px, lenses[0].noise_px, lenses[0].rms_px, 1.0, 0, 0)
    )
    provenance: dict[str, Any] = {
        "method": "joint bundle adjustment of lenses, poses and boards",
        "software": {
            name: importlib.metadata.version(name)
            for name in ("hybridve", "pycolmap", "opencv-python-headless")
        },
        "boards": [{"name": board.name, "body": board.body, "is": str(board)} for board in boards],
        "rms_px": round(noise.rms_px, 4),
        "noise": asdict(noise),
        "cameras": told,
        **about,
        "settings": {"lens": asdict(settings.lens), "observe": asdict(settings.observe)},
    }
    if solved is not None:
        provenance["adjustment"] = {
            "steps": solved.adjusted.n_steps,
            "views": len(views),
            "outliers": len(solved.outliers),
            "worst_outliers": solved.outliers[:_TOLD_OUTLIERS],
            "left_out": dict(solved.linked.left_out),
            "warnings": list(solved.linked.warnings),
        }
    rig = Rig(
        cameras,
        provenance,
        covariance=_whole_covariance(solved, mounted),
        mounts={one.camera.name: one.mount for one in mounted},
    )
    return Calibration(rig, noise, pixels, residuals)


def _whole_covariance(solved: _Solved | None, mounted: Sequence[_Mounted]) -> RigCovariance:
    """Return the covariance of all cameras; moving ones are independent, their lenses as given.

    The pose of a moving camera is that at one instant.
    """
    labels = () if solved is None else solved.covariance.labels
    blocks = [] if solved is None else [solved.covariance.matrix]
    for one in mounted:
        names = camera_parameter_names(one.camera)
        labels += tuple(f"{one.camera.name} {name}" for name in names)
        block = np.zeros((len(names), len(names)))
        block[:POSE, :POSE] = one.told["pose_covariance"]
        blocks.append((block + block.T) / 2.0)
    size = sum(map(len, blocks))
    matrix = np.zeros((size, size))
    position = 0
    for block in blocks:
        span = slice(position, position + len(block))
        matrix[span, span] = block
        position += len(block)
    return RigCovariance(labels, matrix)


def _told_of_camera(
    boards: Sequence[Board],
    seen: Observations,
    lens: FittedLens,
    stills: Sequence[NDArray[np.float64]],
    clip: Sequence[NDArray[np.float64]],
) -> dict[str, Any]:
    """Return where one camera's numbers come from, as plain JSON values."""
    extrinsics = {
        "source": seen.sources.get("extrinsics"),
        "corners_by_hand": seen.sources.get("corners"),
        **_errors(clip),
        "how": seen.how,
    }
    if seen.spread_px is not None and np.isfinite(seen.spread_px):
        extrinsics["spread_over_clip_px"] = round(seen.spread_px, 4)
    other_tilt = _other_tilt(boards, lens.camera, seen) if seen.is_still else None
    if other_tilt is not None:
        extrinsics["other_tilt_times_worse"] = round(other_tilt, 2)
    told: dict[str, Any] = {
        "model": lens.camera.model,
        "intrinsics": {
            "source": seen.sources.get("intrinsics"),
            **_errors(stills),
            "views_dropped": lens.dropped,
            "views_without_board": seen.missed,
            "outliers": len(lens.outliers),
        },
        "extrinsics": extrinsics,
        "warnings": list(lens.warnings),
        "notes": list(seen.notes),
    }
    if lens.choice is not None:
        told["model_chosen"] = lens.choice
    return told


def _errors(residuals: Sequence[NDArray[np.float64]]) -> dict[str, Any]:
    if not residuals:
        return {"views_used": 0, "rms_px": None, "max_px": None}
    every = np.concatenate(residuals)
    every = every[is_seen(every)]
    return {
        "views_used": len(residuals),
        "rms_px": round(rms(every), 4),
        "max_px": round(float(np.linalg.norm(every, axis=1).max()), 3),
    }
