"""Fixed cameras in one world: linked, adjusted at once, with the errors that they may have.

::

    lenses, Observations -> labels -> linked cameras -> joint adjustment -> world -> covariance

COLMAP's adjustment comes first, wherever it can express what is to be adjusted; ours starts from
its answer, and adds the noise by kind of view, boards on bodies, shared lenses and the covariance.
"""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.boards.board import Board, Observations, is_seen
from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.placing.labelling import label_still_boards
from hybridve.calib.placing.link import Linked, link_cameras
from hybridve.calib.placing.marks import Mark
from hybridve.calib.placing.moments import Body, body_of
from hybridve.calib.placing.settings import CalibrationSettings, LensRequest
from hybridve.calib.placing.world import SeenBoards, place_world
from hybridve.calib.pose import Pose, compose, invert, moved_pose, nearest_rotation
from hybridve.calib.record import Labelling, Noise, Outlier, WorldRecord
from hybridve.calib.rig import Rig, RigCovariance
from hybridve.calib.solving.bundle import POSE, Adjusted, Bundle, BundleView, adjust
from hybridve.calib.solving.colmap_adjust import colmap_adjust
from hybridve.calib.solving.consensus import common_pose
from hybridve.calib.solving.covariance import even_covariance, in_world, rig_covariance
from hybridve.calib.solving.errors_in_space import parameter_slices
from hybridve.calib.solving.lens_fit import FittedLens
from hybridve.calib.solving.locate import locate_board, rms
from hybridve.calib.solving.noise import measure_group_noise, measure_noise

logger = logging.getLogger(__name__)

#: A point is an outlier of the joint adjustment if it misses by so many times the noise of its
#: camera (a normal error does so once in 300,000 points), and by more than this.
_OUTLIER_SIGMAS = 5.0
_OUTLIER_PX = 0.2

#: A still board that misses its lens by more than this after all is another camera's.
_WRONG_CLIP_PX = 5.0

#: Where the two poses that a plane allows differ in error by less than this factor, its tilt is
#: not determined.
_TILT_FACTOR = 1.5

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


@dataclass(frozen=True, slots=True, eq=False)
class Solved:
    """Fixed cameras in the world, what they were adjusted to, and what was decided on the way.

    `second` is the same rig as COLMAP's own adjustment has it, with the errors of that for the
    noise that was found; or why there is none, as a sentence. `start` says what ours started from.
    """

    adjusted: Adjusted
    linked: Linked
    noise: Noise
    cameras: tuple[Camera, ...]
    covariance: RigCovariance
    world_from_rig: Pose
    outliers: list[Outlier]
    noise_by_group: dict[str, Noise]
    labelling: Labelling | None
    world: WorldRecord
    second: Rig | str
    start: str


def solve_fixed(
    boards: Sequence[Board],
    observations: Sequence[Observations],
    lenses: Sequence[FittedLens],
    requests: Mapping[str, LensRequest],
    settings: CalibrationSettings,
    shares: Mapping[str, float],
) -> Solved:
    """Link fixed cameras, adjust them with all they saw, and place them in the world.

    Parameters
    ----------
    boards : sequence of Board
        The boards; sightings count them.
    observations, lenses : sequence of Observations, sequence of FittedLens
        Of the same cameras.
    requests : mapping of str to LensRequest
        By camera what is asked of its lens.
    settings : CalibrationSettings
        How it is done.
    shares : mapping of str to float
        By camera the noise of interpolated points by that of frames
        (`hybridve.calib.placing.clock.noise_shares`).

    Raises
    ------
    CalibrationError
        Naming the camera that cannot be linked, contradicts the others, or is under the floor.
    """
    is_still = all(seen.is_still for seen in observations)
    seen: Sequence[Observations] = observations
    labelling = None
    if is_still:
        cameras = [lens.camera for lens in lenses]
        seen, labelling = label_still_boards(boards, cameras, observations)
        _warn_of_flat_views(boards, cameras, seen)
    elif any(len(board.looks) > 1 for board in boards):
        looks = max(len(board.looks) for board in boards)
        labelling = Labelling(looks=looks, decided_by="poses common to all frames")
    linked = link_cameras(boards, lenses, seen, is_labelled=is_still)
    bundle = make_bundle(boards, lenses, linked, requests)
    first = colmap_adjust(bundle, settings.lens.loss_px)
    rough = adjust(bundle if isinstance(first, str) else first, settings.lens.loss_px)
    if is_still:
        _refuse_wrong_clips(rough, linked)
    linked = replace(
        linked, warnings=(*linked.warnings, *_disagreeing(boards, lenses, linked, rough))
    )
    cleaned, outliers = without_outliers(rough)
    theirs = colmap_adjust(cleaned)
    adjusted, noise, groups = adjust_weighed(
        cleaned if isinstance(theirs, str) else theirs, linked, shares
    )
    placed = place_world(
        settings.world,
        adjusted.bundle.cameras,
        _seen_boards(boards, linked, adjusted.bundle),
        settings.marks,
    )
    for warning in placed.told.warnings:
        logger.warning("%s", warning)
    in_the_world = _in_world(adjusted.bundle.cameras, placed.world_from_rig)
    covariance, even = rig_covariance(adjusted, 1.0), even_covariance(adjusted.bundle)
    if settings.world != "board":
        # The board is held, and so without error; a world found by the cameras shares theirs. Both
        # adjustments have the same clicks.
        by_parameter, of_clicks = _world_errors(
            boards, linked, adjusted.bundle, covariance, settings
        )
        covariance = in_world(covariance, in_the_world, by_parameter, of_clicks)
        even = in_world(even, in_the_world, by_parameter, np.zeros_like(of_clicks))
    second: Rig | str
    if isinstance(theirs, str):
        second = theirs
    else:
        world_from_rig = _world_of(boards, linked, theirs, settings, placed.world_from_rig)
        second = Rig(_in_world(theirs.cameras, world_from_rig), covariance=even)
    return Solved(
        adjusted,
        linked,
        noise,
        in_the_world,
        covariance,
        placed.world_from_rig,
        outliers,
        groups,
        labelling,
        placed.told,
        second,
        f"linked cameras: {first}" if isinstance(first, str) else "COLMAP's adjustment",
    )


def _in_world(cameras: Sequence[Camera], world_from_rig: Pose) -> tuple[Camera, ...]:
    rig_from_world = invert(world_from_rig)
    return tuple(
        replace(camera, cam_from_world=_rigid(compose(camera.cam_from_world, rig_from_world)))
        for camera in cameras
    )


def _world_of(
    boards: Sequence[Board],
    linked: Linked,
    bundle: Bundle,
    settings: CalibrationSettings,
    otherwise: Pose,
) -> Pose:
    """Return the world that another adjustment has; where it has none, as we have it."""
    seen = _seen_boards(boards, linked, bundle)
    try:
        return place_world(settings.world, bundle.cameras, seen, settings.marks).world_from_rig
    except CalibrationError:
        return otherwise  # a camera under the floor: it shows in the comparison


def adjust_weighed(
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
        if linked.pose_keys[view.pose].moment.is_clip
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
        boards, bundle.body_from_board, bundle.rig_from_body, linked.pose_keys, bundle.views
    )


def make_bundle(
    boards: Sequence[Board],
    lenses: Sequence[FittedLens],
    linked: Linked,
    requests: Mapping[str, LensRequest],
) -> Bundle:
    """Return the start of the joint adjustment; its frame is that of the body most cameras saw.

    Poses of bodies from all cameras at once (COLMAP's generalized absolute pose) start nearer, by
    an eighth to a third of the residuals, but take longer than the steps of COLMAP's adjustment,
    of which they save none.
    """
    held, _, _ = SeenBoards(
        boards, linked.body_from_board, linked.rig_from_body, linked.pose_keys, linked.views
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
    bodies: dict[Body, int] = {}
    for index, board in enumerate(boards):
        bodies.setdefault(body_of(board), index)
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
    return np.column_stack([nearest_rotation(pose[:, :3]), pose[:, 3]])


def _refuse_wrong_clips(rough: Adjusted, linked: Linked) -> None:
    for view, missed in zip(rough.bundle.views, rough.residuals_px, strict=True):
        missed_px = rms(missed[is_seen(missed)])
        is_clip = linked.pose_keys[view.pose].moment.is_clip
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
        if linked.pose_keys[view.pose].moment.is_clip:
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
        if located is not None and linked.pose_keys[view.pose].moment.is_clip:
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
        factor = other_tilt(boards, camera, seen)
        if factor is not None and factor < _TILT_FACTOR:
            logger.warning(
                "camera %s: the board clip hardly tells how the board is tilted (the other tilt "
                "fits %.1f times worse); use a larger board or bring it nearer",
                camera.name,
                factor,
            )


def other_tilt(boards: Sequence[Board], camera: Camera, seen: Observations) -> float | None:
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


def without_outliers(rough: Adjusted) -> tuple[Bundle, list[Outlier]]:
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
    outliers: list[Outlier] = []
    for view, residuals in zip(bundle.views, rough.residuals_px, strict=True):
        misses_px = np.linalg.norm(residuals, axis=1)
        with np.errstate(invalid="ignore"):
            is_outlier = misses_px > limits_px[view.camera]
        if is_outlier.sum() > len(residuals) / 4:
            is_outlier[:] = False  # a whole view is judged by its lens and by the other views
        outliers += [
            Outlier(
                bundle.cameras[view.camera].name,
                view.image,
                view.board,
                int(point),
                round(float(misses_px[point]), 2),
            )
            for point in np.flatnonzero(is_outlier)
        ]
        pixels = np.where(is_outlier[:, None], np.nan, view.pixels)
        views.append(replace(view, pixels=pixels))
    outliers.sort(key=lambda told: -told.missed_px)
    return replace(bundle, views=tuple(views)), outliers
