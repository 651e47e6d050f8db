"""Lines, dots and translucent faces of the picture, as triangles in clip coordinates.

Graphics drivers draw lines one pixel wide at best; these have a width in pixels, ends that meet,
and a depth that is compared with the scene's, so that what is behind something is drawn faintly.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.view.novel import NovelView

#: Numbers a vertex: clip coordinates 4, colour 4, place in a dot 2, opacity where hidden 1.
FLOATS = 11

Colour = tuple[float, float, float, float]


@dataclass(slots=True)
class Strokes:
    """What is drawn over the scene, seen through `view` in a picture of `size_px`."""

    view: NovelView
    size_px: tuple[int, int]
    _parts: list[NDArray[np.float32]] = field(default_factory=list)

    def lines(
        self,
        starts_world: NDArray[np.float64],
        ends_world: NDArray[np.float64],
        width_px: float,
        colour: Colour,
        when_hidden: float = 0.2,
    ) -> None:
        """Add segments from (N, 3) to (N, 3), with round ends."""
        first, last = self._clipped(
            self.view.view_points(starts_world), self.view.view_points(ends_world)
        )
        if len(first) == 0:
            return
        first_ndc, last_ndc = self._ndc(first), self._ndc(last)
        along = (last_ndc - first_ndc) * self.size_px
        length = np.linalg.norm(along, axis=1, keepdims=True)
        along = np.where(length > 0, along / np.maximum(length, 1e-9), np.array([1.0, 0.0]))
        aside = np.stack([-along[:, 1], along[:, 0]], axis=1) * width_px / np.array(self.size_px)
        corners = np.stack(
            [first_ndc - aside, first_ndc + aside, last_ndc - aside, last_ndc + aside], axis=1
        )
        depths = np.stack([first[:, 2], first[:, 2], last[:, 2], last[:, 2]], axis=1)
        self._add_quads(corners, depths, np.zeros((len(corners), 4, 2)), colour, when_hidden)
        ends = np.concatenate([first, last])
        self._dots(ends, width_px / 2, colour, when_hidden)

    def dots(
        self,
        points_world: NDArray[np.float64],
        radius_px: float,
        colour: Colour,
        when_hidden: float,
    ) -> None:
        """Add a disc at each of the points (N, 3)."""
        points = self.view.view_points(points_world)
        self._dots(points[points[:, 2] > self.view.range_m[0]], radius_px, colour, when_hidden)

    def faces(
        self, corners_world: NDArray[np.float64], colour: Colour, when_hidden: float = 0.0
    ) -> None:
        """Add flat triangles (N, 3, 3); those that reach behind the eye are left out."""
        view = self.view.view_points(corners_world.reshape(-1, 3)).reshape(-1, 3, 3)
        view = view[(view[..., 2] > self.view.range_m[0]).all(axis=1)]
        ndc = self._ndc(view.reshape(-1, 3))
        depths = view[..., 2].ravel()
        self._add(ndc, depths, np.zeros((len(ndc), 2)), colour, when_hidden)

    def vertices(self) -> NDArray[np.float32]:
        """Return all triangles' vertices, (3 N, FLOATS), in the order in which they were added."""
        return np.concatenate([np.zeros((0, FLOATS), np.float32), *self._parts])

    def _dots(
        self, points: NDArray[np.float64], radius_px: float, colour: Colour, when_hidden: float
    ) -> None:
        square = np.array([[-1, -1], [1, -1], [-1, 1], [1, 1]], np.float64)
        middle = self._ndc(points)
        corners = middle[:, None] + square * 2 * radius_px / np.array(self.size_px)
        depths = np.repeat(points[:, 2:], 4, axis=1)
        places = np.broadcast_to(square, (len(points), 4, 2))
        self._add_quads(corners, depths, places, colour, when_hidden)

    def _clipped(
        self, first: NDArray[np.float64], last: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Cut off what of the segments is nearer than the nearest depth."""
        near = self.view.range_m[0]
        kept = (first[:, 2] > near) | (last[:, 2] > near)
        first, last = first[kept], last[kept]
        slope = last[:, 2] - first[:, 2]
        share = (near - first[:, 2]) / np.where(slope == 0, 1.0, slope)
        crossing = first + share[:, None] * (last - first)
        return (
            np.where(first[:, 2:] > near, first, crossing),
            np.where(last[:, 2:] > near, last, crossing),
        )

    def _ndc(self, points_view: NDArray[np.float64]) -> NDArray[np.float64]:
        return self.view.places(points_view)

    def _add_quads(
        self,
        corners: NDArray[np.float64],
        depths: NDArray[np.float64],
        places: NDArray[np.float64],
        colour: Colour,
        when_hidden: float,
    ) -> None:
        order = [0, 1, 2, 2, 1, 3]
        self._add(
            corners[:, order].reshape(-1, 2),
            depths[:, order].ravel(),
            places[:, order].reshape(-1, 2),
            colour,
            when_hidden,
        )

    def _add(
        self,
        ndc: NDArray[np.float64],
        depths: NDArray[np.float64],
        places: NDArray[np.float64],
        colour: Colour,
        when_hidden: float,
    ) -> None:
        part = np.zeros((len(ndc), FLOATS), np.float32)
        # Depth runs along a line as w does, so the device interpolates it in perspective.
        part[:, :2] = ndc * depths[:, None]
        part[:, 3] = depths
        part[:, 4:8] = colour
        part[:, 8:10] = places
        part[:, 10] = when_hidden
        self._parts.append(part)
