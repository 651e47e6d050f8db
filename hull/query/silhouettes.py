"""The visual hull of one frame: silhouettes of all cameras, ready to be asked.

A point is inside the hull when it projects onto an object pixel of every camera (Eq. 1 of Lok,
Naik, Whitton and Brooks, 2003). Two rules for a camera that cannot see a point, because it lies
behind the camera or outside its image:

* ``unseen = "carve"``: the point is outside the hull.
* ``unseen = "keep"``: the camera abstains, and at least ``min_cameras`` must see the point.

The silhouettes are those of pinhole images: lens distortion was removed from them. Their pixel is
the floor of the projection; the centre of the top-left pixel is (0.5, 0.5).
"""

from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.pose import nearest_to_axes

Unseen = Literal["carve", "keep"]

#: Two projections are those of one camera if a rotation leads from one to the other, to this error.
_ROTATION_TOLERANCE = 1e-6

#: Condition number from which on optical axes are parallel, for want of a better origin.
_PARALLEL = 1e6


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """The cameras' pinhole images; the same from frame to frame unless a camera moves.

    Attributes
    ----------
    names : tuple of str
        The cameras, C of them.
    sizes_px : (C, 2) int64
        Width and height of each image; they may differ.
    img_from_local : (C, 3, 4) float64
        Projection matrices in pixels from metres about `origin_world`. The local frame keeps
        float32 engines exact where the scene lies far from the world's origin. Each is scaled so
        that the third coordinate of a projection is the depth in metres.
    origin_world : (3,) float64
        Origin of the local frame: ``local = world - origin_world``.
    unseen, min_cameras
        What a camera that cannot see a point says of it, and how many must see it.
    """

    names: tuple[str, ...]
    sizes_px: NDArray[np.int64]
    img_from_local: NDArray[np.float64]
    origin_world: NDArray[np.float64]
    unseen: Unseen = "carve"
    min_cameras: int = 1

    def __len__(self) -> int:
        return len(self.names)


def make_views(
    names: tuple[str, ...],
    sizes_px: NDArray[np.int64],
    img_from_world: NDArray[np.float64],
    unseen: Unseen = "carve",
    min_cameras: int = 1,
    origin_world: NDArray[np.float64] | None = None,
) -> Views:
    """Return views about a local origin near the working volume.

    The origin is the point nearest to all optical axes, or the mean of the cameras where the axes
    are parallel. Cameras that move keep the origin that they began with.

    Parameters
    ----------
    names : tuple of str
        The cameras, C of them.
    sizes_px : (C, 2) int64
        Width and height of each image.
    img_from_world : (C, 3, 4) float64
        Pixels, pixel centre at 0.5, from metres; of any scale, in front of the camera where the
        third coordinate is positive.
    unseen, min_cameras
        See `Views`.
    origin_world : (3,) float64, optional
        The local origin, if it is known already.

    Raises
    ------
    ValueError
        If there is no camera, a matrix is singular, or `min_cameras` is not within 1..C.
    """
    n_cameras = len(names)
    if not 1 <= min_cameras <= n_cameras:
        raise ValueError(f"min_cameras is {min_cameras}, expected 1..{n_cameras}")
    axes = img_from_world[:, 2, :3]
    norms = np.linalg.norm(axes, axis=1)
    if not (norms > 0).all():
        raise ValueError(f"camera {names[int(norms.argmin())]}: the projection matrix is singular")
    scaled = img_from_world / norms[:, None, None]
    origin = _origin(scaled) if origin_world is None else origin_world
    img_from_local = scaled.copy()
    img_from_local[:, :, 3] += scaled[:, :, :3] @ origin
    return Views(names, np.asarray(sizes_px, np.int64), img_from_local, origin, unseen, min_cameras)


def _origin(img_from_world: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the local origin (3,) of scaled projections (C, 3, 4), metres."""
    axes = img_from_world[:, 2, :3]
    centers = _centers(img_from_world)
    origin = nearest_to_axes(centers, axes, _PARALLEL)
    if origin is None:
        origin = centers.mean(axis=0)
    # Centimetres: short numbers, the same on every machine.
    return np.asarray(np.round(origin, 2), np.float64)


def _centers(matrices: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return where the cameras of projections (C, 3, 4) stand, (C, 3)."""
    return np.asarray(-np.linalg.solve(matrices[:, :, :3], matrices[:, :, 3:])[..., 0])


def interpolated_views(before: Views, after: Views, fraction: float) -> Views:
    """Return the views of an instant between two frames; cameras move straight and turn evenly.

    Parameters
    ----------
    before, after : Views
        Of two frames: the same cameras about the same origin, perhaps moved. If they are one, it
        is returned.
    fraction : float
        The instant: 0 gives `before`, 1 gives `after`.

    Raises
    ------
    ValueError
        If they are not of the same cameras.
    """
    if before is after:
        return before
    first, second = before.img_from_local, after.img_from_local
    if (
        before.names != after.names
        or (before.unseen, before.min_cameras) != (after.unseen, after.min_cameras)
        or (before.sizes_px != after.sizes_px).any()
        or (before.origin_world != after.origin_world).any()
    ):
        raise ValueError("not of the same views, nor of the same cameras moved")
    # Both are K R with one K, or they are not of one camera.
    turns = np.linalg.solve(first[:, :, :3], second[:, :, :3])  # (C, 3, 3)
    error = np.abs(turns @ turns.transpose(0, 2, 1) - np.eye(3)).max()
    if not error < _ROTATION_TOLERANCE:
        raise ValueError("not of the same views, nor of the same cameras moved")
    if fraction in (0.0, 1.0):
        return after if fraction else before
    centers = (1.0 - fraction) * _centers(first) + fraction * _centers(second)
    matrices = first.copy()
    for camera in np.flatnonzero((first != second).any(axis=(1, 2))):
        turn = cv2.Rodrigues(fraction * _rotation_vector(turns[camera]))[0]
        matrix = first[camera, :, :3] @ turn
        matrices[camera] = np.column_stack([matrix, -matrix @ centers[camera]])
    return replace(before, img_from_local=matrices)


def _rotation_vector(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return axis times angle (3,) of a rotation; OpenCV's forgets angles below 1e-5."""
    axis = 0.5 * np.array(
        [
            rotation[2, 1] - rotation[1, 2],
            rotation[0, 2] - rotation[2, 0],
            rotation[1, 0] - rotation[0, 1],
        ]
    )
    sine = float(np.linalg.norm(axis))
    cosine = 0.5 * (float(np.trace(rotation)) - 1.0)
    if cosine < 0.0:
        return np.asarray(cv2.Rodrigues(rotation)[0].ravel(), np.float64)
    return axis * (np.arctan2(sine, cosine) / sine) if sine else axis


@dataclass(frozen=True, slots=True, eq=False)
class Hull:
    """The visual hull of one frame.

    Build it with `make_hull`. The images of all cameras lie in one flat buffer each, camera after
    camera, so that compiled code and graphics memory take them as they are.

    Attributes
    ----------
    views : Views
        The cameras.
    masks_flat : (sum of H*W,) uint8
        1 on object pixels, else 0; row-major per camera.
    mask_offset : (C,) int64
        Where each camera's mask starts in `masks_flat`.
    integrals_flat : (sum of (H+1)*(W+1),) int32
        Per camera the number of object pixels above and left of each pixel corner
        (``cv2.integral``), so that four look-ups count the object pixels of a rectangle.
    integral_offset : (C,) int64
        Where each camera's integral image starts in `integrals_flat`.
    """

    views: Views
    masks_flat: NDArray[np.uint8]
    mask_offset: NDArray[np.int64]
    integrals_flat: NDArray[np.int32]
    integral_offset: NDArray[np.int64]

    def mask(self, camera: int) -> NDArray[np.uint8]:
        """Return the (H, W) silhouette of one camera, 1 on object pixels."""
        width, height = (int(size) for size in self.views.sizes_px[camera])
        start = int(self.mask_offset[camera])
        return self.masks_flat[start : start + width * height].reshape(height, width)

    def integral(self, camera: int) -> NDArray[np.int32]:
        """Return the (H + 1, W + 1) integral image of one camera."""
        width, height = (int(size) for size in self.views.sizes_px[camera])
        start = int(self.integral_offset[camera])
        stop = start + (width + 1) * (height + 1)
        return self.integrals_flat[start:stop].reshape(height + 1, width + 1)


def make_hull(views: Views, masks: list[NDArray[np.uint8]]) -> Hull:
    """Return the hull of one frame from its silhouettes.

    Parameters
    ----------
    views : Views
        C cameras.
    masks : list of C (H, W) uint8
        Silhouettes without lens distortion; object pixels are those above 0.

    Raises
    ------
    ValueError
        If there are not C masks of the cameras' sizes.
    """
    if len(masks) != len(views):
        raise ValueError(f"{len(masks)} masks for {len(views)} cameras")
    areas = views.sizes_px.prod(axis=1)
    corners = (views.sizes_px + 1).prod(axis=1)
    mask_offset = np.concatenate([[0], np.cumsum(areas)[:-1]]).astype(np.int64)
    integral_offset = np.concatenate([[0], np.cumsum(corners)[:-1]]).astype(np.int64)
    hull = Hull(
        views,
        np.zeros(int(areas.sum()), np.uint8),
        mask_offset,
        np.zeros(int(corners.sum()), np.int32),
        integral_offset,
    )
    for camera, mask in enumerate(masks):
        target = hull.mask(camera)
        if mask.shape != target.shape:
            raise ValueError(
                f"mask of camera {views.names[camera]} has shape {mask.shape}, "
                f"expected {target.shape}"
            )
        np.greater(mask, 0, out=target.view(np.bool_))
        cv2.integral(target, sum=hull.integral(camera), sdepth=cv2.CV_32S)
    return hull
