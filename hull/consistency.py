"""Silhouettes freed of what cannot matter: objects of one picture that no other camera confirms.

A piece of a silhouette (an 8-connected component) to which no point of the hull projects can be
dropped without changing the hull at all: what the hull is, it is without it. Such pieces are things
that only one camera sees (a chair in a corner, a reflection); they are no errors, but a person who
looks at the silhouettes wants to see what counts.

Whether a piece is confirmed is asked of the hull that has this piece as its camera's silhouette:
the piece goes only if that hull is proved empty. Space behind the piece's pixels is divided into
cells, a rectangle of pixels between two depths, until the rectangle test of `hull.query.bounds`
proves each free. A cell that cannot be proved free keeps the piece: in doubt nothing is dropped.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.lens import Undistortion
from hybridve.hull.capture.recording import undistort_mask
from hybridve.hull.query.bounds import FREE, FULL, verdicts
from hybridve.hull.query.reference import contains_points
from hybridve.hull.query.silhouettes import Hull, Views, make_hull

Mask = NDArray[np.uint8]

#: Between which depths from the camera a real thing may be, in metres.
NEAREST_M, FARTHEST_M = 0.01, 1000.0

#: Rays, and depths along each, that are tried for a witness before a proof is begun.
_WITNESS_RAYS, _WITNESS_DEPTHS = 48, 96

#: A piece whose proof takes more cells than this stays.
_MOST_CELLS = 20_000

#: Cells are halved in depth until their depths differ by less than this share, then sideways.
_DEPTH_SHARE = 0.02


def drop_unconfirmed(
    views: Views, undistortions: list[Undistortion], masks: list[Mask]
) -> list[Mask]:
    """Return a frame's silhouettes without the pieces that no point of the hull projects to.

    Parameters
    ----------
    views : Views
        C cameras.
    undistortions : list of Undistortion
        How each camera's recorded image becomes its view.
    masks : list of C (H, W) uint8
        Silhouettes in the images as recorded, above 0 on object pixels.

    Returns
    -------
    list of C (H, W) uint8
        The same hull; 1 on object pixels.
    """
    undistorted = [
        undistort_mask(mask, lens) for mask, lens in zip(masks, undistortions, strict=True)
    ]
    result = []
    for camera, (mask, lens) in enumerate(zip(masks, undistortions, strict=True)):
        count, labels = cv2.connectedComponents((mask > 0).astype(np.uint8), connectivity=8)
        kept = (mask > 0).astype(np.uint8)
        for label in range(1, count):
            piece = undistort_mask((labels == label).astype(np.uint8), lens)
            alone = [*undistorted[:camera], piece, *undistorted[camera + 1 :]]
            if is_empty(make_hull(views, alone), camera):
                kept[labels == label] = 0
        result.append(kept)
    return result


def is_empty(hull: Hull, camera: int) -> bool:
    """Tell whether a hull is proved to hold no point that `camera` sees.

    Points between `NEAREST_M` and `FARTHEST_M` from the camera are meant. False means that there is
    such a point, or that no proof was found.

    Parameters
    ----------
    hull : Hull
        The visual hull of one frame.
    camera : int
        The camera along whose rays to look; its silhouette should be small.
    """
    mask = hull.mask(camera)
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if len(rows) == 0:
        return True
    if _has_witness(hull, camera):
        return False
    integral = hull.integral(camera)
    # A cell is left, right, top, bottom in pixels and two inverse depths, nearest first.
    cells = np.array(
        [[columns[0], columns[-1] + 1, rows[0], rows[-1] + 1, 1 / NEAREST_M, 1 / FARTHEST_M]],
        np.float64,
    )
    n_cells = 0
    while len(cells):
        n_cells += len(cells)
        if n_cells > _MOST_CELLS:
            return False
        verdict = verdicts(hull, _corners(hull.views, camera, cells))
        if (verdict == FULL).any():
            return False
        cells = cells[verdict != FREE]
        if len(cells) == 0:
            return True
        parts = _halved(cells)
        if parts is None:  # a cell is as small as cells get
            return False
        left, right, top, bottom = parts[:, :4].astype(np.int64).T
        in_piece = (
            integral[bottom, right]
            - integral[top, right]
            - integral[bottom, left]
            + integral[top, left]
        )
        cells = parts[in_piece > 0]
    return True


def _has_witness(hull: Hull, camera: int) -> bool:
    rows, columns = np.nonzero(hull.mask(camera))
    chosen = np.linspace(0, len(rows) - 1, min(_WITNESS_RAYS, len(rows))).astype(np.int64)
    pixels = np.column_stack([columns[chosen] + 0.5, rows[chosen] + 0.5])
    center_m = abs(float(hull.views.img_from_local[camera, 2, 3]))  # depth of the local origin
    depths = np.geomspace(max(center_m / 8, NEAREST_M), max(center_m * 8, 1.0), _WITNESS_DEPTHS)
    points_local = _points(
        hull.views,
        camera,
        np.repeat(pixels, len(depths), axis=0),
        np.tile(depths, len(pixels)),
    )
    return bool(contains_points(hull, points_local + hull.views.origin_world).any())


def _points(
    views: Views, camera: int, pixels: NDArray[np.float64], depths_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the points, (N, 3) local, that a camera sees at pixels (N, 2) and depths (N,)."""
    matrix = views.img_from_local[camera]
    homogeneous = np.column_stack([pixels, np.ones(len(pixels))]) * depths_m[:, None]
    return np.asarray(np.linalg.solve(matrix[:, :3], (homogeneous - matrix[:, 3]).T).T)


def _corners(views: Views, camera: int, cells: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the eight corners of each cell, (N, 8, 3) local."""
    corners = []
    for x in (0, 1):
        for y in (2, 3):
            for inverse_depth in (4, 5):
                corners.append(
                    _points(views, camera, cells[:, [x, y]], 1.0 / cells[:, inverse_depth])
                )
    return np.stack(corners, axis=1)


def _halved(cells: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Return the halves of all cells: in depth while they are deep, else across; None if minute."""
    parts = []
    width = cells[:, 1] - cells[:, 0]
    height = cells[:, 3] - cells[:, 2]
    deep = cells[:, 4] / cells[:, 5] > 1.0 + _DEPTH_SHARE * np.maximum(np.maximum(width, height), 1)
    wide = ~deep & (width >= height) & (width > 1)
    high = ~deep & ~wide & (height > 1)
    if not (deep | wide | high).all():
        return None
    for chosen, low, up in ((deep, 4, 5), (wide, 0, 1), (high, 2, 3)):
        first, second = cells[chosen].copy(), cells[chosen].copy()
        if low == 4:  # halve in the logarithm of the depth
            middle = np.sqrt(first[:, 4] * first[:, 5])
        else:
            middle = np.floor((first[:, low] + first[:, up]) / 2)
        first[:, up] = middle
        second[:, low] = middle
        parts += [first, second]
    return np.concatenate(parts)
