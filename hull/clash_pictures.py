"""Pictures of a clash in its worst frame: as its cameras saw it, or drawn from the report alone."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.camera import Camera
from hybridve.calib.lens import Undistortion, project_points, undistortion
from hybridve.calib.rig import Rig
from hybridve.hull.capture.recording import FrameRange
from hybridve.hull.query.silhouettes import Views, make_hull, make_views
from hybridve.hull.recorded import Recorded, seen_frames
from hybridve.hull.report.clashes import Clash
from hybridve.hull.report.read import Report
from hybridve.hull.report.touched import Touched
from hybridve.hull.view.drawn import DrawnObject
from hybridve.hull.view.paint import Painter
from hybridve.hull.view.picture import draw_overlay, draw_picture
from hybridve.hull.view.viewpoint import Viewpoint, choose_viewpoint

Image = NDArray[np.uint8]

#: Width of the first picture and of the others, and how many cameras.
_LARGE_PX, _OTHER_PX, _MOST_CAMERAS = 1280, 560, 4

#: A close-up shows this much of a picture.
_CLOSE_SHARE = 0.34


@dataclass(frozen=True, slots=True, eq=False)
class ClashPicture:
    """A picture of a clash.

    Attributes
    ----------
    image : (H, W, 3) uint8
        BGR.
    says : str
        What it shows, for who does not see it.
    caption : str
        What stands beneath it.
    viewpoint : Viewpoint
        From where it is seen.
    """

    image: Image
    says: str
    caption: str
    viewpoint: Viewpoint


def row_of(report: Report, clash: Clash) -> int:
    """Return which row of a report has the worst frame of one of its clashes."""
    return int(np.flatnonzero(report.index == clash.worst.frame)[0])


def clash_pictures(
    report: Report,
    clash: Clash,
    origin_m: NDArray[np.float64],
    touched: Mapping[str, Touched],
    rig: Rig,
    recorded: Recorded | None,
    painter: Painter,
) -> list[ClashPicture]:
    """Return pictures of a clash, the one that shows most first.

    With the recordings what the closest camera saw, a close-up, and what others saw; without, or
    where that frame cannot be read, the CAD and its collision points from outside.

    Raises
    ------
    SessionError
        If the recordings cannot be read.
    """
    objects = _drawn(report, touched, origin_m, row_of(report, clash))
    pictures = [] if recorded is None else _overlays(recorded, clash, objects, painter)
    return pictures or [_drawing(report, rig, clash, objects, painter)]


def _drawn(
    report: Report, touched: Mapping[str, Touched], origin_m: NDArray[np.float64], row: int
) -> list[DrawnObject]:
    """Return the CAD as it stood in a row of the report, with what of it is touched."""
    drawn = []
    for name, one in touched.items():
        vertices = one.mesh.vertices_at(row)
        if not np.isfinite(vertices).all():
            continue
        triangles, offset = one.triangles()
        drawn.append(
            DrawnObject(
                name=name,
                vertices_world=vertices + origin_m,
                faces=one.mesh.faces,
                collides=bool(report.objects[name].collides[row]),
                hit_triangles=triangles[offset[row] : offset[row + 1]].astype(np.uint32),
                hit_points_world=one.points(row) + origin_m,
            )
        )
    return drawn


def _drawing(
    report: Report, rig: Rig, clash: Clash, objects: list[DrawnObject], painter: Painter
) -> ClashPicture:
    """Return the CAD and its collision points from outside, without a hull."""
    views, lenses = _pinholes(rig)
    nothing = [np.zeros((lens.height_px, lens.width_px), np.uint8) for lens in lenses]
    alone = [one for one in objects if one.name == clash.name] or objects
    hull = make_hull(views, nothing)
    viewpoint = choose_viewpoint(hull, rig, alone)
    image = draw_picture(
        hull,
        rig,
        alone,
        viewpoint=viewpoint,
        size_px=(_LARGE_PX, 800),
        title=clash.name,
        caption=f"frame {clash.worst.frame} ({clash.worst.time_s:.2f} s), without the hull",
        painter=painter,
    )
    return ClashPicture(
        image,
        f"{clash.name} from outside: what of it is touched in frame {clash.worst.frame} is red.",
        f"{report.path.name}, frame {clash.worst.frame}: CAD and collision points",
        viewpoint,
    )


def _pinholes(rig: Rig) -> tuple[Views, list[Undistortion]]:
    lenses = [undistortion(camera) for camera in rig.cameras]
    matrices = [
        lens.img_from_cam @ camera.cam_from_world
        for lens, camera in zip(lenses, rig.cameras, strict=True)
    ]
    sizes_px = np.array([(lens.width_px, lens.height_px) for lens in lenses], np.int64)
    names = tuple(camera.name for camera in rig.cameras)
    return make_views(names, sizes_px, np.array(matrices)), lenses


def _overlays(
    recorded: Recorded, clash: Clash, objects: list[DrawnObject], painter: Painter
) -> list[ClashPicture]:
    """Return what the cameras saw in the worst frame: the closest whole, a close-up, and others."""
    index = clash.worst.frame
    seen = next(iter(seen_frames(recorded, FrameRange(index, index + 1))), None)
    if seen is None or seen.masks is None:
        return []
    rig = recorded.rig_at(index)
    at_world = clash.worst.on_object_world[None]
    shown = []
    for name, image, mask in zip(recorded.views.names, seen.images, seen.masks, strict=True):
        if image is None:
            continue
        camera = rig[name]
        pixels, depths_m = project_points(camera, at_world)
        x, y = pixels[0].tolist()
        inside = min(x, y, camera.width_px - x, camera.height_px - y)
        if not (math.isfinite(inside) and depths_m[0] > 0):
            continue
        scale = camera.pinhole[0, 0] / float(depths_m[0])
        shown.append((inside > 0, name in clash.worst.ends_at, scale, name, image, mask, (x, y)))
    shown.sort(key=lambda one: (not one[0], not one[1], -one[2]))
    pictures = []
    for number, (_, _, _, name, image, mask, at) in enumerate(shown[:_MOST_CAMERAS]):
        drawn = draw_overlay(image, rig[name], mask, objects, painter=painter)
        _ring(drawn, at)
        says = (
            f"What {name} saw in frame {index}: the outline of what is real, and {clash.name} "
            "drawn in, what of it is touched in red; a ring marks the worst place."
        )
        size_px = _LARGE_PX if number == 0 else _OTHER_PX
        viewpoint = _viewpoint_of(rig[name])
        caption = f"{name}, frame {index}"
        pictures.append(ClashPicture(fitted(drawn, size_px), says, caption, viewpoint))
        if number == 0:
            says = f"The same, close about the worst place, as {name} saw it."
            caption = f"{name}, close about the worst place"
            pictures.append(ClashPicture(_close_up(drawn, at), says, caption, viewpoint))
    return pictures


def _viewpoint_of(camera: Camera) -> Viewpoint:
    """Return from where a camera looks, as if its picture had its principal point in the middle."""
    _, down, forward = camera.cam_from_world[:, :3]
    tangent = 0.5 * camera.height_px / float(camera.pinhole[1, 1])
    fov_deg = math.degrees(2.0 * math.atan(tangent))
    return Viewpoint(camera.center_world, camera.center_world + forward, -down, fov_deg)


def _ring(image: Image, at: tuple[float, float]) -> None:
    """Draw a ring about a pixel."""
    scale = image.shape[0] / 500
    center = (round(16 * (at[0] - 0.5)), round(16 * (at[1] - 0.5)))
    for colour, width in (((0, 0, 0), 4), ((255, 255, 255), 2)):
        thickness = max(1, round(scale * width))
        cv2.circle(image, center, round(16 * 16 * scale), colour, thickness, cv2.LINE_AA, 4)


def fitted(image: Image, width_px: int) -> Image:
    """Return a picture of at most so many pixels across."""
    height, width = image.shape[:2]
    if width <= width_px:
        return image
    size = (width_px, max(1, round(height * width_px / width)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def _close_up(image: Image, at: tuple[float, float]) -> Image:
    height, width = image.shape[:2]
    half = max(40, round(0.5 * _CLOSE_SHARE * min(height, width) * 1.2))
    x = int(np.clip(at[0], half, max(width - half, half)))
    y = int(np.clip(at[1], half, max(height - half, half)))
    part = image[max(y - half, 0) : y + half, max(x - half, 0) : x + half]
    factor = max(1.0, _OTHER_PX / part.shape[1])
    size = (round(part.shape[1] * factor), round(part.shape[0] * factor))
    return np.asarray(cv2.resize(part, size, interpolation=cv2.INTER_CUBIC), np.uint8)
