"""A sheet of cloth: nodes with masses, springs along edges and across them, and its free motion.

The triangles of a mesh become springs along their edges, of the stiffness that the membrane has
along them, and bends across the edges that two triangles share. Both are one kind of element: a
vector v = sum of K_i x_i over a few nodes, with the energy c / 2 (|v| - L)^2. For a spring K is
(1, -1) and L the rest length. For a bend K is that of Bergou, Wardetzky, Harmon, Zorin and
Grinspun, A quadratic bending model for inextensible surfaces (2006), by which v measures how much
the surface turns at the edge; L is what it turns at rest, so that folds may be at rest. No force is
greater than c |K_i| (|v| + L), whatever becomes of a triangle: nothing divides by an area but that
at rest.

The stiffness of a spring is k = E sum(A) / l^2 over the triangles of its edge, after Van Gelder,
Approximate simulation of elastic membranes by triangulated spring meshes (1998).

Time goes on by kick, drift, kick (velocity Verlet): energy without damping neither grows nor
decays, and free fall is exact. What the sheet leans on holds it within every one of these steps:
held once for several of them, a node that is pulled at would run, and be set back against springs
that have shed their tension as waves, for ever. Places are set right after the drift, speeds after
the last kick, so that what rests on something neither gains nor loses.

It is stable for steps below 2 / w with w the angular frequency of the stiffest mode, which
`highest_frequency` bounds.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.cad.topology import places_of
from hybridve.hull.jit import ZERO, compiled

#: What a step may use of the limit 2 / w: damping and compressed springs need the rest.
_SHARE = 0.8


class Springs(NamedTuple):
    """What holds a sheet together, as compiled loops take it.

    Attributes
    ----------
    ends : (E, 2) int64
        The nodes of each edge.
    length_m : (E,) float64
        At rest.
    stiffness : (E,) float64
        Newtons a metre.
    hinges : (B, 4) int64
        The two nodes of each inner edge, then those opposite to it.
    weights : (B, 4) float64
        K of each.
    turn_m : (B,) float64
        L of each.
    resistance : (B,) float64
        Newtons a metre.
    """

    ends: NDArray[np.int64]
    length_m: NDArray[np.float64]
    stiffness: NDArray[np.float64]
    hinges: NDArray[np.int64]
    weights: NDArray[np.float64]
    turn_m: NDArray[np.float64]
    resistance: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Welded:
    """A mesh whose vertices at one place are one node.

    Attributes
    ----------
    nodes_world : (N, 3) float64
        Where the nodes are, metres.
    faces : (T, 3) int32
        In numbers of nodes.
    node_of_vertex : (V,) int64
        The node of each vertex of the mesh; -1 for one that no triangle uses.
    """

    nodes_world: NDArray[np.float64]
    faces: NDArray[np.int32]
    node_of_vertex: NDArray[np.int64]


def weld(
    vertices_world: NDArray[np.float64], faces: NDArray[np.int32], vertices: NDArray[np.float64]
) -> Welded:
    """Return a mesh with one node for all vertices that are at one place in the file.

    Parameters
    ----------
    vertices_world : (V, 3) float64
        Metres.
    faces : (T, 3) int32
        Vertex numbers.
    vertices : (V, 3) float64
        The same before they were turned and moved, which rounds. What differs by no more than
        two units in the last place of single precision is at one place.
    """
    noise = float(np.abs(vertices[faces]).max()) * 2.0**-22
    place = places_of(vertices, noise)
    used = np.unique(place[faces])
    node_of_place = np.full(len(vertices), -1, np.int64)
    node_of_place[used] = np.arange(len(used))
    node_of_vertex = node_of_place[place]
    is_used = np.zeros(len(vertices), np.bool_)
    is_used[faces.ravel()] = True
    node_of_vertex[~is_used] = -1
    nodes = np.zeros((len(used), 3))
    own = np.flatnonzero(is_used)[::-1]  # the vertex with the lowest number says where
    nodes[node_of_vertex[own]] = vertices_world[own]
    return Welded(nodes, node_of_vertex[faces].astype(np.int32), node_of_vertex)


def why_no_sheet(nodes: NDArray[np.float64], faces: NDArray[np.int32]) -> str:
    """Return why a welded mesh is no sheet, as the rest of a sentence; "" if it is one."""
    areas_m2 = triangle_areas(nodes, faces)
    if not (areas_m2 > 0).all():
        flat = int(np.flatnonzero(~(areas_m2 > 0))[0])
        return f"its triangle {flat} has no area"
    _, counts = np.unique(_edges(faces), axis=0, return_counts=True)
    if (counts > 2).any():
        return (
            f"{int((counts > 2).sum())} of its edges are used by more than two triangles; a sheet "
            "has one on each side of an edge"
        )
    if not (counts == 1).any():
        return "it has no border: it closes off a volume"
    return ""


def triangle_areas(nodes: NDArray[np.float64], faces: NDArray[np.int32]) -> NDArray[np.float64]:
    """Return the areas (T,) of triangles, square metres."""
    a, b, c = np.moveaxis(nodes[faces], 1, 0)
    return np.asarray(np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2.0)


def node_masses(
    nodes: NDArray[np.float64], faces: NDArray[np.int32], areal_density_kg_m2: float
) -> NDArray[np.float64]:
    """Return the masses (N,) of the nodes, kilograms: a third of each triangle's to each corner."""
    thirds = areal_density_kg_m2 * triangle_areas(nodes, faces) / 3.0
    masses = np.zeros(len(nodes))
    np.add.at(masses, faces.ravel(), np.repeat(thirds, 3))
    return masses


def make_springs(
    nodes: NDArray[np.float64],
    faces: NDArray[np.int32],
    stretch_n_m: float,
    bending_j: float,
) -> Springs:
    """Return what holds a sheet together, at rest as it is.

    Parameters
    ----------
    nodes : (N, 3) float64
        Metres.
    faces : (T, 3) int32
        Node numbers; a sheet, see `why_no_sheet`.
    stretch_n_m : float
        Tension per width and strain, newtons a metre.
    bending_j : float
        Moment per width and curvature, joules.
    """
    areas_m2 = triangle_areas(nodes, faces)
    edges, of_edge = np.unique(_edges(faces), axis=0, return_inverse=True)
    of_edge = of_edge.ravel()
    triangle, opposite = np.tile(np.arange(len(faces)), 3), faces.T[[2, 0, 1]].ravel()
    around_m2 = np.bincount(of_edge, areas_m2[triangle])
    length_m = np.linalg.norm(nodes[edges[:, 0]] - nodes[edges[:, 1]], axis=1)
    order = np.argsort(of_edge, kind="stable")
    first = np.searchsorted(of_edge[order], np.arange(len(edges)))
    inner = np.flatnonzero(np.bincount(of_edge) == 2)
    sides = order[first[inner, None] + np.arange(2)]  # (B, 2) which uses of the edge
    hinges = np.column_stack([edges[inner], opposite[sides]]).astype(np.int64)
    x0, x1, x2, x3 = np.moveaxis(nodes[hinges], 1, 0)
    at_0 = np.column_stack([_cotangent(x1 - x0, x2 - x0), _cotangent(x1 - x0, x3 - x0)])
    at_1 = np.column_stack([_cotangent(x0 - x1, x2 - x1), _cotangent(x0 - x1, x3 - x1)])
    weights = np.column_stack([at_1.sum(axis=1), at_0.sum(axis=1), -at_0 - at_1])
    turn_m = np.linalg.norm(np.einsum("bk,bki->bi", weights, nodes[hinges]), axis=1)
    return Springs(
        np.ascontiguousarray(edges, np.int64),
        length_m,
        stretch_n_m * around_m2 / length_m**2,
        np.ascontiguousarray(hinges),
        np.ascontiguousarray(weights),
        turn_m,
        3.0 * bending_j / around_m2[inner],
    )


def _edges(faces: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return the edges (3 T, 2) of triangles, the lower node first: all ab, all bc, all ca."""
    pairs = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    return np.sort(pairs, axis=1)


def _cotangent(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    across = np.linalg.norm(np.cross(a, b), axis=1)
    return np.asarray(np.einsum("ij,ij->i", a, b) / across)


def highest_frequency(springs: Springs, inverse_mass: NDArray[np.float64]) -> float:
    """Return a bound of the angular frequency of all modes, radians a second.

    A row of M^-1 K sums up to no less than its largest eigenvalue, and no element is stiffer in any
    direction than c K K^T.
    """
    rows = np.zeros(len(inverse_mass))
    np.add.at(rows, springs.ends.ravel(), np.repeat(2.0 * springs.stiffness, 2))
    weights = np.abs(springs.weights)
    each = springs.resistance[:, None] * weights * weights.sum(axis=1, keepdims=True)
    np.add.at(rows, springs.hinges.ravel(), each.ravel())
    return float(np.sqrt((rows * inverse_mass).max(initial=0.0)))


def longest_step(frequency: float, damping_s: float) -> float:
    """Return the longest stable step, seconds; `damping_s` is that of `move_on`.

    The largest root of h^2 w^2 + 2 h d w^2 = 4, and a margin.
    """
    if frequency == 0.0:
        return np.inf
    return _SHARE * float(np.sqrt(damping_s**2 + 4.0 / frequency**2) - damping_s)


def potential_of(
    nodes: NDArray[np.float64], masses: NDArray[np.float64], springs: Springs, gravity: float
) -> float:
    """Return the energy of weight (above z = 0) and of the springs, joules."""
    return float(_spring_energy(nodes, springs) + gravity * (masses @ nodes[:, 2]))


def kinetic_of(velocities: NDArray[np.float64], masses: NDArray[np.float64]) -> float:
    """Return the kinetic energy of nodes, joules."""
    return float(0.5 * (masses @ np.einsum("ij,ij->i", velocities, velocities)))


@compiled
def _spring_energy(x: NDArray[np.float64], springs: Springs) -> float:
    energy = 0.0
    for e in range(len(springs.ends)):
        i, j = springs.ends[e]
        squared = 0.0
        for k in range(3):
            squared += (x[i, k] - x[j, k]) ** 2
        energy += 0.5 * springs.stiffness[e] * (np.sqrt(squared) - springs.length_m[e]) ** 2
    for b in range(len(springs.hinges)):
        squared = 0.0
        for k in range(3):
            v = 0.0
            for n in range(4):
                v += springs.weights[b, n] * x[springs.hinges[b, n], k]
            squared += v * v
        energy += 0.5 * springs.resistance[b] * (np.sqrt(squared) - springs.turn_m[b]) ** 2
    return energy


@compiled
def _forces(
    x: NDArray[np.float64],
    v: NDArray[np.float64],
    springs: Springs,
    damping_s: float,
    force: NDArray[np.float64],
) -> float:
    """Write the forces (N, 3) of springs and bends on the nodes, with their damping.

    Return the power that the damping takes, watts.
    """
    force[:] = 0.0
    power = 0.0
    for e in range(len(springs.ends)):
        i, j = springs.ends[e]
        dx, dy, dz = x[i, 0] - x[j, 0], x[i, 1] - x[j, 1], x[i, 2] - x[j, 2]
        length = np.sqrt(dx * dx + dy * dy + dz * dz)
        if length == 0.0:
            continue
        rate = (
            dx * (v[i, 0] - v[j, 0]) + dy * (v[i, 1] - v[j, 1]) + dz * (v[i, 2] - v[j, 2])
        ) / length
        power += springs.stiffness[e] * damping_s * rate * rate
        pull = springs.stiffness[e] * (length - springs.length_m[e] + damping_s * rate) / length
        force[i, 0] -= pull * dx
        force[i, 1] -= pull * dy
        force[i, 2] -= pull * dz
        force[j, 0] += pull * dx
        force[j, 1] += pull * dy
        force[j, 2] += pull * dz
    for b in range(len(springs.hinges)):
        tx, ty, tz, ux, uy, uz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for n in range(4):
            at, weight = springs.hinges[b, n], springs.weights[b, n]
            tx += weight * x[at, 0]
            ty += weight * x[at, 1]
            tz += weight * x[at, 2]
            ux += weight * v[at, 0]
            uy += weight * v[at, 1]
            uz += weight * v[at, 2]
        turn = np.sqrt(tx * tx + ty * ty + tz * tz)
        if turn == 0.0:
            continue
        rate = (tx * ux + ty * uy + tz * uz) / turn
        power += springs.resistance[b] * damping_s * rate * rate
        pull = springs.resistance[b] * (turn - springs.turn_m[b] + damping_s * rate) / turn
        for n in range(4):
            at, weight = springs.hinges[b, n], springs.weights[b, n]
            force[at, 0] -= pull * weight * tx
            force[at, 1] -= pull * weight * ty
            force[at, 2] -= pull * weight * tz
    return power


class Contacts(NamedTuple):
    """What samples of a sheet may not go below, as compiled loops take it.

    Attributes
    ----------
    corners : (K, 3) int64
        The nodes of each sample.
    weights : (K, 3) float64
        Its weights.
    way : (K, 3) float64
        Unit vectors; what is below is against them.
    level_m : (K,) float64
        What the way's coordinate may not be below at the end of the step, world.
    rise_m : (K,) float64
        How much lower that is at its beginning.
    speed : (K,) float64
        With which what is below comes along the way, metres a second.
    """

    corners: NDArray[np.int64]
    weights: NDArray[np.float64]
    way: NDArray[np.float64]
    level_m: NDArray[np.float64]
    rise_m: NDArray[np.float64]
    speed: NDArray[np.float64]


def no_contacts() -> Contacts:
    """Return none."""
    none = np.zeros((0, 3))
    return Contacts(none.astype(np.int64), none, none, none[:, 0], none[:, 0], none[:, 0])


def joined_contacts(some: Sequence[Contacts]) -> Contacts:
    """Return the contacts of several as one."""
    return Contacts(
        *(np.ascontiguousarray(np.concatenate(each)) for each in zip(*some, strict=True))
    )


@compiled
def _lift(
    x: NDArray[np.float64],
    x_before: NDArray[np.float64],
    inverse_mass: NDArray[np.float64],
    contacts: Contacts,
    first: int,
    last: int,
    left: float,
    friction: float,
    is_active: NDArray[np.bool_],
) -> None:
    """Lift samples that are below what they lean on, in place, and mark these contacts.

    Contacts `first` to `last`; `left` is the share of the step that is to come. Friction takes of
    the path across the way as much as `friction` times the lift.
    """
    slip = np.zeros(3)
    for c in range(first, last):
        way = contacts.way[c]
        total, at_m = 0.0, 0.0
        for n in range(3):
            node, weight = contacts.corners[c, n], contacts.weights[c, n]
            total += weight * weight * inverse_mass[node]
            at_m += weight * (x[node, 0] * way[0] + x[node, 1] * way[1] + x[node, 2] * way[2])
        below_m = contacts.level_m[c] - left * contacts.rise_m[c] - at_m
        is_active[c] = below_m > 0.0 and total > 0.0
        if not is_active[c]:
            continue
        slip[:] = 0.0
        for n in range(3):
            node, weight = contacts.corners[c, n], contacts.weights[c, n]
            share = weight * inverse_mass[node] / total
            for k in range(3):
                x[node, k] += share * below_m * way[k]
                slip[k] += weight * (x[node, k] - x_before[node, k])
        _give(x, contacts, c, slip, friction * below_m, total, inverse_mass)


@compiled
def _stop(
    v: NDArray[np.float64],
    inverse_mass: NDArray[np.float64],
    contacts: Contacts,
    first: int,
    last: int,
    friction: float,
    is_active: NDArray[np.bool_],
    is_held: NDArray[np.bool_],
) -> None:
    """Give samples that were lifted the speed of what they lean on, in place.

    Marks in `is_held` (N,) the nodes that were lifted.
    """
    slip = np.zeros(3)
    for c in range(first, last):
        if not is_active[c]:
            continue
        way = contacts.way[c]
        total, along = 0.0, 0.0
        for n in range(3):
            node, weight = contacts.corners[c, n], contacts.weights[c, n]
            total += weight * weight * inverse_mass[node]
            along += weight * (v[node, 0] * way[0] + v[node, 1] * way[1] + v[node, 2] * way[2])
        given = max(contacts.speed[c] - along, 0.0)
        slip[:] = 0.0
        for n in range(3):
            node, weight = contacts.corners[c, n], contacts.weights[c, n]
            share = weight * inverse_mass[node] / total
            is_held[node] |= share > 0.0
            for k in range(3):
                v[node, k] += share * given * way[k]
                slip[k] += weight * v[node, k]
        _give(v, contacts, c, slip, friction * given, total, inverse_mass)


@compiled
def _give(
    of_nodes: NDArray[np.float64],
    contacts: Contacts,
    contact: int,
    slip: NDArray[np.float64],
    most: float,
    total: float,
    inverse_mass: NDArray[np.float64],
) -> None:
    """Take from what a sample slips, path or speed, what is across the way, at most so much."""
    if most <= 0.0:
        return
    way = contacts.way[contact]
    out = slip[0] * way[0] + slip[1] * way[1] + slip[2] * way[2]
    slip -= out * way
    length = np.sqrt(slip[0] ** 2 + slip[1] ** 2 + slip[2] ** 2)
    if length == 0.0:
        return
    taken = min(1.0, most / length) / total
    for n in range(3):
        node = contacts.corners[contact, n]
        share = taken * contacts.weights[contact, n] * inverse_mass[node]
        for k in range(3):
            of_nodes[node, k] -= share * slip[k]


@compiled
def _potential(
    x: NDArray[np.float64], inverse_mass: NDArray[np.float64], springs: Springs, gravity: float
) -> float:
    """Return the potential energy of the nodes that move, joules."""
    energy = _spring_energy(x, springs)
    for i in range(len(x)):
        if inverse_mass[i] > 0.0:
            energy += gravity * x[i, 2] / inverse_mass[i]
    return energy


@compiled
def _kinetic(v: NDArray[np.float64], inverse_mass: NDArray[np.float64]) -> float:
    energy = 0.0
    for i in range(len(v)):
        if inverse_mass[i] > 0.0:
            energy += 0.5 * (v[i, 0] ** 2 + v[i, 1] ** 2 + v[i, 2] ** 2) / inverse_mass[i]
    return energy


@compiled
def move_on(
    x: NDArray[np.float64],
    v: NDArray[np.float64],
    inverse_mass: NDArray[np.float64],
    springs: Springs,
    gravity: float,
    drag_per_s: float,
    damping_s: float,
    step_s: float,
    n_steps: int,
    contacts: Contacts,
    n_in_hull: int,
    friction: float,
    is_held: NDArray[np.bool_],
    is_driven: bool,
) -> tuple[float, float]:
    """Move nodes on in place, by so many steps.

    Parameters
    ----------
    x, v : (N, 3) float64
        Metres, and metres a second.
    inverse_mass : (N,) float64
        Of each node, 1 / kg; 0 for one that does not move.
    springs : Springs
        What holds them together.
    gravity : float
        Along -z, m/s^2.
    drag_per_s : float
        What share of all speed the air takes, a second.
    damping_s : float
        What springs and bends resist their rate of change with, as seconds times their stiffness.
    step_s : float
        Of each step, seconds; see `longest_step`.
    n_steps : int
        How many.
    contacts : Contacts
        What the sheet leans on.
    n_in_hull : int
        So many of the contacts, the first, are with the hull.
    friction : float
        Coulomb's.
    is_held : (N,) bool
        Set for nodes that contacts with the hull moved.
    is_driven : bool
        Whether any of the others moves.

    Returns
    -------
    float, float
        What drag and damping have taken, joules; and the work of the contacts that are not with
        the hull, 0 unless there are both, or these move.
    """
    force, before = np.zeros_like(x), np.zeros_like(x)
    is_held_otherwise = np.zeros(len(x), np.bool_)
    n_contacts = len(contacts.level_m)
    active = np.zeros(n_contacts, np.bool_)
    is_shared = n_in_hull < n_contacts and (n_in_hull > 0 or is_driven)
    lost_j, other_j = 0.0, 0.0
    kept = np.exp(-0.5 * drag_per_s * step_s)  # half before a step, half after it
    power = _forces(x, v, springs, damping_s, force)
    for step in range(n_steps):
        before[:] = x
        lost_j += 0.5 * step_s * power + (1.0 - kept * kept) * _kinetic(v, inverse_mass)
        for i in range(len(x)):
            if inverse_mass[i] > 0.0:
                for k in range(3):
                    v[i, k] = kept * v[i, k] + 0.5 * step_s * inverse_mass[i] * force[i, k]
                v[i, 2] -= 0.5 * step_s * gravity
                for k in range(3):
                    x[i, k] += step_s * v[i, k]
        if n_contacts > 0:
            left = 1.0 - (step + 1.0) / n_steps
            if is_shared:
                other_j -= _potential(x, inverse_mass, springs, gravity)
            _lift(x, before, inverse_mass, contacts, n_in_hull, n_contacts, left, friction, active)
            if is_shared:
                other_j += _potential(x, inverse_mass, springs, gravity)
            _lift(x, before, inverse_mass, contacts, ZERO, n_in_hull, left, friction, active)
        power = _forces(x, v, springs, damping_s, force)
        for i in range(len(x)):
            if inverse_mass[i] > 0.0:
                for k in range(3):
                    v[i, k] += 0.5 * step_s * inverse_mass[i] * force[i, k]
                v[i, 2] -= 0.5 * step_s * gravity
        lost_j += 0.5 * step_s * power + (1.0 - kept * kept) * _kinetic(v, inverse_mass)
        v *= kept
        if n_contacts > 0:
            if is_shared:
                other_j -= _kinetic(v, inverse_mass)
            _stop(
                v,
                inverse_mass,
                contacts,
                n_in_hull,
                n_contacts,
                friction,
                active,
                is_held_otherwise,
            )
            if is_shared:
                other_j += _kinetic(v, inverse_mass)
            _stop(v, inverse_mass, contacts, ZERO, n_in_hull, friction, active, is_held)
    return lost_j, other_j
