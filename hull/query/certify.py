"""Verdicts on triangles that no viewport can overturn.

Samples tell where a triangle is in the hull, never that it is not: a contact may hide between
them. Here a triangle is cut into cells, along its longest edge, again and again, until it is
decided:

* `FREE`: every cell is proved free by its rectangle in some camera (see
  `hybridve.hull.query.bounds`). No point of the triangle is in the hull, and no sample of any
  viewport, as any engine in double precision computes it.
* `COLLIDING`: a point of the triangle, the witness, is in every silhouette. It is computed in
  double precision and asked of the specification (`hybridve.hull.query.reference`) before it is
  called so.
* `OPEN`: neither, down to cells so small that **no disc of diameter `open_at_m` on the triangle
  lies in the hull**. What could still hide is thinner than that everywhere.

Why rounding cannot turn the proof into a guess
-----------------------------------------------
A cell's corners are corners of the triangle and midpoints of edges. A computed midpoint is off by
at most u M_j in coordinate j (u the unit roundoff, M_j the largest coordinate), and inherits at
most the errors of its ends, so after k cuts a corner is off by at most k u M_j, and each point of
the triangle lies within k u M_j of a point of some cell. With k <= `_MOST_CUTS` = 64, a computed
sample is off by at most (24 + 64) u M_j where step 1 of `bounds` has 24 u M_j, and its projection
by at most (88 + 4) u B_k where it has 32 u B_k. The pads for cells are therefore those of three
times the roundoff: 96 u B_k.

Why a disc
----------
The centroid of every cell that ends open was asked, and is outside. Let a disc of radius r on the
triangle be in the hull. Its centre lies in some cell; a free one it cannot be. In an open one with
longest edge L the centroid is within two thirds of a median, less than 2/3 L, of the centre, so it
would be in the disc if r >= 2/3 L. Hence r < 2/3 L, and cells are cut until L <= 3/4 `open_at_m`.

The specification in NumPy is `hybridve.hull.query.certify_reference`.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.jit import ZERO, compiled
from hybridve.hull.query.boxes import ABSTAINS, ACCEPTS, REJECTS, WITHHOLDS, rectangle_vote
from hybridve.hull.query.clusters import make_shares
from hybridve.hull.query.engine import Closing, Triangles
from hybridve.hull.query.frame import Frame
from hybridve.hull.query.points import is_inside
from hybridve.hull.query.rectangles import (
    Surface,
    Tree,
    load_corners,
    survivors,
    triangle_rectangles,
)
from hybridve.hull.query.reference import contains_points
from hybridve.hull.query.silhouettes import Hull
from hybridve.hull.query.threads import Threads

#: Verdicts.
FREE, OPEN, COLLIDING = 0, 1, 2

#: Rounding of cells compared with that of samples; see above.
_ROUNDOFF_OF_CELLS = 3.0

#: Longest edge of the cells that end open, in diameters of the disc.
LEAF_EDGE = 0.75

#: Cuts between a triangle and its smallest cells, at most: each third cut or so halves all edges.
_MOST_CUTS = 64

#: Cells of one triangle, at most. One that needs more is left open at the size it has reached.
MOST_CELLS = 1 << 17

#: Of the triangles that rectangles did not prove free at once, ascending: their numbers (K,),
#: verdicts (K,), witnesses (K, 3) in metres, local frame, and longest edges (K,) of a cell that
#: ended open.
_Part = tuple[NDArray[np.int64], NDArray[np.int8], NDArray[np.float64], NDArray[np.float64]]


@dataclass(frozen=True, slots=True, eq=False)
class Certificates:
    """What is certain about the triangles of a mesh.

    Attributes
    ----------
    verdict : (T,) int8
        `FREE`, `OPEN` or `COLLIDING`.
    witness_world : (T, 3) float64
        Metres: a point of the triangle that is in the hull; NaN unless it collides.
    open_at_m : (T,) float64
        No disc of this diameter on the triangle is in the hull; NaN unless it is open.
    """

    verdict: NDArray[np.int8]
    witness_world: NDArray[np.float64]
    open_at_m: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class MeshCertificate:
    """What is certain about a mesh as a whole.

    Attributes
    ----------
    verdict : int
        `COLLIDING` if a triangle collides, `FREE` if all are free, else `OPEN`.
    witness_world : (3,) float64
        Metres: a point of the first triangle that collides; NaN unless one does.
    open_at_m : float
        No disc of this diameter on the surface is in the hull; NaN unless it is open.
    """

    verdict: int
    witness_world: NDArray[np.float64]
    open_at_m: float


class Certifier(Closing):
    """Certifies meshes, with threads that are kept from call to call.

    Parameters
    ----------
    open_at_m : float
        Diameter in metres of the discs that may not hide in what is left open.
    n_threads : int, optional
        By default as many as the process may run on.
    """

    def __init__(self, open_at_m: float, n_threads: int | None = None) -> None:
        if not open_at_m > 0:
            raise ValueError(f"open_at_m is {open_at_m}, expected a positive length")
        self.open_at_m = open_at_m
        self._threads = Threads(n_threads)

    def certify(self, hull: Hull, mesh: Triangles) -> Certificates:
        """Return what is certain about each triangle of a mesh, whatever its viewports."""
        certificates = Certificates(
            np.full(len(mesh), FREE, np.int8),
            np.full((len(mesh), 3), np.nan),
            np.full(len(mesh), np.nan),
        )
        for triangle, verdict, witness_local, edge_m in self._parts(hull, mesh, is_any=False):
            is_open, collides = verdict == OPEN, verdict == COLLIDING
            certificates.verdict[triangle] = verdict
            certificates.open_at_m[triangle[is_open]] = edge_m[is_open] / LEAF_EDGE
            witness_world = witness_local[collides] + hull.views.origin_world
            certificates.witness_world[triangle[collides]] = witness_world
        # A pixel edge within rounding: what is no witness in the world's frame is none.
        collides = np.flatnonzero(certificates.verdict == COLLIDING)
        fails = collides[~contains_points(hull, certificates.witness_world[collides])]
        certificates.verdict[fails] = OPEN
        certificates.witness_world[fails] = np.nan
        certificates.open_at_m[fails] = np.inf
        return certificates

    def certify_mesh(self, hull: Hull, mesh: Triangles) -> MeshCertificate:
        """Return what is certain about a mesh in one frame; it ends with the first witness."""
        parts = self._parts(hull, mesh, is_any=True)
        nowhere = np.full(3, np.nan)
        for _, verdict, witness_local, _ in parts:
            collides = np.flatnonzero(verdict == COLLIDING)
            if len(collides) == 0:
                continue
            witness_world = witness_local[collides[0]] + hull.views.origin_world
            if contains_points(hull, witness_world[None])[0]:
                return MeshCertificate(COLLIDING, witness_world, np.nan)
            others = self.certify(hull, mesh)  # a pixel edge within rounding: ask them all
            collides = np.flatnonzero(others.verdict == COLLIDING)
            if len(collides):
                return MeshCertificate(COLLIDING, others.witness_world[collides[0]], np.nan)
            return MeshCertificate(OPEN, nowhere, float(np.nanmax(others.open_at_m)))
        edges_m = [edge_m[verdict == OPEN] for _, verdict, _, edge_m in parts]
        open_m = np.concatenate([np.zeros(0), *edges_m])
        if len(open_m) == 0:
            return MeshCertificate(FREE, nowhere, np.nan)
        return MeshCertificate(OPEN, nowhere, float(open_m.max()) / LEAF_EDGE)

    def _parts(self, hull: Hull, mesh: Triangles, *, is_any: bool) -> list[_Part]:
        frame = hull.frame
        # The number of the first share that has found a witness: those after it need not look on.
        found = np.full(1, np.iinfo(np.int64).max)
        asked = (LEAF_EDGE * self.open_at_m, MOST_CELLS, is_any, found)
        shares = make_shares(hull, frame, mesh, self._threads)
        parts: list[_Part] = self._threads.run(
            [(_certify, (*share, frame, *asked, number)) for number, share in enumerate(shares)]
        )
        return parts

    def close(self) -> None:
        """End the threads; a later call starts them again."""
        self._threads.close()


def certify_triangles(hull: Hull, mesh: Triangles, open_at_m: float) -> Certificates:
    """Return what is certain about each triangle of a mesh; `Certifier` keeps its threads."""
    with Certifier(open_at_m) as certifier:
        return certifier.certify(hull, mesh)


@compiled
def _longest_edge(cell: NDArray[np.float64]) -> tuple[float, int]:
    """Return the longest edge of a cell (9,), and the corner that it begins at."""
    longest, corner = -1.0, 0
    for k in range(3):
        squared = 0.0
        for axis in range(3):
            difference = cell[3 * k + axis] - cell[(3 * k + 3 + axis) % 9]
            squared += difference * difference
        if squared > longest:
            longest, corner = squared, k
    return np.sqrt(longest), corner


@compiled
def _certify_triangle(
    leaf_m: float,
    most_cells: int,
    frame: Frame,
    pads: NDArray[np.float64],
    cells: NDArray[np.float64],
    cell_cuts: NDArray[np.int64],
    n_accept: NDArray[np.int64],
    is_open: NDArray[np.bool_],
    witness: NDArray[np.float64],
) -> tuple[int, float]:
    """Decide a triangle: the first cell (9,) of `cells`, with what is known of it.

    Cells are taken in the order in which they were made, large ones first; the arrays are a ring.

    Returns
    -------
    verdict : int
        `COLLIDING` leaves the point (3,) in `witness`, metres, local frame.
    edge_m : float
        The longest edge of a cell that ended open.
    """
    matrices, sizes, integrals = frame.matrices, frame.sizes, frame.integrals
    answers, mask_offset = frame.answers, frame.mask_offset
    integral_offset = frame.integral_offset
    keep, min_cameras = frame.keep, frame.min_cameras
    all_cameras, room = len(matrices), len(cells)
    corners, rectangle = np.zeros((9, 1)), np.zeros((4, 1), np.int32)
    cell, n_cells = np.zeros(9), ZERO + 1  # one triangle; not a literal, see ZERO
    left = np.zeros(all_cameras, np.int64)
    first, n_waiting, n_made = 0, 1, 1
    verdict, edge_m = FREE, 0.0
    while n_waiting > 0:
        for k in range(9):
            cell[k] = corners[k, 0] = cells[first, k]
        n_left, n_withheld, accepted, is_free = ZERO, ZERO, n_accept[first], False
        for camera in range(all_cameras):
            if not is_open[first, camera]:
                continue
            width, height = sizes[camera, 0], sizes[camera, 1]
            triangle_rectangles(
                n_cells, corners, matrices[camera], width, height, pads[camera], rectangle
            )
            vote = rectangle_vote(
                np.int64(rectangle[0, 0]),
                np.int64(rectangle[1, 0]),
                np.int64(rectangle[2, 0]),
                np.int64(rectangle[3, 0]),
                width,
                height,
                integral_offset[camera],
                integrals,
                keep,
                camera,
                frame.recorded,
            )
            if vote == REJECTS:
                is_free = True
                break
            if vote == ACCEPTS:
                accepted += 1
            elif vote != ABSTAINS:
                left[n_left] = camera
                n_left += 1
                n_withheld += vote == WITHHOLDS
        cuts = cell_cuts[first]
        first = (first + 1) % room
        n_waiting -= 1
        if is_free or (keep and accepted + n_left - n_withheld < min_cameras):
            continue
        x = (cell[0] + cell[3] + cell[6]) / 3.0
        y = (cell[1] + cell[4] + cell[7]) / 3.0
        z = (cell[2] + cell[5] + cell[8]) / 3.0
        if is_inside(
            x,
            y,
            z,
            left,
            n_left,
            accepted,
            matrices,
            sizes,
            answers,
            mask_offset,
            keep,
            min_cameras,
            0.0,  # the specification is asked about edges of pixels
        ):
            witness[0], witness[1], witness[2] = x, y, z
            return COLLIDING, 0.0
        longest_m, corner = _longest_edge(cell)
        if longest_m <= leaf_m or n_made + 2 > most_cells or cuts >= _MOST_CUTS:
            verdict, edge_m = OPEN, max(edge_m, longest_m)
            continue
        # Two cells: the edge's one end moves to its middle, then the other.
        for moving in range(2):
            place = (first + n_waiting) % room
            for k in range(9):
                cells[place, k] = cell[k]
            for axis in range(3):
                begin, end = 3 * corner + axis, (3 * corner + 3 + axis) % 9
                target = begin if moving == 0 else end
                cells[place, target] = 0.5 * (cell[begin] + cell[end])
            cell_cuts[place], n_accept[place] = cuts + 1, accepted
            for camera in range(all_cameras):
                is_open[place, camera] = False
            for number in range(n_left):
                is_open[place, left[number]] = True
            n_waiting += 1
        n_made += 2
    return verdict, edge_m


@compiled
def _certify(
    nodes: NDArray[np.int64],
    level: int,
    tree: Tree,
    surface: Surface,
    frame: Frame,
    leaf_m: float,
    most_cells: int,
    is_any: bool,
    found: NDArray[np.int64],
    share: int,
) -> _Part:
    """Certify some nodes of a mesh; see `hybridve.hull.query.rectangles.survivors`.

    With `is_any`, only up to the first triangle of this or of an earlier share that collides.
    """
    n_cameras = len(frame.matrices)
    left = survivors(nodes, level, tree, surface, frame)
    n_triangles = ZERO
    for k in range(len(left.start)):
        n_triangles += left.stop[k] - left.start[k]
    triangle, verdict = np.zeros(n_triangles, np.int64), np.zeros(n_triangles, np.int8)
    witness, edge_m = np.zeros((n_triangles, 3)), np.zeros(n_triangles)
    corners, cell_pads = np.zeros((9, 1)), np.zeros((n_cameras, 3))
    for camera in range(n_cameras):
        for k in range(3):
            cell_pads[camera, k] = _ROUNDOFF_OF_CELLS * surface.pads[camera, k]
    room = 256
    cells, cuts = np.zeros((room, 9)), np.zeros(room, np.int64)
    accepted, is_open = np.zeros(room, np.int64), np.zeros((room, n_cameras), np.bool_)
    n = 0
    for k in range(len(left.start)):
        for number in range(left.start[k], left.stop[k]):
            if is_any and found[0] <= share:
                return triangle[:n], verdict[:n], witness[:n], edge_m[:n]
            triangle[n] = number
            load_corners(number, ZERO + 1, surface.vertices_local, surface.faces, corners)
            while True:
                # The ring holds at most half of the cells made; few triangles need many.
                for i in range(9):
                    cells[0, i] = corners[i, 0]
                cuts[0], accepted[0] = 0, left.n_accept[k]
                for camera in range(n_cameras):
                    is_open[0, camera] = left.is_open[k, camera]
                most = min(most_cells, 2 * room - 2)
                outcome, edge = _certify_triangle(
                    leaf_m,
                    most,
                    frame,
                    cell_pads,
                    cells,
                    cuts,
                    accepted,
                    is_open,
                    witness[n],
                )
                if outcome != OPEN or edge <= leaf_m or most == most_cells:
                    break
                room *= 16
                cells, cuts = np.zeros((room, 9)), np.zeros(room, np.int64)
                accepted, is_open = np.zeros(room, np.int64), np.zeros((room, n_cameras), np.bool_)
            verdict[n], edge_m[n] = outcome, edge
            if outcome == COLLIDING:
                found[0] = min(found[0], share)
            n += 1
    return triangle, verdict, witness, edge_m
