"""The volume query in whole numbers: no rounding, so what it says of a sample is so.

Every float64 is a whole number times a power of two. Projections and corners are taken as such
numbers, and only the question remains which pixel a quotient of two of them falls into. The rest of
this room asks the same of rays, of triangles under silhouettes that are rectangles, and of
distances.
"""

import itertools
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from helpers.exact_geometry import squared_to_triangle
from hybridve.hull.query.engine import Triangles
from hybridve.hull.query.silhouettes import Hull
from hybridve.hull.query.viewport import sample_steps

#: Whole numbers of any size, in an array of Python's.
Integers = NDArray[np.object_]


def as_integers(values: NDArray[np.float64]) -> tuple[Integers, int]:
    """Return whole numbers and an exponent: ``values == integers * 2.0**exponent``, exactly."""
    mantissa, exponents = np.frexp(np.asarray(values, np.float64))
    whole = (mantissa * 2.0**53).astype(np.int64)
    exponents = exponents.astype(np.int64) - 53
    lowest = min(int(exponents[whole != 0].min(initial=0)), 0)
    shift = np.where(whole != 0, exponents - lowest, 0)
    return whole.astype(object) * (np.full(whole.shape, 2, object) ** shift.astype(object)), lowest


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """What is true of the samples of a mesh.

    Attributes
    ----------
    inside : (S,) bool
        Which are in the hull.
    edge_px : (S,) float64
        How near any camera's projection of each is to the edge of a pixel, in pixels; 0 for one
        that lies in a camera's own plane but for a billionth of its coordinates.
    """

    inside: NDArray[np.bool_]
    edge_px: NDArray[np.float64]


def _projections(hull: Hull, points_world: NDArray[np.float64]) -> Integers:
    """Return the homogeneous pixels (C, N, 3) of points, up to a scale that all share."""
    matrices, _ = as_integers(hull.views.img_from_local)
    points, exponent = as_integers(np.concatenate([hull.views.origin_world[None], points_world]))
    local = points[1:] - points[0]  # (N, 3)
    one = 2**-exponent
    sums = [
        [
            sum(matrix[row, axis] * local[:, axis] for axis in range(3)) + matrix[row, 3] * one
            for row in range(3)
        ]
        for matrix in matrices
    ]
    return np.array(sums, object).reshape(len(matrices), 3, len(local)).transpose(0, 2, 1)


def _look(
    hull: Hull, camera: int, projected: Integers
) -> tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.float64]]:
    """Return which of some projections (N, 3) are seen, which on object, and how near an edge."""
    width, height = hull.views.sizes_px[camera].tolist()
    in_front = (projected[:, 2] > 0).astype(np.bool_)
    depth = np.where(in_front, projected[:, 2], 1)
    pixels = projected[:, :2] // depth[:, None]
    rest = projected[:, :2] - pixels * depth[:, None]
    to_edge = np.minimum(rest, depth[:, None] - rest).min(axis=1)
    edge_px = np.where(in_front, (to_edge / depth).astype(np.float64), np.inf)
    seen = in_front & ((pixels >= 0) & (pixels < np.array([width, height], object))).all(
        axis=1
    ).astype(np.bool_)
    column, row = np.where(seen[:, None], pixels, 0).astype(np.int64).T
    recorded = hull.views.seen_mask(camera)
    if recorded is not None:
        seen &= recorded[row, column] != 0
    return seen, seen & (hull.mask(camera)[row, column] != 0), edge_px


def _verdict(hull: Hull, projected: Integers) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    views = hull.views
    n_seen = np.zeros(projected.shape[1], np.int64)
    denied = np.zeros(projected.shape[1], np.bool_)
    nearest_px = np.full(projected.shape[1], np.inf)
    for camera in range(len(views)):
        seen, on_object, edge_px = _look(hull, camera, projected[camera])
        n_seen += seen
        denied |= seen & ~on_object
        nearest_px = np.minimum(nearest_px, edge_px)
    needed = len(views) if views.unseen == "carve" else views.min_cameras
    return ~denied & (n_seen >= needed), nearest_px


def contains(hull: Hull, points_world: NDArray[np.float64]) -> Samples:
    """Return what is true of points (N, 3)."""
    return Samples(*_verdict(hull, _projections(hull, points_world)))


def samples(hull: Hull, mesh: Triangles, numbers: NDArray[np.int64] | None = None) -> Samples:
    """Return what is true of the samples of a mesh: of all in their order, or of some numbers."""
    before = mesh.topology.samples_before
    if numbers is None:
        numbers = np.arange(before[-1])
    if len(numbers) == 0:
        return Samples(np.zeros(0, np.bool_), np.zeros(0))
    at_vertices = _projections(hull, mesh.vertices_world)
    triangle = np.searchsorted(before, numbers, side="right") - 1
    viewports = mesh.viewports[triangle]
    i, j = sample_steps(viewports, (numbers - before[triangle]).astype(np.uint32))
    steps = np.maximum(viewports.astype(np.int64) - 1, 1)
    # (u - 1 - i - j) a + i b + j c; of the centroid a + b + c.
    weights = [
        np.where(viewports == 1, 1, weight).astype(object) for weight in (steps - i - j, i, j)
    ]
    corners = [at_vertices[:, mesh.faces[triangle, k]] for k in range(3)]
    projected = sum(
        weight[None, :, None] * corner for weight, corner in zip(weights, corners, strict=True)
    )
    inside, edge_px = _verdict(hull, projected)
    # In a camera's own plane the sign of a depth is that of its rounding.
    reach = sum(np.abs(corner[..., 2]) for corner in corners) * steps.astype(object)
    in_plane = (np.abs(projected[..., 2]) * 10**9 < reach).any(axis=0).astype(np.bool_)
    return Samples(inside, np.where(in_plane, 0.0, edge_px))


def runs_inside(
    hull: Hull, boxes: list[tuple[int, int, int, int]], mesh: Triangles
) -> NDArray[np.int64]:
    """Return the runs (R, 2) of samples of the one triangle of a mesh that are in a hull.

    The silhouettes are rectangles, so each row of the viewport has one run at most; for viewports
    with more samples than could be asked one by one.
    """
    u = int(mesh.viewports[0])
    at_corners = _projections(hull, mesh.vertices_world[mesh.faces[0]])
    j = np.arange(u).astype(object)
    first, last = np.zeros(u, object), (u - 1) - j
    for (left, top, right, bottom), corners in zip(boxes, at_corners, strict=True):
        x, y, z = corners.T  # of a, b, c each
        for plane, is_strict in (
            (z, True),
            (x - left * z, False),
            (right * z - x, True),
            (y - top * z, False),
            (bottom * z - y, True),
        ):
            # Whole numbers: above 0 is 1 or more.
            at_row = plane[0] * (u - 1) + (plane[2] - plane[0]) * j - int(is_strict)
            slope = plane[1] - plane[0]
            if slope > 0:
                first = np.maximum(first, -(at_row // slope))
            elif slope < 0:
                last = np.minimum(last, at_row // -slope)
            else:
                last = np.where(at_row >= 0, last, -1)
    is_some = (first <= last).astype(np.bool_)
    row_start = (j * u - j * (j - 1) // 2)[is_some]
    runs = np.stack([row_start + first[is_some], row_start + last[is_some] + 1], axis=1)
    return runs.astype(np.int64)


def leaves_at(
    hull: Hull,
    start_world: NDArray[np.float64],
    direction: NDArray[np.float64],
    height_m: float,
    reach_m: float,
    least_m: float,
) -> float | None:
    """Return where a ray leaves the hull, in lengths of `direction`.

    Of its stretches in the hull the last that begins below `height_m` counts: where that ends, or
    None if none does. One that goes on to `reach_m` ends there. Gaps and then stretches no longer
    than `least_m` are none: a ray through the corner of a pixel has one side of it as a gap, which
    no rounded direction holds.
    """
    matrices, _ = as_integers(hull.views.img_from_local)
    both, exponent = as_integers(
        np.stack([hull.views.origin_world, start_world, start_world + 0.0, direction])
    )
    local, step, one = both[1] - both[0], both[3], 2**-exponent
    height, reach, least = Fraction(height_m), Fraction(reach_m), Fraction(least_m)
    begin = [[sum(row[:3] * local) + row[3] * one for row in matrix] for matrix in matrices]
    along = [[sum(row[:3] * step) for row in matrix] for matrix in matrices]
    # What a camera says changes at its own lines of pixels alone.
    changes: list[tuple[Fraction, int, bool, bool]] = []
    for camera, (h0, h1) in enumerate(zip(begin, along, strict=True)):
        edges = sorted(_cuts(h0, h1, hull.views.sizes_px[camera].tolist(), reach))
        middles = [(a + b) / 2 for a, b in itertools.pairwise(edges)]
        projected = np.array(
            [[h0[k] * t.denominator + t.numerator * h1[k] for k in range(3)] for t in middles],
            object,
        )
        seen, on_object, _ = _look(hull, camera, projected.reshape(-1, 3))
        changes += zip(edges, itertools.repeat(camera), seen, seen & ~on_object, strict=False)
    changes.sort(key=lambda change: change[0])
    seen_by, denied_by = np.zeros((2, len(begin)), np.bool_)
    needed = len(begin) if hull.views.unseen == "carve" else hull.views.min_cameras
    stretches: list[list[Fraction]] = []
    for number, (at, camera, is_seen, is_denied) in enumerate(changes):
        seen_by[camera], denied_by[camera] = is_seen, is_denied
        until = changes[number + 1][0] if number + 1 < len(changes) else reach
        if at == until or denied_by.any() or seen_by.sum() < needed:
            continue
        if stretches and at - stretches[-1][1] <= least:
            stretches[-1][1] = until
        else:
            stretches.append([at, until])
    ends = [end for begin, end in stretches if begin < height and end - begin > least]
    return float(ends[-1]) if ends else None


def _cuts(h0: list[int], h1: list[int], sizes: list[int], reach: Fraction) -> set[Fraction]:
    """Return where h0 + t h1 crosses a line of pixels or depth 0 up to `reach`; and both ends."""
    found = {Fraction(0), reach}
    for axis, size in enumerate(sizes):
        for k in range(size + 1):
            away, speed = k * h0[2] - h0[axis], h1[axis] - k * h1[2]
            if speed:
                found.add(Fraction(away, speed))
    if h1[2]:
        found.add(Fraction(-h0[2], h1[2]))
    return {cut for cut in found if 0 <= cut <= reach}


def rectangles(hull: Hull) -> list[tuple[int, int, int, int]] | None:
    """Return the silhouettes as left, top, right, bottom (the last two not in them), or None.

    None where one is empty or no rectangle, or a camera may abstain: then the hull is no
    intersection of half-spaces.
    """
    if hull.views.unseen == "keep":
        return None
    found = []
    for camera in range(len(hull.views)):
        mask = hull.mask(camera)
        rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        if len(rows) == 0:
            return None
        box = (int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1)
        if not mask[box[1] : box[3], box[0] : box[2]].all():
            return None
        found.append(box)
    return found


def half_spaces(hull: Hull, boxes: list[tuple[int, int, int, int]]) -> Integers:
    """Return planes (4 C, 4) of the local frame, 0 or positive in the hull, up to scale each."""
    matrices, _ = as_integers(hull.views.img_from_local)
    planes = []
    for matrix, (left, top, right, bottom) in zip(matrices, boxes, strict=True):
        planes += [
            matrix[2],
            matrix[0] - left * matrix[2],
            right * matrix[2] - matrix[0],
            matrix[1] - top * matrix[2],
            bottom * matrix[2] - matrix[1],
        ]
    return np.array(planes, object)


def clipped(
    hull: Hull, planes: Integers, corners_world: NDArray[np.float64]
) -> tuple[list[tuple[Fraction, ...]], bool]:
    """Return the part of a triangle (3, 3) in half-spaces, and whether some point is well in all.

    The part is a polygon, its corners in shares of the triangle's corners; empty if nothing is in
    all of them, be it on their border.
    """
    both, exponent = as_integers(np.concatenate([hull.views.origin_world[None], corners_world]))
    local, one = both[1:] - both[0], 2**-exponent
    values = [[sum(plane[:3] * corner) + plane[3] * one for corner in local] for plane in planes]
    polygon = [tuple(Fraction(int(k == corner)) for k in range(3)) for corner in range(3)]
    for value in values:
        at = [sum(share * v for share, v in zip(point, value, strict=True)) for point in polygon]
        kept: list[tuple[Fraction, ...]] = []
        for k, point in enumerate(polygon):
            following, ahead = polygon[(k + 1) % len(polygon)], at[(k + 1) % len(polygon)]
            if at[k] >= 0:
                kept.append(point)
            if (at[k] > 0 > ahead) or (at[k] < 0 < ahead):
                share = at[k] / (at[k] - ahead)
                kept.append(
                    tuple(a + share * (b - a) for a, b in zip(point, following, strict=True))
                )
        polygon = kept
        if not polygon:
            return [], False
    middle = [sum(column) / len(polygon) for column in zip(*polygon, strict=True)]
    is_well_in = all(
        sum(share * v for share, v in zip(middle, value, strict=True)) > 0 for value in values
    )
    return polygon, is_well_in


def distance(
    point: NDArray[np.float64], vertices: NDArray[np.float64], faces: NDArray[np.int32]
) -> float:
    """Return the distance of a point (3,) and a mesh, rounded once at its end."""
    corners = vertices[faces]
    beyond = np.maximum(np.maximum(corners.min(axis=1) - point, point - corners.max(axis=1)), 0)
    at_least = np.linalg.norm(beyond, axis=1)
    best = None
    for number in np.argsort(at_least, kind="stable"):
        if best is not None and at_least[number] ** 2 > float(best) * (1 + 1e-9):
            break
        squared = squared_to_triangle(point, corners[number])
        best = squared if best is None or squared < best else best
    return 0.0 if not best else _root(best)


def _root(squared: Fraction) -> float:
    """Return a square root; of numbers that float64 does not hold, too."""
    shift = (squared.denominator.bit_length() - squared.numerator.bit_length()) // 2
    return float(np.ldexp(float(squared * Fraction(4) ** shift) ** 0.5, -shift))
