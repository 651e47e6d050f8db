"""Does a rig agree with pictures? With those of a board, and with those of the scene around it.

A board of known squares tells the scale of a rig, and which camera stands elsewhere than the rig
says. The scene tells what a symmetric board cannot: which way round each camera saw it.

This work is based on: Hartley and Zisserman, *Multiple View Geometry*, 2nd ed., 2003 (sections
9.6 and 11.4.3, epipolar constraint and its first-order distance); Lowe, *Distinctive image features
from scale-invariant keypoints*, IJCV 60(2), 2004; Arandjelovic and Zisserman, *Three things
everyone should know to improve object retrieval*, CVPR 2012 (RootSIFT).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, product
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.lens import cam_from_img, img_from_cam, project_points
from hybridve.calib.pose import Pose, compose, invert, transform
from hybridve.calib.rig import Rig
from hybridve.calib.solve import locate_board, rms
from hybridve.calib.target import Chessboard, grey_of

#: Features kept of one picture, the strongest first; matching is quadratic in them.
_MAX_FEATURES = 3000
_MIN_CONTRAST = 0.02

#: A match agrees with two poses when it misses its epipolar line by less than this (pixels), and
#: when on the floor its two places are nearer than this (squares of the board).
_EPIPOLAR_PX = 1.5
_FLOOR_SQUARES = 0.4

#: The floor is compared this far around the board's middle, in diagonals of the board, at this
#: many pixels a side.
_FLOOR_DIAGONALS = 2.5
_FLOOR_PIXELS = 400

#: Points of the scene may lie this far under the floor (squares): a point that does so further
#: was matched wrongly.
_BELOW_FLOOR_SQUARES = 2.0

#: A board clip contradicts a rig beyond these: the rig's scale by more than 5 % (independent
#: careful calibrations of one recording differ by up to 4 %), or its corners by more than 1 % of
#: the image's width.
SCALE_TOLERANCE = 0.05
REPROJECTION_TOLERANCE = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class SceneFeatures:
    """What is recognisable in one camera's picture, apart from the board.

    Attributes
    ----------
    rays : (K, 2) float64
        Rays at depth 1, camera frame.
    descriptors : (K, 128) float32
        RootSIFT.
    floor_points : (L, 2) float64
        Features of the floor as seen from above, board frame, metres.
    floor_descriptors : (L, 128) float32
        RootSIFT of these.
    focal_px : float
        Pixels a unit of ray, in the middle of the image.
    """

    rays: NDArray[np.float64]
    descriptors: NDArray[np.float32]
    floor_points: NDArray[np.float64]
    floor_descriptors: NDArray[np.float32]
    focal_px: float


def describe_scene(
    camera: Camera, cam_from_board: Pose, image: NDArray[Any], board: Chessboard
) -> SceneFeatures:
    """Find what can be recognised in a picture around a board that lies on the floor.

    Features are taken from the picture itself and from the view of its floor from above, where
    cameras on opposite sides see the same; features of the board are left out, since they are
    the same in every one of its `Chessboard.looks`.

    Parameters
    ----------
    camera : Camera
        Its lens is used, its pose is not.
    cam_from_board : (3, 4) float64
        The camera's pose in any look of the board.
    image : (H, W) or (H, W, 3) uint8 or float32
        The picture, 0 to 255.
    board : Chessboard
        The board.
    """
    grey = np.clip(np.round(grey_of(image)), 0, 255).astype(np.uint8)
    focal_px = float(camera.pinhole[0, 0])
    pixels, descriptors = _features(grey)
    rays = cam_from_img(camera, pixels) if len(pixels) else np.zeros((0, 2))
    keep = np.isfinite(rays).all(axis=1)
    rays, descriptors = rays[keep], descriptors[keep]
    # Where a ray meets the plane of the board.
    directions = np.column_stack([rays, np.ones(len(rays))]) @ cam_from_board[:, :3]
    center = invert(cam_from_board)[:, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        hits = center + (-center[2] / directions[:, 2])[:, None] * directions
    keep = ~((directions[:, 2] < 0) & _on_board(hits[:, :2], board))
    floor_points, floor_descriptors = _floor_features(camera, cam_from_board, grey, board)
    return SceneFeatures(rays[keep], descriptors[keep], floor_points, floor_descriptors, focal_px)


def _features(
    grey: NDArray[np.uint8], mask: NDArray[np.uint8] | None = None
) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Return places (K, 2), pixel centre at 0.5, and RootSIFT descriptors (K, 128)."""
    sift: Any = cv2.SIFT.create(_MAX_FEATURES, contrastThreshold=_MIN_CONTRAST)
    points, descriptors = sift.detectAndCompute(grey, mask)
    if not points:
        return np.zeros((0, 2)), np.zeros((0, 128), np.float32)
    total = np.maximum(np.abs(descriptors).sum(axis=1, keepdims=True), 1e-9)
    places = np.array([point.pt for point in points], np.float64) + 0.5
    return places, np.sqrt(descriptors / total).astype(np.float32)


def _on_board(points: NDArray[np.float64], board: Chessboard) -> NDArray[np.bool_]:
    """Tell which points (K, 2) of the floor are on the board or its margin of two squares."""
    center = board.center_board[:2]
    with np.errstate(invalid="ignore"):
        return np.asarray((np.abs(points - center) < center + 2.5 * board.square_m).all(axis=1))


def _floor_features(
    camera: Camera, cam_from_board: Pose, grey: NDArray[np.uint8], board: Chessboard
) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    reach_m = _FLOOR_DIAGONALS * 2.0 * float(np.linalg.norm(board.center_board))
    steps = ((np.arange(_FLOOR_PIXELS) + 0.5) / _FLOOR_PIXELS * 2.0 - 1.0) * reach_m
    x, y = np.meshgrid(steps, steps)
    points = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]) + board.center_board
    points_cam = transform(cam_from_board, points)
    seen = points_cam[:, 2] > 0.1 * reach_m
    pixels = np.full((len(points), 2), -1e3)
    pixels[seen] = img_from_cam(camera, points_cam[seen])
    with np.errstate(invalid="ignore"):
        seen &= (pixels > 1).all(axis=1) & (pixels < np.array(grey.shape[::-1]) - 1).all(axis=1)
    # A lens polynomial folds back far outside the image: the pixel must lead back to the point.
    rays = np.full((len(points), 2), np.nan)
    rays[seen] = cam_from_img(camera, pixels[seen])
    with np.errstate(divide="ignore", invalid="ignore"):
        expected = points_cam[:, :2] / points_cam[:, 2:]
        seen &= np.linalg.norm(rays - expected, axis=1) < 1e-3
    pixels[~seen] = -1e3
    shape = (_FLOOR_PIXELS, _FLOOR_PIXELS)
    map_x, map_y = (pixels[:, axis].reshape(shape).astype(np.float32) - 0.5 for axis in (0, 1))
    view = np.asarray(cv2.remap(grey, map_x, map_y, cv2.INTER_LINEAR), np.uint8)
    on_board = _on_board(points[:, :2], board)
    usable = (seen & ~on_board).reshape(shape).astype(np.uint8) * np.uint8(255)
    mask = np.asarray(cv2.erode(usable, np.ones((9, 9), np.uint8), borderValue=0), np.uint8)
    places, descriptors = _features(view, mask)
    return (places / _FLOOR_PIXELS * 2.0 - 1.0) * reach_m + board.center_board[:2], descriptors


def count_agreeing(
    first: SceneFeatures,
    first_from_board: Pose,
    second: SceneFeatures,
    second_from_board: Pose,
    board: Chessboard,
) -> NDArray[np.intp]:
    """Count, for each look of the board, the matches that agree with two cameras' poses.

    Parameters
    ----------
    first, second : SceneFeatures
        What the two cameras see.
    first_from_board, second_from_board : (3, 4) float64
        Their poses, each in some look of the board.
    board : Chessboard
        The board.

    Returns
    -------
    counts : (L,) int
        Matches that agree if the second camera's look is ahead of the first one's by 0, 1, ...
        Wrong looks collect chance agreements only.
    """
    looks = len(board.looks)
    counts = np.zeros(looks, dtype=np.intp)
    near, far = _mutual_matches(first.descriptors, second.descriptors)
    on_floor, on_other_floor = _mutual_matches(first.floor_descriptors, second.floor_descriptors)
    for look in range(looks):
        turned = board.board_from_turned(look)
        pose = compose(second_from_board, turned)
        counts[look] += int(
            _agree(
                first.rays[near],
                first_from_board,
                second.rays[far],
                pose,
                _EPIPOLAR_PX / min(first.focal_px, second.focal_px),
                -_BELOW_FLOOR_SQUARES * board.square_m,
            ).sum()
        )
        # Points of the second floor are in its look; `turned` leads from the first's to it.
        points = first.floor_points[on_floor]
        points = points @ turned[:2, :2].T + turned[:2, 3]
        misses = np.linalg.norm(points - second.floor_points[on_other_floor], axis=1)
        counts[look] += int((misses < _FLOOR_SQUARES * board.square_m).sum())
    return counts


def _mutual_matches(
    first: NDArray[np.float32], second: NDArray[np.float32]
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the indices of descriptors that are each other's nearest."""
    if not len(first) or not len(second):
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    likeness = first @ second.T
    forward, backward = likeness.argmax(axis=1), likeness.argmax(axis=0)
    mutual = np.flatnonzero(backward[forward] == np.arange(len(first)))
    return mutual, forward[mutual]


def _agree(
    first_rays: NDArray[np.float64],
    first_from_world: Pose,
    second_rays: NDArray[np.float64],
    second_from_world: Pose,
    tolerance: float,
    lowest_m: float,
) -> NDArray[np.bool_]:
    """Tell which pairs of rays meet in front of both cameras and not under the floor."""
    if not len(first_rays):
        return np.zeros(0, np.bool_)
    second_from_first = compose(second_from_world, invert(first_from_world))
    rotation, shift = second_from_first[:, :3], second_from_first[:, 3]
    cross = np.array(
        [[0.0, -shift[2], shift[1]], [shift[2], 0.0, -shift[0]], [-shift[1], shift[0], 0.0]]
    )
    essential = cross @ rotation
    a = np.column_stack([first_rays, np.ones(len(first_rays))])
    b = np.column_stack([second_rays, np.ones(len(second_rays))])
    lines_b, lines_a = a @ essential.T, b @ essential
    norm = np.sqrt((lines_b[:, :2] ** 2).sum(axis=1) + (lines_a[:, :2] ** 2).sum(axis=1))
    distance = np.abs((b * lines_b).sum(axis=1)) / np.maximum(norm, 1e-12)
    # The points on both rays that are nearest to each other, by their depths.
    a_turned = a @ rotation.T
    aa, bb, ab = (a_turned**2).sum(1), (b**2).sum(1), (a_turned * b).sum(1)
    determinant = np.maximum(aa * bb - ab**2, 1e-12)
    depth_a = (ab * (b @ shift) - bb * (a_turned @ shift)) / determinant
    depth_b = (aa * (b @ shift) - ab * (a_turned @ shift)) / determinant
    heights = transform(invert(first_from_world), a * depth_a[:, None])[:, 2]
    return np.asarray((distance < tolerance) & (depth_a > 0) & (depth_b > 0) & (heights > lowest_m))


@dataclass(frozen=True, slots=True, eq=False)
class LooksByVote:
    """Which look of a symmetric board each camera saw, by votes for pairs of cameras.

    Attributes
    ----------
    looks : tuple of int
        One a camera, known up to a turn common to all.
    margins_sigma : tuple of float
        By how many standard deviations of chance votes (Poisson) this beats the same with that
        one camera turned.
    weakest_sigma : float
        The same for the weakest link: turning any one camera, or one side of the tree of the
        surest pairs.
    """

    looks: tuple[int, ...]
    margins_sigma: tuple[float, ...]
    weakest_sigma: float


def choose_looks(votes: NDArray[np.float64]) -> LooksByVote:
    """Choose the looks for which the votes of all pairs of cameras add up to most.

    The surest pairs, as a tree that joins all cameras, give a start; then single cameras and
    sides of the tree are turned as long as that gains votes.

    Parameters
    ----------
    votes : (C, C, L) float64
        ``votes[i, j, k]``: for camera j to be k looks ahead of camera i, for i < j; the others
        are not read.
    """
    n_cameras, _, n_looks = votes.shape
    tree = _surest_tree(votes)
    looks = [0] * n_cameras
    reached = {0}
    while len(reached) < n_cameras:
        i, j = next((i, j) for i, j in tree if (i in reached) != (j in reached))
        ahead = int(np.argmax(votes[i, j]))
        if i in reached:
            looks[j] = (looks[i] + ahead) % n_looks
        else:
            looks[i] = (looks[j] - ahead) % n_looks
        reached |= {i, j}
    singles = [{camera} for camera in range(n_cameras)]
    sides = singles + [_side(tree, cut) for cut in tree]
    gains = True
    while gains:
        gains = False
        for side, ahead in product(sides, range(1, n_looks)):
            turned = _turned(looks, side, ahead, n_looks)
            if _total(votes, turned) > _total(votes, looks):
                looks, gains = turned, True
    margins = [_margin(votes, looks, side) for side in sides]
    return LooksByVote(tuple(looks), tuple(margins[:n_cameras]), min(margins))


def _surest_tree(votes: NDArray[np.float64]) -> list[tuple[int, int]]:
    """Return the pairs that join all cameras with the greatest lead of votes (Kruskal)."""

    def lead(pair: tuple[int, int]) -> float:
        ranked = np.sort(votes[pair])
        return _sigmas(ranked[-1], ranked[-2])

    part = list(range(len(votes)))
    tree = []
    for i, j in sorted(combinations(range(len(votes)), 2), key=lead, reverse=True):
        if part[i] != part[j]:
            tree.append((i, j))
            part = [part[i] if value == part[j] else value for value in part]
    return tree


def _side(tree: Sequence[tuple[int, int]], cut: tuple[int, int]) -> set[int]:
    """Return the cameras on one side of a tree that is cut at one of its pairs."""
    side = {cut[0]}
    for _ in tree:
        for i, j in tree:
            if (i, j) != cut and (i in side) != (j in side):
                side |= {i, j}
    return side


def _turned(looks: Sequence[int], side: set[int], ahead: int, n_looks: int) -> list[int]:
    return [
        (look + ahead) % n_looks if camera in side else look for camera, look in enumerate(looks)
    ]


def _total(votes: NDArray[np.float64], looks: Sequence[int]) -> float:
    pairs = combinations(range(len(looks)), 2)
    return float(sum(votes[i, j, (looks[j] - looks[i]) % votes.shape[2]] for i, j in pairs))


def _sigmas(more: float, less: float) -> float:
    """Return by how many standard deviations two counts differ (Poisson)."""
    return float((more - less) / np.sqrt(more + less + 1.0))


def _margin(votes: NDArray[np.float64], looks: Sequence[int], side: set[int]) -> float:
    """Return by how many standard deviations the looks beat those with one side turned."""
    n_looks = votes.shape[2]
    across = [(i, j) for i, j in combinations(range(len(looks)), 2) if (i in side) != (j in side)]

    def count(candidate: Sequence[int]) -> float:
        return float(sum(votes[i, j, (candidate[j] - candidate[i]) % n_looks] for i, j in across))

    rival = max(count(_turned(looks, side, ahead, n_looks)) for ahead in range(1, n_looks))
    return _sigmas(count(looks), rival)


@dataclass(frozen=True, slots=True, eq=False)
class RigCheck:
    """What a board clip says of a rig.

    Attributes
    ----------
    scale : float
        How many times too large the rig is: the board's squares as the rig measures them, by the
        squares as they are. NaN where it cannot be told (fewer than two cameras).
    pair_scales : dict of str to float
        The same from the distance of each two cameras alone, "cam1 cam2"; they differ where the
        rig is wrong by more than its scale.
    rms_px : dict of str to float
        How far corners lie from where the rig, at the scale found, says: per camera, pixels.
    odd_camera : str or None
        The camera without which the others agree.
    is_trustworthy : bool
        Whether scale and corners are within tolerance.
    message : str
        The verdict in one line.
    """

    scale: float
    pair_scales: dict[str, float]
    rms_px: dict[str, float]
    odd_camera: str | None
    is_trustworthy: bool
    message: str


def check_rig(
    rig: Rig, board: Chessboard, extrinsic_corners: dict[str, NDArray[np.float64]]
) -> RigCheck:
    """Check a rig against a board that several of its cameras saw at once.

    The board is placed in the rig's world by position, orientation and size, so that its corners
    are reprojected best: the size tells the rig's scale, what remains tells whether the cameras
    agree with one another. Which way round a symmetric board was seen follows from the rig.

    Parameters
    ----------
    rig : Rig
        The rig to be checked.
    board : Chessboard
        The board, with its true squares.
    extrinsic_corners : dict of str to (N, 2) float64
        By camera the corners as `find_corners` gives them, pixels.

    Raises
    ------
    CalibrationError
        If fewer than two cameras of the rig see the board.
    """
    names = [camera.name for camera in rig.cameras if camera.name in extrinsic_corners]
    if len(names) < 2:
        raise CalibrationError(
            f"the rig cannot be checked: {len(names)} of its cameras see the board, expected two "
            f"or more (rig: {', '.join(camera.name for camera in rig.cameras)}; board: "
            f"{', '.join(sorted(extrinsic_corners)) or 'none'})"
        )
    cameras = [rig[name] for name in names]
    poses = []
    for camera in cameras:
        located = locate_board(camera, board.points_board, extrinsic_corners[camera.name])
        if located is None:
            raise CalibrationError(
                f"camera {camera.name!r}: its lens cannot have seen the board's corners; "
                "check the image size and the unit of its parameters"
            )
        poses.append(located[0])
    looks = _looks_by_rig(cameras, poses, board)
    poses = [
        compose(pose, board.board_from_turned(look))
        for pose, look in zip(poses, looks, strict=True)
    ]
    corners = [
        extrinsic_corners[name][board.looks[look]] for name, look in zip(names, looks, strict=True)
    ]
    pair_scales = _pair_scales(cameras, poses)
    scale = float(np.median(list(pair_scales.values())))
    scale, residuals = _fit_board(cameras, poses, corners, board, scale)
    rms_px = {name: rms(residual) for name, residual in zip(names, residuals, strict=True)}
    odd_camera = None
    limits = {camera.name: REPROJECTION_TOLERANCE * camera.width_px for camera in cameras}
    agree = all(rms_px[name] <= limits[name] for name in names)
    if not agree and len(names) > 2:
        odd_camera = _odd_one_out(cameras, poses, corners, board, scale, limits)
    is_scaled = abs(scale - 1.0) > SCALE_TOLERANCE
    return RigCheck(
        scale,
        pair_scales,
        rms_px,
        odd_camera,
        agree and not is_scaled,
        _verdict(board, scale, pair_scales, rms_px, odd_camera, agree, is_scaled),
    )


def _verdict(
    board: Chessboard,
    scale: float,
    pair_scales: dict[str, float],
    rms_px: dict[str, float],
    odd_camera: str | None,
    agree: bool,
    is_scaled: bool,
) -> str:
    measured = (
        f"the board's squares measure {scale * board.square_m * 1000:.1f} mm in the rig, "
        f"{board.square_m * 1000:g} mm in truth: scale {scale:.3f} "
        f"(by pairs of cameras {min(pair_scales.values()):.3f} to {max(pair_scales.values()):.3f})"
    )
    worst = max(rms_px, key=lambda name: rms_px[name])
    missed = f"its corners are missed by {max(rms_px.values()):.1f} px in camera {worst!r}"
    if odd_camera is not None:
        return (
            f"camera {odd_camera!r} stands elsewhere than the rig says; without it the others "
            f"agree; {measured}; calibrate again"
        )
    if is_scaled:
        return f"{measured}; {missed}; check the rig's unit, or calibrate again"
    if not agree:
        return f"the cameras disagree: {missed}; {measured}; calibrate again"
    return f"{measured}; {missed}: the rig agrees with the board"


def _looks_by_rig(cameras: Sequence[Camera], poses: Sequence[Pose], board: Chessboard) -> list[int]:
    """Return for each camera the look under which its board agrees with the first one's.

    Orientation decides: it does not depend on the rig's scale.
    """
    first = invert(cameras[0].cam_from_world)[:, :3] @ poses[0][:, :3]  # world_from_board
    looks = []
    for camera, pose in zip(cameras, poses, strict=True):
        agreement = [
            float(
                np.trace(
                    first.T
                    @ invert(camera.cam_from_world)[:, :3]
                    @ compose(pose, board.board_from_turned(look))[:, :3]
                )
            )
            for look in range(len(board.looks))
        ]
        looks.append(int(np.argmax(agreement)))
    return looks


def _pair_scales(cameras: Sequence[Camera], poses: Sequence[Pose]) -> dict[str, float]:
    scales = {}
    for i, first in enumerate(cameras):
        for j in range(i + 1, len(cameras)):
            in_rig = float(np.linalg.norm(first.center_world - cameras[j].center_world))
            by_board = float(np.linalg.norm(invert(poses[i])[:, 3] - invert(poses[j])[:, 3]))
            scales[f"{first.name} {cameras[j].name}"] = in_rig / max(by_board, 1e-12)
    return scales


def _fit_board(
    cameras: Sequence[Camera],
    poses: Sequence[Pose],
    corners: Sequence[NDArray[np.float64]],
    board: Chessboard,
    scale: float,
) -> tuple[float, list[NDArray[np.float64]]]:
    """Place the board in the world with its size free; return the size and residuals, pixels."""
    points = board.points_board - board.center_board

    def residuals(
        rotation: NDArray[np.float64], center: NDArray[np.float64], size: float
    ) -> list[NDArray[np.float64]]:
        placed = size * points @ rotation.T + center
        found = []
        for camera, pixels in zip(cameras, corners, strict=True):
            projected, _ = project_points(camera, placed)
            # A corner behind a camera misses by more than the image.
            missed = np.where(np.isfinite(projected), projected, 10.0 * camera.width_px)
            found.append(pixels - missed)
        return found

    # Start where the cameras, each on its own, see the board on average.
    rotations, centers = [], []
    for camera, pose in zip(cameras, poses, strict=True):
        world_from_cam = invert(camera.cam_from_world)
        rotations.append(world_from_cam[:, :3] @ pose[:, :3])
        center_cam = scale * transform(pose, board.center_board[None])[0]
        centers.append(world_from_cam[:, :3] @ center_cam + world_from_cam[:, 3])
    u, _, vt = np.linalg.svd(np.sum(rotations, axis=0))
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    center, size = np.mean(centers, axis=0), scale

    damping = 1e-3
    current = residuals(rotation, center, size)
    cost = sum(float((residual**2).sum()) for residual in current)
    unit_m = size * float(np.linalg.norm(board.center_board))
    for _ in range(100):
        # Seven unknowns: turn (radians), shift (in half diagonals of the board), size (relative).
        columns = []
        for axis in range(7):
            nudge = np.zeros(7)
            nudge[axis] = 1e-6
            moved = residuals(*_moved(rotation, center, size, nudge, unit_m))
            columns.append((np.concatenate(moved) - np.concatenate(current)).ravel() / 1e-6)
        jacobian = np.stack(columns, axis=1)
        normal, right = jacobian.T @ jacobian, -jacobian.T @ np.concatenate(current).ravel()
        damped = normal + damping * np.diag(np.diag(normal) + 1e-9)
        step = np.asarray(np.linalg.solve(damped, right), np.float64)
        candidate = _moved(rotation, center, size, step, unit_m)
        if not candidate[2] > 0:
            damping *= 10.0
            continue
        trial = residuals(*candidate)
        trial_cost = sum(float((residual**2).sum()) for residual in trial)
        if trial_cost < cost:
            done = cost - trial_cost < 1e-10 * cost
            (rotation, center, size), current, cost = candidate, trial, trial_cost
            damping = max(damping * 0.1, 1e-12)
            if done:
                break
        else:
            damping *= 10.0
            if damping > 1e8:
                break
    return float(size), current


def _moved(
    rotation: NDArray[np.float64],
    center: NDArray[np.float64],
    size: float,
    step: NDArray[np.float64],
    unit_m: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    turn = cv2.Rodrigues(step[:3])[0]
    return turn @ rotation, center + step[3:6] * unit_m, size * (1.0 + float(step[6]))


def _odd_one_out(
    cameras: Sequence[Camera],
    poses: Sequence[Pose],
    corners: Sequence[NDArray[np.float64]],
    board: Chessboard,
    scale: float,
    limits: dict[str, float],
) -> str | None:
    """Return the one camera without which the others agree; None where there is no such one."""
    odd = []
    for left_out in range(len(cameras)):
        others = [index for index in range(len(cameras)) if index != left_out]
        _, residuals = _fit_board(
            [cameras[index] for index in others],
            [poses[index] for index in others],
            [corners[index] for index in others],
            board,
            scale,
        )
        if all(
            rms(residual) <= limits[cameras[index].name]
            for index, residual in zip(others, residuals, strict=True)
        ):
            odd.append(cameras[left_out].name)
    return odd[0] if len(odd) == 1 else None
