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

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from hybridve.calib.boards.board import Board, Observations, is_seen
from hybridve.calib.camera import N_PARAMS
from hybridve.calib.errors import CalibrationError
from hybridve.calib.image_io import natural_order
from hybridve.calib.judging.account import Calibration, put_together
from hybridve.calib.placing.board_tracks import noise_shares
from hybridve.calib.placing.clock import estimate_offsets, resampled
from hybridve.calib.placing.fixed_cameras import make_bundle, solve_fixed
from hybridve.calib.placing.link import link_cameras
from hybridve.calib.placing.moving_cameras import mount
from hybridve.calib.placing.settings import CalibrationSettings, LensRequest
from hybridve.calib.pose import Pose
from hybridve.calib.record import ClocksRecord
from hybridve.calib.seeing.corner_cache import CornerCache
from hybridve.calib.seeing.inputs import CameraInput
from hybridve.calib.seeing.observe import observe_boards
from hybridve.calib.solving.bundle import adjust
from hybridve.calib.solving.lens_choice import choose_shared_lens
from hybridve.calib.solving.lens_fit import FittedLens, LensSettings, fit_shared_lens

logger = logging.getLogger(__name__)

Progress = Callable[[str, int, int], None]

#: A lens whose model is chosen by its views.
AUTO_MODEL = "auto"

#: Points that lie outside the image (found there, or marked): a larger share is a mistake.
_OUTSIDE = 0.1

_DEFAULTS = CalibrationSettings()


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
    clocks = None
    shares: dict[str, float] = {}
    if settings.sync == "estimate" and fixed:
        fixed, shares, clocks = _synchronised(boards, fixed, settings, requests)
    lenses = _fit_lenses(boards, [*fixed, *moving], settings.lens, requests, report)
    report("adjusting everything", 0, 1)
    solved = None
    if fixed:
        solved = solve_fixed(boards, fixed, lenses[: len(fixed)], requests, settings, shares)
    mounted = [
        mount(boards, seen, lens, tracks[seen.name], solved)
        for seen, lens in zip(moving, lenses[len(fixed) :], strict=True)
    ]
    calibration = put_together(boards, [*fixed, *moving], lenses, solved, mounted, clocks, settings)
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
) -> tuple[list[Observations], dict[str, float], ClocksRecord]:
    """Return observations as clocks that agree would have made them, and their `noise_shares`.

    Also returns by how much the clocks were found to be late.
    """
    if all(seen.is_still for seen in observations):
        raise CalibrationError(
            "the cameras' clocks cannot be compared: the boards lie still in the clip; record a "
            'board that is moved about, or say sync = "given"'
        )
    lenses = _fit_lenses(boards, observations, settings.lens, requests, _no_progress)
    clocks = estimate_offsets(boards, [lens.camera for lens in lenses], observations)
    if any(known for name, known in clocks.is_known.items() if name != clocks.reference):
        # A lens that one camera tells alone is a little wrong, and bends the board's path in time.
        # All cameras together, once they agree, tell lenses better, and these the offsets.
        in_time = resampled(observations, clocks.offset_frames, boards)
        lenses = _fit_lenses(boards, in_time, settings.lens, requests, _no_progress)
        linked = link_cameras(boards, lenses, in_time, is_labelled=False)
        rough = adjust(make_bundle(boards, lenses, linked, requests), settings.lens.loss_px)
        lenses = [
            replace(lens, camera=replace(camera, cam_from_world=lens.camera.cam_from_world))
            for lens, camera in zip(lenses, rough.bundle.cameras, strict=True)
        ]
        clocks = estimate_offsets(boards, [lens.camera for lens in lenses], observations)
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
    advice = None
    if late:
        advice = (
            f"frames by which cameras are later than {clocks.reference}: {', '.join(late)}; these "
            "hold for the board clip; where they hold for the recording, say "
            "offset_s = frames / fps"
        )
        logger.info("clocks: %s", advice)
    return (
        resampled(observations, clocks.offset_frames, boards),
        noise_shares(observations, clocks.offset_frames),
        ClocksRecord(
            reference=clocks.reference,
            offset_frames=_rounded(clocks.offset_frames),
            std_frames=_rounded(clocks.std_frames),
            notes=clocks.notes,
            views_left_out=clocks.left_out,
            advice=advice,
        ),
    )


def _rounded(frames: Mapping[str, float]) -> dict[str, float | None]:
    return {
        name: round(number, 4) if np.isfinite(number) else None for name, number in frames.items()
    }
