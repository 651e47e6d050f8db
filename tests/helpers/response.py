"""Visual hulls whose boundary along a line is a closed form: of balls and of convex polyhedra.

A camera's cone of a ball is a circular cone; that of a convex polyhedron is bounded by the planes
through the camera and the edges of the outline, the convex hull of the projected vertices.

A silhouette is not the outline: its pixels are those whose centre lies within. A point of such a
pixel is at most half a diagonal outside of the outline, and one that lies deeper than that within
it is in such a pixel. So the silhouette's boundary lies between the outlines moved by `HALF_PX`.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.hull.query.silhouettes import Views

#: Half the diagonal of a pixel, and a little.
HALF_PX = 0.7072


@dataclass(frozen=True, slots=True)
class Exit:
    """Where a line leaves a camera's cone.

    Attributes
    ----------
    distance_m : float
        From the line's origin; infinite where it does not.
    normal : (3,) float64
        Outward normal of the cone there.
    camera : int
        Whose cone it is.
    footprint_m : float
        What moving the outline by one pixel does to the distance, at most: depth / focal length,
        over the sine of the angle of line and cone.
    """

    distance_m: float
    normal: NDArray[np.float64]
    camera: int
    footprint_m: float


def camera_center(views: Views, camera: int) -> NDArray[np.float64]:
    """Return where a camera is, (3,) metres, world."""
    matrix = views.img_from_local[camera]
    return views.origin_world - np.linalg.solve(matrix[:, :3], matrix[:, 3])


def focal_length(views: Views, camera: int) -> float:
    """Return the focal length of a camera, pixels."""
    matrix = views.img_from_local[camera]
    return float(np.linalg.norm(np.cross(matrix[0, :3], matrix[2, :3])))


def _exit(
    views: Views,
    camera: int,
    origin_world: NDArray[np.float64],
    unit: NDArray[np.float64],
    distance_m: float,
    normal: NDArray[np.float64],
) -> Exit:
    matrix = views.img_from_local[camera]
    point_local = origin_world + distance_m * unit - views.origin_world
    depth_m = matrix[2] @ np.append(point_local, 1.0)
    footprint_m = depth_m / focal_length(views, camera) / abs(normal @ unit)
    return Exit(distance_m, normal, camera, float(footprint_m))


def ball_exits(
    views: Views,
    center_world: NDArray[np.float64],
    radius_m: float,
    origin_world: NDArray[np.float64],
    unit: NDArray[np.float64],
    wider_px: float = 0.0,
) -> list[Exit]:
    """Return where a line from inside a ball leaves each camera's cone, nearest first.

    The cones are wider by as much as pixels subtend in the image's middle, where it is most.
    x is on the cone about axis a of half angle s from camera o: ((x-o) a)^2 = cos^2 s (x-o)^2.
    """
    exits = []
    for camera in range(len(views)):
        apex = camera_center(views, camera)
        axis = center_world - apex
        distance_m = float(np.linalg.norm(axis))
        axis /= distance_m
        cosine = np.cos(np.arcsin(radius_m / distance_m) + wider_px / focal_length(views, camera))
        start = origin_world - apex
        quadratic = (unit @ axis) ** 2 - cosine**2
        linear = 2 * ((start @ axis) * (unit @ axis) - cosine**2 * (start @ unit))
        constant = (start @ axis) ** 2 - cosine**2 * (start @ start)
        for root in np.roots([quadratic, linear, constant]):
            point = start + root.real * unit
            if root.real > 0 and point @ axis > 0:  # not on the cone behind the camera
                normal = cosine * point / np.linalg.norm(point) - axis
                normal /= np.linalg.norm(normal)
                exits.append(_exit(views, camera, origin_world, unit, float(root.real), normal))
    return sorted(exits, key=lambda found: found.distance_m)


def ball_silhouettes(
    views: Views, center_world: NDArray[np.float64], radius_m: float
) -> list[NDArray[np.uint8]]:
    """Return what `helpers.hulls.ball_masks` does, row by row: quick for large images.

    The cone of `ball_exits` is a quadric in pixels, below 0 outside; a row is inside between two
    roots. The ball must lie in front of the cameras.
    """
    masks = []
    for camera, (width, height) in enumerate(views.sizes_px):
        ray_from_pixel = np.linalg.inv(views.img_from_local[camera, :, :3])
        axis = center_world - camera_center(views, camera)
        distance_m = np.linalg.norm(axis)
        axis /= distance_m
        cone = np.outer(axis, axis) - (1.0 - (radius_m / distance_m) ** 2) * np.eye(3)
        q = ray_from_pixel.T @ cone @ ray_from_pixel
        x, y = np.arange(width) + 0.5, np.arange(height) + 0.5
        middle = -(q[0, 1] * y + q[0, 2]) / q[0, 0]
        constant = (q[1, 1] * y**2 + 2 * q[1, 2] * y + q[2, 2]) / q[0, 0]
        squared = middle**2 - constant
        half = np.where(squared > 0, np.sqrt(np.maximum(squared, 0.0)), 0.0)
        masks.append((np.abs(x - middle[:, None]) < half[:, None]).astype(np.uint8))
    return masks


def polyhedron_lines(
    views: Views, camera: int, vertices_world: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the lines (E, 3) of the outline of a convex polyhedron: positive outside."""
    matrix = views.img_from_local[camera]
    projected = (vertices_world - views.origin_world) @ matrix[:, :3].T + matrix[:, 3]
    pixels = projected[:, :2] / projected[:, 2:]
    # Single precision only chooses the corners; what is concave by that much does no harm.
    order = cv2.convexHull(pixels.astype(np.float32), returnPoints=False)[:, 0]
    corners = pixels[order]
    along = np.roll(corners, -1, axis=0) - corners
    normals = np.column_stack([along[:, 1], -along[:, 0]])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    lines = np.column_stack([normals, -(normals * corners).sum(axis=1)])
    middle = np.append(corners.mean(axis=0), 1.0)
    return np.asarray(lines * -np.sign(lines @ middle)[:, None])


def polyhedron_masks(views: Views, vertices_world: NDArray[np.float64]) -> list[NDArray[np.uint8]]:
    """Return silhouettes of a convex polyhedron: pixels whose centre lies in its outline."""
    masks = []
    for camera, (width, height) in enumerate(views.sizes_px):
        a, b, c = polyhedron_lines(views, camera, vertices_world).T[:, :, None]  # (E, 1) each
        x, y = np.arange(width) + 0.5, np.arange(height) + 0.5
        with np.errstate(divide="ignore", invalid="ignore"):
            crossing = -(b * y + c) / a  # (E, H): where a row of pixels crosses a line
        first = np.where(a < 0, crossing, -np.inf).max(axis=0)
        last = np.where(a > 0, crossing, np.inf).min(axis=0)
        last[((a == 0) & (b * y + c >= 0)).any(axis=0)] = -np.inf
        masks.append(((x > first[:, None]) & (x < last[:, None])).astype(np.uint8))
    return masks


def polyhedron_exits(
    views: Views,
    vertices_world: NDArray[np.float64],
    origin_world: NDArray[np.float64],
    unit: NDArray[np.float64],
    wider_px: float = 0.0,
) -> list[Exit]:
    """Return where a line from inside a convex polyhedron leaves each camera's cone.

    Nearest first; the outlines are moved outwards by some pixels.
    """
    exits = []
    for camera in range(len(views)):
        matrix = views.img_from_local[camera]
        lines = polyhedron_lines(views, camera, vertices_world)
        lines[:, 2] -= wider_px
        planes = lines @ matrix  # (E, 4)
        start = planes[:, :3] @ (origin_world - views.origin_world) + planes[:, 3]
        speed = planes[:, :3] @ unit
        with np.errstate(divide="ignore"):
            distances_m = np.where(speed > 0, -start / speed, np.inf)
        first = int(distances_m.argmin())
        if np.isfinite(distances_m[first]):
            normal = planes[first, :3] / np.linalg.norm(planes[first, :3])
            exits.append(_exit(views, camera, origin_world, unit, distances_m[first], normal))
    return sorted(exits, key=lambda found: found.distance_m)


def box_vertices(
    half_m: NDArray[np.float64], rotation: NDArray[np.float64], center_world: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the corners (8, 3) of a box, metres."""
    signs = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), axis=-1).reshape(-1, 3)
    return signs * half_m @ rotation.T + center_world


def cylinder_vertices(
    radius_m: float,
    half_length_m: float,
    rotation: NDArray[np.float64],
    center_world: NDArray[np.float64],
    n_sides: int = 240,
) -> NDArray[np.float64]:
    """Return a prism (2 * n_sides, 3) within a cylinder: at 240, off by 9e-5 of the radius."""
    angle = np.arange(n_sides) * (2 * np.pi / n_sides)
    rim = np.column_stack([radius_m * np.cos(angle), radius_m * np.sin(angle), 0 * angle])
    ends = np.array([[0, 0, half_length_m], [0, 0, -half_length_m]])
    return np.asarray((rim + ends[:, None]).reshape(-1, 3) @ rotation.T + center_world)


def random_rotation(rng: np.random.Generator) -> NDArray[np.float64]:
    """Return a rotation matrix (3, 3)."""
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return np.asarray(rotation * np.sign(np.linalg.det(rotation)))


def random_unit(rng: np.random.Generator) -> NDArray[np.float64]:
    """Return a direction (3,)."""
    direction = rng.normal(size=3)
    return direction / np.linalg.norm(direction)


def angle_deg(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """Return the angle of two unit vectors, degrees."""
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))
