"""What the cameras saw, laid onto the hull; ``shaders/skin.frag.glsl``."""

from collections.abc import Sequence

import cv2
import moderngl
import numpy as np
from numpy.typing import NDArray

from hybridve.hull.query.silhouettes import Hull
from hybridve.hull.view.novel import (
    HullOnDevice,
    NovelView,
    clear_all,
    draw_within,
    set_uniforms,
    view_uniforms,
)
from hybridve.hull.view.recorded import view_of_matrix

Image = NDArray[np.uint8]

#: Cameras that colours are taken from at most; the same in skin.frag.glsl.
MOST_CAMERAS = 64

#: Within so many pixels of its border a silhouette has the colours of what is behind it.
_BORDER_PX = 6.0

#: The nearest and the farthest that a camera looks, metres; what is drawn is in the hull's box.
_RANGE_M = (1e-3, 1e6)


class SkinOnDevice:
    """Pictures of one frame, and what of the hull each camera sees, in graphics memory.

    Parameters
    ----------
    device : moderngl.Context
        Of the hull.
    hull : Hull
        The visual hull of the frame.
    on_device : HullOnDevice
        The same in graphics memory.
    images : sequence of C (H, W, 3) uint8 or None
        The cameras' pinhole images, BGR; None for a camera that no colour is taken from.
    depths_per_px : float
        How fine maps of depths are: texels for a pixel of a camera.
    """

    def __init__(
        self,
        device: moderngl.Context,
        hull: Hull,
        on_device: HullOnDevice,
        images: Sequence[Image | None],
        depths_per_px: float = 1.0,
    ) -> None:
        self._hull, self._on_device = hull, on_device
        self._per_px = depths_per_px
        regions = on_device.regions
        n_layers = max(1, len(regions))
        width = max((size[0] for _, size, _ in regions), default=1)
        height = max((size[1] for _, size, _ in regions), default=1)
        self._images = device.texture_array((width, height, n_layers), 4, dtype="f1")
        self._images.repeat_x = self._images.repeat_y = False
        deep = (round(width * depths_per_px), round(height * depths_per_px))
        self._depths = device.texture_array((*deep, n_layers), 1, dtype="f4")
        self._depths.filter = (moderngl.NEAREST, moderngl.NEAREST)
        depth = device.texture(deep, 1, dtype="f4")
        normal = device.texture(deep, 4, dtype="f2")
        target = device.framebuffer([depth, normal])
        for number, (first, size, matrix) in enumerate(regions):
            image = images[number]
            if image is None:  # as if it saw nothing: everything is behind what it sees
                nothing = np.zeros((deep[1], deep[0]), np.float32)
                self._depths.write(nothing, viewport=(0, 0, number, *deep, 1))
                continue
            part = _part(image, hull.mask(number), first, size)
            self._images.write(part, viewport=(0, 0, number, *size, 1))
            across = np.array([deep[0], deep[1]]) / depths_per_px
            view = view_of_matrix(matrix, across, hull.views.origin_world, _RANGE_M)
            on_device.draw(target, view, deep)
            self._depths.write(depth.read(), viewport=(0, 0, number, *deep, 1))

    def draw(
        self,
        target: moderngl.Framebuffer,
        paint: tuple[moderngl.Program, moderngl.VertexArray],
        layers: tuple[moderngl.Texture, moderngl.Texture],
        view: NovelView,
        size_px: tuple[int, int],
    ) -> None:
        """Write the hull's colours into `target`, by its depths and normals in `layers`."""
        program, triangle = paint
        clear_all(target)
        scissor = self._on_device.rectangle(view, size_px)
        if scissor is None:
            return
        self._on_device.bind(program)
        for unit, layer in enumerate(layers, start=2):
            layer.use(unit)
        self._images.use(4)
        self._depths.use(5)
        set_uniforms(
            program,
            **view_uniforms(view, self._hull.views.origin_world),
            size_px=size_px,
            n_pictures=min(len(self._on_device.regions), MOST_CAMERAS),
            depths_per_px=self._per_px,
        )
        draw_within(target, scissor, triangle)


def _part(
    image: Image, mask: NDArray[np.uint8], first: NDArray[np.int64], size: tuple[int, int]
) -> Image:
    """Return a region of an image, RGBA; beyond the image black."""
    depth = cv2.distanceTransform(np.pad(mask, 1), cv2.DIST_L2, 3)[1:-1, 1:-1]
    inner = np.clip(depth / _BORDER_PX * 255.0, 0.0, 255.0).astype(np.uint8)
    whole = np.dstack([image[..., ::-1], inner])
    part = np.zeros((size[1], size[0], 4), np.uint8)
    left, top = (int(value) for value in first)
    rows = slice(max(top, 0), min(top + size[1], whole.shape[0]))
    columns = slice(max(left, 0), min(left + size[0], whole.shape[1]))
    part[rows.start - top : rows.stop - top, columns.start - left : columns.stop - left] = whole[
        rows, columns
    ]
    return part
