"""By how much cameras are out of time, told by a board that moves before them.

A camera's *offset* is how many frames late its clock is: its frame k was recorded when the
session's frame ``k + offset`` was. (A session's ``offset_s`` is the same in seconds.) The clock of
the first camera, by name, is the session's.

Whole frames are found by trying them: with the right one, two cameras have the same relative pose
at all instants. Fractions follow from a least-squares fit of the offsets, the cameras' poses and
the board's pose at each instant: the corners that a camera saw at the session's instants are
interpolated on their tracks, by cubics through four frames, and moved as the offsets change. Only
where the board moves does a frame's place in time show; constant speed in one direction looks like
another place of the camera, and shows nothing either. What cannot be told is NaN.

This work is based on: Albl, Kukelova, Fitzgibbon, Heller, Smid and Pajdla, *On the two-view
geometry of unsynchronized cameras*, CVPR 2017 (image tracks linearised in time); Rehder, Siegwart
and Furgale, *A general approach to spatiotemporal calibration in multisensor systems*, IEEE Trans.
Robotics 32(2), 2016 (the offset as one more parameter of the adjustment).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, pairwise
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.boards.board import Board, Observations, Sighting, is_seen
from hybridve.calib.camera import Camera
from hybridve.calib.lens import cam_from_img
from hybridve.calib.pose import Pose, compose, invert
from hybridve.calib.solving.consensus import common_pose, pose_distances
from hybridve.calib.solving.lens_fit import locate_board

#: Offsets tried, and common instants from which each is judged.
_MAX_OFFSET_FRAMES = 25
_JUDGED = 40
_MIN_COMMON = 6

#: Common views that differ by more than this (radians plus shares of distance) are not in time at
#: all, or not of one board.
_DISAGREE = 0.2

#: Instants adjusted together at most.
_MAX_INSTANTS = 80

#: Steps of the adjustment; it has converged when no offset moves further (frames).
_MAX_STEPS = 30
_CONVERGED_FRAMES = 1e-8

#: Residuals beyond this many robust standard deviations weigh less than squared.
_LOSS_SIGMAS = 3.0

#: The least share of the corners' speed (mean square) that must be motion rather than noise: of all
#: of it, and of that which tells an offset; the mean square, (pixels a frame) squared, of no motion
#: at all; and the largest standard deviation of an offset that counts as known, frames.
_MIN_MOTION = 0.75
_MIN_TELLING = 0.5
_STILL = 1e-12
_KNOWN_FRAMES = 0.25

#: A view is off its path if its corners, in the median, are further from a cubic through four
#: frames around it than all of these: so many times what the best tenth are (the noise), so much of
#: a step from frame to frame (a swing to and fro within 6 frames), and pixels.
_USUAL = 0.1
_JUMP_USUAL = 20.0
_JUMP_STEPS = 0.15
_JUMP_PX = 1.0

#: Views of the path are looked for so many frames away, and must have so many points in common. By
#: `_PATH_GAIN` the variance of noise grows where a view is compared with its four neighbours; where
#: noise grows more, up to so many times more is allowed for.
_PATH_REACH = 8
_PATH_POINTS = 4
_PATH_GAIN = 1.0 + 34.0 / 36.0
_MAX_GAIN = 3.0


class SolvedLens(Protocol):
    """What is needed of a lens that was fitted to the views of one camera."""

    @property
    def camera(self) -> Camera:
        """The lens; its pose is not used."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Clocks:
    """How late the cameras are.

    Attributes
    ----------
    reference : str
        The camera whose clock is the session's.
    offset_frames : dict of str to float
        By camera: its frame k was recorded at the session's frame ``k + offset``. NaN: unknown.
    std_frames : dict of str to float
        Standard deviations; 0 for the reference, NaN where the offset is unknown.
    is_known : dict of str to bool
        Whether the offset is known to a quarter of a frame.
    rms_px : float
        Of the corners that the offsets were fitted to; NaN where none were.
    notes : tuple of str
        Why an offset is not known.
    left_out : dict of str to tuple of int
        By camera the instants at which a board, all of it, is far off its path through the frames
        before and after; nothing was told by these.
    """

    reference: str
    offset_frames: dict[str, float]
    std_frames: dict[str, float]
    is_known: dict[str, bool]
    rms_px: float
    notes: tuple[str, ...] = ()
    left_out: dict[str, tuple[int, ...]] = field(default_factory=dict)


#: By board and instant the points that a camera saw: (N, 2), pixels or rays.
_Tracks = dict[tuple[int, int], NDArray[np.float64]]


def estimate_offsets(
    boards: Sequence[Board],
    lenses: Sequence[SolvedLens],
    observations: Sequence[Observations],
    max_offset_frames: int = _MAX_OFFSET_FRAMES,
) -> Clocks:
    """Estimate how late each camera is, from a clip in which boards move before all of them.

    Parameters
    ----------
    boards : sequence of Board
        The boards.
    lenses : sequence of SolvedLens
        The lenses of the cameras.
    observations : sequence of Observations
        What the same cameras saw, in order of their names; every frame of the clip, so that
        neighbours can be interpolated.
    max_offset_frames : int
        The largest offset between two cameras that is looked for.
    """
    names = [seen.name for seen in observations]
    n_cameras = len(names)
    offsets, stds = np.full(n_cameras, np.nan), np.full(n_cameras, np.nan)
    offsets[0] = stds[0] = 0.0
    notes: dict[int, str] = {}
    left_out: dict[str, tuple[int, ...]] = dict.fromkeys(names, ())
    rms_px = np.nan
    if any(seen.is_still for seen in observations):
        notes |= dict.fromkeys(range(1, n_cameras), "the boards lie still in the clip")
    elif n_cameras > 1:
        cameras = [lens.camera for lens in lenses]
        tracks = [_tracks(seen.sightings) for seen in observations]
        spacing = _spacing(tracks)
        tracks = [_listed_alike(boards, track, spacing) for track in tracks]
        for camera, track in enumerate(tracks):
            jumped = _jumped(track, spacing)
            left_out[names[camera]] = tuple(sorted({instant for _, instant in jumped}))
            tracks[camera] = {key: track[key] for key in track if key not in jumped}
        poses = [_located(boards, *pair) for pair in zip(cameras, tracks, strict=True)]
        start = _start(boards, poses, spacing, max_offset_frames)
        for index in range(1, n_cameras):
            if index not in start:
                notes[index] = (
                    "it shares no run of frames with the others in which their views of a board "
                    "agree on where the cameras stand"
                )
        problem = _Problem.of(boards, cameras, tracks, poses, start, spacing)
        if problem is None:
            notes |= dict.fromkeys(
                start.keys() - {0}, "too few neighbouring frames show a board to two cameras"
            )
        else:
            found = problem.solve()
            rms_px = found.rms_px
            for index in sorted(start.keys() - {0}):
                std = found.std_frames[index]
                if found.motion[index] < _MIN_MOTION:
                    notes[index] = "the board hardly moves before it"
                elif not (std < _KNOWN_FRAMES and found.telling[index] > _MIN_TELLING):
                    notes[index] = (
                        "the board's motion does not tell it: move it to and fro, and turn it"
                    )
                else:
                    offsets[index], stds[index] = found.offset_frames[index], std
    return Clocks(
        names[0],
        {name: float(offset) for name, offset in zip(names, offsets, strict=True)},
        {name: float(std) for name, std in zip(names, stds, strict=True)},
        {name: bool(np.isfinite(offset)) for name, offset in zip(names, offsets, strict=True)},
        rms_px,
        tuple(
            f"camera {names[index]!r}: its offset in time cannot be told: {why}"
            for index, why in sorted(notes.items())
        ),
        left_out,
    )


def resampled(
    observations: Sequence[Observations],
    offset_frames: Mapping[str, float],
    boards: Sequence[Board] | None = None,
) -> list[Observations]:
    """Return what the cameras would have seen of moving boards, had their clocks been right.

    Corners are interpolated by cubics through four neighbouring frames, where these were seen, and
    none of them is off the path of the others; other sightings in the clip are left out. Stills,
    still clips and cameras without offset stay.

    Parameters
    ----------
    observations : sequence of Observations
        What the cameras saw.
    offset_frames : mapping of str to float
        As `Clocks.offset_frames`; cameras that are not named, or NaN, are taken to be in time.
    boards : sequence of Board, optional
        The boards: where one looks the same when turned, neighbouring frames may list it from
        different ends, and are then listed alike.
    """
    instants = sorted(
        {s.instant for seen in observations for s in seen.sightings if s.instant is not None}
    )
    spacing = _spacing([_tracks(seen.sightings) for seen in observations])
    found = []
    for seen in observations:
        offset = offset_frames.get(seen.name, 0.0)
        if seen.is_still or not np.isfinite(offset) or offset == 0.0:
            found.append(seen)
            continue
        tracks = _tracks(seen.sightings)
        if boards is not None:
            tracks = _listed_alike(boards, tracks, spacing)
        jumped = _jumped(tracks, spacing)
        tracks = {key: tracks[key] for key in tracks if key not in jumped}
        stills = tuple(s for s in seen.sightings if s.instant is None)
        moved = []
        for instant in instants:
            for board in sorted({board for board, _ in tracks}):
                track = _interpolated(tracks, board, instant - offset, spacing)
                if track is not None:
                    image = f"board clip, instant {instant}"
                    moved.append(Sighting(image, instant, board, track.points))
        found.append(replace(seen, sightings=(*stills, *moved)))
    return found


def noise_shares(
    observations: Sequence[Observations], offset_frames: Mapping[str, float]
) -> dict[str, float]:
    """Return by camera the variance of noise in `resampled` points, that in its frames being 1.

    Interpolated points are less noisy than those of frames, but neighbours share their noise: all
    together they tell no more than the frames do. Where they are taken for independent, as all
    pictures are, their noise must be taken to be that of the frames.

    Parameters
    ----------
    observations : sequence of Observations
        What the cameras saw, not resampled.
    offset_frames : mapping of str to float
        As for `resampled`.
    """
    spacing = _spacing([_tracks(seen.sightings) for seen in observations])
    shares = {}
    for seen in observations:
        offset = offset_frames.get(seen.name, 0.0)
        is_moved = not seen.is_still and np.isfinite(offset)
        weights, _ = _cubic((-offset / spacing) % 1.0 if is_moved else 0.0)
        shares[seen.name] = float((weights**2).sum())
    return shares


# --- Tracks ----------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _Interpolated:
    """Points (N, 2) between frames, their speed a frame, and what becomes of noise in both.

    The points are the sum of those in `frames`, by `weights`. Noise of variance 1 in the frames
    becomes `noise` in the points, `speed_noise` in the speed, and makes the two covary by
    `common_noise`.
    """

    points: NDArray[np.float64]
    speed: NDArray[np.float64]
    frames: tuple[int, ...]
    weights: NDArray[np.float64]
    noise: float
    speed_noise: float
    common_noise: float


def _tracks(sightings: Sequence[Sighting]) -> _Tracks:
    """Return by board and instant what was seen in the clip."""
    return {(s.board, s.instant): s.pixels for s in sightings if s.instant is not None}


def _listed_alike(boards: Sequence[Board], tracks: _Tracks, spacing: int) -> _Tracks:
    """List boards that look the same when turned from frame to frame by the same end."""
    found: _Tracks = {}
    for board, instant in sorted(tracks):
        pixels, looks = tracks[board, instant], boards[board].looks
        before = found.get((board, instant - spacing))
        if before is not None and len(looks) > 1:
            moved = [_mean_distance(pixels[look], before) for look in looks]
            pixels = pixels[looks[int(np.argmin(moved))]]
        found[board, instant] = pixels
    return found


def _mean_distance(pixels: NDArray[np.float64], others: NDArray[np.float64]) -> float:
    both = is_seen(pixels) & is_seen(others)
    if not both.any():
        return np.inf
    return float(np.linalg.norm(pixels[both] - others[both], axis=1).mean())


def _spacing(tracks: Sequence[_Tracks]) -> int:
    """Return how many frames lie between neighbouring instants."""
    instants = sorted({instant for seen in tracks for _, instant in seen})
    return min((b - a for a, b in pairwise(instants)), default=1)


def _jumped(tracks: _Tracks, spacing: int) -> set[tuple[int, int]]:
    """Return the views, by board and instant, that are off the path of those around them."""
    jumped: set[tuple[int, int]] = set()
    for board in sorted({board for board, _ in tracks}):
        path = {instant: tracks[b, instant] for b, instant in sorted(tracks) if b == board}
        jumped |= {(board, instant) for instant in _off_path(path, spacing)}
    return jumped


def _off_path(path: Mapping[int, NDArray[np.float64]], spacing: int) -> set[int]:
    """Return the instants of a path at which the board was found elsewhere.

    A view between two frames before and two behind is on the path if it lies on the cubic through
    them. Of the others, most only have a neighbour that is off: they are on the path if they lie
    on the cubic through the nearest views that are. What cannot be judged stays.
    """
    around = [step * spacing for step in (-2, -1, 1, 2)]
    misses = {}
    for instant in path:
        nodes = tuple(instant + step for step in around)
        if all(node in path for node in nodes):
            misses[instant] = _miss(path, instant, nodes)
    found = [miss.length_px for miss in misses.values() if miss is not None]
    if not found:
        return set()
    least_px = max(_JUMP_USUAL * float(np.quantile(found, _USUAL)), _JUMP_PX)
    on = {t for t, miss in misses.items() if miss is not None and miss.is_small(least_px)}
    again: dict[tuple[int, ...], _Miss | None] = {}
    while True:
        best: tuple[float, int] | None = None
        for instant in sorted(path.keys() - on):
            near = [node for node in on if abs(node - instant) <= _PATH_REACH * spacing]
            if len(near) < len(around):
                continue
            nearest = sorted((abs(node - instant), node) for node in near)[: len(around)]
            nodes = tuple(sorted(node for _, node in nearest))
            if (instant, *nodes) not in again:
                again[instant, *nodes] = _miss(path, instant, nodes)
            misses[instant] = miss = again[instant, *nodes]
            if miss is not None and miss.is_small(least_px):
                best = (miss.gain, instant) if best is None else min(best, (miss.gain, instant))
        if best is None:
            return {t for t, miss in misses.items() if miss is not None and t not in on}
        on.add(best[1])  # the surest first: it may show others to be off


@dataclass(frozen=True, slots=True)
class _Miss:
    """By how much a view misses a cubic through four others, median over its points, pixels.

    `gain` says by how much more than between neighbours noise and acceleration show, `step_px` how
    far points move from frame to frame.
    """

    length_px: float
    gain: float
    step_px: float

    def is_small(self, least_px: float) -> bool:
        limit_px = max(least_px, _JUMP_STEPS * self.step_px)
        return self.length_px <= min(self.gain, _MAX_GAIN) * limit_px


def _miss(
    path: Mapping[int, NDArray[np.float64]], instant: int, nodes: Sequence[int]
) -> _Miss | None:
    """Compare a view with four others; None where they have few points in common."""
    weights = np.ones(len(nodes))
    for index, node in enumerate(nodes):
        for other in nodes:
            if other != node:
                weights[index] *= (instant - other) / (node - other)
    frames = np.stack([path[node] for node in nodes])
    missed = np.tensordot(weights, frames, axes=1) - path[instant]
    common = is_seen(missed)
    if common.sum() < _PATH_POINTS:
        return None
    steps = np.linalg.norm(np.median(np.diff(frames[:, common], axis=0), axis=1), axis=1)
    return _Miss(
        float(np.linalg.norm(np.median(missed[common], axis=0))),
        float(np.sqrt((1.0 + (weights**2).sum()) / _PATH_GAIN)),
        float(np.median(steps / np.diff(nodes))),
    )


def _interpolated(tracks: _Tracks, board: int, time: float, spacing: int) -> _Interpolated | None:
    """Return a board's points at a time between frames; None unless four frames around show it.

    Points that are not seen in all four are NaN. At a frame itself its own points are returned,
    without speed where the frames around do not show the board.
    """
    phase = next((instant % spacing for b, instant in tracks if b == board), 0)
    first = int(np.floor((time - phase) / spacing)) * spacing + phase
    nodes = [first + step * spacing for step in (-1, 0, 1, 2)]
    if any((board, node) not in tracks for node in nodes):
        if time != first or (board, first) not in tracks:
            return None
        alone = tracks[board, first]
        return _Interpolated(alone, np.zeros_like(alone), (first,), np.ones(1), 1.0, 0.0, 0.0)
    weights, slopes = _cubic((time - first) / spacing)
    frames = np.stack([tracks[board, node] for node in nodes])
    return _Interpolated(
        np.tensordot(weights, frames, axes=1),
        np.tensordot(slopes, frames, axes=1) / spacing,
        tuple(nodes),
        weights,
        float((weights**2).sum()),
        float((slopes**2).sum()) / spacing**2,
        float((weights * slopes).sum()) / spacing,
    )


def _cubic(share: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the weights (4,) of frames at -1, 0, 1, 2 for a cubic at `share`, and of its slope."""
    polynomials = np.array(  # Lagrange's, by powers of the share
        [
            [0.0, -1.0 / 3.0, 0.5, -1.0 / 6.0],
            [1.0, -0.5, -1.0, 0.5],
            [0.0, 1.0, 0.5, -0.5],
            [0.0, -1.0 / 6.0, 0.0, 1.0 / 6.0],
        ]
    )
    powers = share ** np.arange(4.0)
    slopes = np.array([0.0, 1.0, 2.0 * share, 3.0 * share**2])
    return polynomials @ powers, polynomials @ slopes


# --- Whole frames ----------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _Start:
    """A camera's offset to whole frames, and its pose against the reference."""

    offset: int
    cam_from_rig: Pose


def _located(
    boards: Sequence[Board], camera: Camera, tracks: _Tracks
) -> dict[tuple[int, int], Pose]:
    poses = {}
    for (board, instant), pixels in tracks.items():
        located = locate_board(camera, boards[board].points_board, pixels)
        if located is not None:
            poses[board, instant] = located[0]
    return poses


def _start(
    boards: Sequence[Board],
    poses: Sequence[Mapping[tuple[int, int], Pose]],
    spacing: int,
    max_offset: int,
) -> dict[int, _Start]:
    """Return offsets and poses of the cameras that can be reached from the first one.

    Pairs that share most frames go first; pairs of cameras that hang together already are spared.
    """
    views = [_Views.of(boards, seen) for seen in poses]
    pairs = sorted(
        combinations(range(len(poses)), 2),
        key=lambda pair: (-len(poses[pair[0]].keys() & poses[pair[1]].keys()), pair),
    )
    part = list(range(len(poses)))
    edges: list[tuple[int, int, int, Pose]] = []
    for one, other in pairs:
        if part[one] == part[other]:
            continue
        found = _whole_offset(views[one], views[other], spacing, max_offset)
        if found is not None:
            edges += [
                (one, other, found[0], found[1]),
                (other, one, -found[0], invert(found[1])),
            ]
            part = [part[one] if label == part[other] else label for label in part]
    start = {0: _Start(0, np.eye(3, 4))}
    while True:
        edge = next((edge for edge in edges if edge[0] in start and edge[1] not in start), None)
        if edge is None:
            return start
        known, new, ahead, new_from_known = edge
        pose = compose(new_from_known, start[known].cam_from_rig)
        start[new] = _Start(start[known].offset + ahead, pose)


@dataclass(frozen=True, slots=True, eq=False)
class _Views:
    """A camera's located boards: by board and instant the row of each, and their poses.

    `cam_from_board` (V, L, 3, 4) holds one pose for each look, repeated for boards with fewer.
    """

    row_of: dict[tuple[int, int], int]
    cam_from_board: NDArray[np.float64]
    board_from_cam: NDArray[np.float64]

    @classmethod
    def of(cls, boards: Sequence[Board], poses: Mapping[tuple[int, int], Pose]) -> "_Views":
        turns = [
            [board.board_from_turned(look) for look in range(len(board.looks))] for board in boards
        ]
        n_looks = max(map(len, turns))
        keys = sorted(poses)
        turned = np.zeros((len(keys), n_looks, 3, 4))
        inverses = np.zeros((len(keys), 3, 4))
        for row, key in enumerate(keys):
            inverses[row] = invert(poses[key])
            for look in range(n_looks):
                turn = turns[key[0]][look % len(turns[key[0]])]
                turned[row, look] = compose(poses[key], turn)
        return cls({key: row for row, key in enumerate(keys)}, turned, inverses)


def _whole_offset(
    first: _Views, second: _Views, spacing: int, max_offset: int
) -> tuple[int, Pose] | None:
    """Return by how many frames the second is later, and second_from_first.

    None where no offset lets most of the common views share a relative pose.
    """
    best: tuple[float, int, int, Pose] | None = None
    for late in range(-(max_offset // spacing), max_offset // spacing + 1):
        ahead = late * spacing
        keys = sorted(key for key in first.row_of if (key[0], key[1] - ahead) in second.row_of)
        if len(keys) < _MIN_COMMON:
            continue
        chosen = np.linspace(0, len(keys) - 1, min(len(keys), _JUDGED)).round().astype(int)
        mine = [first.row_of[keys[index]] for index in chosen]
        other = [second.row_of[keys[index][0], keys[index][1] - ahead] for index in chosen]
        turned, inverse = second.cam_from_board[other], first.board_from_cam[mine]
        relative = turned[..., :3] @ inverse[:, None]
        relative[..., 3] += turned[..., 3]
        length_m = float(np.median(np.linalg.norm(turned[:, 0, :, 3], axis=1)))
        common = common_pose(list(relative), np.ones(len(relative)), length_m)
        if common.error <= _DISAGREE:
            found = (common.error, abs(ahead), ahead, common.pose)
            best = found if best is None else min(best, found, key=lambda item: item[:3])
    return None if best is None else best[2:]


# --- Fractions of frames ---------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    """Offsets, and how far they can be trusted.

    `motion` is the share of the corners' mean square speed that is no noise, `telling` the same of
    what tells an offset: the speed that no other place of the camera and the boards explains.
    """

    offset_frames: NDArray[np.float64]
    std_frames: NDArray[np.float64]
    motion: NDArray[np.float64]
    telling: NDArray[np.float64]
    rms_px: float


@dataclass(frozen=True, slots=True, eq=False)
class _Sampled:
    """All views at given offsets: residuals (V, N, 2) px and their slopes; 0 where not seen."""

    residuals: NDArray[np.float64]
    by_point: NDArray[np.float64]
    points_cam: NDArray[np.float64]
    speed: NDArray[np.float64]
    noise: NDArray[np.float64]
    speed_noise: NDArray[np.float64]
    common_noise: NDArray[np.float64]
    seen: NDArray[np.bool_]


class _Problem:
    """Offsets, poses of cameras and of boards at chosen instants, and the tracks that tell them."""

    def __init__(
        self,
        points: NDArray[np.float64],
        focal_px: NDArray[np.float64],
        rays: Sequence[_Tracks],
        views: Sequence[tuple[int, int, int, int, NDArray[np.intp]]],
        start: Mapping[int, _Start],
        rig_from_board: NDArray[np.float64],
        spacing: int,
    ) -> None:
        self.points = points  # (B, N, 3)
        self.focal_px = focal_px
        self.rays = rays
        self.views = views  # camera, pose, board, instant, listing
        self.spacing = spacing
        self.cameras = np.array([view[0] for view in views])
        self.poses = np.array([view[1] for view in views])
        self.board_points = points[[view[2] for view in views]]  # (V, N, 3)
        self.rig_from_board = rig_from_board
        n_cameras = len(focal_px)
        self.offsets = np.array(
            [start[c].offset if c in start else 0 for c in range(n_cameras)], np.float64
        )
        self.cam_from_rig = np.stack(
            [start[c].cam_from_rig if c in start else np.eye(3, 4) for c in range(n_cameras)]
        )

    @classmethod
    def of(
        cls,
        boards: Sequence[Board],
        cameras: Sequence[Camera],
        tracks: Sequence[_Tracks],
        poses: Sequence[Mapping[tuple[int, int], Pose]],
        start: Mapping[int, _Start],
        spacing: int,
    ) -> "_Problem | None":
        """Choose the instants that most cameras see, and list symmetric boards alike."""
        most = max(len(board.points_board) for board in boards)
        points = np.zeros((len(boards), most, 3))
        for index, board in enumerate(boards):
            points[index, : len(board.points_board)] = board.points_board
        rays = [
            {key: _rays(camera, pixels) for key, pixels in seen.items()}
            for camera, seen in zip(cameras, tracks, strict=True)
        ]
        # Fractions are not known yet, but for the session's own clock: a camera's frame needs its
        # neighbours, and one more on either side.
        usable: dict[tuple[int, int], list[int]] = {}
        for camera in sorted(start):
            late = start[camera].offset
            for key in sorted(rays[camera].keys() & poses[camera].keys()):
                around = [
                    (key[0], key[1] + step * spacing) in rays[camera] for step in (-2, -1, 1, 2)
                ]
                if camera == 0 or (any(around[::3]) and all(around[1:3])):
                    usable.setdefault((key[0], key[1] + late), []).append(camera)
        shared = sorted(key for key, seeing in usable.items() if len(seeing) > 1)
        if len(shared) < _MIN_COMMON:
            return None
        chosen = np.linspace(0, len(shared) - 1, min(len(shared), _MAX_INSTANTS))
        views = []
        rig_from_board = []
        for number, place in enumerate(chosen.round().astype(int)):
            board, instant = shared[place]
            first_pose: Pose | None = None
            for camera in usable[board, instant]:
                here = start[camera]
                turned = np.stack(
                    [
                        compose(
                            invert(here.cam_from_rig),
                            compose(
                                poses[camera][board, instant - here.offset],
                                boards[board].board_from_turned(look),
                            ),
                        )
                        for look in range(len(boards[board].looks))
                    ]
                )
                if first_pose is None:
                    first_pose = turned[0]
                look = int(np.argmin(pose_distances(first_pose[None], turned, 1.0)))
                listing = np.arange(most)
                listing[: len(boards[board].points_board)] = boards[board].looks[look]
                views.append((camera, number, board, instant, listing))
            rig_from_board.append(first_pose)
        focal_px = np.array([float(camera.pinhole[0, 0]) for camera in cameras])
        return cls(points, focal_px, rays, views, start, np.array(rig_from_board), spacing)

    def solve(self) -> _Found:
        """Fit everything by Levenberg and Marquardt's method, robustly."""
        damping = 1e-4
        sampled = self._sample(self.offsets, self.cam_from_rig, self.rig_from_board)
        for _ in range(_MAX_STEPS):
            weights, limit = self._weights(sampled)
            normal, right, back = self._normal_equations(sampled, weights)
            cost = self._cost(sampled, limit)
            moved = 0.0
            while damping < 1e8:
                damped = normal + damping * np.diag(np.diag(normal) + 1e-9)
                step = np.asarray(np.linalg.solve(damped, right), np.float64)
                trial = self._moved(step, back(step))
                trial_sampled = self._sample(*trial)
                if self._cost(trial_sampled, limit) <= cost:
                    moved = float(np.abs(trial[0] - self.offsets).max())
                    self.offsets, self.cam_from_rig, self.rig_from_board = trial
                    sampled = trial_sampled
                    damping = max(0.1 * damping, 1e-12)
                    break
                damping *= 10.0
            if moved < _CONVERGED_FRAMES:
                break
        weights, _ = self._weights(sampled)
        normal, _, back = self._normal_equations(sampled, weights)
        # Interpolation smooths noise: that of the frames themselves is what is sought.
        n_points = int(sampled.seen.sum())
        n_seen_poses = len(np.unique(self.poses[sampled.seen.any(axis=1)]))
        n_unknown = 6 * n_seen_poses + len(normal)
        share_left = max(2 * n_points - n_unknown, 1) / max(2 * n_points, 1)
        square = (weights * (sampled.residuals**2).sum(axis=2)).sum(axis=1) / sampled.noise
        variance = float(square.sum()) / max(2 * n_points - n_unknown, 1)
        # Noise in the speed looks like motion, and so like knowledge, and no pose of the board
        # explains it away; and noise in points is smoothed most half-way between frames, where
        # residuals are smallest, which pulls the offset there. Both are expected values, and are
        # taken off.
        of_noise = 2.0 * share_left * variance * (weights * sampled.seen).sum(axis=1)
        pull, false_motion = np.zeros((2, len(self.offsets), 7))
        np.add.at(pull[:, 6], self.cameras, of_noise * sampled.common_noise)
        np.add.at(false_motion[:, 6], self.cameras, of_noise * sampled.speed_noise)
        scale = np.sqrt(np.diag(normal)) + 1e-12
        true_normal = normal - np.diag(false_motion[1:].ravel())
        inverse = np.linalg.pinv(true_normal / np.outer(scale, scale), hermitian=True)
        inverse /= np.outer(scale, scale)
        offsets = self.offsets.copy()
        offsets[1:] -= (inverse @ pull[1:].ravel()).reshape(-1, 7)[:, 6]
        scatter = self._scatter(sampled, weights, back)
        covariance = variance * inverse @ scatter @ inverse
        stds = np.zeros(len(self.offsets))
        motion, telling = np.ones((2, len(self.offsets)))
        for camera in range(1, len(self.offsets)):
            column = 7 * (camera - 1) + 6
            stds[camera] = np.sqrt(max(float(covariance[column, column]), 0.0))
            false, power = false_motion[camera, 6], float(normal[column, column])
            motion[camera] = 1.0 - false / power if power > _STILL * n_points else 0.0
            left = float(inverse[column, column])
            telling[camera] = 1.0 / (1.0 + false * left) if left > 0.0 else 0.0
        total = float((sampled.residuals**2).sum()) / max(n_points, 1)
        return _Found(offsets, stds, motion, telling, float(np.sqrt(total)))

    def _scatter(
        self, sampled: _Sampled, weights: NDArray[np.float64], back: "_Back"
    ) -> NDArray[np.float64]:
        """Return the covariance of the right-hand side for noise of variance 1 in the frames.

        Neighbouring instants are interpolated from the same frames, and share their noise: it is
        summed up frame by frame.
        """
        size = len(back.solved[0, 0])
        camera_part, board_part = self._slopes(sampled)
        scatter = np.zeros((size, size))
        for camera in np.unique(self.cameras):
            of_frame: dict[tuple[int, int], NDArray[np.float64]] = {}
            for row in np.flatnonzero(self.cameras == camera).tolist():
                _, pose, board, instant, listing = self.views[row]
                track = _interpolated(
                    self.rays[camera], board, instant - self.offsets[camera], self.spacing
                )
                if track is None:
                    continue
                slopes = -board_part[row] @ back.solved[pose]  # (N, 2, size)
                if camera > 0:
                    slopes[..., 7 * (camera - 1) : 7 * camera] += camera_part[row]
                unlisted = np.zeros_like(slopes)
                unlisted[listing] = weights[row][:, None, None] * slopes
                for frame, share in zip(track.frames, track.weights, strict=True):
                    sums = of_frame.setdefault((board, frame), np.zeros_like(unlisted))
                    sums += share * unlisted
            for sums in of_frame.values():
                flat = sums.reshape(-1, size)
                scatter += flat.T @ flat
        return scatter

    def _sample(
        self,
        offsets: NDArray[np.float64],
        cam_from_rig: NDArray[np.float64],
        rig_from_board: NDArray[np.float64],
    ) -> _Sampled:
        n_views, n_points = self.board_points.shape[:2]
        tracked, speed = np.full((2, n_views, n_points, 2), np.nan)
        noise, speed_noise, common_noise = np.ones(n_views), np.zeros(n_views), np.zeros(n_views)
        for row, (camera, _, board, instant, listing) in enumerate(self.views):
            track = _interpolated(self.rays[camera], board, instant - offsets[camera], self.spacing)
            if track is not None:
                tracked[row, : len(track.points)] = track.points
                speed[row, : len(track.points)] = track.speed
                tracked[row], speed[row] = tracked[row][listing], speed[row][listing]
                noise[row], speed_noise[row] = track.noise, track.speed_noise
                common_noise[row] = track.common_noise
        placed = rig_from_board[self.poses]
        points_rig = self.board_points @ placed[:, :, :3].swapaxes(1, 2) + placed[:, None, :, 3]
        seeing = cam_from_rig[self.cameras]
        points_cam = points_rig @ seeing[:, :, :3].swapaxes(1, 2) + seeing[:, None, :, 3]
        x, y, z = np.moveaxis(points_cam, 2, 0)
        focal = self.focal_px[self.cameras][:, None, None]
        seen = np.isfinite(tracked).all(axis=2) & (z > 1e-3)
        z = np.where(seen, z, 1.0)
        flat = np.stack([x / z, y / z], axis=2)
        residuals = np.where(seen[:, :, None], focal * (tracked - flat), 0.0)
        zero = np.zeros_like(z)
        by_point = np.stack(
            [
                np.stack([1.0 / z, zero, -x / z**2], axis=2),
                np.stack([zero, 1.0 / z, -y / z**2], axis=2),
            ],
            axis=2,
        )  # (V, N, 2, 3)
        by_point = np.where(seen[:, :, None, None], focal[..., None] * by_point, 0.0)
        speed = np.where(seen[:, :, None], focal * speed, 0.0)
        return _Sampled(
            residuals, by_point, points_cam, speed, noise, speed_noise, common_noise, seen
        )

    def _weights(self, sampled: _Sampled) -> tuple[NDArray[np.float64], float]:
        """Return the weights (V, N) of Huber's loss, and where it leaves the square."""
        misses = np.linalg.norm(sampled.residuals, axis=2)
        sigma = 0.85 * float(np.median(misses[sampled.seen]))  # of a two-dimensional error
        limit = max(_LOSS_SIGMAS * sigma, 1e-9)
        return np.where(misses <= limit, 1.0, limit / np.maximum(misses, limit)), limit

    @staticmethod
    def _cost(sampled: _Sampled, limit: float) -> float:
        misses = np.linalg.norm(sampled.residuals, axis=2)[sampled.seen]
        if not len(misses):
            return np.inf
        loss = np.where(misses <= limit, misses**2, 2.0 * limit * misses - limit**2)
        return float(loss.mean())  # the mean: as offsets move, corners come and go

    def _normal_equations(
        self, sampled: _Sampled, weights: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], "_Back"]:
        """Return the equations of cameras and offsets, the boards' poses eliminated."""
        n_cameras, n_poses = len(self.offsets), len(self.rig_from_board)
        camera_part, board_part = self._slopes(sampled)
        weighted = weights[..., None, None] * camera_part
        cc = np.einsum("vnki,vnkj->vij", weighted, camera_part)
        cb = np.einsum("vnki,vnkj->vij", weighted, board_part)
        bb = np.einsum("vnki,vnkj,vn->vij", board_part, board_part, weights)
        rc = np.einsum("vnki,vnk->vi", weighted, sampled.residuals)
        rb = np.einsum("vnki,vnk,vn->vi", board_part, sampled.residuals, weights)
        normal = np.zeros((n_cameras, 7, n_cameras, 7))
        right = np.zeros((n_cameras, 7))
        across = np.zeros((n_poses, n_cameras, 7, 6))
        boards, right_boards = np.zeros((n_poses, 6, 6)), np.zeros((n_poses, 6))
        for camera in range(n_cameras):
            normal[camera, :, camera] = cc[self.cameras == camera].sum(axis=0)
        np.add.at(right, self.cameras, rc)
        np.add.at(across, (self.poses, self.cameras), cb)
        np.add.at(boards, self.poses, bb)
        np.add.at(right_boards, self.poses, rb)
        boards += 1e-9 * np.eye(6) * (1.0 + np.trace(boards, axis1=1, axis2=2))[:, None, None]
        # The reference holds the rig's frame and the session's clock.
        flat = across[:, 1:].reshape(n_poses, -1, 6)
        size = flat.shape[1]
        solved = np.asarray(
            np.linalg.solve(boards, flat.swapaxes(1, 2)), np.float64
        )  # (P, 6, size)
        whole = normal[1:, :, 1:].reshape(size, size) - np.einsum("pia,paj->ij", flat, solved)
        solved_right = np.asarray(np.linalg.solve(boards, right_boards[..., None]), np.float64)[
            ..., 0
        ]
        reduced = right[1:].ravel() - np.einsum("pia,pa->i", flat, solved_right)
        return whole, reduced, _Back(solved, solved_right)

    def _slopes(self, sampled: _Sampled) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return by what residuals fall: camera and offset (V, N, 2, 7), board (V, N, 2, 6)."""
        camera_part = np.zeros((*sampled.residuals.shape, 7))
        camera_part[..., :6] = _by_motion(sampled.by_point, sampled.points_cam)
        camera_part[..., 6] = sampled.speed
        seeing = self.cam_from_rig[self.cameras]
        points_rig = (sampled.points_cam - seeing[:, None, :, 3]) @ seeing[:, :, :3]
        return camera_part, _by_motion(sampled.by_point @ seeing[:, None, :, :3], points_rig)

    def _moved(
        self, step: NDArray[np.float64], board_steps: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        steps = step.reshape(-1, 7)
        offsets = self.offsets.copy()
        offsets[1:] += np.clip(steps[:, 6], -0.5, 0.5)
        cam_from_rig = self.cam_from_rig.copy()
        for camera, motion in enumerate(steps[:, :6], start=1):
            cam_from_rig[camera] = _nudged(cam_from_rig[camera], motion)
        placed = np.stack(
            [_nudged(*pair) for pair in zip(self.rig_from_board, board_steps, strict=True)]
        )
        return offsets, cam_from_rig, placed


@dataclass(frozen=True, slots=True, eq=False)
class _Back:
    """How the boards' poses follow from the rest."""

    solved: NDArray[np.float64]
    solved_right: NDArray[np.float64]

    def __call__(self, step: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(self.solved_right - self.solved @ step)


def _by_motion(by_point: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return slopes (V, N, 2, 6) by turn and shift from those by points (V, N, 2, 3)."""
    turn = np.cross(points[:, :, None, :], by_point)
    return np.concatenate([turn, by_point], axis=3)


def _nudged(pose: Pose, motion: NDArray[np.float64]) -> Pose:
    turn = np.asarray(cv2.Rodrigues(motion[:3])[0], np.float64)
    return np.column_stack([turn @ pose[:, :3], turn @ pose[:, 3] + motion[3:]])


def _rays(camera: Camera, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return rays (N, 2) at depth 1; NaN where a point is not seen."""
    rays = np.full(pixels.shape, np.nan)
    seen = is_seen(pixels)
    if seen.any():
        rays[seen] = cam_from_img(camera, pixels[seen])
    return rays
