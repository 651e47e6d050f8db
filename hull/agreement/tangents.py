"""Where outlines of two cameras touch the same planes, and by how much they miss each other there.

All planes through the centres of two cameras form a *pencil*; the angle phi of a plane about the
line of centres is the same in both images. A piece of a silhouette takes an interval of angles, all
of a silhouette a union of intervals, and a thing that both cameras see wholly takes the same union
in both: the planes that meet it. Where the union ends (a *limit*) a plane touches the thing, and
both outlines with it, at a frontier point (Cipolla, Astroem and Giblin, 1995). So limits of one
image have their like in the other, whatever the thing, however many pieces it comes in, however
they hide each other, without any correspondence but the order of angles.

By how much two limits differ is told in pixels, r = (phi_i - phi_j) / sqrt(g_i^2 + g_j^2), with g
how much phi changes as the outline moves by a pixel across: with outlines that err by sigma pixels
each, r has that standard deviation. It changes with the picture's shift (x, y) by (dphi/dx,
dphi/dy) over the same root: to find the shift of a picture is a linear problem.

A limit is *unknown* where its corner is cut off by the border of the image, or where the other
camera does not see its plane at all. Where a camera stands within the silhouette that another one
sees, the pair says nothing.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.agreement.outlines import OutlineTable
from hybridve.hull.jit import compiled
from hybridve.hull.query.silhouettes import Views

#: Limits of one silhouette and one pencil that are kept, of either kind: those of the widest
#: intervals.
MOST_LIMITS = 8

#: Pieces of one silhouette that are looked at.
_MOST_PIECES = 64

#: Intervals that are nearer to each other than this, in pixels, are one: thin things break.
_GAP_PX = 4.0

#: A piece whose angles span more than this, in radians, surrounds the other camera.
_WIDEST = 2.5

#: Limits this near to where the other image ends, in pixels, are unknown.
_MARGIN_PX = 3.0

LOW, HIGH = 0, 1


class Pencils(NamedTuple):
    """The pencils of D pairs of cameras, each seen from its first one.

    Attributes
    ----------
    cameras : (D, 2) int64
        The camera whose image it is, and the other.
    reverse : (D,) int64
        The number of the same pair from the other side.
    axes : (D, 2, 3) float64
        The angle of pixel (x, y) is that of the vector ``axes @ (x, y, 1)``, zero towards the
        scene, and the same for the reverse pair.
    ends : (D, 2) float64
        The angles between which the other camera sees planes; without end where it sees all.
    """

    cameras: NDArray[np.int64]
    reverse: NDArray[np.int64]
    axes: NDArray[np.float64]
    ends: NDArray[np.float64]

    def of(self, rows: NDArray[np.int64]) -> "Pencils":
        """Return some of them, by number."""
        return Pencils(self.cameras[rows], self.reverse[rows], self.axes[rows], self.ends[rows])


class Limits(NamedTuple):
    """Where the unions of intervals begin and end; D pencils, F frames, K of a kind at most.

    Attributes
    ----------
    angle : (D, F, 2, K) float64
        Radians; NaN behind the last.
    gradient : (D, F, 2, K, 2) float64
        Its change, radians, as the outline moves by a pixel along x and y.
    is_known : (D, F, 2, K) bool
        Whether the thing ends there, and not the image.
    """

    angle: NDArray[np.float64]
    gradient: NDArray[np.float64]
    is_known: NDArray[np.bool_]

    def of(self, rows: NDArray[np.int64]) -> "Limits":
        """Return those of some pencils, by number."""
        return Limits(self.angle[rows], self.gradient[rows], self.is_known[rows])

    def with_rows(self, rows: NDArray[np.int64], new: "Limits") -> "Limits":
        """Return the same with those of some pencils replaced."""
        result = Limits(self.angle.copy(), self.gradient.copy(), self.is_known.copy())
        result.angle[rows], result.gradient[rows], result.is_known[rows] = new
        return result


def make_pencils(views: Views, pairs: NDArray[np.int64]) -> Pencils:
    """Return the pencils of unordered pairs (N, 2) of cameras, D = 2 N: first to second, and back.

    Pairs of cameras that stand at one place have none and are left out.
    """
    matrices, centers = views.img_from_local, views.centers_local()
    rays = np.linalg.inv(matrices[:, :, :3])
    cameras, axes, ends = [], [], []
    for i, j in pairs.tolist():
        line = centers[j] - centers[i]
        length = float(np.linalg.norm(line))
        if not length > 0.0:
            continue
        line /= length
        # Towards the middle of what all look at: there silhouettes are, and angles do not wrap.
        across = -(centers[i] + centers[j]) / 2.0
        across -= (across @ line) * line
        if not np.linalg.norm(across) > 1e-6 * length:
            across = np.cross(line, np.eye(3)[np.abs(line).argmin()])
        across /= np.linalg.norm(across)
        planes = np.stack([across, np.cross(line, across)])
        both = [planes @ rays[i], planes @ rays[j]]
        for mine, other, axis, seen in ((i, j, both[0], both[1]), (j, i, both[1], both[0])):
            cameras.append((mine, other))
            axes.append(axis)
            ends.append(_seen_angles(matrices[other], centers[mine], views.sizes_px[other], seen))
    count = len(cameras)
    return Pencils(
        np.array(cameras, np.int64).reshape(-1, 2),
        np.arange(count, dtype=np.int64) ^ 1,
        np.array(axes).reshape(-1, 2, 3),
        np.array(ends).reshape(-1, 2),
    )


def _seen_angles(
    matrix: NDArray[np.float64],
    center: NDArray[np.float64],
    size_px: NDArray[np.int64],
    axes: NDArray[np.float64],
) -> tuple[float, float]:
    """Return between which angles a camera of this matrix sees planes through a centre."""
    width, height = size_px.tolist()
    epipole = matrix[:, :3] @ center + matrix[:, 3]
    x, y = epipole[:2] / epipole[2] if epipole[2] else (np.inf, np.inf)
    if 0 <= x <= width and 0 <= y <= height:
        return -np.inf, np.inf
    corners = np.array([[0, 0, 1], [width, 0, 1], [0, height, 1], [width, height, 1]], np.float64)
    across = corners @ axes.T
    middle = axes @ np.array([width / 2.0, height / 2.0, 1.0])
    about = float(np.arctan2(middle[1], middle[0]))
    turned = (across[:, 0] + 1j * across[:, 1]) * np.exp(-1j * about)
    angles = about + np.angle(turned)
    return float(angles.min()), float(angles.max())


def limits_of(pencils: Pencils, table: OutlineTable, inverse: bool = False) -> Limits:
    """Return the limits of the outlines of F frames in D pencils.

    Outlines of what is not object are taken for those of objects where `inverse` asks for it; else
    they have none.
    """
    return _limits(
        pencils.cameras,
        pencils.axes,
        pencils.ends,
        table.corners_px,
        table.is_cut,
        table.first_corner,
        table.first_piece,
        table.is_inverse,
        inverse,
    )


@compiled
def _limits(
    cameras: NDArray[np.int64],
    axes: NDArray[np.float64],
    ends: NDArray[np.float64],
    corners: NDArray[np.float64],
    is_cut: NDArray[np.bool_],
    first_corner: NDArray[np.int64],
    first_piece: NDArray[np.int64],
    is_inverse: NDArray[np.bool_],
    inverse: bool,
) -> Limits:
    n_pencils, (n_frames, n_cameras) = len(cameras), is_inverse.shape
    angle = np.full((n_pencils, n_frames, 2, MOST_LIMITS), np.nan)
    gradient = np.zeros((n_pencils, n_frames, 2, MOST_LIMITS, 2))
    is_known = np.zeros((n_pencils, n_frames, 2, MOST_LIMITS), np.bool_)
    extremes = np.zeros((_MOST_PIECES, 2))
    at = np.zeros((_MOST_PIECES, 2), np.int64)
    for pencil in range(n_pencils):
        camera, axis = cameras[pencil, 0], axes[pencil]
        for frame in range(n_frames):
            row = frame * n_cameras + camera
            if is_inverse[frame, camera] and not inverse:
                continue
            n_pieces = 0
            surrounds = False
            for piece in range(first_piece[row], first_piece[row + 1]):
                if n_pieces == _MOST_PIECES:
                    break
                start, stop = first_corner[piece], first_corner[piece + 1]
                # The piece's own middle is where its angles do not wrap.
                middle_a, middle_b = 0.0, 0.0
                for corner in range(start, stop):
                    x, y = corners[corner, 0], corners[corner, 1]
                    a = axis[0, 0] * x + axis[0, 1] * y + axis[0, 2]
                    b = axis[1, 0] * x + axis[1, 1] * y + axis[1, 2]
                    size = np.sqrt(a * a + b * b)
                    if size > 0.0:
                        middle_a += a / size
                        middle_b += b / size
                about = np.arctan2(middle_b, middle_a)
                cosine, sine = np.cos(about), np.sin(about)
                low, high = np.inf, -np.inf
                for corner in range(start, stop):
                    x, y = corners[corner, 0], corners[corner, 1]
                    a = axis[0, 0] * x + axis[0, 1] * y + axis[0, 2]
                    b = axis[1, 0] * x + axis[1, 1] * y + axis[1, 2]
                    turned = np.arctan2(cosine * b - sine * a, cosine * a + sine * b)
                    if turned < low:
                        low = turned
                        at[n_pieces, 0] = corner
                    if turned > high:
                        high = turned
                        at[n_pieces, 1] = corner
                if high - low > _WIDEST:
                    surrounds = True
                    break
                extremes[n_pieces, 0], extremes[n_pieces, 1] = about + low, about + high
                n_pieces += 1
            if surrounds or n_pieces == 0:
                continue
            order = np.argsort(extremes[:n_pieces, 0])
            begins = np.zeros(n_pieces, np.int64)
            finishes = np.zeros(n_pieces, np.int64)
            widths = np.zeros(n_pieces)
            n_unions = 0
            for number in range(n_pieces):
                piece = order[number]
                if n_unions > 0:
                    last = finishes[n_unions - 1]
                    gx, gy = _gradient(axis, corners, at[last, 1])
                    gap = extremes[piece, 0] - extremes[last, 1]
                    if gap <= _GAP_PX * np.sqrt(gx * gx + gy * gy):
                        if extremes[piece, 1] > extremes[last, 1]:
                            finishes[n_unions - 1] = piece
                        continue
                begins[n_unions] = piece
                finishes[n_unions] = piece
                n_unions += 1
            for union in range(n_unions):
                widths[union] = extremes[finishes[union], 1] - extremes[begins[union], 0]
            widest = np.argsort(-widths[:n_unions])
            for number in range(min(n_unions, MOST_LIMITS)):
                union = widest[number]
                for kind in range(2):
                    piece = begins[union] if kind == LOW else finishes[union]
                    corner, value = at[piece, kind], extremes[piece, kind]
                    gx, gy = _gradient(axis, corners, corner)
                    margin = _MARGIN_PX * np.sqrt(gx * gx + gy * gy)
                    angle[pencil, frame, kind, number] = value
                    gradient[pencil, frame, kind, number, 0] = gx
                    gradient[pencil, frame, kind, number, 1] = gy
                    is_known[pencil, frame, kind, number] = (
                        not is_cut[corner]
                        and value > ends[pencil, 0] + margin
                        and value < ends[pencil, 1] - margin
                    )
    return Limits(angle, gradient, is_known)


@compiled
def _gradient(
    axis: NDArray[np.float64], corners: NDArray[np.float64], corner: int
) -> tuple[float, float]:
    """Return how the angle of a corner changes along x and y, radians a pixel."""
    x, y = corners[corner, 0], corners[corner, 1]
    a = axis[0, 0] * x + axis[0, 1] * y + axis[0, 2]
    b = axis[1, 0] * x + axis[1, 1] * y + axis[1, 2]
    size2 = a * a + b * b
    return (
        (a * axis[1, 0] - b * axis[0, 0]) / size2,
        (a * axis[1, 1] - b * axis[0, 1]) / size2,
    )


class Misses(NamedTuple):
    """By how much each limit misses its like in the other image; shapes as of `Limits`.

    Attributes
    ----------
    miss_px : (D, F, 2, K) float64
        r of this file's head; NaN where it is unknown.
    slope : (D, F, 2, K, 2) float64
        Its change as the pencil's own picture is shifted by a pixel along x and y.
    other_slope : (D, F, 2, K, 2) float64
        The same of the other one's picture.
    """

    miss_px: NDArray[np.float64]
    slope: NDArray[np.float64]
    other_slope: NDArray[np.float64]


def misses(limits: Limits, others: NDArray[np.int64], other: Limits) -> Misses:
    """Return by how much the limits of D pencils miss those nearest to them in the other images.

    Parameters
    ----------
    limits : Limits
        Of D pencils.
    others : (D,) int64
        Which of the other limits is the reverse of each pencil.
    other : Limits
        Of the other images, of as many frames.
    """
    return _misses(*limits, others, *other)


@compiled
def _misses(
    angle: NDArray[np.float64],
    gradient: NDArray[np.float64],
    is_known: NDArray[np.bool_],
    others: NDArray[np.int64],
    other_angle: NDArray[np.float64],
    other_gradient: NDArray[np.float64],
    other_is_known: NDArray[np.bool_],
) -> Misses:
    miss = np.full(angle.shape, np.nan)
    slope = np.zeros(gradient.shape)
    other_slope = np.zeros(gradient.shape)
    n_pencils, n_frames, n_kinds, n_limits = angle.shape
    for pencil in range(n_pencils):
        other = others[pencil]
        for frame in range(n_frames):
            for kind in range(n_kinds):
                for number in range(n_limits):
                    value = angle[pencil, frame, kind, number]
                    if np.isnan(value):
                        break
                    if not is_known[pencil, frame, kind, number]:
                        continue
                    nearest, best = -1, np.inf
                    for place in range(n_limits):
                        there = other_angle[other, frame, kind, place]
                        if np.isnan(there):
                            break
                        away = value - there
                        away = abs(away - 2.0 * np.pi * np.round(away / (2.0 * np.pi)))
                        if away < best:
                            best, nearest = away, place
                    if nearest < 0 or not other_is_known[other, frame, kind, nearest]:
                        continue
                    away = value - other_angle[other, frame, kind, nearest]
                    away -= 2.0 * np.pi * np.round(away / (2.0 * np.pi))
                    size2 = 0.0
                    for axis in range(2):
                        size2 += gradient[pencil, frame, kind, number, axis] ** 2
                        size2 += other_gradient[other, frame, kind, nearest, axis] ** 2
                    size = np.sqrt(size2)
                    miss[pencil, frame, kind, number] = away / size
                    for axis in range(2):
                        slope[pencil, frame, kind, number, axis] = (
                            gradient[pencil, frame, kind, number, axis] / size
                        )
                        other_slope[pencil, frame, kind, number, axis] = (
                            -other_gradient[other, frame, kind, nearest, axis] / size
                        )
    return Misses(miss, slope, other_slope)
