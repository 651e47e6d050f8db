"""From where to look: the view that shows what touched what."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.pose import rotation_of
from hybridve.calib.rig import Rig
from hybridve.hull.query.silhouettes import Hull
from hybridve.hull.view.cells import Cells, hull_cells
from hybridve.hull.view.drawn import DrawnObject
from hybridve.hull.view.novel import NovelView

#: Vertical field of view: long enough a lens that nothing near the border looks bent.
_FOV_DEG = 30.0

#: Directions tried: around, and above the horizon.
_N_AZIMUTHS = 24
_ELEVATIONS_DEG = (20.0, 32.0)

#: Share of the picture's half width and height that is filled; the rest is for text.
_FILL = np.array([0.90, 0.76])

#: The world's origin, and the cameras, come into the picture if that makes everything else no
#: smaller than one over this.
_ORIGIN_MAY_COST, _CAMERAS_MAY_COST = 1.15, 1.7

#: Objects count for the framing as far as this many times the hull's diagonal from its middle: a
#: hall's floor plan must not make the person a dot.
_NEAR_HULL = 1.5

#: Stray cells of the hull that do not count for the framing, as a share on either side.
_STRAY = 0.01

#: Points that stand for the objects, and for what collides, when directions are compared.
_N_SAMPLES, _N_HITS = 3000, 600

#: Points of an object that the framing minds, about.
_MOST_FOCUS = 2000

#: The raster in which directions are compared.
RASTER_PX = (64, 40)

#: How far, as a cosine, the cameras must agree with Z to leave it up, or with another axis.
_UP_COSINE = 0.35


@dataclass(frozen=True, slots=True, eq=False)
class Viewpoint:
    """From where a picture is seen.

    Attributes
    ----------
    eye_world, target_world : (3,) float64
        Where the eye is and what it looks at, in metres.
    up_world : (3,) float64
        What is up in the picture, near enough.
    vertical_fov_deg : float
        Angle between the upper and the lower border.
    """

    eye_world: NDArray[np.float64]
    target_world: NDArray[np.float64]
    up_world: NDArray[np.float64]
    vertical_fov_deg: float

    def novel_view(self, aspect: float, range_m: tuple[float, float]) -> NovelView:
        """Return the camera of a picture that is `aspect` times as wide as high."""
        right, down, forward = _axes(self.target_world - self.eye_world, self.up_world)
        tangent = np.tan(np.deg2rad(self.vertical_fov_deg) / 2)
        half_extent = np.array([tangent * aspect, tangent])
        return NovelView(self.eye_world, right, down, forward, half_extent, range_m)


@dataclass(frozen=True, slots=True, eq=False)
class Focus:
    """What a picture is about, where that is not all of the scene.

    Attributes
    ----------
    points_world : (N, 3) float64
        What fills it, metres; at least one.
    names : tuple of str
        The objects that must be seen.
    """

    points_world: NDArray[np.float64]
    names: tuple[str, ...]


def zoomed(
    viewpoint: Viewpoint, factor: float, at_world: NDArray[np.float64] | None = None
) -> Viewpoint:
    """Return the view from the same place, so many times as large.

    Parameters
    ----------
    viewpoint : Viewpoint
        The view.
    factor : float
        Above 1 less is seen, larger.
    at_world : (3,) float64, optional
        What comes into the middle of the picture; by default what is there.
    """
    tangent = np.tan(np.deg2rad(viewpoint.vertical_fov_deg) / 2) / factor
    fov_deg = float(np.rad2deg(2 * np.arctan(tangent)))
    target = viewpoint.target_world if at_world is None else at_world
    return replace(viewpoint, target_world=target, vertical_fov_deg=fov_deg)


def orbited(viewpoint: Viewpoint, angle_rad: float) -> Viewpoint:
    """Return a view turned about the vertical through its target, seen from above leftward."""
    up = viewpoint.up_world / np.linalg.norm(viewpoint.up_world)
    turned = rotation_of(angle_rad * up) @ (viewpoint.eye_world - viewpoint.target_world)
    return replace(viewpoint, eye_world=viewpoint.target_world + turned)


def up_axis(rig: Rig) -> NDArray[np.float64]:
    """Return the world axis that is up: Z, unless the cameras clearly stand otherwise.

    Rigs calibrated from a board on the floor have Z up. In a world made elsewhere the axis is taken
    that the upper edges of the images point to, and that the cameras look down from.
    """
    poses = np.array([camera.cam_from_world for camera in rig.cameras])
    up = -(poses[:, 1, :3] + poses[:, 2, :3]).mean(axis=0)
    if up[2] >= _UP_COSINE or np.abs(up).max() < _UP_COSINE:
        return np.array([0.0, 0.0, 1.0])
    axis = int(np.abs(up).argmax())
    result = np.zeros(3)
    result[axis] = np.sign(up[axis])
    return result


def focus_points(hull: Hull, cells: Cells, objects: list[DrawnObject]) -> NDArray[np.float64]:
    """Return points (N, 3) in metres that a picture must show: the hull's and the objects'."""
    points = [np.zeros((0, 3))]
    near_middle, near_m = np.zeros(3), np.inf
    if len(cells):
        centers = cells.centers_local + hull.views.origin_world
        low, high = np.quantile(centers, [_STRAY, 1 - _STRAY], axis=0)
        low, high = low - cells.edge_m / 2, high + cells.edge_m / 2
        kept = centers[((centers >= low) & (centers <= high)).all(axis=1)]
        points.append(kept)
        near_middle, near_m = (low + high) / 2, _NEAR_HULL * float(np.linalg.norm(high - low))
    for item in objects:
        vertices = item.vertices_world[np.unique(item.faces)]
        away = np.linalg.norm(vertices - near_middle, axis=1)
        points.append(_outline(vertices[away <= near_m]))
        points.append(_outline(np.asarray(item.hit_points_world, np.float64).reshape(-1, 3)))
    return np.concatenate(points)


def _outline(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return some of the points (N, 3), the outermost ones among them."""
    if len(points) <= _MOST_FOCUS:
        return points
    steps = np.array([-1.0, 0.0, 1.0])
    directions = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
    outermost = [int((points @ direction).argmax()) for direction in directions]
    return points[np.union1d(outermost, np.arange(0, len(points), len(points) // _MOST_FOCUS))]


def fitting_eye(
    points_world: NDArray[np.float64],
    axes: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]],
    half_extent: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the place nearest to points (N, 3) from where all are inside the picture.

    Each border of the picture is a plane through the eye, which the points must not cross: the
    outermost point of each border binds, and of the two pairs of borders the farther one decides.
    """
    view = points_world @ np.stack(axes).T
    first = (view[:, :2] - half_extent * view[:, 2:]).max(axis=0)
    last = (view[:, :2] + half_extent * view[:, 2:]).min(axis=0)
    depth = float(((last - first) / (2 * half_extent)).min())
    across = (first + last) / 2
    return np.asarray(np.array([*across, depth]) @ np.stack(axes))


def choose_viewpoint(
    hull: Hull,
    rig: Rig,
    objects: list[DrawnObject],
    *,
    aspect: float = 1.6,
    focus: Focus | None = None,
) -> Viewpoint:
    """Return a view from above in which hull and objects fill the picture and the collision shows.

    Directions around the scene are compared by how much of what collides (or, where nothing does,
    of the objects) is seen, how broad it appears, and how much of the hull is before it. Cameras
    come into the picture if the rest stays large.

    Parameters
    ----------
    hull : Hull
        The visual hull of one frame.
    rig : Rig
        Its cameras.
    objects : list of DrawnObject
        What else is drawn.
    aspect : float
        Width of the picture over its height.
    focus : Focus, optional
        What the picture is about, if not about all; cameras then do not matter.
    """
    vertices = [item.vertices_world for item in objects]
    cells = hull_cells(hull, np.concatenate(vertices) if vertices else None)
    return viewpoint_for(hull, cells, rig, objects, aspect, focus)


def viewpoint_for(
    hull: Hull,
    cells: Cells,
    rig: Rig,
    objects: list[DrawnObject],
    aspect: float,
    focus: Focus | None = None,
) -> Viewpoint:
    """Return what `choose_viewpoint` does, of a hull whose cells are known."""
    up = up_axis(rig)
    points = focus_points(hull, cells, objects)
    centers = rig.centers_world
    origin = np.zeros((1, 3))
    if len(points) == 0:  # nothing to see but the cameras
        points = np.concatenate([centers, hull.views.origin_world[None]])
    tangent = np.tan(np.deg2rad(_FOV_DEG) / 2)
    half_extent = np.array([tangent * aspect, tangent])

    best, best_score = None, -np.inf
    hull_points = cells.centers_local + hull.views.origin_world
    samples, hits = surface_samples(objects), _hits(objects)
    others = [origin, centers]
    if focus is not None:
        wanted = [item for item in objects if item.name in focus.names]
        points, others = focus.points_world, []
        hits = np.concatenate([_hits(wanted), surface_samples(wanted)[:_N_HITS]])
    for forward in _directions(up):
        axes = _axes(forward, up)
        eye = _eye([points, *others], axes, half_extent)
        view = NovelView(eye, *axes, half_extent, (1e-3, np.inf))
        score = _score(view, hull_points, samples, hits, centers)
        if score > best_score:
            best, best_score = view, score
    assert best is not None  # there are directions
    depth_m = float(np.median(best.view_points(points)[:, 2]))
    return Viewpoint(best.eye_world, best.eye_world + depth_m * best.forward, up, _FOV_DEG)


def overview(points_world: NDArray[np.float64], viewpoint: Viewpoint, aspect: float) -> Viewpoint:
    """Return a viewpoint on the same side, 35 degrees up, that shows all of the points (N, 3)."""
    up = viewpoint.up_world / np.linalg.norm(viewpoint.up_world)
    forward = viewpoint.target_world - viewpoint.eye_world
    level = forward - up * (forward @ up)
    if np.linalg.norm(level) > 1e-6 * np.linalg.norm(forward):
        forward = level / np.linalg.norm(level) - up * np.tan(np.deg2rad(35.0))
    axes = _axes(forward, up)
    tangent = np.tan(np.deg2rad(_FOV_DEG) / 2)
    half_extent = np.array([tangent * aspect, tangent])
    eye = fitting_eye(points_world, axes, 0.85 * half_extent)
    depth_m = float(np.median((points_world - eye) @ axes[2]))
    return Viewpoint(eye, eye + max(depth_m, 1e-3) * axes[2], up, _FOV_DEG)


def _axes(
    forward: NDArray[np.float64], up: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return right, down and forward as unit vectors; any right where up is along forward."""
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-6 * np.linalg.norm(up):
        right = np.cross(forward, np.eye(3)[int(np.abs(forward).argmin())])
    right = right / np.linalg.norm(right)
    return right, np.cross(forward, right), forward


def _directions(up: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    axis = int(np.abs(up).argmax())
    first, second = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3]
    result = []
    for elevation in np.deg2rad(_ELEVATIONS_DEG):
        # Half a step off the world's axes: a box seen square on looks flat.
        for azimuth in (np.arange(_N_AZIMUTHS) + 0.5) * 2 * np.pi / _N_AZIMUTHS:
            level = np.cos(azimuth) * first + np.sin(azimuth) * second
            result.append(-np.cos(elevation) * level - np.sin(elevation) * up)
    return result


def _eye(
    points: list[NDArray[np.float64]],
    axes: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]],
    half_extent: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return from where the first points are seen, and the others too unless that costs too much.

    The world's origin and the cameras follow, in this order.
    """
    shown = points[0]
    eye = fitting_eye(shown, axes, _FILL * half_extent)
    near_m = float(np.median((shown - eye) @ axes[2]))
    for more, cost in zip(points[1:], (_ORIGIN_MAY_COST, _CAMERAS_MAY_COST), strict=False):
        wider = np.concatenate([shown, more])
        far = fitting_eye(wider, axes, _FILL * half_extent)
        if float(np.median((points[0] - far) @ axes[2])) <= cost * near_m:
            shown, eye = wider, far
    return eye


def surface_samples(objects: list[DrawnObject]) -> NDArray[np.float64]:
    """Return points (N, 3) spread over the objects' surfaces."""
    if not objects:
        return np.zeros((0, 3))
    corners = np.concatenate([item.corners_world for item in objects])
    areas = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    if len(corners) == 0 or areas.sum() == 0:
        return np.zeros((0, 3))
    rng = np.random.default_rng(0)
    chosen = corners[rng.choice(len(corners), _N_SAMPLES, p=areas / areas.sum())]
    weights = rng.dirichlet(np.ones(3), _N_SAMPLES)
    return np.asarray(np.einsum("nk,nkd->nd", weights, chosen))


def _hits(objects: list[DrawnObject]) -> NDArray[np.float64]:
    """Return points (N, 3) that stand for what collides."""
    points = [np.zeros((0, 3))]
    for item in objects:
        if not item.collides:
            continue
        if len(item.hit_points_world):
            points.append(np.asarray(item.hit_points_world, np.float64))
        elif len(item.hit_triangles):
            points.append(item.corners_world[item.hit_triangles].mean(axis=1))
        else:
            points.append(item.corners_world.mean(axis=1))
    found = np.concatenate(points)
    return found[:: max(1, len(found) // _N_HITS)]


def _score(
    view: NovelView,
    hull_points: NDArray[np.float64],
    samples: NDArray[np.float64],
    hits: NDArray[np.float64],
    centers: NDArray[np.float64],
) -> float:
    """Return how good a direction is; larger is better."""
    wanted = hits if len(hits) else samples
    score = 0.0
    if len(wanted):
        pixels, depths_m = view.pixels(wanted, RASTER_PX)
        seen = ~np.isnan(pixels).any(axis=1)
        seen &= ((pixels >= 0) & (pixels < RASTER_PX)).all(axis=1)
        if not seen.any():
            return -np.inf
        slack_m = 0.04 * float(np.median(depths_m))
        before_object = nearest_depth(view, samples, pixels[seen]) < depths_m[seen] - slack_m
        hull_m = np.minimum(nearest_depth(view, hull_points, pixels[seen]), depths_m[seen])
        covered = np.clip((depths_m[seen] - hull_m) / (5 * slack_m), 0, 1)
        spread = (
            np.sqrt(max(float(np.linalg.det(np.cov(pixels[seen].T))), 0.0))
            if (seen.sum() > 2)
            else 0.0
        )
        score += seen.mean() - before_object.sum() / len(wanted)
        score += 0.3 * (1 - covered.mean()) + 0.6 * min(1.0, spread / 8.0)
    # The hull broadside and unhidden.
    if len(hull_points):
        pixels, depths_m = view.pixels(hull_points, RASTER_PX)
        seen = ~np.isnan(pixels).any(axis=1)
        if seen.any():
            hidden = nearest_depth(view, samples, pixels[seen]) < depths_m[seen]
            score += 0.4 * (1 - hidden.mean())
            score += 0.2 * min(1.0, float(np.prod(pixels[seen].std(axis=0))) ** 0.5 / 8.0)
    # Cameras right before the eye.
    places, depths_m = view.pixels(centers, RASTER_PX)
    scene_m = (
        float(np.median(view.view_points(np.concatenate([hull_points, samples]))[:, 2]))
        if (len(hull_points) + len(samples))
        else 0.0
    )
    with np.errstate(invalid="ignore"):
        inside = ((places >= 0) & (places < RASTER_PX)).all(axis=1)
    return score - 0.15 * float((inside & (depths_m < 0.7 * scene_m)).sum())


def nearest_depth(
    view: NovelView, points: NDArray[np.float64], pixels: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return how deep the nearest of `points` lies in the cell of each pixel (N, 2) of the raster.

    The raster is `RASTER_PX` large; infinite where no point is.
    """
    width, height = RASTER_PX
    depth = np.full(width * height, np.inf)
    if len(points):
        places, depths_m = view.pixels(points, RASTER_PX)
        seen = ~np.isnan(places).any(axis=1)
        column, row = np.floor(places[seen]).astype(np.int64).T
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        np.minimum.at(depth, row[inside] * width + column[inside], depths_m[seen][inside])
    column, row = np.clip(np.floor(pixels), 0, np.array(RASTER_PX) - 1).astype(np.int64).T
    return np.asarray(depth[row * width + column])
