"""The hull between two frames."""

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.hull.capture.outline_motion import Outline, follow_outline
from hybridve.hull.capture.pixel_boxes import Box
from hybridve.hull.query.silhouettes import Hull, Views, interpolated_views, make_hull
from hybridve.hull.query.threads import Threads


def interpolated_hull(before: Hull, after: Hull, fraction: float) -> Hull:
    """Return the estimated hull of an instant between two frames; see `interpolate_masks`.

    Raises
    ------
    ValueError
        If the fraction is not within 0..1, or the two hulls are not of the same cameras.
    """
    if not 0.0 <= fraction <= 1.0:
        raise ValueError(f"fraction is {fraction}, expected 0..1")
    windows = [(0, int(height), 0, int(width)) for width, height in before.views.sizes_px]
    return Between(before, after, windows).hull(fraction)


class Between:
    """The hulls of instants between two frames.

    Parameters
    ----------
    before, after : Hull
        Of the two frames, of the same cameras.
    windows : list of box
        Where the silhouettes of each camera have to be right; those of a camera that moves are so
        everywhere, as an object may pass through any part of its image.
    threads : Threads, optional
        Follow the outlines of several cameras at once.

    Raises
    ------
    ValueError
        If the hulls are not of the same cameras.
    """

    def __init__(
        self, before: Hull, after: Hull, windows: list[Box], threads: Threads | None = None
    ) -> None:
        interpolated_views(before.views, after.views, 0.5)  # other cameras are refused
        self._before, self._after = before, after
        first, second = before.views.img_from_local, after.views.img_from_local
        still = [camera for camera in range(len(first)) if (first[camera] == second[camera]).all()]
        followed = (threads or Threads(1)).run(
            [
                (follow_outline, (before.mask(camera), after.mask(camera), windows[camera]))
                for camera in still
            ]
        )
        self._still: dict[int, Outline] = dict(zip(still, followed, strict=True))

    def outlines(self, fraction: float) -> list[Outline]:
        """Return the outlines of all cameras; those of moving ones as they look at an instant."""
        views = interpolated_views(self._before.views, self._after.views, fraction)
        return [
            self._still[camera] if camera in self._still else self._turned(camera, views)
            for camera in range(len(views))
        ]

    def hull(self, fraction: float) -> Hull:
        """Return the hull of an instant."""
        if fraction == 1.0:
            return self._after
        views = interpolated_views(self._before.views, self._after.views, fraction)
        return make_hull(views, [outline.at(fraction) for outline in self.outlines(fraction)])

    def _turned(self, camera: int, views: Views) -> Outline:
        height, width = self._before.mask(camera).shape
        before, after = (
            _turned_mask(
                hull.mask(camera),
                hull.views.img_from_local[camera, :, :3],
                views.img_from_local[camera, :, :3],
            )
            for hull in (self._before, self._after)
        )
        return follow_outline(before, after, (0, height, 0, width))


def _turned_mask(
    mask: NDArray[np.uint8], from_local: NDArray[np.float64], to_local: NDArray[np.float64]
) -> NDArray[np.uint8]:
    """Return a silhouette as its camera sees it turned on the spot; 0 where it saw nothing.

    The projections (3, 3), without their last columns, hold lens and rotation.
    """
    if (from_local == to_local).all():
        return mask
    centre = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])  # OpenCV's is at 0
    turn = np.linalg.inv(centre) @ to_local @ np.linalg.inv(from_local) @ centre
    size = (mask.shape[1], mask.shape[0])
    return np.asarray(cv2.warpPerspective(mask, turn, size, flags=cv2.INTER_NEAREST), np.uint8)
