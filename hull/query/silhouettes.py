"""The visual hull of one frame: silhouettes of all cameras, ready to be asked.

A point is inside the hull when it projects onto an object pixel of every camera (Eq. 1 of Lok,
Naik, Whitton and Brooks, 2003). Two rules for a camera that cannot see a point, because it lies
behind the camera, outside its image, or on a pixel of the image that nothing was recorded for:

* ``unseen = "carve"``: the point is outside the hull.
* ``unseen = "keep"``: the camera abstains, and at least ``min_cameras`` must see the point.

The silhouettes are those of pinhole images: lens distortion was removed from them. Their pixel is
the floor of the projection; the centre of the top-left pixel is (0.5, 0.5). A pinhole image that
holds all that a bent lens recorded also has pixels that it did not record (`Seen`). They are
background to a camera that carves, and nothing to one that abstains.
"""

import mmap
import weakref
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.pose import Pose, nearest_to_axes, rotation_of, rotation_vector
from hybridve.hull.query.frame import Frame

_Number = TypeVar("_Number", np.uint8, np.int32)

Unseen = Literal["carve", "keep"]

#: What a camera says at a pixel of its image. Whatever is not 0 does not deny the point.
BACKGROUND, OBJECT, UNSEEN = 0, 1, 2

#: Two projections are those of one camera if a rotation leads from one to the other, to this error.
_ROTATION_TOLERANCE = 1e-6

#: Condition number from which on optical axes are parallel, for want of a better origin.
_PARALLEL = 1e6


#: The volume that the rows of a projection span, as a share of a box of their lengths: more than
#: this, or there is no camera. A principal point a thousand focal lengths off leaves 1e-6.
_SINGULAR = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """Which pixels of the pinhole images were recorded; the same for all frames.

    Build it with `make_seen`. Flat buffers as those of `Hull`, of the cameras that have pixels
    that were not recorded; the others have no place in them.

    Attributes
    ----------
    masks_flat : (sum of H*W,) uint8
        1 on pixels that were recorded, else 0.
    mask_offset : (C,) int64
        Where each camera's mask starts in `masks_flat`; -1 for one that recorded all its image.
    integrals_flat : (sum of (H+1)*(W+1),) int32
        Per camera the number of recorded pixels above and left of each pixel corner.
    integral_offset : (C,) int64
        Where each camera's integral image starts in `integrals_flat`; -1 likewise.
    """

    masks_flat: NDArray[np.uint8]
    mask_offset: NDArray[np.int64]
    integrals_flat: NDArray[np.int32]
    integral_offset: NDArray[np.int64]

    def of(self, cameras: NDArray[np.int64]) -> "Seen":
        """Return what some of the cameras, by number, recorded; images are shared, not copied."""
        return replace(
            self,
            mask_offset=self.mask_offset[cameras],
            integral_offset=self.integral_offset[cameras],
        )

    def is_same(self, other: "Seen") -> bool:
        """Tell whether two say the same of all pixels, given cameras of the same image sizes."""
        return self is other or (
            np.array_equal(self.mask_offset, other.mask_offset)
            and np.array_equal(self.masks_flat, other.masks_flat)
        )


def make_seen(
    names: tuple[str, ...],
    sizes_px: NDArray[np.int64],
    masks: Sequence[NDArray[np.bool_] | NDArray[np.uint8] | None],
) -> Seen | None:
    """Return which pixels of the cameras' pinhole images were recorded; None for all of them.

    Parameters
    ----------
    names : tuple of str
        The cameras, C of them.
    sizes_px : (C, 2) int64
        Width and height of each image.
    masks : sequence of C (H, W) bool or uint8, or None
        Not 0 where a pixel was recorded; None for a camera that recorded all of its image.

    Raises
    ------
    ValueError
        If there are not C masks of the cameras' sizes.
    """
    if len(masks) != len(names):
        raise ValueError(f"{len(masks)} masks of what was seen for {len(names)} cameras")
    mask_offset = np.full(len(masks), -1, np.int64)
    integral_offset = np.full(len(masks), -1, np.int64)
    flat, integrals = [np.zeros(0, np.uint8)], [np.zeros(0, np.int32)]
    for camera, mask in enumerate(masks):
        if mask is None:
            continue
        width, height = (int(size) for size in sizes_px[camera])
        if mask.shape != (height, width):
            raise ValueError(
                f"what camera {names[camera]} saw has shape {mask.shape}, "
                f"expected {(height, width)}"
            )
        is_seen = mask != 0
        if is_seen.all():
            continue
        seen = is_seen.view(np.uint8)
        mask_offset[camera] = sum(map(len, flat))
        integral_offset[camera] = sum(map(len, integrals))
        flat.append(seen.ravel())
        integrals.append(np.asarray(cv2.integral(seen, sdepth=cv2.CV_32S), np.int32).ravel())
    if (mask_offset < 0).all():
        return None
    return Seen(np.concatenate(flat), mask_offset, np.concatenate(integrals), integral_offset)


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
    seen : Seen or None
        Which pixels of the images were recorded; None for all. None where unseen is "carve": there
        a pixel that was not recorded is background like any other.
    """

    names: tuple[str, ...]
    sizes_px: NDArray[np.int64]
    img_from_local: NDArray[np.float64]
    origin_world: NDArray[np.float64]
    unseen: Unseen = "carve"
    min_cameras: int = 1
    seen: Seen | None = None

    def __post_init__(self) -> None:
        if self.seen is not None and self.unseen == "carve":
            raise ValueError("cameras that carve see all of their images, expected seen = None")

    def __len__(self) -> int:
        return len(self.names)

    def project(self, points_world: NDArray[np.float64], camera: int) -> NDArray[np.float64]:
        """Return the homogeneous pixels (..., 3) of points (..., 3), metres, in one camera.

        The third coordinate is the depth in metres; divided by it, the others are a pixel where
        it is above 0.
        """
        matrix = self.img_from_local[camera]
        projected = (points_world - self.origin_world) @ matrix[:, :3].T + matrix[:, 3]
        return np.asarray(projected, np.float64)

    def centers_local(self) -> NDArray[np.float64]:
        """Return where the cameras stand, (C, 3) metres."""
        return _centers(self.img_from_local)

    def seen_mask(self, camera: int) -> NDArray[np.uint8] | None:
        """Return the (H, W) mask of what a camera recorded, 1 there; None for all its image."""
        if self.seen is None or self.seen.mask_offset[camera] < 0:
            return None
        width, height = (int(size) for size in self.sizes_px[camera])
        start = int(self.seen.mask_offset[camera])
        return self.seen.masks_flat[start : start + width * height].reshape(height, width)

    def seen_integral(self, camera: int) -> NDArray[np.int32] | None:
        """Return the (H + 1, W + 1) integral image of `seen_mask`; None for all of the image."""
        if self.seen is None or self.seen.integral_offset[camera] < 0:
            return None
        width, height = (int(size) for size in self.sizes_px[camera])
        start = int(self.seen.integral_offset[camera])
        stop = start + (width + 1) * (height + 1)
        return self.seen.integrals_flat[start:stop].reshape(height + 1, width + 1)


def make_views(
    names: tuple[str, ...],
    sizes_px: NDArray[np.int64],
    img_from_world: NDArray[np.float64],
    unseen: Unseen = "carve",
    min_cameras: int = 1,
    origin_world: NDArray[np.float64] | None = None,
    seen: Seen | None = None,
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
    seen : Seen, optional
        Which pixels of the images were recorded, by default all; see `make_seen`.

    Raises
    ------
    ValueError
        If there is no camera, a matrix is singular or not finite, or `min_cameras` is not within
        1..C.
    """
    n_cameras = len(names)
    if not 1 <= min_cameras <= n_cameras:
        raise ValueError(f"min_cameras is {min_cameras}, expected 1..{n_cameras}")
    is_finite = np.isfinite(img_from_world).all(axis=(1, 2))
    if not is_finite.all():
        name = names[int(is_finite.argmin())]
        raise ValueError(f"camera {name}: the projection matrix is not finite")
    norms = np.linalg.norm(img_from_world[:, :, :3], axis=2)  # (C, 3)
    units = img_from_world[:, :, :3] / np.where(norms > 0, norms, 1.0)[:, :, None]
    flatness = np.abs(np.linalg.det(units))
    if not (flatness > _SINGULAR).all():
        raise ValueError(
            f"camera {names[int(flatness.argmin())]}: the projection matrix is singular"
        )
    norms = norms[:, 2]
    scaled = img_from_world / norms[:, None, None]
    origin = _origin(scaled) if origin_world is None else origin_world
    img_from_local = scaled.copy()
    img_from_local[:, :, 3] += scaled[:, :, :3] @ origin
    sizes_px = np.asarray(sizes_px, np.int64)
    seen = seen if unseen == "keep" else None
    return Views(names, sizes_px, img_from_local, origin, unseen, min_cameras, seen)


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
        or not _is_same_seen(before.seen, after.seen)
    ):
        raise ValueError("not of the same views, nor of the same cameras moved")
    # Both are K R with one K, or they are not of one camera.
    turns = np.asarray(np.linalg.solve(first[:, :, :3], second[:, :, :3]), np.float64)  # (C, 3, 3)
    error = np.abs(turns @ turns.transpose(0, 2, 1) - np.eye(3)).max()
    if not error < _ROTATION_TOLERANCE:
        raise ValueError("not of the same views, nor of the same cameras moved")
    if fraction in (0.0, 1.0):
        return after if fraction else before
    centers = (1.0 - fraction) * _centers(first) + fraction * _centers(second)
    matrices = first.copy()
    moved = np.flatnonzero((first != second).any(axis=(1, 2)))
    shares = rotation_of(fraction * rotation_vector(turns[moved]))
    for camera, turn in zip(moved, shares, strict=True):
        matrix = first[camera, :, :3] @ turn
        matrices[camera] = np.column_stack([matrix, -matrix @ centers[camera]])
    return replace(before, img_from_local=matrices)


def _is_same_seen(first: Seen | None, second: Seen | None) -> bool:
    if first is None or second is None:
        return first is second
    return first.is_same(second)


@dataclass(frozen=True, slots=True, eq=False)
class Hull:
    """The visual hull of one frame.

    Build it with `make_hull`. The images of all cameras lie in one flat buffer each, camera after
    camera, so that compiled code and graphics memory take them as they are. They cannot be written
    to.

    Attributes
    ----------
    views : Views
        The cameras.
    masks_flat : (sum of H*W,) uint8
        1 on object pixels, else 0; row-major per camera.
    answers_flat : (sum of H*W,) uint8
        What each camera says at each pixel: `BACKGROUND`, `OBJECT` or `UNSEEN`. The same array as
        `masks_flat` where the views have no pixel that was not recorded.
    mask_offset : (C,) int64
        Where each camera's mask starts in `masks_flat` and `answers_flat`.
    integrals_flat : (sum of (H+1)*(W+1),) int32
        Per camera the number of object pixels above and left of each pixel corner
        (``cv2.integral``), so that four look-ups count the object pixels of a rectangle. Behind
        them, those of the views' `Seen`: compiled code takes one array sooner than two.
    integral_offset, recorded_offset : (C,) int64
        Where each camera's integral images start in `integrals_flat`: that of object pixels, and
        that of recorded pixels, -1 for a camera that recorded all of its image.
    """

    views: Views
    masks_flat: NDArray[np.uint8]
    answers_flat: NDArray[np.uint8]
    mask_offset: NDArray[np.int64]
    integrals_flat: NDArray[np.int32]
    integral_offset: NDArray[np.int64]
    recorded_offset: NDArray[np.int64]
    _frame: Frame | None = field(default=None, init=False, repr=False)
    #: For the images of another hull, until they are there; see `beside`.
    _room: "list[_Room]" = field(default_factory=list, init=False, repr=False)

    @property
    def frame(self) -> Frame:
        """The hull as compiled loops take it, made when it is first asked for.

        The camera that sees the smallest silhouette rejects most: it is asked first.
        """
        if self._frame is None:  # threads that meet here make the same one
            views = self.views
            order = np.argsort(self.object_shares(), kind="stable")
            made = Frame(
                views.img_from_local.reshape(-1, 12)[order],
                views.sizes_px[order],
                self.answers_flat,
                self.mask_offset[order],
                self.integrals_flat,
                self.integral_offset[order],
                None if views.seen is None else self.recorded_offset[order],
                order,
                np.arange(len(views)),
                views.unseen == "keep",
                views.min_cameras,
            )
            object.__setattr__(self, "_frame", made)
            return made
        return self._frame

    def mask(self, camera: int) -> NDArray[np.uint8]:
        """Return the (H, W) silhouette of one camera, 1 on object pixels."""
        return self._image(self.masks_flat, camera)

    def answers(self, camera: int) -> NDArray[np.uint8]:
        """Return what one camera says at its pixels, (H, W); see `answers_flat`."""
        return self._image(self.answers_flat, camera)

    def _image(self, flat: NDArray[np.uint8], camera: int) -> NDArray[np.uint8]:
        width, height = (int(size) for size in self.views.sizes_px[camera])
        start = int(self.mask_offset[camera])
        return flat[start : start + width * height].reshape(height, width)

    def integral(self, camera: int) -> NDArray[np.int32]:
        """Return the (H + 1, W + 1) integral image of one camera."""
        width, height = (int(size) for size in self.views.sizes_px[camera])
        start = int(self.integral_offset[camera])
        stop = start + (width + 1) * (height + 1)
        return self.integrals_flat[start:stop].reshape(height + 1, width + 1)

    def object_shares(self) -> NDArray[np.float64]:
        """Return which share (C,) of each image are object pixels."""
        ends = self.integral_offset + (self.views.sizes_px + 1).prod(axis=1) - 1
        return np.asarray(self.integrals_flat[ends] / self.views.sizes_px.prod(axis=1))


def make_hull(views: Views, masks: list[NDArray[np.uint8]]) -> Hull:
    """Return the hull of one frame from its silhouettes.

    Parameters
    ----------
    views : Views
        C cameras.
    masks : list of C (H, W) uint8
        Silhouettes without lens distortion; object pixels are those above 0. Of a pixel that was
        not recorded, whatever a mask says of it is not taken.

    Raises
    ------
    ValueError
        If there are not C masks of the cameras' sizes.
    """
    room = _Room.of(views)
    hull = _filled(views, masks, room.half(0))
    hull._room.append(room)
    return hull


def beside(hull: Hull, masks: list[NDArray[np.uint8]]) -> tuple[Hull, Hull]:
    """Return the hull of other silhouettes of the same views, and the first with both's images.

    The other images lie behind the first's in memory, at offsets of their own and the length of
    the first's: a hull of some of each is made without copying any.

    Parameters
    ----------
    hull : Hull
        Of one frame. Its images are copied if it was not made by `make_hull`, or the second time.
    masks : list of C (H, W) uint8
        As of `make_hull`.
    """
    try:
        room = hull._room.pop()
    except IndexError:
        other = make_hull(hull.views, masks)
        room = _Room(
            np.concatenate([hull.masks_flat, other.masks_flat]),
            np.concatenate([hull.answers_flat, other.answers_flat]),
            np.concatenate([hull.integrals_flat, other.integrals_flat]),
        )
    else:
        other = _filled(hull.views, masks, room.half(1))
    for whole in (room.masks, room.answers, room.integrals):
        whole.flags.writeable = False
    both = replace(
        hull, masks_flat=room.masks, answers_flat=room.answers, integrals_flat=room.integrals
    )
    return other, both


#: Pieces of one size, and sizes, of which memory that nobody holds any more is kept.
_MOST_KEPT, _MOST_SIZES = 2, 6

_kept: dict[int, deque[mmap.mmap]] = {}


def _memory(count: int, dtype: type[_Number]) -> NDArray[_Number]:
    """Return an array (count,) of whatever numbers, to be written to, the first time zeros.

    Its memory is used again once no array holds it. To touch new memory takes the system longer
    than to fill it with an image: a tenth of a second for a frame of ten cameras.
    """
    n_bytes = count * np.dtype(dtype).itemsize
    try:
        memory = _kept[n_bytes].pop()
    except (KeyError, IndexError):
        memory = mmap.mmap(-1, max(n_bytes, 1))
    array = np.frombuffer(memory, dtype, count)
    # Parts of the array hold it, as its memory is not NumPy's own.
    weakref.finalize(array, _keep, n_bytes, memory).atexit = False
    return array


def _keep(n_bytes: int, memory: mmap.mmap) -> None:
    """Keep memory that was let go. No lock: this runs wherever the last array happens to go."""
    if n_bytes not in _kept and len(_kept) >= _MOST_SIZES:
        _kept.clear()
    _kept.setdefault(n_bytes, deque(maxlen=_MOST_KEPT)).append(memory)


class _Room(NamedTuple):
    """Memory for the images of two hulls, which costs nothing until it is written to."""

    masks: NDArray[np.uint8]
    answers: NDArray[np.uint8]
    integrals: NDArray[np.int32]

    @classmethod
    def of(cls, views: Views) -> "_Room":
        n_integrals = int((views.sizes_px + 1).prod(axis=1).sum())
        if views.seen is not None:
            n_integrals += len(views.seen.integrals_flat)
        n_pixels = int(views.sizes_px.prod(axis=1).sum())
        masks = _memory(2 * n_pixels, np.uint8)
        answers = masks if views.seen is None else _memory(2 * n_pixels, np.uint8)
        return cls(masks, answers, _memory(2 * n_integrals, np.int32))

    def half(self, number: int) -> "_Room":
        """Return the first half, 0, or the second, 1."""

        def part(whole: NDArray[_Number]) -> NDArray[_Number]:
            return whole[number * (len(whole) // 2) :][: len(whole) // 2]

        masks = part(self.masks)
        answers = masks if self.answers is self.masks else part(self.answers)
        return _Room(masks, answers, part(self.integrals))


def _filled(views: Views, masks: list[NDArray[np.uint8]], images: _Room) -> Hull:
    """Return the hull of silhouettes, in memory that is just large enough."""
    if len(masks) != len(views):
        raise ValueError(f"{len(masks)} masks for {len(views)} cameras")
    areas = views.sizes_px.prod(axis=1)
    corners = (views.sizes_px + 1).prod(axis=1)
    recorded_offset = np.full(len(views), -1, np.int64)
    n_corners = int(corners.sum())
    if views.seen is not None:
        has_gaps = views.seen.integral_offset >= 0
        recorded_offset[has_gaps] = n_corners + views.seen.integral_offset[has_gaps]
        images.integrals[n_corners:] = views.seen.integrals_flat
    hull = Hull(
        views,
        masks_flat=images.masks,
        answers_flat=images.answers,
        integrals_flat=images.integrals,
        mask_offset=np.concatenate([[0], np.cumsum(areas)[:-1]]).astype(np.int64),
        integral_offset=np.concatenate([[0], np.cumsum(corners)[:-1]]).astype(np.int64),
        recorded_offset=recorded_offset,
    )
    for camera, mask in enumerate(masks):
        target = hull.mask(camera)
        if mask.shape != target.shape:
            raise ValueError(
                f"mask of camera {views.names[camera]} has shape {mask.shape}, "
                f"expected {target.shape}"
            )
        np.greater(mask, 0, out=target.view(np.bool_))
        if views.seen is not None:
            seen, answers = views.seen_mask(camera), hull.answers(camera)
            if seen is None:
                answers[:] = target
            else:
                np.bitwise_and(target, seen, out=target)
                np.subtract(np.uint8(1), seen, out=answers)
                np.multiply(answers, np.uint8(UNSEEN), out=answers)
                np.add(answers, target, out=answers)
        cv2.integral(target, sum=hull.integral(camera), sdepth=cv2.CV_32S)
    for flat in (hull.masks_flat, hull.answers_flat, hull.integrals_flat):
        flat.flags.writeable = False
    return hull


def seen_from(hull: Hull, world_from_own: Pose) -> Hull:
    """Return the hull as an object that moved rigidly has it about itself; images are shared.

    Of the hull returned, "world" is the object's own frame: a point of that frame is in it if the
    point that it is in the world is in `hull`, but for the rounding of the projections.

    Parameters
    ----------
    hull : Hull
        In the world.
    world_from_own : (3, 4) float64
        Where the object's own frame lies, metres.
    """
    views = hull.views
    rotation, translation = world_from_own[:, :3], world_from_own[:, 3]
    # Both local frames have one origin, so that the last column stays, and no size is lost.
    matrices = views.img_from_local.copy()
    matrices[:, :, :3] = views.img_from_local[:, :, :3] @ rotation
    origin_own = rotation.T @ (views.origin_world - translation)
    return replace(hull, views=replace(views, img_from_local=matrices, origin_world=origin_own))


def hull_of(hull: Hull, cameras: NDArray[np.int64]) -> Hull:
    """Return the hull of some of the cameras; images are shared, not copied.

    Where ``min_cameras`` asks for more than these, it asks for all of them.

    Parameters
    ----------
    hull : Hull
        Of all cameras.
    cameras : (K,) int64
        Numbers of those that are left, at least one.
    """
    views = hull.views
    fewer = replace(
        views,
        names=tuple(views.names[camera] for camera in cameras),
        sizes_px=views.sizes_px[cameras],
        img_from_local=views.img_from_local[cameras],
        min_cameras=min(views.min_cameras, len(cameras)),
        seen=None if views.seen is None else views.seen.of(cameras),
    )
    return replace(
        hull,
        views=fewer,
        mask_offset=hull.mask_offset[cameras],
        integral_offset=hull.integral_offset[cameras],
        recorded_offset=hull.recorded_offset[cameras],
    )
