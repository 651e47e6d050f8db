"""Where the hull meets a body, which way out, how deep, and how fast the hull comes.

Collision points that lie near each other are a patch; two hands that squeeze a ball are two. Its
recovery vector V_rec points against the mean outward normal of the body's surface over the patch
(for a hinge along its arc), for a body's centre tells nothing where it is long or hollow. Where the
surface is open, both ways are tried, and the shorter is taken. From collision points along V_rec,
the exits of `hybridve.hull.query.walk` are CP_hull.

The hull's surface there is a plane through exits around CP_hull, of a footprint as large as the
body is: a silhouette's rim is a staircase of pixels, of which one exit is anywhere, and a hull has
creases that a body straddles. On blocks seen with pixels of 4 mm, depth from it is off by 0.8 mm
rms, of a single exit by 1.3. N_hull is that of the silhouette which ends the hull at CP_hull where
the plane agrees with it to 10 degrees, else the plane's: in the mean off by 1.0 to 1.2 degrees for
bodies of 50 to 200 mm; the plane's alone is by 2.2 to 1.3.

How fast the hull moves is what the same rays say of an earlier hull.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.effects.body_shape import cross
from hybridve.hull.jit import compiled
from hybridve.hull.query.engine import Hits, Triangles
from hybridve.hull.query.silhouettes import Hull, Views
from hybridve.hull.query.viewport import sample_positions
from hybridve.hull.query.walk import boundary_cameras, silhouette_normal, spans_of_rays

#: Collision points that are grouped, and those of a patch whose way out is measured, at most.
_MOST_POINTS, _MOST_RAYS = 600, 16

#: Contacts of a patch at most: a face needs its corners.
MOST_CONTACTS = 6

#: A mean normal shorter than this has no direction: the patch goes all around.
_LEAST_MEAN = 0.1

#: A normal that leans more than this against V_rec (as a cosine) is not believed.
_LEAST_COSINE = 0.2

#: Directions whose cosine is below minus this are opposed.
_OPPOSED = 0.3

#: Directions that patches say less of, as a share of the most, are not said anything of.
_LEAST_LEVERAGE = 0.3

#: Cosine of 10 degrees.
_AGREE = 0.985

#: The footprint of a normal: a share of the body's size, and pixels at least.
_FOOTPRINT_SHARE, _FOOTPRINT_PX = 0.2, 4.0

#: The fastest that a hull is followed, metres a second.
MOST_HULL_SPEED = 10.0

#: An earlier hull, a later one, and the seconds between them, of which its speed is read; None for
#: the first if nothing is known of it.
Way = tuple[Hull | None, Hull | None, float]

#: Rays around CP_hull, as shares of the footprint's radius: two rings and the middle.
_RING = np.arange(8) * (np.pi / 4)
_OFFSETS = np.concatenate(
    [
        np.zeros((1, 2)),
        np.column_stack([np.cos(_RING), np.sin(_RING)]) * 0.5,
        np.column_stack([np.cos(_RING + np.pi / 8), np.sin(_RING + np.pi / 8)]),
    ]
)


#: With this share of its rays a footprint is whole.
_WHOLE = 0.8


@dataclass(frozen=True, slots=True, eq=False)
class Arc:
    """The way that a hinged body can go.

    Attributes
    ----------
    axis : (3,) float64
        Unit vector, world.
    anchor_world : (3,) float64
        A point of it, metres.
    """

    axis: NDArray[np.float64]
    anchor_world: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Patch:
    """One connected contact of a body and the hull.

    Attributes
    ----------
    points_world : (K, 3) float64
        Collision points, metres, the deepest first.
    out_m : (K,) float64
        How far each is from its exit along V_rec; infinite where none is within reach.
    v_rec : (3,) float64
        The recovery vector.
    reach_m : float
        How far an exit was looked for, metres.
    """

    points_world: NDArray[np.float64]
    out_m: NDArray[np.float64]
    v_rec: NDArray[np.float64]
    reach_m: float

    @property
    def deepest_m(self) -> float:
        """How deep it is along V_rec; the reach, where that is not known but at least as much."""
        return min(float(self.out_m.max()), self.reach_m)


@dataclass(frozen=True, slots=True, eq=False)
class HullContact:
    """A patch as the solver takes it.

    Attributes
    ----------
    points_world : (K, 3) float64
        At most `MOST_CONTACTS` points of the body in the hull, metres, the deepest first.
    depths_m : (K,) float64
        How deep they are, along `n_hull`.
    n_hull : (3,) float64
        N_hull, outwards.
    speed_m_s : float
        How fast the hull's surface moves along it.
    v_rec : (3,) float64
        The patch's recovery vector.
    out_m : float
        D_rec of the first point.
    """

    points_world: NDArray[np.float64]
    depths_m: NDArray[np.float64]
    n_hull: NDArray[np.float64]
    speed_m_s: float
    v_rec: NDArray[np.float64]
    out_m: float


def find_patches(
    hull: Hull,
    mesh: Triangles,
    hits: Hits,
    *,
    center_world: NDArray[np.float64],
    is_closed: bool,
    arc: Arc | None = None,
) -> list[Patch]:
    """Return the connected contacts of one body, those that leave against their entry left out.

    Parameters
    ----------
    hull : Hull
        The visual hull.
    mesh : Triangles
        The body where it is; of a closed one all faces outwards.
    hits : Hits
        Its samples in the hull.
    center_world : (3,) float64
        RP_obj: where a patch gives way to that goes all around the body.
    is_closed : bool
        Whether the faces tell inside and outside apart.
    arc : Arc or None
        Of a hinged body.
    """
    if len(hits.start) == 0:
        return []
    size_m = float(np.linalg.norm(np.ptp(mesh.vertices_world, axis=0)))
    reach_m = max(2.0 * size_m, 0.1)
    triangle, sample = hits.thinned(_MOST_POINTS)
    corners = mesh.corners_world[triangle]
    points_world = sample_positions(corners, mesh.viewports[triangle], sample.astype(np.uint32))
    across = cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    viewports = mesh.viewports[triangle].astype(np.float64)
    weighted = across / (viewports * (viewports + 1.0))[:, None]  # a sample's share of the area
    edges_m = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    spacing_m = float((edges_m / np.maximum(viewports - 1.0, 1.0)).max())
    thinning = max(1.0, len(hits) / len(points_world))
    # A silhouette's staircase parts what one surface touches.
    pixel_m = pixel_size(hull.views, points_world[0])
    label = _clusters(points_world, max(1.7 * spacing_m * thinning**0.5, 2.0 * pixel_m))
    patches = []
    for number in range(int(label.max()) + 1):
        is_here = label == number
        patches.append(
            _patch(
                hull,
                points_world[is_here],
                weighted[is_here],
                center_world,
                is_closed,
                arc,
                reach_m,
            )
        )
    return _without_pierced(patches)


@compiled
def _clusters(points: NDArray[np.float64], near_m: float) -> NDArray[np.int64]:
    """Return a number for each point, the same for those that steps of `near_m` join."""
    n_points = len(points)
    label = np.full(n_points, -1, np.int64)
    waiting = np.zeros(n_points, np.int64)
    number = -1
    for start in range(n_points):
        if label[start] >= 0:
            continue
        number += 1
        label[start] = number
        waiting[0], n_waiting = start, 1
        while n_waiting > 0:
            n_waiting -= 1
            here = waiting[n_waiting]
            for other in range(n_points):
                if label[other] < 0 and _squared(points, here, other) <= near_m * near_m:
                    label[other] = number
                    waiting[n_waiting] = other
                    n_waiting += 1
    return label


@compiled
def _squared(points: NDArray[np.float64], one: int, other: int) -> float:
    x = points[one, 0] - points[other, 0]
    y = points[one, 1] - points[other, 1]
    z = points[one, 2] - points[other, 2]
    squared: float = x * x + y * y + z * z
    return squared


def _patch(
    hull: Hull,
    points_world: NDArray[np.float64],
    weighted: NDArray[np.float64],
    center_world: NDArray[np.float64],
    is_closed: bool,
    arc: Arc | None,
    reach_m: float,
) -> Patch:
    weights = np.linalg.norm(weighted, axis=1)
    total = max(float(weights.sum()), float(np.finfo(np.float64).tiny))
    mean = weighted.sum(axis=0) / total
    middle = weights @ points_world / total if weights.any() else points_world.mean(axis=0)
    if not is_closed:  # one face's normal, the others turned to its side
        turned = weighted * np.where(weighted @ weighted[weights.argmax()] < 0, -1.0, 1.0)[:, None]
        mean = turned.sum(axis=0) / total
    v_rec = -mean
    if np.linalg.norm(mean) < _LEAST_MEAN:
        farthest = points_world[((points_world - center_world) ** 2).sum(axis=1).argmax()]
        v_rec = center_world - farthest
    if arc is not None:
        tangent = cross(arc.axis, middle - arc.anchor_world)
        v_rec = tangent if tangent @ v_rec >= 0 else -tangent
    length = float(np.linalg.norm(v_rec))
    v_rec = v_rec / length if length > 0 else np.array([0.0, 0.0, 1.0])
    farthest = int(((points_world - middle) ** 2).sum(axis=1).argmax())
    chosen = points_world[_spread(points_world, farthest, _MOST_RAYS)]
    found = _ways_out(hull, chosen, v_rec, reach_m)
    if not is_closed:
        other = _ways_out(hull, chosen, -v_rec, reach_m)
        if other.max() < found.max():
            v_rec, found = -v_rec, other
    order = np.argsort(-np.where(np.isfinite(found), found, -1.0), kind="stable")
    return Patch(chosen[order], found[order], v_rec, reach_m)


@compiled
def _spread(points: NDArray[np.float64], first: int, most: int) -> NDArray[np.int64]:
    """Return the numbers of points that lie far from each other: each farthest from those before.

    Points at the place of one that was chosen are none.
    """
    n_points = len(points)
    chosen = np.zeros(min(most, n_points), np.int64)
    apart = np.full(n_points, np.inf)
    latest = first
    for count in range(len(chosen)):
        chosen[count] = latest
        apart[latest] = 0.0
        farthest = latest
        for point in range(n_points):
            apart[point] = min(apart[point], _squared(points, latest, point))
            if apart[point] > apart[farthest]:
                farthest = point
        if apart[farthest] <= 0.0:
            return chosen[: count + 1]
        latest = farthest
    return chosen


def _ways_out(
    hull: Hull, points_world: NDArray[np.float64], v_rec: NDArray[np.float64], reach_m: float
) -> NDArray[np.float64]:
    """Return how far points are from where they leave the hull: 0 outside, infinite if nowhere."""
    directions = np.broadcast_to(v_rec, points_world.shape)
    found = np.zeros(len(points_world))
    for i, spans_m in enumerate(spans_of_rays(hull, points_world, directions, reach_m)):
        if len(spans_m) and spans_m[0, 0] == 0.0:
            found[i] = spans_m[0, 1] if spans_m[0, 1] < reach_m else np.inf
    return found


def _without_pierced(patches: list[Patch]) -> list[Patch]:
    """Leave out patches where a piece of the hull that entered elsewhere comes out of the body.

    Its way out leads back through the body, against that of the patch where it entered, which is
    the shorter. Two hands that squeeze a body are apart from each other within it.
    """
    kept = []
    for patch in patches:
        for other in patches:
            ahead_m = (patch.points_world[0] - other.points_world[0]) @ other.v_rec
            is_behind = other.v_rec @ patch.v_rec < -_OPPOSED and 0 < ahead_m <= other.out_m[0]
            if is_behind and other.out_m[0] < patch.out_m[0]:
                break
        else:
            kept.append(patch)
    return kept


def contact_of(
    hull: Hull,
    patch: Patch,
    *,
    size_m: float,
    ways: Sequence[Way] = (),
) -> HullContact | None:
    """Return a patch as the solver takes it; None if no point of it has a way out.

    Parameters
    ----------
    hull : Hull
        The visual hull.
    patch : Patch
        A contact with it.
    size_m : float
        The body's size: the diagonal of its bounding box.
    ways : sequence of Way
        What tells how fast the hull moves: the first that does. It stands where none does.
    """
    has_exit = np.isfinite(patch.out_m) & (patch.out_m > 0)
    if not has_exit.any():
        return None
    points_world, out_m = patch.points_world[has_exit], patch.out_m[has_exit]
    surface = _surface_at(hull, points_world[0], float(out_m[0]), patch.v_rec, size_m, ways)
    cosine = float(surface.n_hull @ patch.v_rec)
    depths_m = out_m * cosine
    # Under the footprint the plane knows better than a single exit, which may be on any stair.
    is_under = np.linalg.norm(points_world - points_world[0], axis=1) < surface.radius_m
    depths_m[is_under] = (surface.point_world - points_world[is_under]) @ surface.n_hull
    if depths_m.max() <= 0:  # the whole patch is on one stair that sticks out
        depths_m = out_m * cosine
    order = np.argsort(-depths_m, kind="stable")
    order = order[depths_m[order] > 0]
    points_world, depths_m = points_world[order], depths_m[order]
    # The corners of a face first; the deepest may lie between them.
    apart = ((points_world - points_world.mean(axis=0)) ** 2).sum(axis=1)
    chosen = _spread(np.ascontiguousarray(points_world), int(apart.argmax()), MOST_CONTACTS - 1)
    chosen = np.concatenate([[0], chosen[chosen != 0]])
    return HullContact(
        points_world[chosen],
        depths_m[chosen],
        surface.n_hull,
        surface.speed_m_s * cosine,
        patch.v_rec,
        float(depths_m[0] / cosine),
    )


class _Surface(NamedTuple):
    """The plane that stands for the hull where a patch leaves it.

    `point_world` lies on it, `n_hull` is its normal, `radius_m` how large the footprint was that it
    was taken from, and `speed_m_s` its speed along V_rec.
    """

    point_world: NDArray[np.float64]
    n_hull: NDArray[np.float64]
    radius_m: float
    speed_m_s: float


def _surface_at(
    hull: Hull,
    point_world: NDArray[np.float64],
    out_m: float,
    v_rec: NDArray[np.float64],
    size_m: float,
    ways: Sequence[Way],
) -> _Surface:
    """Return the hull's surface where a point leaves it along V_rec after a way."""
    pixel_m = pixel_size(hull.views, point_world)
    radius_m = max(_FOOTPRINT_SHARE * size_m, _FOOTPRINT_PX * pixel_m)
    side = cross(v_rec, np.eye(3)[np.abs(v_rec).argmin()])
    side /= np.linalg.norm(side)
    frame = np.stack([side, cross(v_rec, side)])  # (2, 3)
    moving = [
        (first, last, seconds)
        for first, last, seconds in ways
        if first is not None and last is not None and first is not last and seconds > 0
    ]
    longest_s = max((seconds for _, _, seconds in moving), default=0.0)
    back_m = 2.0 * radius_m + MOST_HULL_SPEED * longest_s
    origins = point_world - back_m * v_rec + radius_m * _OFFSETS @ frame
    middle_m = back_m + out_m
    reach_m = middle_m + back_m
    here_m = _ends_near(hull, origins, v_rec, np.full(len(origins), middle_m), reach_m)
    is_near = np.abs(here_m - middle_m) <= 1.5 * radius_m
    ahead_m, slopes = _plane(radius_m * _OFFSETS[is_near], here_m[is_near] - back_m, out_m)
    n_hull = v_rec - slopes @ frame
    n_hull /= np.linalg.norm(n_hull)
    if n_hull @ v_rec < _LEAST_COSINE:
        ahead_m, n_hull = out_m, v_rec
    cameras = boundary_cameras(hull, point_world + out_m * v_rec, v_rec)
    if len(cameras) == 1:
        of_camera = silhouette_normal(hull, cameras[0], point_world + out_m * v_rec)
        if of_camera @ n_hull > _AGREE:  # not where it is NaN
            n_hull = of_camera
    speed = 0.0
    for first, last, seconds in moving:
        first_m = _ends_near(first, origins, v_rec, here_m, reach_m)
        last_m = here_m if last is hull else _ends_near(last, origins, v_rec, here_m, reach_m)
        both = is_near & np.isfinite(first_m) & np.isfinite(last_m)
        if 2 * both.sum() >= is_near.sum() > 0:
            speed = float((last_m[both] - first_m[both]).mean()) / seconds
            break
    speed = float(np.clip(speed, -MOST_HULL_SPEED, MOST_HULL_SPEED))
    return _Surface(point_world + ahead_m * v_rec, n_hull, radius_m, speed)


def pixel_size(views: Views, point_world: NDArray[np.float64]) -> float:
    """Return how large a pixel is at a point, metres: in the mean of the cameras before it."""
    matrices = views.img_from_local
    depths_m = matrices[:, 2, :3] @ (point_world - views.origin_world) + matrices[:, 2, 3]
    focal_px = np.linalg.norm(cross(matrices[:, 0, :3], matrices[:, 2, :3]), axis=1)
    in_front = depths_m > 0
    return float((depths_m / focal_px)[in_front].mean()) if in_front.any() else 0.0


def _ends_near(
    hull: Hull,
    origins: NDArray[np.float64],
    direction: NDArray[np.float64],
    wanted_m: NDArray[np.float64],
    reach_m: float,
) -> NDArray[np.float64]:
    """Return where rays leave the hull, nearest to what is wanted; infinite if nowhere."""
    ends_m = np.full(len(origins), np.inf)
    directions = np.broadcast_to(direction, origins.shape)
    for i, spans_m in enumerate(spans_of_rays(hull, origins, directions, reach_m)):
        ends = spans_m[spans_m[:, 1] < reach_m, 1]
        if len(ends) and np.isfinite(wanted_m[i]):
            ends_m[i] = ends[np.abs(ends - wanted_m[i]).argmin()]
    return ends_m


def _plane(
    beside_m: NDArray[np.float64], ahead_m: NDArray[np.float64], unknown_m: float
) -> tuple[float, NDArray[np.float64]]:
    """Return how far ahead the surface through points is in their middle, and its slopes (2,).

    Of points `beside_m` (K, 2) and `ahead_m` (K,), in one frame. With nearly all of the footprint
    the surface may bulge evenly; else it is a plane. Points that lie far from it are left out once:
    beyond an edge the hull is another surface. Flat, at what is known, where they lie on a line.
    """
    kept = np.ones(len(beside_m), np.bool_)
    bulge = (beside_m**2).sum(axis=1, keepdims=True)
    found = np.array([unknown_m, 0.0, 0.0])
    for _ in range(2):
        spread = np.linalg.eigvalsh(np.cov(beside_m[kept].T)) if kept.sum() >= 4 else np.zeros(2)
        if spread[0] <= 0.05 * spread[1]:
            return unknown_m, np.zeros(2)
        columns = [np.ones((len(beside_m), 1)), beside_m]
        if kept.sum() >= _WHOLE * len(_OFFSETS):
            columns.append(bulge / bulge.max())
        terms = np.hstack(columns)
        found = np.linalg.lstsq(terms[kept], ahead_m[kept], rcond=None)[0]
        off_m = np.abs(ahead_m - terms @ found)
        is_close = off_m <= 2.0 * float(np.sqrt(np.mean(off_m[kept] ** 2))) + 1e-9
        if is_close.sum() == kept.sum():
            break
        kept = is_close
    return float(found[0]), found[1:3]


def followed(
    normals: NDArray[np.float64], wanted: NDArray[np.float64]
) -> tuple[bool, NDArray[np.float64]]:
    """Return whether patches squeeze a body, and how far along each normal it then goes.

    No rigid body leaves two hands that close on it. It takes the one velocity, or the one
    displacement, that comes nearest to what all patches want.

    Parameters
    ----------
    normals : (P, 3) float64
        N_hull of the patches.
    wanted : (P,) float64
        Speeds or displacements along them.
    """
    if not (normals @ normals.T < -_OPPOSED).any():
        return False, wanted
    common = np.linalg.lstsq(normals, wanted, rcond=_LEAST_LEVERAGE)[0]
    return True, normals @ common
