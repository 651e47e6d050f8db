"""A rig from outside and from above, with its cameras, and how far off points are in it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from hybridve.calib.camera import Camera
from hybridve.calib.judging.certificate import Volume
from hybridve.calib.lens import cam_from_img
from hybridve.calib.pose import invert, transform
from hybridve.calib.rig import Rig
from hybridve.calib.solving.covariance import point_errors
from hybridve.hull.view.chart_marks import (
    BLUE,
    GREEN,
    GREY,
    INK,
    ORANGE,
    RED,
    draw_iso_lines,
    halo,
    new_figure,
    nice,
    spread_levels,
)

#: Light to dark, so that the order survives a grey print; blank is none of its colours.
_ERROR_COLOURS = LinearSegmentedColormap.from_list(
    "error", ["#EAF4FA", "#B9DAEE", "#7DB8DC", "#4391C4", "#1C6CA3"]
)
_BLANK = "#F1F1F1"

#: Heights of the slices, as shares of the volume's.
_SLICES = (("low", 1 / 6), ("middle", 1 / 2), ("high", 5 / 6))

#: Points of a slice, a side.
_SLICE_POINTS = 33

#: How points (N, 3) of the world come to the plane of a picture, (N, 2).
_Map = Callable[[NDArray[np.float64]], NDArray[np.float64]]

#: What is this much further away than all else is large does not come into the picture.
_FAR = 2.0


def slice_errors(
    rig: Rig, volume: Volume
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the error in level slices through a volume.

    Returns
    -------
    x_m, y_m : (W,), (H,) float64
        Columns and rows of the slices, world.
    z_m : (S,) float64
        Their heights, ascending.
    errors95_m : (S, H, W) float64
        The distance that the error of a point exceeds in 5 % of calibrations; NaN where fewer
        cameras see it than the volume asks for, or fewer than two.
    """
    low, high = volume.low_world, volume.high_world
    x, y = (np.linspace(low[axis], high[axis], _SLICE_POINTS) for axis in (0, 1))
    z = np.array([low[2] + share * (high[2] - low[2]) for _, share in _SLICES])
    grid = np.stack(np.meshgrid(z, y, x, indexing="ij"), axis=-1)[..., ::-1].reshape(-1, 3)
    found = point_errors(rig, grid)
    errors_m = np.where(found.n_seeing >= volume.min_cameras, found.radius95_m, np.nan)
    return x, y, z, errors_m.reshape(len(z), len(y), len(x))


def draw_errors(rig: Rig, volume: Volume) -> Figure | None:
    """Return the map of the error: slices seen from above; None where no point has an error."""
    x, y, z, errors_m = slice_errors(rig, volume)
    errors_mm = 1000.0 * errors_m
    known = errors_mm[np.isfinite(errors_mm)]
    if not len(known):
        return None
    figure = new_figure(11.0, 3.95)
    least, most = float(known.min()), float(np.quantile(known, 0.95))
    if not most > least:
        least, most = 0.0, max(most, 1e-9)
    levels = spread_levels(errors_mm, 6)
    scale = Normalize(least, most)
    for number, ((what, _), height_m, layer) in enumerate(zip(_SLICES, z, errors_mm, strict=True)):
        axes = figure.add_axes((0.06 + 0.2955 * number, 0.115, 0.28, 0.81))
        half = (x[1] - x[0]) / 2, (y[1] - y[0]) / 2
        axes.set_facecolor("white")
        box = (x[0] - half[0], x[-1] + half[0], y[0] - half[1], y[-1] + half[1])
        axes.add_patch(
            Rectangle(
                (box[0], box[2]),
                box[1] - box[0],
                box[3] - box[2],
                facecolor=_BLANK,
                edgecolor="#999999",
                linewidth=0.8,
                linestyle="--",
                zorder=0,
            )
        )
        axes.imshow(
            np.ma.masked_invalid(layer),
            cmap=_ERROR_COLOURS,
            norm=scale,
            extent=box,
            origin="lower",
            interpolation="nearest",
            zorder=1,
        )
        draw_iso_lines(axes, *np.meshgrid(x, y), layer, 6, colour=INK, levels=levels)
        _frame_from_above(axes, rig, volume)
        _draw_cameras_from_above(axes, rig)
        share = np.isfinite(layer).mean()
        axes.set_title(f"{what}: z = {height_m:.2f} m ({100 * share:.0f} % seen)", fontsize=9)
        axes.set_xlabel("x, m", fontsize=8)
        if number == 0:
            axes.set_ylabel("y, m", fontsize=8)
        else:
            axes.set_yticklabels([])
    bar = figure.colorbar(
        ScalarMappable(scale, _ERROR_COLOURS),
        cax=figure.add_axes((0.95, 0.17, 0.012, 0.65)),
        extend="max" if known.max() > most else "neither",
    )
    bar.ax.tick_params(labelsize=8)
    bar.ax.set_title("mm", fontsize=8)
    return figure


def _frame_from_above(axes: Axes, rig: Rig, volume: Volume) -> None:
    """Show the volume, and the cameras as far as they are near it."""
    low, high = volume.low_world[:2], volume.high_world[:2]
    size = float(max((high - low).max(), 1e-6))
    centers = rig.centers_world[:, :2]
    reach = np.concatenate([centers, [low, high]]).clip(low - size, high + size)
    middle = (reach.min(axis=0) + reach.max(axis=0)) / 2.0
    half = 0.5 * float(np.ptp(reach, axis=0).max()) * 1.3
    axes.set_xlim(middle[0] - half, middle[0] + half)
    axes.set_ylim(middle[1] - half, middle[1] + half)
    axes.set_aspect("equal")
    axes.tick_params(labelsize=8)
    axes.grid(color="#EEEEEE", linewidth=0.5)
    axes.set_axisbelow(True)


def _draw_cameras_from_above(axes: Axes, rig: Rig) -> None:
    """Draw wedges where cameras stand; those outside the axes as a triangle on the border."""
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    span = right - left
    low = np.array([left, bottom]) + 0.03 * span
    high = np.array([right, top]) - 0.03 * span
    places, names = [], []
    wedges = []
    for camera in rig.cameras:
        center = camera.center_world[:2]
        inside = ((center >= low) & (center <= high)).all()
        shown = center.clip(low, high)
        if inside:
            rim = frustum(camera, 0.09 * span)[:, :2]
            wedges += [np.stack([center, rim[corner]]) for corner in _corners(rim)]
            wedges.append(rim)
            axes.plot(*shown, "o", color=INK, markersize=3.5, zorder=5)
        else:
            angle = np.rad2deg(np.arctan2(*(center - shown)[::-1])) - 90.0
            axes.plot(*shown, marker=(3, 0, angle), color=INK, markersize=7, zorder=5)
        places.append(shown)
        names.append(camera.name)
    axes.add_collection(LineCollection(wedges, colors=INK, linewidths=0.7, zorder=4))
    _place_names(axes, np.array(places), names)


#: Points along each border of an image, by which a frustum's rim is drawn.
_RIM_STEPS = 5

#: A lens is wide if its corners are this far off the axis: one over the cosine.
_WIDE = 2.0


def frustum(camera: Camera, length_m: float) -> NDArray[np.float64]:
    """Return the rim of what a camera sees, as far as `length_m`: (4 * steps + 1, 3) world."""
    steps = np.linspace(0.0, 1.0, _RIM_STEPS, endpoint=False)
    corners = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0), (0.0, 0.0)])
    rim = np.concatenate(
        [a + steps[:, None] * (b - a) for a, b in pairwise(corners)] + [corners[:1]]
    )
    size = np.array([camera.width_px, camera.height_px])
    rays = np.zeros((len(rim), 2))
    # The corners of a fisheye's image may be beyond what the lens maps: then of a part of it.
    for share in (1.0, 0.85, 0.7, 0.5, 0.3):
        rays = cam_from_img(camera, (0.5 + share * (rim - 0.5)) * size)
        if np.isfinite(rays).all():
            break
    directions = np.column_stack([np.nan_to_num(rays), np.ones(len(rays))])
    lengths = np.linalg.norm(directions, axis=1, keepdims=True)
    # A pyramid; of a wide lens a cone of the sphere, which does not run off to infinity.
    directions *= length_m / (lengths if lengths.max() > _WIDE else lengths.max())
    return transform(invert(camera.cam_from_world), directions)


def _corners(rim: NDArray[np.float64]) -> range:
    return range(0, len(rim) - 1, _RIM_STEPS)


def draw_rig(rig: Rig, volume: Volume) -> Figure:
    """Return the cameras with what they see, the working volume, floor and axes: two views."""
    scene = _scene(rig, volume)
    figure = new_figure(11.0, 4.8)
    perspective = figure.add_axes((0.0, 0.02, 0.56, 0.9))
    above = figure.add_axes((0.61, 0.09, 0.38, 0.83))
    eye_from_world = _eye(scene.extent)
    _draw_scene(perspective, scene, lambda points: _project(eye_from_world, points))
    perspective.set_axis_off()
    perspective.set_title("in perspective", fontsize=9)
    # The third axis points at the eye.
    _draw_scene(above, replace(scene, axes=scene.axes[:2]), lambda points: points[:, :2])
    above.tick_params(labelsize=8)
    above.set_xlabel("x, m", fontsize=8)
    above.set_ylabel("y, m", fontsize=8)
    above.set_title("from above", fontsize=9)
    return figure


@dataclass(frozen=True, slots=True, eq=False)
class _Scene:
    """What the views of a rig show; everything in world, metres.

    Attributes
    ----------
    strokes : tuple of (str, float, style, list of (K, 3) float64)
        Colour, width, style, and the lines that have them; later ones lie over earlier ones.
    axes : (0 to 3, 3) float64
        The ends of the world's axes.
    names : tuple of str
        The cameras.
    centers : (C, 3) float64
        Where they stand.
    rims : (N, 3) float64
        Points of their frusta, which names should not cover.
    extent : (2, 3) float64
        The box around all of it.
    """

    strokes: tuple[tuple[str, float, Any, list[NDArray[np.float64]]], ...]
    axes: NDArray[np.float64]
    names: tuple[str, ...]
    centers: NDArray[np.float64]
    rims: NDArray[np.float64]
    extent: NDArray[np.float64]


def _scene(rig: Rig, volume: Volume) -> _Scene:
    centers = rig.centers_world
    box = np.array([volume.low_world, volume.high_world])
    distances_m = np.linalg.norm(centers - box.mean(axis=0), axis=1)
    length_m = 0.22 * max(float(np.median(distances_m)), 1e-3)
    frusta = []
    for camera in rig.cameras:
        rim = frustum(camera, length_m)
        frusta.append(rim)
        frusta += [np.stack([camera.center_world, rim[corner]]) for corner in _corners(rim)]
        # A roof over the upper border tells which way up the camera is.
        left, right = rim[0], rim[_RIM_STEPS]
        up = -0.25 * np.linalg.norm(right - left) * camera.cam_from_world[1, :3]
        frusta.append(np.stack([left, (left + right) / 2.0 + up, right]))
    around = np.concatenate([box, *frusta])
    extent = np.array([around.min(axis=0), around.max(axis=0)])
    size = float(np.linalg.norm(extent[1] - extent[0]))
    strokes: list[tuple[str, float, Any, list[NDArray[np.float64]]]] = []
    if max(extent[0, 2], -extent[1, 2]) < _FAR * size:
        feet = [np.stack([center, center * (1.0, 1.0, 0.0)]) for center in centers]
        strokes += [(GREY, 0.6, "-", _floor(extent)), ("#999999", 0.7, ":", feet)]
        extent[0, 2], extent[1, 2] = min(extent[0, 2], 0.0), max(extent[1, 2], 0.0)
    strokes.append((ORANGE, 1.1, (0, (4, 2)), _box_edges(box)))
    strokes.append((BLUE, 1.0, "-", frusta))
    axes = np.zeros((0, 3))
    if np.linalg.norm(np.clip(0.0, *extent)) < _FAR * size:
        axes = 0.6 * length_m * np.eye(3)
    names = tuple(camera.name for camera in rig.cameras)
    return _Scene(tuple(strokes), axes, names, centers, np.concatenate(frusta), extent)


def _floor(extent: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Return a grid on z = 0 under a box."""
    step = nice(float((extent[1, :2] - extent[0, :2]).max()) / 5.0)
    first, last = np.floor(extent[0, :2] / step), np.ceil(extent[1, :2] / step)
    xs, ys = (np.arange(first[axis], last[axis] + 1) * step for axis in (0, 1))
    lines = [np.array([(x, ys[0], 0.0), (x, ys[-1], 0.0)]) for x in xs]
    return lines + [np.array([(xs[0], y, 0.0), (xs[-1], y, 0.0)]) for y in ys]


def _box_edges(box: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    corners = np.array(
        [[box[i, 0], box[j, 1], box[k, 2]] for k in (0, 1) for j in (0, 1) for i in (0, 1)]
    )
    pairs = [(a, a | 1 << axis) for a in range(8) for axis in range(3) if not a & 1 << axis]
    return [corners[list(pair)] for pair in pairs]


def _eye(extent: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return eye_from_world (3, 4) of a viewpoint above and beside a box; x right, y up."""
    middle = extent.mean(axis=0)
    size = float(np.linalg.norm(extent[1] - extent[0]))
    azimuth, elevation = np.deg2rad(-62.0), np.deg2rad(27.0)
    back = np.array(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ]
    )
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    rotation = np.stack([right, np.cross(back, right), -back])
    return np.column_stack([rotation, -rotation @ (middle + 1.9 * size * back)])


def _project(
    eye_from_world: NDArray[np.float64], points: NDArray[np.float64]
) -> NDArray[np.float64]:
    seen = transform(eye_from_world, points)
    return np.asarray(seen[:, :2] / seen[:, 2:])


def _draw_scene(axes: Axes, scene: _Scene, img_from_world: _Map) -> None:
    for colour, width, style, lines in scene.strokes:
        drawn = [img_from_world(line) for line in lines]
        axes.add_collection(
            LineCollection(drawn, colors=colour, linewidths=width, linestyles=style)
        )
    for end, colour in zip(scene.axes, (RED, GREEN, "#3344AA"), strict=False):
        line = img_from_world(np.stack([np.zeros(3), end]))
        axes.plot(*line.T, color=colour, linewidth=2.2)
    places = img_from_world(np.concatenate([scene.centers, scene.axes]))
    axes.plot(*places[: len(scene.names)].T, "o", color=INK, markersize=3.5)
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.1)
    axes.apply_aspect()
    _place_names(
        axes, places, [*scene.names, *"xyz"[: len(scene.axes)]], img_from_world(scene.rims)
    )


def _place_names(
    axes: Axes,
    places: NDArray[np.float64],
    names: Sequence[str],
    avoid: NDArray[np.float64] | None = None,
) -> None:
    """Write names beside places (N, 2), each where it covers least, also of `avoid` (M, 2)."""
    figure = axes.get_figure(root=True)
    assert figure is not None
    to_points = 72.0 / figure.dpi
    points = axes.transData.transform(places) * to_points
    frame = axes.get_window_extent()
    low, high = np.array(frame.min) * to_points, np.array(frame.max) * to_points
    size_pt = 8.0 if len(names) <= 8 else 7.0
    taken = [np.concatenate([point - 3.0, point + 3.0]) for point in points]
    if avoid is not None:
        taken += [
            np.concatenate([point - 1.5, point + 1.5])
            for point in axes.transData.transform(avoid) * to_points
        ]
    middle = points.mean(axis=0)
    for name, place, point in zip(names, places, points, strict=True):
        half = np.array([0.34 * len(name), 0.58]) * size_pt
        outwards = (point - middle) / max(float(np.linalg.norm(point - middle)), 1e-9)
        best: tuple[float, NDArray[np.float64]] | None = None
        for reach in (5.0, 11.0):
            for angle in np.arange(8) * np.pi / 4.0:
                way = np.array([np.cos(angle), np.sin(angle)])
                offset = way * (half + reach)
                box = np.concatenate([point + offset - half, point + offset + half])
                outside = (low - box[:2]).clip(0.0).sum() + (box[2:] - high).clip(0.0).sum()
                # Outwards is freer, as a rule, and near is better than far.
                cost = sum(_overlap(box, other) for other in taken) + 20.0 * float(outside)
                cost += 0.5 * reach - 2.0 * float(way @ outwards)
                if best is None or cost < best[0]:
                    best = cost, offset
        assert best is not None
        offset = best[1]
        taken.append(np.concatenate([point + offset - half, point + offset + half]))
        axes.annotate(
            name,
            (float(place[0]), float(place[1])),
            xytext=(float(offset[0]), float(offset[1])),
            textcoords="offset points",
            ha="center",
            va="center",
            fontsize=size_pt,
            color=INK,
            path_effects=halo(),
            zorder=25,
            parse_math=False,
        )


def _overlap(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    """Return the area that two boxes (left, bottom, right, top) share."""
    shared = np.minimum(first[2:], second[2:]) - np.maximum(first[:2], second[:2])
    return float(shared.clip(0.0).prod())
