"""What the edges of a mesh say: whether it closes off a volume, and where it does not.

Files repeat a vertex for every face that uses it (STL) or for every normal (glTF, STEP), so edges
are compared between vertices of equal coordinates, in the numbers of the file. An edge is fine when
exactly two triangles use it, in opposite directions. A mesh is closed when all its edges are; then
how often its surface goes round a point is an integer for every point that is not on it, and inside
and outside can be told apart everywhere (`hybridve.hull.cad.distance` says what inside is).
Where two triangles use an edge in the same direction the number is none: such a mesh is not closed.
The rule is stricter than that: two cubes that share an edge, or a solid that is there twice, are
not closed either. For where more than two triangles meet at an edge, walls may be there from both
sides, as made for pictures; these go round nothing, and all within would count as outside. The mesh
itself is never touched.

Two things that files are full of do not count against a mesh.

*Triangles without area* add nothing to the surface. One with two corners at the same place uses one
edge there and back; it is never looked at. One with three corners on a line may be all that joins a
long edge to the two halves on its other side; dropped, it would leave three open edges where there
is no gap. So a mesh is closed if it is with these, or if it is without.

*Noise in the last bit* of single precision, such as 1e-16 in one face and 0 in the next: four of 26
real STL files are closed but for that. If a mesh is not closed as it stands, it is looked at once
more with coordinates taken as equal that differ by no more than two units in the last place of the
largest, as single precision counts. If it is closed then, `closed_within` says how much was
allowed; the edges are counted as the file has them all the same.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

#: How many open edges are compared with each other; more is no gap, but a surface that is open.
_MAX_OPEN_EDGES = 4000


@dataclass(frozen=True, slots=True)
class Topology:
    """What is to be known of a mesh before anything is said about its inside.

    Attributes
    ----------
    n_zero_area : int
        How many triangles have no area.
    n_open_edges, n_nonmanifold_edges, n_inconsistent_edges : int
        Edges that one triangle uses; that three or more use; that two use in the same direction.
    closed_within : float or None
        How far apart coordinates may be, in the unit of the mesh, for vertices to be at one place
        and the mesh to be closed: 0, or the noise of single precision. None if it is not closed.
    volume : float or None
        What a closed mesh encloses, in cubes of its unit; negative if it is inside out. None if it
        is not closed.
    """

    n_zero_area: int
    n_open_edges: int
    n_nonmanifold_edges: int
    n_inconsistent_edges: int
    closed_within: float | None
    volume: float | None

    @property
    def closed(self) -> bool:
        """Whether inside and outside can be told apart."""
        return self.closed_within is not None


def examine_topology(vertices: NDArray[np.float64], faces: NDArray[np.int32]) -> Topology:
    """Return what the edges of a mesh say.

    Parameters
    ----------
    vertices : (V, 3) float64
        Finite.
    faces : (T, 3) int32
        Vertex numbers, counter-clockwise seen from outside.
    """
    has_area = _has_area(vertices, faces)
    meeting = _meet(vertices, faces, has_area)
    counts = meeting.counts
    return Topology(
        n_zero_area=int((~has_area).sum()),
        n_open_edges=counts[0],
        n_nonmanifold_edges=counts[1],
        n_inconsistent_edges=counts[2],
        closed_within=meeting.within,
        volume=None if meeting.within is None else _volume(*np.moveaxis(vertices[faces], 1, 0)),
    )


def meeting_faces(
    vertices: NDArray[np.float64], faces: NDArray[np.int32]
) -> NDArray[np.int32] | None:
    """Return a closed mesh in vertex numbers that are equal where corners meet.

    Whatever rounding does to the vertices when they are placed, the surface stays closed in these
    numbers.

    Parameters
    ----------
    vertices : (V, 3) float64
        As the file has them: after they were turned, what met may be apart.
    faces : (T, 3) int32
        Vertex numbers.

    Returns
    -------
    (T, 3) int32 or None
        Each corner's place is the vertex with the lowest number there. A triangle without which the
        mesh is closed has one number thrice. None if the mesh is not closed.
    """
    meeting = _meet(vertices, faces, _has_area(vertices, faces))
    if meeting.within is None:
        return None
    _, lowest = np.unique(meeting.places, return_index=True)
    numbers = lowest[meeting.places][faces]
    numbers[~meeting.counted] = numbers[~meeting.counted][:, :1]
    return numbers.astype(np.int32)


def _has_area(vertices: NDArray[np.float64], faces: NDArray[np.int32]) -> NDArray[np.bool_]:
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    result: NDArray[np.bool_] = np.linalg.norm(np.cross(b - a, c - a), axis=1) != 0
    return result


class _Meeting(NamedTuple):
    """Where corners meet.

    `places` (V,) are numbers of places from 0 on, `counted` (T,) the triangles that edges were
    compared between, `counts` the edges that are open, non-manifold and inconsistent in the numbers
    of the file, and `within` what `Topology.closed_within` is.
    """

    places: NDArray[np.int64]
    counted: NDArray[np.bool_]
    counts: tuple[int, int, int]
    within: float | None


def _meet(
    vertices: NDArray[np.float64], faces: NDArray[np.int32], has_area: NDArray[np.bool_]
) -> _Meeting:
    places = places_of(vertices, 0.0)
    counts, counted = _bad_edges(places[faces], has_area)
    if not has_area.any():
        return _Meeting(places, counted, counts, None)
    if not any(counts):
        return _Meeting(places, counted, counts, 0.0)
    noise = float(np.abs(vertices[faces]).max()) * 2.0**-22
    places = places_of(vertices, noise)
    bad, counted = _bad_edges(places[faces], has_area)
    # No triangle may be lost: what is as fine as the noise cannot be told from a crack.
    is_closed = not any(bad) and _has_three_corners(places[faces])[has_area].all()
    return _Meeting(places, counted, counts, noise if is_closed else None)


def places_of(vertices: NDArray[np.float64], apart: float) -> NDArray[np.int64]:
    """Return a number for each vertex (V,): the same for coordinates that are at most so far apart.

    Or that are joined by others between them, each no farther from the next.
    """
    places = np.zeros(len(vertices), np.int64)
    for axis in range(3):
        coordinates = vertices[:, axis]
        order = np.argsort(coordinates)
        steps = np.cumsum(np.diff(coordinates[order]) > apart)
        column = np.zeros(len(vertices), np.int64)
        column[order[1:]] = steps
        # Both are below the number of vertices, so that their pairs fit into 64 bits.
        pairs = places * (len(vertices) + 1) + column
        order = np.argsort(pairs)
        places = np.zeros(len(vertices), np.int64)
        places[order[1:]] = np.cumsum(np.diff(pairs[order]) > 0)
    return places


def _has_three_corners(places: NDArray[np.int64]) -> NDArray[np.bool_]:
    first, second, third = places.T
    result: NDArray[np.bool_] = (first != second) & (second != third) & (third != first)
    return result


def _bad_edges(
    places: NDArray[np.int64], has_area: NDArray[np.bool_]
) -> tuple[tuple[int, int, int], NDArray[np.bool_]]:
    """Return how many edges are open, non-manifold and inconsistent, and of which triangles.

    Of triangles (T, 3) with three corners; or, if there is none among those with area, of these.
    """
    has_three_corners = _has_three_corners(places)
    counts = _count_edges(places[has_three_corners])
    if any(counts) and (has_three_corners & ~has_area).any():
        without = _count_edges(places[has_three_corners & has_area])
        if not any(without):
            return without, has_three_corners & has_area
    return counts, has_three_corners


def _count_edges(places: NDArray[np.int64]) -> tuple[int, int, int]:
    """Return how many edges of triangles (T, 3) are open, non-manifold and inconsistent."""
    tails = places.ravel()
    heads = np.roll(places, -1, axis=1).ravel()
    is_forward = tails < heads
    lower, upper = np.where(is_forward, (tails, heads), (heads, tails))
    edges = lower * (places.max(initial=0) + 1) + upper
    order = np.argsort(edges)
    starts = np.flatnonzero(np.diff(edges[order], prepend=-1))
    n_uses = np.diff(starts, append=len(edges))
    forward_before = np.concatenate([[0], np.cumsum(is_forward[order])])
    n_forward = np.diff(forward_before[np.append(starts, len(edges))])
    return (
        int((n_uses == 1).sum()),
        int((n_uses > 2).sum()),
        int(((n_uses == 2) & (n_forward != 1)).sum()),
    )


def _volume(a: NDArray[np.float64], b: NDArray[np.float64], c: NDArray[np.float64]) -> float:
    """Return the volume enclosed by triangles with corners a, b, c (T, 3), outwards positive."""
    # About a corner of its own: far from the origin the terms would cancel to noise.
    origin = a[0].copy()
    a, b, c = a - origin, b - origin, c - origin
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)


def widest_gap(vertices: NDArray[np.float64], faces: NDArray[np.int32], narrow: float) -> float:
    """Return how wide the gaps of a surface are at most, in its unit; 0 if it has none.

    From the middle of each open edge, across the gap, to the nearest open edge that runs the other
    way. Alone among its neighbours, an edge no longer than `narrow` is the end of a gap and not its
    side. Infinite if an edge has no other across, or there are too many to compare.

    Parameters
    ----------
    vertices : (V, 3) float64
        Finite.
    faces : (T, 3) int32
        Vertex numbers.
    narrow : float
        What is narrow, in the unit of the vertices.
    """
    places = places_of(vertices, 0.0)[faces]
    whole = _has_three_corners(places)
    places, corners = places[whole], vertices[faces[whole]]
    tails, heads = places.ravel(), np.roll(places, -1, axis=1).ravel()
    base = int(places.max(initial=0)) + 1
    keys = np.minimum(tails, heads) * base + np.maximum(tails, heads)
    _, inverse, counts = np.unique(keys, return_inverse=True, return_counts=True)
    is_open = counts[inverse] == 1
    if not is_open.any():
        return 0.0
    starts = corners.reshape(-1, 3)[is_open]
    ends = np.roll(corners, -1, axis=1).reshape(-1, 3)[is_open]
    apexes = np.roll(corners, -2, axis=1).reshape(-1, 3)[is_open]
    along = ends - starts
    lengths = np.linalg.norm(along, axis=1)
    is_short = lengths <= narrow
    n_short = np.bincount(
        np.concatenate([tails[is_open][is_short], heads[is_open][is_short]]), minlength=base
    )
    is_end = is_short & (n_short[tails[is_open]] < 2) & (n_short[heads[is_open]] < 2)
    if len(starts) > _MAX_OPEN_EDGES:
        return np.inf
    widest = 0.0
    for edge in np.flatnonzero(~is_end).tolist():
        middle, direction = starts[edge] + along[edge] / 2.0, along[edge] / lengths[edge]
        outwards = middle - apexes[edge]
        outwards = outwards - (outwards @ direction) * direction
        outwards /= max(float(np.linalg.norm(outwards)), 1e-300)
        against = along @ direction < -0.5 * lengths
        share = np.einsum("ij,ij->i", middle - starts, along) / np.maximum(lengths, 1e-300) ** 2
        across = starts + np.clip(share, 0.0, 1.0)[:, None] * along - middle
        # Chords of two curves that are closer than these are coarse may cross.
        facing = against & (across @ outwards >= -narrow)
        apart = np.linalg.norm(across[facing], axis=1)
        widest = max(widest, float(apart.min(initial=np.inf)))
    return widest
