"""What a calibration tells: the rig, and as plain values where its numbers come from."""

import importlib.metadata
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.boards.board import Board, Observations, is_seen
from hybridve.calib.judging.certificate import NO_BOARDS, SeenPoints, working_volume
from hybridve.calib.placing.fixed_cameras import Solved, other_tilt
from hybridve.calib.placing.moments import PoseKey
from hybridve.calib.placing.moving_cameras import Mounted
from hybridve.calib.placing.settings import CalibrationSettings
from hybridve.calib.pose import compose, transform
from hybridve.calib.record import (
    METHOD,
    Adjustment,
    BoardRecord,
    CalibrationRecord,
    CameraRecord,
    ClipRecord,
    ClocksRecord,
    MountRecord,
    Noise,
    StillsRecord,
)
from hybridve.calib.rig import Rig, RigCovariance
from hybridve.calib.solving.bundle import POSE, BundleView
from hybridve.calib.solving.covariance import camera_parameter_names
from hybridve.calib.solving.lens_fit import FittedLens
from hybridve.calib.solving.locate import rms
from hybridve.calib.solving.second_opinion import second_opinion

#: Outliers that are listed one by one.
_TOLD_OUTLIERS = 50


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """A rig and what it was made from.

    Attributes
    ----------
    rig : Rig
        With its covariance; its provenance is `record`.
    record : CalibrationRecord
        Errors per camera, what was decided, dropped and doubted, and why.
    seen : dict of str to SeenPoints
        By camera all points that were used, and by how much the rig misses them.
    boards_world : (K, 3) float64
        Where points of boards were that two cameras or more saw at once, metres.
    """

    rig: Rig
    record: CalibrationRecord
    seen: dict[str, SeenPoints]
    boards_world: NDArray[np.float64]


def put_together(
    boards: Sequence[Board],
    observations: Sequence[Observations],
    lenses: Sequence[FittedLens],
    solved: Solved | None,
    mounted: Sequence[Mounted],
    clocks: ClocksRecord | None,
    settings: CalibrationSettings,
) -> Calibration:
    """Return a calibration from its parts.

    Parameters
    ----------
    boards : sequence of Board
        The boards; sightings count them.
    observations, lenses : sequence of Observations, sequence of FittedLens
        Of the fixed cameras, then of the moving ones.
    solved : Solved or None
        The fixed cameras, if there are any.
    mounted : sequence of Mounted
        The moving ones.
    clocks : ClocksRecord or None
        By how much the fixed ones were late, if that was asked.
    settings : CalibrationSettings
        How it was done.
    """
    cameras = (() if solved is None else solved.cameras) + tuple(one.camera for one in mounted)
    used: dict[str, SeenPoints] = {}
    views: Sequence[tuple[BundleView, NDArray[np.float64]]] = ()
    keys: Sequence[PoseKey] = ()
    if solved is not None:
        keys = solved.linked.pose_keys
        views = list(zip(solved.adjusted.bundle.views, solved.adjusted.residuals_px, strict=True))
    told: dict[str, CameraRecord] = {}
    mounts = {one.camera.name: one.told for one in mounted}
    for index, (seen, lens) in enumerate(zip(observations, lenses, strict=True)):
        own = [(view, missed) for view, missed in views if view.camera == index]
        clip = [missed for view, missed in own if keys[view.pose].moment.is_clip]
        alone = [missed for view, missed in own if not keys[view.pose].moment.is_clip]
        if own:
            every = np.concatenate([missed for _, missed in own])
            found = is_seen(every)
            pixels = np.concatenate([view.pixels for view, _ in own])
            used[seen.name] = SeenPoints(pixels[found], every[found])
        told[seen.name] = _told_of_camera(boards, seen, lens, alone, clip, mounts.get(seen.name))
    noise = (
        solved.noise
        if solved is not None
        else Noise(lenses[0].noise_px, lenses[0].noise_px, lenses[0].rms_px, 1.0, 0, 0)
    )
    rig = Rig(
        cameras,
        covariance=_whole_covariance(solved, mounted),
        mounts={one.camera.name: one.mount for one in mounted},
    )
    opinion = None
    boards_world = NO_BOARDS
    if solved is not None:
        boards_world = _common_boards(solved)
        volume = working_volume(rig, boards_world, settings.box_world)
        opinion = second_opinion(rig, solved.second, volume.points_world)
    record = CalibrationRecord(
        method=METHOD,
        software={
            name: importlib.metadata.version(name)
            for name in ("hybridve", "pycolmap", "opencv-python-headless")
        },
        boards=tuple(BoardRecord(board.name, board.body, str(board)) for board in boards),
        rms_px=round(noise.rms_px, 4),
        noise=noise,
        cameras=told,
        clocks=clocks,
        labelling=None if solved is None else solved.labelling,
        noise_by_group=None if solved is None else solved.noise_by_group,
        world=None if solved is None else solved.world,
        settings={"lens": asdict(settings.lens), "observe": asdict(settings.observe)},
        adjustment=None if solved is None else _told_of_adjustment(solved),
        second_opinion=opinion,
    )
    return Calibration(replace(rig, provenance=record), record, used, boards_world)


def _common_boards(solved: Solved) -> NDArray[np.float64]:
    """Return the points (K, 3), world, of boards that two cameras or more saw at once."""
    bundle = solved.adjusted.bundle
    cameras_of: defaultdict[tuple[int, int], set[int]] = defaultdict(set)
    for view in bundle.views:
        cameras_of[view.pose, view.board].add(view.camera)
    places = [NO_BOARDS]
    for (pose, board), cameras in cameras_of.items():
        if len(cameras) > 1:
            rig_from_board = compose(bundle.rig_from_body[pose], bundle.body_from_board[board])
            world_from_board = compose(solved.world_from_rig, rig_from_board)
            places.append(transform(world_from_board, bundle.points_board[board]))
    return np.concatenate(places)


def _told_of_adjustment(solved: Solved) -> Adjustment:
    return Adjustment(
        steps=solved.adjusted.n_steps,
        views=len(solved.adjusted.bundle.views),
        outliers=len(solved.outliers),
        worst_outliers=tuple(solved.outliers[:_TOLD_OUTLIERS]),
        left_out=dict(solved.linked.left_out),
        warnings=tuple(solved.linked.warnings),
        start=solved.start,
    )


def _whole_covariance(solved: Solved | None, mounted: Sequence[Mounted]) -> RigCovariance:
    """Return the covariance of all cameras; moving ones are independent, their lenses as given.

    The pose of a moving camera is that at one instant.
    """
    labels = () if solved is None else solved.covariance.labels
    blocks = [] if solved is None else [solved.covariance.matrix]
    for one in mounted:
        names = camera_parameter_names(one.camera)
        labels += tuple(f"{one.camera.name} {name}" for name in names)
        block = np.zeros((len(names), len(names)))
        block[:POSE, :POSE] = one.told.pose_covariance
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
    mount: MountRecord | None,
) -> CameraRecord:
    """Return where one camera's numbers come from."""
    spread_px = seen.spread_px
    if spread_px is not None:
        spread_px = round(spread_px, 4) if np.isfinite(spread_px) else None
    tilt = other_tilt(boards, lens.camera, seen) if seen.is_still else None
    stills_rms_px, stills_max_px = _errors(stills)
    clip_rms_px, clip_max_px = _errors(clip)
    return CameraRecord(
        model=lens.camera.model,
        intrinsics=StillsRecord(
            source=seen.sources.get("intrinsics"),
            views_used=len(stills),
            rms_px=stills_rms_px,
            max_px=stills_max_px,
            views_dropped=lens.dropped,
            views_without_board=seen.missed,
            outliers=len(lens.outliers),
        ),
        extrinsics=ClipRecord(
            source=seen.sources.get("extrinsics"),
            corners_by_hand=seen.sources.get("corners"),
            views_used=len(clip),
            rms_px=clip_rms_px,
            max_px=clip_max_px,
            how=seen.how,
            spread_over_clip_px=spread_px,
            other_tilt_times_worse=None if tilt is None else round(tilt, 2),
        ),
        warnings=tuple(lens.warnings),
        notes=tuple(seen.notes),
        model_chosen=lens.choice,
        mount=mount,
    )


def _errors(residuals: Sequence[NDArray[np.float64]]) -> tuple[float | None, float | None]:
    """Return the rms and the largest length of residuals (N, 2) of views, pixels, rounded."""
    if not residuals:
        return None, None
    every = np.concatenate(residuals)
    every = every[is_seen(every)]
    return round(rms(every), 4), round(float(np.linalg.norm(every, axis=1).max()), 3)
