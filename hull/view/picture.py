"""Pictures of one frame: the scene from outside, and a camera's image with the CAD drawn in.

What a person looks at first: cameras, the hull, the CAD, and in red what collides.
"""

import zlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.camera import Camera
from hybridve.calib.errors import ReportError
from hybridve.calib.files import write_whole
from hybridve.calib.rig import Rig
from hybridve.hull.places import MARK
from hybridve.hull.query.silhouettes import Hull
from hybridve.hull.view.cells import hull_cells
from hybridve.hull.view.drawn import DrawnObject, Marks, Measure
from hybridve.hull.view.heat_scale import HeatScale, draw_heat
from hybridve.hull.view.labels import (
    INK,
    LABEL_SIZE,
    PALE_INK,
    Box,
    Labels,
    Rgb,
    draw_legend,
    fitted,
    plate,
    put_text,
    text_size,
)
from hybridve.hull.view.novel import NovelView
from hybridve.hull.view.overlay import Overlay, overlay_picture
from hybridve.hull.view.paint import (
    AXIS_RGB,
    COLLIDING_RGB,
    FREE_RGB,
    HULL_RGB,
    INSIDE_RGB,
    POINT_RGB,
    TOUCHED_RGB,
    PaintedScene,
    Painter,
    camera_corners,
    camera_length_m,
    floor_under,
    round_length,
)
from hybridve.hull.view.recorded import view_of_matrix
from hybridve.hull.view.viewpoint import (
    RASTER_PX,
    Focus,
    Viewpoint,
    choose_viewpoint,
    focus_points,
    nearest_depth,
    overview,
    surface_samples,
    up_axis,
    viewpoint_for,
)

__all__ = [
    "DrawnObject",
    "Focus",
    "HeatScale",
    "Measure",
    "Painter",
    "Viewpoint",
    "choose_viewpoint",
    "contact_sheet",
    "draw_from_camera",
    "draw_overlay",
    "draw_picture",
    "sheet_layout",
    "write_picture",
]

Image = NDArray[np.uint8]

#: Side of the small picture of the whole rig, as a share of the picture's; its distance from the
#: border, in pixels of a picture 1000 high.
_INSET_SHARE, _INSET_MARGIN_PX = 0.30, 20

#: Height of the line that the legend takes, in pixels of a picture 1000 high.
_TEXT_LINE_PX = 76

#: Objects beyond this many go without a label.
_MOST_LABELS = 16

#: Space between the pictures of a contact sheet, in pixels, and its colour.
_SHEET_GAP_PX, _SHEET_GREY = 6, 245


def draw_picture(
    hull: Hull,
    rig: Rig,
    objects: list[DrawnObject],
    *,
    viewpoint: Viewpoint | None = None,
    size_px: tuple[int, int] = (1600, 1000),
    title: str = "",
    caption: str = "",
    marks: Marks | None = None,
    images: Sequence[Image | None] = (),
    heat: HeatScale | None = None,
    with_overview: bool = True,
    painter: Painter | None = None,
) -> Image:
    """Return the scene from outside.

    The hull is drawn by volume query (`hybridve.hull.view.novel`) and the objects with it, each
    before the other where it is nearer. What of a colliding object is inside the hull is red and
    shines through; cameras are labelled pyramids, the floor has a grid, the world's axes are red,
    green and blue. Cameras that do not fit into the picture are shown in a small one in its corner.

    Parameters
    ----------
    hull : Hull
        The visual hull of one frame; it may be empty.
    rig : Rig
        Its cameras.
    objects : list of DrawnObject
        What else is drawn.
    viewpoint : Viewpoint, optional
        From where to look; by default from where `choose_viewpoint` says.
    size_px : tuple of int
        Width and height.
    title, caption : str
        Written into the upper left corner.
    marks : Marks, optional
        Points, ways and measures that are drawn over it.
    images : sequence of C (H, W, 3) uint8 or None
        What the hull's cameras recorded, as pinhole images, BGR: the hull is drawn as it looked.
        None for a camera that no colour is taken from.
    heat : HeatScale, optional
        What the colours of objects with `warmth` mean; it is drawn into the picture.
    with_overview : bool
        Whether cameras that do not fit into the picture are shown in a small one.
    painter : Painter, optional
        Draws it; for many pictures make one and keep it.

    Returns
    -------
    (H, W, 3) uint8
        BGR.

    Raises
    ------
    DeviceError
        If there is no OpenGL.
    """
    if painter is None:
        with Painter() as own:
            return draw_picture(
                hull,
                rig,
                objects,
                viewpoint=viewpoint,
                size_px=size_px,
                title=title,
                caption=caption,
                marks=marks,
                images=images,
                heat=heat,
                with_overview=with_overview,
                painter=own,
            )
    aspect = size_px[0] / size_px[1]
    vertices = [item.vertices_world for item in objects]
    cells = hull_cells(hull, np.concatenate(vertices) if vertices else None)
    if viewpoint is None:
        viewpoint = viewpoint_for(hull, cells, rig, objects, aspect)
    focus = focus_points(hull, cells, objects)
    middle = hull.views.origin_world if len(focus) == 0 else np.median(focus, axis=0)
    camera_m = camera_length_m(rig, middle)
    frusta = np.concatenate([camera_corners(camera, camera_m) for camera in rig.cameras])
    floor = floor_under(focus if len(focus) else rig.centers_world, up_axis(rig))
    everything = np.concatenate(
        [
            focus,
            rig.centers_world,
            frusta,
            *vertices,
            *_box_corners(cells.box_local(), hull.views.origin_world, len(cells)),
        ]
    )
    view = viewpoint.novel_view(aspect, _depth_range(viewpoint, everything))
    with_cameras = _are_seen(view, rig.centers_world)
    shown = rig.cameras if with_cameras else ()
    scene = PaintedScene(hull, cells, objects, shown, camera_m, floor, marks or Marks(), images)
    image = painter.paint(scene, view, size_px)
    labels = Labels(image, size_px[1] / 1000)
    _write_text(labels, title, caption, scene)
    _write_corner(labels, _grid_text(scene))
    if heat is not None:
        labels.reserve(draw_heat(image, heat, labels.scale))
    if with_overview and not with_cameras:
        small = (round(size_px[0] * _INSET_SHARE), round(size_px[1] * _INSET_SHARE))
        hits = [np.asarray(item.hit_points_world, np.float64) for item in objects]
        wide = overview(np.concatenate([focus, rig.centers_world, frusta]), viewpoint, aspect)
        grid_m = max(floor.grid_m, round_length(float(np.ptp(rig.centers_world, axis=0).max()) / 8))
        around = replace(
            scene,
            images=(),
            marks=replace(scene.marks, measures=()),
            cameras=rig.cameras,
            floor=replace(floor, grid_m=grid_m),
        )
        wide_view = wide.novel_view(aspect, _depth_range(wide, everything))
        inset = painter.paint(around, wide_view, small)
        inset_labels = Labels(inset, 0.85 * size_px[1] / 1000)
        _write_corner(inset_labels, _grid_text(around))
        _label_cameras(inset_labels, rig.cameras, wide_view, small)
        pixels, _ = view.pixels(np.concatenate([focus, *hits]), size_px)
        labels.reserve(_put_inset(labels, inset, pixels[np.isfinite(pixels).all(axis=1)]))
    _label_scene(labels, scene, view, size_px)
    return image


def draw_from_camera(
    hull: Hull,
    camera: int,
    image: Image,
    objects: list[DrawnObject],
    *,
    size_px: tuple[int, int],
    zoom: float = 1.0,
    at_world: NDArray[np.float64] | None = None,
    title: str = "",
    caption: str = "",
    marks: Marks | None = None,
    heat: HeatScale | None = None,
    painter: Painter,
) -> Image:
    """Return the scene over what one of the hull's cameras recorded.

    The CAD covers the picture where it is before the hull; where it is behind the hull, the picture
    covers it. The hull is outlined.

    Parameters
    ----------
    hull : Hull
        The visual hull of one frame.
    camera : int
        Which of its cameras.
    image : (H, W, 3) uint8
        What it recorded, as pinhole image, BGR.
    objects, title, caption, marks, heat
        As of `draw_picture`.
    size_px : tuple of int
        Width and height; the picture is as wide as it can be in it, and black beside.
    zoom : float
        So many times as large, cut out of the image.
    at_world : (3,) float64, optional
        What that is about; the middle of the image otherwise.
    painter : Painter
        Draws it.

    Returns
    -------
    (H, W, 3) uint8
        BGR.
    """
    vertices = [item.vertices_world for item in objects]
    cells = hull_cells(hull, np.concatenate(vertices) if vertices else None)
    whole = np.array(image.shape[1::-1])
    middle = whole / 2
    if at_world is not None:
        place = hull.views.project(at_world, camera)
        middle = place[:2] / place[2] if place[2] > 0 else middle
    extent = np.maximum(np.minimum(np.rint(whole / max(zoom, 1.0)), whole), 2)
    first = np.clip(np.rint(middle - extent / 2), 0, whole - extent).astype(int)
    width, height = extent.astype(int)
    image = image[first[1] : first[1] + height, first[0] : first[0] + width]
    share = min(size_px[0] / width, size_px[1] / height)
    inner = (max(1, round(share * width)), max(1, round(share * height)))
    matrix = hull.views.img_from_local[camera].copy()
    matrix[:2] -= first[:, None] * matrix[2]
    view = view_of_matrix(matrix, extent, hull.views.origin_world, (1e-3, 1e6))
    seen = [
        *vertices,
        *_box_corners(cells.box_local(), hull.views.origin_world, len(cells)),
    ]
    depths = np.concatenate(seen) if seen else np.zeros((0, 3))
    depths_m = (depths - view.eye_world) @ view.forward
    farthest = float(depths_m.max(initial=1.0)) * 1.05
    nearest = float(depths_m[depths_m > 0].min(initial=farthest))
    view = replace(view, range_m=(max(0.5 * nearest, 1e-4 * farthest), farthest))
    floor = floor_under(np.zeros((0, 3)), np.array([0.0, 0.0, 1.0]))
    scene = PaintedScene(hull, cells, objects, (), 1.0, floor, marks or Marks(), backdrop=image)
    drawn = painter.paint(scene, view, inner)
    result = np.zeros((size_px[1], size_px[0], 3), np.uint8)
    left, top = (size_px[0] - inner[0]) // 2, (size_px[1] - inner[1]) // 2
    result[top : top + inner[1], left : left + inner[0]] = drawn
    labels = Labels(result, size_px[1] / 1000)
    _write_text(labels, title, caption, scene)
    if heat is not None:
        labels.reserve(draw_heat(result, heat, labels.scale))
    _label_measures(labels, scene, view, inner, np.array([left, top]))
    return result


def draw_overlay(
    image: Image,
    camera: Camera,
    mask: NDArray[np.uint8],
    objects: list[DrawnObject],
    *,
    hull_depth_m: NDArray[np.float32] | None = None,
    measures: tuple[Measure, ...] = (),
    share: float = 1.0,
    painter: Painter | None = None,
) -> Image:
    """Return a camera's frame with the silhouette outlined and the CAD drawn over it.

    The CAD goes through the camera's lens as the world did, so that it lies where it would have
    been seen; what of it is touched is red, what the hull hides is faint.

    Parameters
    ----------
    image : (H, W, 3) uint8
        The frame as recorded, BGR.
    camera : Camera
        What took it.
    mask : (H, W) uint8
        The silhouette in the image as recorded, above 0 on object pixels.
    objects : list of DrawnObject
        What is drawn over it.
    hull_depth_m : (H, W) float32, optional
        How deep the hull is in the image, metres; inf where it is not.
    measures : tuple of Measure
        Lines with numbers.
    share : float
        How large the picture is beside the frame, at most 1.
    painter : Painter, optional
        Draws it; for many pictures make one and keep it.

    Returns
    -------
    (H, W, 3) uint8
        BGR.

    Raises
    ------
    ValueError
        If the sizes of image, mask and camera differ.
    DeviceError
        If there is no OpenGL.
    """
    size = (camera.height_px, camera.width_px)
    if image.shape != (*size, 3) or mask.shape != size:
        raise ValueError(
            f"camera {camera.name}: image {image.shape} and mask {mask.shape}, expected "
            f"{(*size, 3)} and {size}"
        )
    over = Overlay(objects, hull_depth_m, measures, share)
    if painter is None:
        with Painter() as own:
            return overlay_picture(own.device, image, camera, mask, over)
    return overlay_picture(painter.device, image, camera, mask, over)


def sheet_layout(sizes_px: list[tuple[int, int]], most_px: tuple[int, int]) -> tuple[int, float]:
    """Return in how many columns pictures fit best on a sheet, and how large they are then.

    Parameters
    ----------
    sizes_px : list of tuple of int
        Widths and heights; at least one.
    most_px : tuple of int
        Width and height that the sheet must not exceed.

    Returns
    -------
    columns : int
        Those with which the pictures are largest; of equals the fewest, two at least.
    share : float
        Of the pictures' own size, at most 1.
    """
    width = max(size[0] for size in sizes_px)
    height = max(size[1] for size in sizes_px)
    count, gap = len(sizes_px), _SHEET_GAP_PX
    best = (0.0, 0)
    for columns in range(1, count + 1):
        rows = -(-count // columns)
        share = min(
            (most_px[0] - gap * (columns + 1)) / (columns * width),
            (most_px[1] - gap * (rows + 1)) / (rows * height),
            1.0,
        )
        if columns >= min(2, count) and share > best[0] * (1 + 1e-9):
            best = (share, columns)
    return best[1], best[0]


def contact_sheet(images: list[Image], columns: int) -> Image:
    """Return pictures side by side, row by row, each in a cell of the largest one's size.

    Parameters
    ----------
    images : list of (H, W, 3) uint8
        At least one; sizes may differ.
    columns : int
        How many a row.

    Raises
    ------
    ValueError
        If there is no picture or no column.
    """
    if not images or columns < 1:
        raise ValueError(f"{len(images)} pictures in {columns} columns make no sheet")
    columns = min(columns, len(images))
    rows = -(-len(images) // columns)
    height = max(image.shape[0] for image in images)
    width = max(image.shape[1] for image in images)
    gap = _SHEET_GAP_PX
    shape = (rows * (height + gap) + gap, columns * (width + gap) + gap, 3)
    sheet = np.full(shape, _SHEET_GREY, np.uint8)
    for number, image in enumerate(images):
        row, column = divmod(number, columns)
        top = gap + row * (height + gap) + (height - image.shape[0]) // 2
        left = gap + column * (width + gap) + (width - image.shape[1]) // 2
        sheet[top : top + image.shape[0], left : left + image.shape[1]] = image
    return sheet


def _marked(encoded: bytes) -> bytes:
    """Return a PNG or JPEG with a remark that it is ours; another file as it is."""
    text = MARK.encode()
    if encoded.startswith(b"\x89PNG"):
        head = 33  # the signature and the chunk that comes first
        chunk = b"tEXtSoftware\0" + text
        size, check = len(chunk) - 4, zlib.crc32(chunk)
        remark = size.to_bytes(4) + chunk + check.to_bytes(4)
    elif encoded.startswith(b"\xff\xd8"):
        head, remark = 2, b"\xff\xfe" + (len(text) + 2).to_bytes(2) + text
    else:
        return encoded
    return encoded[:head] + remark + encoded[head:]


def write_picture(path: Path, image: Image) -> None:
    """Write a picture; the file appears only when it is complete.

    Raises
    ------
    ReportError
        If the suffix is none that OpenCV writes, or the place cannot be written to.
    """
    try:
        good, encoded = cv2.imencode(path.suffix, image)
    except cv2.error as error:
        raise ReportError(
            f"{path}: pictures of kind {path.suffix or '(no suffix)'!r} cannot be written; "
            "take .png or .jpg"
        ) from error
    if not good:
        raise ReportError(f"{path}: the picture could not be encoded as {path.suffix}")
    try:
        write_whole(path, _marked(encoded.tobytes()))
    except OSError as error:
        raise ReportError(
            f"{path}: cannot be written ({error.strerror}); name a place that can"
        ) from error


def _box_corners(
    box_local: tuple[NDArray[np.float64], NDArray[np.float64]],
    origin_world: NDArray[np.float64],
    count: int,
) -> list[NDArray[np.float64]]:
    if count == 0:
        return []
    choice = [[box_local[i >> axis & 1][axis] for axis in range(3)] for i in range(8)]
    return [np.array(choice) + origin_world]


def _depth_range(viewpoint: Viewpoint, points: NDArray[np.float64]) -> tuple[float, float]:
    """Return the depths between which all of the points (N, 3) before the eye lie."""
    forward = viewpoint.target_world - viewpoint.eye_world
    distance_m = float(np.linalg.norm(forward))
    depths = (points - viewpoint.eye_world) @ (forward / distance_m)
    farthest = max(float(depths.max(initial=0.0)) * 1.05, 2 * distance_m)
    nearest = float(depths[depths > 0].min(initial=distance_m))
    return max(0.8 * nearest, 1e-3 * distance_m), farthest


def _are_seen(view: NovelView, points_world: NDArray[np.float64]) -> bool:
    """Tell whether all of the points (N, 3) are in the picture."""
    places, _ = view.pixels(points_world, (1, 1))
    with np.errstate(invalid="ignore"):
        return bool(((places >= 0) & (places < 1)).all())


def _write_text(labels: Labels, title: str, caption: str, scene: PaintedScene) -> None:
    """Write title, caption, legend and the grid's spacing."""
    image, scale = labels.image, labels.scale
    height, width = image.shape[:2]
    left = round(28 * scale)
    room = round(width * (1 - _INSET_SHARE)) - 3 * left
    baseline = round(24 * scale)
    for text, size, rgb, bold in ((title, 1.0, INK, True), (caption, 0.62, PALE_INK, False)):
        if not text:
            continue
        shown = fitted(text, size * scale, room, bold)
        text_width, above, below = text_size(shown, size * scale, bold)
        baseline += above + round(6 * scale)
        box = (left - 8, baseline - above - 6, left + text_width + 8, baseline + below + 4)
        plate(image, box, 0.6)
        labels.reserve(box)
        put_text(image, shown, (left, baseline), size * scale, rgb, bold)
        baseline += below + round(8 * scale)

    objects = scene.objects
    entries: list[tuple[str, Rgb, str]] = []
    if len(scene.cells) and len(scene.images) == 0 and scene.backdrop is None:
        entries.append(("patch", HULL_RGB, "real: visual hull"))
    if any(not item.collides and item.warmth is None for item in objects):
        entries.append(("patch", FREE_RGB, "CAD, free"))
    if any(item.collides for item in objects):
        if any(item.collides and item.warmth is None for item in objects):
            entries.append(("patch", COLLIDING_RGB, "CAD, collides"))
            entries.append(("patch", TOUCHED_RGB, "touched triangle"))
        entries.append(("patch", INSIDE_RGB, "inside the hull"))
    if any(item.collides and len(item.hit_points_world) for item in objects):
        entries.append(("dot", POINT_RGB, "collision point"))
    bottom = height - round(24 * scale)
    if entries:
        labels.reserve(draw_legend(image, entries, left, bottom, scale))


def _write_corner(labels: Labels, text: str) -> None:
    """Write a remark into the lower right corner."""
    image, scale = labels.image, labels.scale
    height, width = image.shape[:2]
    margin = round(min(24 * scale, 0.05 * height))
    text_width, above, below = text_size(text, LABEL_SIZE * scale)
    left, baseline = width - margin - text_width, height - margin
    box = (left - 8, baseline - above - 8, left + text_width + 8, baseline + below + 6)
    plate(image, box, 0.7)
    put_text(image, text, (left, baseline), LABEL_SIZE * scale, PALE_INK)
    labels.reserve(box)


def _grid_text(scene: PaintedScene) -> str:
    """Return what the grid is: its spacing, and its height unless that is 0."""
    floor = scene.floor
    text = f"grid {_length_text(floor.grid_m)}"
    if floor.height_m == 0:
        return text
    axis = int(np.abs(floor.up).argmax())
    return f"{text} at {'XYZ'[axis]} = {floor.height_m * float(floor.up[axis]):.3g} m"


def _length_text(length_m: float) -> str:
    """Return a length in the unit in which it reads best."""
    if length_m >= 1.0:
        return f"{length_m:g} m"
    if length_m >= 0.01:
        return f"{100 * length_m:g} cm"
    return f"{1000 * length_m:g} mm"


def _label_scene(
    labels: Labels, scene: PaintedScene, view: NovelView, size_px: tuple[int, int]
) -> None:
    """Name the objects, what collides first, then the cameras and the axes."""
    _label_measures(labels, scene, view, size_px, np.zeros(2))
    ordered = sorted(scene.objects, key=lambda item: not item.collides)
    around = np.concatenate(
        [scene.cells.centers_local + scene.hull.views.origin_world, surface_samples(scene.objects)]
    )
    for item in ordered[:_MOST_LABELS]:
        rgb: Rgb = (0.70, 0.02, 0.05) if item.collides else INK
        labels.add(item.name, _top(item, view, around) * size_px, rgb, bold=item.collides)
    _label_cameras(labels, scene.cameras, view, size_px)
    tips, _ = view.pixels(np.eye(3) * scene.floor.grid_m, size_px)
    for axis, tip in enumerate(tips):
        labels.add("XYZ"[axis], tip, AXIS_RGB[axis], bold=True)


def _label_measures(
    labels: Labels,
    scene: PaintedScene,
    view: NovelView,
    size_px: tuple[int, int],
    off_px: NDArray[np.float64] | NDArray[np.int64],
) -> None:
    """Write the numbers of lines at their middles, in a picture that lies `off_px` in another."""
    for measure in scene.marks.measures:
        if measure.text:
            pixels, _ = view.pixels(measure.middle_world[None], size_px)
            labels.add(measure.text, pixels[0] + off_px, measure.rgb, bold=True)


def _top(
    item: DrawnObject, view: NovelView, around_world: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return where an object appears highest, of what of it is not hidden if there is any.

    As shares (2,) of the picture's width and height; NaN for an object that does not appear.
    """
    points = np.concatenate([item.vertices_world[np.unique(item.faces)], surface_samples([item])])
    pixels, depths_m = view.pixels(points, RASTER_PX)
    with np.errstate(invalid="ignore"):
        seen = ((pixels >= 0) & (pixels < RASTER_PX)).all(axis=1)
    pixels, depths_m = pixels[seen], depths_m[seen]
    if len(pixels) == 0:
        return np.full(2, np.nan)
    slack_m = 0.01 * float(np.median(depths_m))
    unhidden = depths_m < nearest_depth(view, around_world, pixels) + slack_m
    if unhidden.any():
        pixels = pixels[unhidden]
    return np.asarray(pixels[pixels[:, 1].argmin()] / RASTER_PX)


def _label_cameras(
    labels: Labels, cameras: tuple[Camera, ...], view: NovelView, size_px: tuple[int, int]
) -> None:
    for camera in cameras:
        pixels, _ = view.pixels(camera.center_world[None], size_px)
        labels.add(camera.name, pixels[0])


def _overlaps(first: Box, second: Box) -> bool:
    """Tell whether two rectangles have a pixel in common."""
    return (
        first[0] < second[2]
        and second[0] < first[2]
        and first[1] < second[3]
        and second[1] < first[3]
    )


def _put_inset(labels: Labels, inset: Image, pixels: NDArray[np.float64]) -> Box:
    """Lay a small picture into the corner where it hides the fewest of the scene's pixels (N, 2).

    Returns its rectangle.
    """
    image = labels.image
    (rows, columns), (height, width) = image.shape[:2], inset.shape[:2]
    margin = round(_INSET_MARGIN_PX * labels.scale)
    below = rows - height - round(_TEXT_LINE_PX * labels.scale)  # clear of the legend
    above = max([margin, *(box[3] + margin for box in labels.taken if box[3] < rows // 2)])
    corners = [
        (columns - margin - width, margin),
        (margin, above),
        (columns - margin - width, below),
        (margin, below),
    ]
    hidden = [
        int(((pixels >= corner) & (pixels < (corner[0] + width, corner[1] + height))).all(1).sum())
        for corner in corners
    ]
    taken = [
        sum(_overlaps((left, top, left + width, top + height), box) for box in labels.taken)
        for left, top in corners
    ]
    left, top = corners[int(np.lexsort((hidden, taken))[0])]
    image[top : top + height, left : left + width] = inset
    frame = (left - 1, top - 1), (left + width, top + height)
    cv2.rectangle(image, *frame, (255, 255, 255), 3)
    cv2.rectangle(image, *frame, (150, 145, 140), 1)
    return left - 4, top - 4, left + width + 4, top + height + 4
