"""What is recognisable around a board: it tells which way round each camera saw a symmetric one.

This work is based on: Hartley and Zisserman, *Multiple View Geometry*, 2nd ed., 2003 (sections
9.6 and 11.4.3, epipolar constraint and its first-order distance).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.boards.board import Board
from hybridve.calib.boards.target import grey_of
from hybridve.calib.camera import Camera
from hybridve.calib.lens import cam_from_img, img_from_cam
from hybridve.calib.pose import Pose, compose, invert, transform
from hybridve.calib.seeing.features import find_features, mutual_matches

#: Features kept of one picture, the strongest first; matching is quadratic in them.
MAX_FEATURES = 3000

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
    camera: Camera,
    cam_from_board: Pose,
    image: NDArray[Any],
    board: Board,
    is_mirrored: bool = False,
    max_features: int = MAX_FEATURES,
) -> SceneFeatures:
    """Find what can be recognised in a picture around a board that lies on the floor.

    Features of the board are left out, since they are the same in every one of its `Board.looks`;
    those of the floor as seen from above are added by `with_floor`.

    Parameters
    ----------
    camera : Camera
        Its lens, as the picture is, is used; its pose is not.
    cam_from_board : (3, 4) float64
        The camera's pose in any look of the board; if `is_mirrored`, after the picture is flipped.
    image : (H, W) or (H, W, 3) uint8 or float32
        The picture, 0 to 255.
    board : Board
        The board.
    is_mirrored : bool
        Whether the picture is to be flipped left to right before anything is recognised in it.
    max_features : int
        Features kept, the strongest first.
    """
    grey = np.clip(np.round(grey_of(image)), 0, 255).astype(np.uint8)
    focal_px = float(camera.pinhole[0, 0])
    upright = np.ascontiguousarray(grey[:, ::-1]) if is_mirrored else grey
    pixels, descriptors = find_features(upright, max_features)
    if is_mirrored:
        # A flipped lens is no lens of its model: the lens is asked where the picture was taken.
        pixels = pixels * [-1.0, 1.0] + [grey.shape[1], 0.0]
    rays = cam_from_img(camera, pixels) if len(pixels) else np.zeros((0, 2))
    if is_mirrored:
        rays = rays * [-1.0, 1.0]
    keep = np.isfinite(rays).all(axis=1)
    rays, descriptors = rays[keep], descriptors[keep]
    # Where a ray meets the plane of the board.
    directions = np.column_stack([rays, np.ones(len(rays))]) @ cam_from_board[:, :3]
    center = invert(cam_from_board)[:, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        hits = center + (-center[2] / directions[:, 2])[:, None] * directions
    keep = ~((directions[:, 2] < 0) & _on_board(hits[:, :2], board))
    return SceneFeatures(rays[keep], descriptors[keep], np.zeros((0, 2)), descriptors[:0], focal_px)


def with_floor(
    scene: SceneFeatures,
    camera: Camera,
    cam_from_board: Pose,
    image: NDArray[Any],
    board: Board,
    is_mirrored: bool = False,
    max_features: int = MAX_FEATURES,
) -> SceneFeatures:
    """Return a scene with features of its floor as seen from above.

    There cameras on opposite sides see the same. The parameters are those of `describe_scene`.
    """
    grey = np.clip(np.round(grey_of(image)), 0, 255).astype(np.uint8)
    if is_mirrored:
        # The camera as it took the picture: its view from above is drawn the right way round.
        cam_from_board = np.diag([-1.0, 1.0, 1.0]) @ cam_from_board
    floor_points, floor_descriptors = _floor_features(
        camera, cam_from_board, grey, board, max_features
    )
    return replace(scene, floor_points=floor_points, floor_descriptors=floor_descriptors)


def _on_board(points: NDArray[np.float64], board: Board) -> NDArray[np.bool_]:
    """Tell which points (K, 2) of the floor are on the board or its margin of two squares."""
    center = board.center_board[:2]
    with np.errstate(invalid="ignore"):
        return np.asarray((np.abs(points - center) < center + 2.5 * board.square_m).all(axis=1))


def _floor_features(
    camera: Camera,
    cam_from_board: Pose,
    grey: NDArray[np.uint8],
    board: Board,
    max_features: int,
) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    reach_m = _FLOOR_DIAGONALS * 2.0 * float(np.linalg.norm(board.center_board))
    steps = ((np.arange(_FLOOR_PIXELS) + 0.5) / _FLOOR_PIXELS * 2.0 - 1.0) * reach_m
    x, y = np.meshgrid(steps, steps)
    points = np.column_stack([x.ravel(), y.ravel()]) + board.center_board[:2]
    points_cam = np.column_stack(
        [
            from_x * points[:, 0] + from_y * points[:, 1] + shift
            for from_x, from_y, _, shift in cam_from_board
        ]
    )
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
    on_board = _on_board(points, board)
    usable = (seen & ~on_board).reshape(shape).astype(np.uint8) * np.uint8(255)
    mask = np.asarray(cv2.erode(usable, np.ones((9, 9), np.uint8), borderValue=0), np.uint8)
    places, descriptors = find_features(view, max_features, mask)
    return (places / _FLOOR_PIXELS * 2.0 - 1.0) * reach_m + board.center_board[:2], descriptors


def count_agreeing(
    first: SceneFeatures,
    first_from_board: Pose,
    second: SceneFeatures,
    second_from_board: Pose,
    board: Board,
    turns: Sequence[Pose] | None = None,
) -> NDArray[np.intp]:
    """Count, for each look of the board, the matches that agree with two cameras' poses.

    Parameters
    ----------
    first, second : SceneFeatures
        What the two cameras see.
    first_from_board, second_from_board : (3, 4) float64
        Their poses, each in some look of the board.
    board : Board
        The board.
    turns : sequence of (3, 4) float64, optional
        Turns of the board that are tried; default: those of its looks.

    Returns
    -------
    counts : (L,) int
        Matches that agree if the second camera's look is ahead of the first one's by 0, 1, ...
        turns. Wrong looks collect chance agreements only.
    """
    if turns is None:
        turns = [board.board_from_turned(look) for look in range(len(board.looks))]
    counts = np.zeros(len(turns), dtype=np.intp)
    near, far = mutual_matches(first.descriptors, second.descriptors)
    on_floor, on_other_floor = mutual_matches(first.floor_descriptors, second.floor_descriptors)
    for look, turned in enumerate(turns):
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
    sides : tuple of (frozenset of int, float)
        All that was turned so, and the margin: each camera, then each side.
    """

    looks: tuple[int, ...]
    margins_sigma: tuple[float, ...]
    weakest_sigma: float
    sides: tuple[tuple[frozenset[int], float], ...]


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
    return LooksByVote(
        tuple(looks),
        tuple(margins[:n_cameras]),
        min(margins),
        tuple((frozenset(side), margin) for side, margin in zip(sides, margins, strict=True)),
    )


def _surest_tree(votes: NDArray[np.float64]) -> list[tuple[int, int]]:
    """Return the pairs that join all cameras with the greatest lead of votes (Kruskal)."""

    def lead(pair: tuple[int, int]) -> float:
        ranked = np.sort(votes[pair])
        return sigmas_apart(ranked[-1], ranked[-2])

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


def sigmas_apart(more: float, less: float) -> float:
    """Return by how many standard deviations two counts differ (Poisson)."""
    return float((more - less) / np.sqrt(more + less + 1.0))


def _margin(votes: NDArray[np.float64], looks: Sequence[int], side: set[int]) -> float:
    """Return by how many standard deviations the looks beat those with one side turned."""
    n_looks = votes.shape[2]
    across = [(i, j) for i, j in combinations(range(len(looks)), 2) if (i in side) != (j in side)]

    def count(candidate: Sequence[int]) -> float:
        return float(sum(votes[i, j, (candidate[j] - candidate[i]) % n_looks] for i, j in across))

    rival = max(count(_turned(looks, side, ahead, n_looks)) for ahead in range(1, n_looks))
    return sigmas_apart(count(looks), rival)
