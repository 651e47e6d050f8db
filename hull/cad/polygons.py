"""Polygons of CAD files become triangles: as many as they have corners, less two, and none twice.

What counts as right is one rule, and it is checked without rounding: *no triangle may be turned
over*. Triangles whose outer edges are the polygon's cover each point as often as the polygon winds
about it. If none of them is turned over, nothing cancels; a polygon that does not cross itself,
convex or not, is then covered once, wholly, and nothing outside it.

A polygon is looked at along the axis that its normal is nearest to, which leaves its coordinates
what they are, so that the sign of each triangle can be computed exactly. A fan from its first
corner is taken where that obeys the rule, as it does for all convex polygons; of a quadrilateral
else the other diagonal; else ears are clipped. A corner may lie on an edge, or at the place of
another one, as where a hole was cut open towards the outline; triangles without area come of it at
times. Where rounding has turned corners over, the triangles are taken that turn over least, if that
is no more than single precision can tell. A polygon that crosses itself by more has no surface that
one could know, and is refused.

Corners of a file are never all in one plane to the last bit. Where they are out of it by more than
the six digits that exporters write, the polygon is bent: its surface depends on the cut, and any
two cuts differ by no more than the corners do along the normal. How many are bent and by how much
is kept, because it is an error of the part that no clearance knows.

References
----------
Shewchuk, Adaptive Precision Floating-Point Arithmetic and Fast Robust Geometric Predicates,
Discrete and Computational Geometry 18, 1997 (the bound of `turns`). Meisters, Polygons Have Ears,
American Mathematical Monthly 82, 1975. Newell's normal: Sutherland et al., ACM Computing Surveys
6(1), 1974.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

#: What corners may be out of a plane, as a share of their largest coordinate: half a unit in the
#: last of six digits is 5e-6 of a number that begins with 1; twice that, for two corners.
FLAT = 1e-5

#: What a triangle may be turned over, as the same share: four units in the last place of single
#: precision, in which most files were written.
_NOISE = 2.0**-22

#: Where no ear is left, cuts are compared that number with the third power of the corners.
_MAX_COMPARED = 1000

#: The rounding of a determinant of differences, relative to its two products: Shewchuk's
#: ccwerrboundA.
_ROUNDING = (3.0 + 16.0 * 2.0**-53) * 2.0**-53

#: Below this, products may have lost digits to underflow.
_TINY = 1e-290

_Point = tuple[float, float]
_Corners = tuple[int, int, int]


@dataclass(frozen=True, slots=True)
class Cuts:
    """What became of the polygons of a part.

    Attributes
    ----------
    n_polygons : int
        How many with more than three corners were cut.
    n_bent : int
        How many of these are not flat: their surface depends on where they are cut.
    bent_by : float
        The farthest that corners of one polygon are apart along its normal, in the unit of the
        part: two ways to cut it are no farther apart.
    """

    n_polygons: int = 0
    n_bent: int = 0
    bent_by: float = 0.0

    def __add__(self, other: "Cuts") -> "Cuts":
        return Cuts(
            self.n_polygons + other.n_polygons,
            self.n_bent + other.n_bent,
            max(self.bent_by, other.bent_by),
        )

    def scaled(self, factor: float) -> "Cuts":
        """Return the same of a part that became larger by a factor."""
        return Cuts(self.n_polygons, self.n_bent, self.bent_by * factor)


class PolygonError(ValueError):
    """A polygon has no surface that one could know; `number` says which."""

    def __init__(self, number: int, found: str) -> None:
        super().__init__(found)
        self.number = number


def cut_polygons(
    vertices: NDArray[np.float64], corners: NDArray[np.int64], counts: NDArray[np.int64]
) -> tuple[NDArray[np.int32], Cuts]:
    """Return triangles for polygons, those of each polygon together and in the polygons' order.

    Parameters
    ----------
    vertices : (V, 3) float64
        Coordinates. A polygon with one that is not finite becomes a fan.
    corners : (C,) int64
        Vertex numbers, those of each polygon together, counter-clockwise seen from outside.
    counts : (P,) int64
        How many corners each polygon has.

    Returns
    -------
    faces : (T, 3) int32
        Of a polygon of n corners n - 2, with its sense of rotation.
    cuts : Cuts
        What became of those with more than three corners.

    Raises
    ------
    PolygonError
        If a polygon has fewer than three corners, or crosses itself.
    ValueError
        If a corner names a vertex that is not there.
    """
    if len(corners) and (corners.min() < 0 or corners.max() >= len(vertices)):
        wrong = corners.max() if corners.max() >= len(vertices) else corners.min()
        raise ValueError(f"a face names vertex {wrong} of {len(vertices)}, counted from 0")
    if (counts < 3).any():
        number = int(np.argmax(counts < 3))
        raise PolygonError(number, f"a face of {counts[number]} corners")
    first_corners = np.concatenate([[0], np.cumsum(counts)])[:-1]
    first_faces = np.concatenate([[0], np.cumsum(counts - 2)])[:-1]
    faces = np.zeros((int((counts - 2).sum()), 3), np.int32)
    cuts = Cuts()
    for n in np.unique(counts).tolist():
        numbers = np.flatnonzero(counts == n)
        polygons = corners[first_corners[numbers][:, None] + np.arange(n)]  # (P, n)
        fans = np.stack([np.zeros(n - 2, np.int64), np.arange(1, n - 1), np.arange(2, n)], axis=1)
        if n == 3:
            local = np.broadcast_to(fans, (len(numbers), 1, 3))
        else:
            local, found = _cut_alike(vertices[polygons], fans, numbers)
            cuts += found
        places = first_faces[numbers][:, None] + np.arange(n - 2)
        faces[places] = np.take_along_axis(polygons[:, None, :], local, axis=2)
    return faces, cuts


def _cut_alike(
    points: NDArray[np.float64], fan: NDArray[np.int64], numbers: NDArray[np.int64]
) -> tuple[NDArray[np.int64], Cuts]:
    """Return the triangles (P, n - 2, 3) of polygons (P, n, 3) of equally many corners."""
    n = points.shape[1]
    local = np.tile(fan, (len(points), 1, 1))
    usable = np.flatnonzero(np.isfinite(points).all(axis=(1, 2)))
    # By a power of two, which is exact, so that no product is too large.
    reach = np.abs(points[usable]).max(axis=(1, 2))
    exponents = np.frexp(reach)[1]
    scaled = np.ldexp(points[usable], -exponents[:, None, None])
    edges = scaled - scaled[:, :1]
    crosses = np.cross(edges, np.roll(edges, -1, axis=1))
    normals = crosses.sum(axis=1)  # (P, 3), twice the area
    lengths = np.linalg.norm(normals, axis=1)
    along = np.einsum("pnk,pk->pn", edges, normals / np.where(lengths > 0, lengths, 1.0)[:, None])
    bent = np.ptp(along, axis=1)
    largest = np.ldexp(reach, -exponents)
    flat = look_along(scaled, crosses)
    a, b, c = (flat[:, fan[:, corner]] for corner in range(3))
    well: NDArray[np.bool_] = np.all(turns(a, b, c) >= 0, axis=1)
    if n == 4 and not well.all():
        other = np.array([[1, 2, 3], [1, 3, 0]])
        rest = np.flatnonzero(~well)
        a, b, c = (flat[rest][:, other[:, corner]] for corner in range(3))
        turned = rest[(turns(a, b, c) >= 0).all(axis=1)]
        local[usable[turned]] = other
        well[turned] = True
    for number in np.flatnonzero(~well).tolist():
        noise = _NOISE * float(largest[number])
        found = clip_ears([(x, y) for x, y in flat[number].tolist()])
        if found is None:
            found = _turn_least(flat[number], noise)
        if found is None:
            raise PolygonError(
                int(numbers[usable[number]]),
                f"a polygon of {n} corners crosses itself; cut it into triangles and export again",
            )
        local[usable[number]] = found
    return local, Cuts(
        n_polygons=len(points),
        n_bent=int((bent > FLAT * largest).sum()),
        bent_by=float(np.ldexp(bent, exponents).max(initial=0.0)),
    )


def look_along(points: NDArray[np.float64], crosses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return polygons (P, n, 3) as seen against their normals, along an axis: (P, n, 2).

    Their coordinates stay what they are; polygons come out counter-clockwise. Given are the cross
    products (P, n, 3) of the edges of a fan, whose sum is the normal. Where they cancel each other,
    as in a bow tie, the axis is that of most of them.
    """
    normals, sizes = crosses.sum(axis=1), np.abs(crosses).sum(axis=1)
    cancels = np.linalg.norm(normals, axis=1) < 1e-3 * np.linalg.norm(sizes, axis=1)
    axes = np.argmax(np.where(cancels[:, None], sizes, np.abs(normals)), axis=1)
    turned_over = np.take_along_axis(normals, axes[:, None], axis=1)[:, 0] < 0
    first, second = (axes + 1) % 3, (axes + 2) % 3
    columns = np.where(
        turned_over[:, None],
        np.stack([second, first], axis=1),
        np.stack([first, second], axis=1),
    )
    every = np.broadcast_to(columns[:, None], (*points.shape[:2], 2))
    return np.take_along_axis(points, every, axis=2)


def turns(
    a: NDArray[np.float64], b: NDArray[np.float64], c: NDArray[np.float64]
) -> NDArray[np.int8]:
    """Return 1 where points (..., 2) turn left from a by b to c, -1 right, 0 on a line: exactly."""
    left = (a[..., 0] - c[..., 0]) * (b[..., 1] - c[..., 1])
    right = (a[..., 1] - c[..., 1]) * (b[..., 0] - c[..., 0])
    signs = np.sign(left - right).astype(np.int8)
    sure = np.abs(left - right) > _ROUNDING * (np.abs(left) + np.abs(right)) + _TINY
    for place in zip(*np.nonzero(~sure), strict=True):
        signs[place] = _turn_exactly(*(tuple(point[place].tolist()) for point in (a, b, c)))
    return signs


def _turn(a: _Point, b: _Point, c: _Point) -> int:
    """Return 1, -1 or 0, as `turns` does, of three points."""
    left = (a[0] - c[0]) * (b[1] - c[1])
    right = (a[1] - c[1]) * (b[0] - c[0])
    determinant = left - right
    if abs(determinant) > _ROUNDING * (abs(left) + abs(right)) + _TINY:
        return 1 if determinant > 0 else -1
    return _turn_exactly(a, b, c)


def _turn_exactly(a: _Point, b: _Point, c: _Point) -> int:
    if a in (b, c) or b == c:
        return 0
    (ax, ay), (bx, by), (cx, cy) = ((Fraction(x), Fraction(y)) for x, y in (a, b, c))
    determinant = (ax - cx) * (by - cy) - (ay - cy) * (bx - cx)
    return (determinant > 0) - (determinant < 0)


def clip_ears(points: Sequence[_Point]) -> list[_Corners] | None:
    """Return the triangles of a counter-clockwise polygon, none turned over, or None.

    There always are some if it does not cross or touch itself. Where it touches itself, an ear may
    be chosen that leads nowhere.
    """
    n = len(points)
    after = [*range(1, n), 0]
    before = [n - 1, *range(n - 1)]
    turn = [_turn(points[before[k]], points[k], points[after[k]]) for k in range(n)]
    triangles: list[_Corners] = []
    corner, waited, left = 0, 0, n
    while left > 3:
        a, c = before[corner], after[corner]
        if waited < left:  # only ears that have area and are free of any other corner
            is_ear = turn[corner] > 0 and _is_free(points, turn, after, a, corner, c)
        elif waited < 2 * left:  # then corners on a line, which have no ear worth the name
            is_ear = turn[corner] == 0
        else:
            return None
        if not is_ear:
            corner, waited = c, waited + 1
            continue
        triangles.append((a, corner, c))
        after[a], before[c] = c, a
        left -= 1
        turn[a] = _turn(points[before[a]], points[a], points[c])
        turn[c] = _turn(points[a], points[c], points[after[c]])
        corner, waited = after[c], 0  # not the neighbour: fans of slivers would come of it
    last = (before[corner], corner, after[corner])
    if _turn(*(points[k] for k in last)) < 0:
        return None
    return [*triangles, last]


def _is_free(
    points: Sequence[_Point], turn: list[int], after: list[int], a: int, b: int, c: int
) -> bool:
    """Tell whether no other corner lies in the triangle of corners a, b, c or on its edges.

    Only corners that do not turn left can be the first to come in. One at the place of a, b or c
    is no matter here.
    """
    pa, pb, pc = points[a], points[b], points[c]
    (x_low, _, x_high), (y_low, _, y_high) = (sorted((pa[k], pb[k], pc[k])) for k in range(2))
    other = after[c]
    while other != a:
        if turn[other] <= 0:
            p = points[other]
            if (
                x_low <= p[0] <= x_high
                and y_low <= p[1] <= y_high
                and p not in (pa, pb, pc)
                and _turn(pa, pb, p) >= 0
                and _turn(pb, pc, p) >= 0
                and _turn(pc, pa, p) >= 0
            ):
                return False
        other = after[other]
    return True


def _turn_least(points: NDArray[np.float64], allowed: float) -> list[_Corners] | None:
    """Return the triangles of a polygon (n, 2) that turn over least, by their height, or None.

    None if one turns over by more than allowed. All ways to cut it are compared, by dynamic
    programming over the chains of corners from i to j.
    """
    n = len(points)
    if n > _MAX_COMPARED:
        return None
    over = np.zeros((n, n))
    apex = np.zeros((n, n), np.int64)
    for length in range(2, n):
        i = np.arange(n - length)[:, None]
        j, k = i + length, i + np.arange(1, length)
        worst = np.maximum(_turned_over_by(points[i], points[k], points[j]), over[i, k])
        worst = np.maximum(worst, over[k, j])
        best = np.argmin(worst, axis=1)
        over[i[:, 0], j[:, 0]] = worst[i[:, 0], best]
        apex[i[:, 0], j[:, 0]] = k[i[:, 0], best]
    if over[0, n - 1] > allowed:
        return None
    triangles: list[_Corners] = []
    waiting = [(0, n - 1)]
    while waiting:
        first, last = waiting.pop()
        if last - first > 1:
            middle = int(apex[first, last])
            triangles.append((first, middle, last))
            waiting += [(middle, last), (first, middle)]
    return triangles


def _turned_over_by(
    a: NDArray[np.float64], b: NDArray[np.float64], c: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the heights over their longest edges of triangles that turn right, else 0."""
    u, v = b - a, c - a
    twice_area = u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]
    longest = np.sqrt(
        np.max(
            [(edge**2).sum(axis=-1) * np.ones(twice_area.shape) for edge in (u, v, c - b)], axis=0
        )
    )
    result: NDArray[np.float64] = np.maximum(-twice_area, 0.0) / np.where(longest > 0, longest, 1.0)
    return result


def cut_holes_open(outline: NDArray[np.float64], holes: Sequence[NDArray[np.float64]]) -> list[int]:
    """Return one chain of corners for a polygon with holes, its outline joined with each by a slit.

    Parameters
    ----------
    outline : (n, 3) float64
        The corners of the outline.
    holes : sequence of (m, 3) float64
        Those of the holes, in any sense of rotation.

    Returns
    -------
    chain : list of int
        Numbers of corners, counted through the outline and then through hole after hole; both ends
        of a slit come twice.

    Raises
    ------
    PolygonError
        If a hole is not inside the outline, or crosses it or another.
    """
    points = np.concatenate([outline, *holes])
    reach = float(np.abs(points).max())
    scaled = np.ldexp(points, -int(np.frexp(reach)[1]))[None]
    edges = scaled[:, : len(outline)] - scaled[:, :1]
    flat = look_along(scaled, np.cross(edges, np.roll(edges, -1, axis=1)))[0]
    chain = list(range(len(outline)))
    rings = []
    start = len(outline)
    for hole in holes:
        ring = list(range(start, start + len(hole)))
        start += len(hole)
        rings.append(ring if _signed_area(flat[ring]) < 0 else ring[::-1])
    # From right to left: the corner of a hole that lies farthest right sees a corner of the chain,
    # because whatever lies right of it belongs to the chain by then.
    rings.sort(key=lambda ring: -float(flat[ring, 0].max()))
    walls = [_edges(chain), *(_edges(ring) for ring in rings)]
    for ring in rings:
        slit = _find_slit(flat, chain, ring, np.concatenate(walls))
        if slit is None:
            raise PolygonError(
                0, "a hole of a polygon is not inside it; cut it into triangles and export again"
            )
        first, second = slit
        walls.append(np.array([[chain[first], ring[second]]]))
        chain = [*chain[: first + 1], *ring[second:], *ring[: second + 1], *chain[first:]]
    return chain


def _edges(ring: Sequence[int]) -> NDArray[np.int64]:
    return np.array([*pairwise(ring), (ring[-1], ring[0])], np.int64)


def _signed_area(points: NDArray[np.float64]) -> float:
    x, y = (points - points[0]).T
    return float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum() / 2.0)


def _find_slit(
    points: NDArray[np.float64], chain: list[int], ring: list[int], walls: NDArray[np.int64]
) -> tuple[int, int] | None:
    """Return places in chain and ring, the nearest whose corners see each other past the walls."""
    apart = np.linalg.norm(points[chain][:, None] - points[ring][None], axis=2)
    c, d = points[walls[:, 0]], points[walls[:, 1]]
    for place in np.argsort(apart, axis=None, kind="stable").tolist():
        first, second = divmod(place, len(ring))
        at, of = chain[first], ring[second]
        a, b = np.broadcast_to(points[at], c.shape), np.broadcast_to(points[of], c.shape)
        meets = (turns(a, b, c) * turns(a, b, d) <= 0) & (turns(c, d, a) * turns(c, d, b) <= 0)
        # A wall that begins at either end, and lies in line with the slit, only makes it shorter.
        blocked = meets & ~np.isin(walls, [at, of]).any(axis=1)
        if not blocked.any() and _opens_into(points, chain, first, of):
            return first, second
    return None


def _opens_into(points: NDArray[np.float64], chain: list[int], place: int, target: int) -> bool:
    """Tell whether a slit from a corner of a chain starts on the inside, left of its two edges.

    A corner that comes twice in the chain, because a slit ends there, sees a part at each place.
    """
    before, at, after = (
        tuple(points[chain[(place + step) % len(chain)]].tolist()) for step in (-1, 0, 1)
    )
    to = tuple(points[target].tolist())
    left_of_first, left_of_second = _turn(before, at, to) > 0, _turn(at, after, to) > 0
    if _turn(before, at, after) > 0:
        return left_of_first and left_of_second
    return left_of_first or left_of_second
