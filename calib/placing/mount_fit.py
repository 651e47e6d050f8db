"""Where a camera sits on its mount: a closed form, then least squares of pixels."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.boards.board import is_seen
from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.lens import img_from_cam
from hybridve.calib.placing.mounted_views import (
    FITS_BETTER,
    LEAST_INSTANTS,
    MISSED,
    SCALE,
    Floats,
    MountedView,
    wrong_unit,
)
from hybridve.calib.pose import (
    Pose,
    compose,
    cross_matrix,
    invert,
    nearest_rotation,
    turned_pose,
)
from hybridve.calib.rig import Mount
from hybridve.calib.solving.least_squares import (
    FLOOR_PX,
    Limits,
    NormalEquations,
    Step,
    minimized,
)

#: Triples of pictures tried, and pictures by which each is judged.
_TRIPLES, _JUDGES = 80, 40

#: A picture is dropped if it fits this many times worse than the median, and than so many pixels.
_OUTLIER, _OUTLIER_PX = 4.0, 0.5

_MAX_TURNS = 10
_MAX_STEPS = 60
_COST_SHARE = 1e-14

#: Step of the derivatives of a lens, in rays at depth 1.
_RAY_STEP = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class HandEye:
    """Both fixed parts of the chain in closed form.

    Attributes
    ----------
    mount : Mount
        Them.
    scale : float
        By what the tracker's lengths were multiplied; 1 unless it was to be found.
    """

    mount: Mount
    scale: float


def solve_hand_eye(
    cam_from_world: Sequence[Pose], tracking_from_tracker: Sequence[Pose], free_scale: bool = False
) -> HandEye:
    """Return the mount that explains N >= 3 pairs of poses best, in closed form.

    The rotations first, in the least squares sense of Shah (2013), then the translations.

    Parameters
    ----------
    cam_from_world : sequence of N (3, 4) float64
        From the camera's pictures, metres.
    tracking_from_tracker : sequence of N (3, 4) float64
        From the tracker, at the same instants.
    free_scale : bool
        Whether the tracker's unit of length is unknown too.

    Raises
    ------
    ValueError
        If there are fewer than three pairs.
    """
    if len(cam_from_world) < LEAST_INSTANTS or len(cam_from_world) != len(tracking_from_tracker):
        raise ValueError(
            f"{len(cam_from_world)} poses of the camera and {len(tracking_from_tracker)} of the "
            f"tracker; expected as many, {LEAST_INSTANTS} or more"
        )
    cameras = np.asarray(cam_from_world)
    trackers = np.array([invert(pose) for pose in tracking_from_tracker])  # from tracking
    # R_cam = X R_tracker Y, so vec(X^T) = (R_tracker kron R_cam) vec(Y), row by row.
    product = np.einsum("nij,nkl->ikjl", trackers[:, :, :3], cameras[:, :, :3]).reshape(9, 9)
    left, _, right = np.linalg.svd(product)
    first, second = left[:, 0].reshape(3, 3), right[0].reshape(3, 3)
    sign = 1.0 if np.linalg.det(first) > 0 else -1.0
    x, y = nearest_rotation(sign * first).T, nearest_rotation(sign * second)

    # t_cam = X R_tracker t_y + scale X t_tracker + t_x.
    turned = x @ trackers[:, :, :3]  # (N, 3, 3)
    moved = trackers[:, :, 3] @ x.T  # (N, 3)
    columns = [turned, np.broadcast_to(np.eye(3), turned.shape)]
    wanted = cameras[:, :, 3]
    if free_scale:
        columns.append(moved[..., None])
    else:
        wanted = wanted - moved
    found = np.linalg.lstsq(
        np.concatenate(columns, axis=2).reshape(-1, 6 + free_scale), wanted.ravel()
    )[0]
    tracking_from_world = np.column_stack([y, found[:3]])
    return HandEye(
        Mount(np.column_stack([x, found[3:6]]), invert(tracking_from_world)),
        float(found[6]) if free_scale else 1.0,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """A mount, and which views it was fitted to."""

    mount: Mount
    rms_px: Floats
    used: NDArray[np.bool_]
    scale: float = 1.0

    @property
    def median_px(self) -> float:
        return float(np.median(self.rms_px))


def fit_mount(camera: Camera, views: list[MountedView]) -> tuple[list[MountedView], Mount, _Fit]:
    """Return the views with the looks that hold, the mount in closed form, and the final fit.

    Raises
    ------
    CalibrationError
        If poses and pictures do not belong together, or the poses mean something else.
    """
    start = _consensus(camera, views)
    if not start.median_px < MISSED * camera.width_px:
        raise _misfit(camera, views, start)
    views = _with_looks(camera, views, start.mount)
    if any(view.look for view in views):
        start = _consensus(camera, views, any_look=False)
    stack = _Stack.of(views, any_look=False)
    mount, used, rms_px = start.mount, start.used, start.rms_px
    for _ in range(_MAX_TURNS):
        mount = _refine(camera, [views[k] for k in np.flatnonzero(used)], mount)
        rms_px = stack.rms_px(camera, mount)[:, 0]
        now = _inliers(rms_px)
        if (now == used).all():
            break
        used = now
    return views, start.mount, _Fit(mount, rms_px, used)


def _misfit(camera: Camera, views: list[MountedView], start: _Fit) -> CalibrationError:
    """Return what is wrong with poses that do not belong to the pictures."""
    scaled = _consensus(camera, views, free_scale=True)
    if scaled.median_px * FITS_BETTER < start.median_px and abs(scaled.scale - 1.0) > SCALE:
        return wrong_unit(camera, scaled.scale)
    turned = [
        replace(view, tracking_from_tracker=invert(view.tracking_from_tracker)) for view in views
    ]
    if _consensus(camera, turned).median_px * FITS_BETTER < start.median_px:
        return CalibrationError(
            f"camera {camera.name!r}: its poses are inverted: they map the tracker's world to the "
            "tracked body (tracker_from_tracking); expected tracking_from_tracker, where the body "
            "is in the tracker's world"
        )
    return CalibrationError(
        f"camera {camera.name!r}: its tracked poses and its pictures do not belong together: the "
        f"best mount misses the corners of the board by {start.median_px:.0f} px; the board has to "
        "lie still, and pose and picture of a frame have to be of one instant: check both, and "
        "record again"
    )


def _consensus(
    camera: Camera, views: list[MountedView], *, any_look: bool = True, free_scale: bool = False
) -> _Fit:
    """Return the mount in closed form of the views that agree with each other."""
    rng = np.random.default_rng(0)
    stack = _Stack.of(views, any_look=any_look)
    judges = _Stack.of([views[k] for k in _spread(len(views), _JUDGES)], any_look=any_look)
    best = _closed_form(views, free_scale)
    best_px = float(np.median(judges.rms_px(camera, best.mount, best.scale).min(axis=1)))
    for _ in range(_TRIPLES):
        chosen = rng.choice(len(views), LEAST_INSTANTS, replace=False)
        found = _closed_form([views[k] for k in chosen], free_scale)
        median_px = float(np.median(judges.rms_px(camera, found.mount, found.scale).min(axis=1)))
        if median_px < best_px:
            best, best_px = found, median_px
    # Once more from all that agree: a triple alone carries its own errors far.
    rms_px = stack.rms_px(camera, best.mount, best.scale)
    agree = _inliers(rms_px.min(axis=1)) & (rms_px.argmin(axis=1) == 0)
    if agree.sum() >= LEAST_INSTANTS:
        chosen = np.flatnonzero(agree)
        again = _closed_form([views[k] for k in chosen], free_scale)
        again_px = stack.rms_px(camera, again.mount, again.scale)
        if np.median(again_px.min(axis=1)) < np.median(rms_px.min(axis=1)):
            best, rms_px = again, again_px
    smallest_px = rms_px.min(axis=1)
    return _Fit(best.mount, smallest_px, _inliers(smallest_px), best.scale)


def _closed_form(views: list[MountedView], free_scale: bool) -> HandEye:
    return solve_hand_eye(
        [view.cam_from_world for view in views],
        [view.tracking_from_tracker for view in views],
        free_scale,
    )


def _inliers(rms_px: Floats) -> NDArray[np.bool_]:
    return np.asarray(rms_px <= max(_OUTLIER * float(np.median(rms_px)), _OUTLIER_PX))


def _spread(count: int, most: int) -> NDArray[np.intp]:
    return np.linspace(0, count - 1, min(count, most)).round().astype(np.intp)


def _with_looks(camera: Camera, views: list[MountedView], mount: Mount) -> list[MountedView]:
    """Return the views listed as the mount sees them."""
    looks = _Stack.of(views, any_look=True).rms_px(camera, mount).argmin(axis=1)
    if 2 * np.count_nonzero(looks) > len(views) and len({view.board for view in views}) == 1:
        # All pictures turned together fit as well: the listing of most of them is the world's.
        looks = (looks - np.bincount(looks).argmax()) % len(views[0].listings)
    return [replace(view, look=int(look)) for view, look in zip(views, looks, strict=True)]


@dataclass(frozen=True, slots=True, eq=False)
class _Stack:
    """Views side by side, so that many mounts can be tried on them.

    Attributes
    ----------
    points_world : (M, 3) float64
        The corners of all views.
    listings : (L, M, 2) float64
        Their pixels, by look; NaN where unseen, or where a board has fewer looks.
    view : (M,) int64
        Of which view each corner is.
    tracking_from_tracker : (V, 3, 4) float64
        Where the tracker was.
    """

    points_world: Floats
    listings: Floats
    view: NDArray[np.int64]
    tracking_from_tracker: Floats

    @classmethod
    def of(cls, views: Sequence[MountedView], *, any_look: bool) -> Self:
        """Return views stacked, under the listing that holds or under all of them."""
        counts = [len(view.points_world) for view in views]
        most = max(len(view.listings) for view in views) if any_look else 1
        listings = np.full((most, sum(counts), 2), np.nan)
        for view, stop in zip(views, np.cumsum(counts), strict=True):
            mine = view.listings if any_look else view.pixels[None]
            listings[: len(mine), stop - mine.shape[1] : stop] = mine
        return cls(
            np.concatenate([view.points_world for view in views]),
            listings,
            np.repeat(np.arange(len(views)), counts),
            np.array([view.tracking_from_tracker for view in views]),
        )

    def project(self, camera: Camera, mount: Mount, scale: float = 1.0) -> Floats:
        """Return where the corners should be, (M, 2) pixels; NaN behind the camera."""
        poses = np.array(
            [
                mount.cam_from_world(pose * [1.0, 1.0, 1.0, scale])
                for pose in self.tracking_from_tracker
            ]
        )[self.view]
        points_cam = np.einsum("mij,mj->mi", poses[:, :, :3], self.points_world) + poses[:, :, 3]
        pixels = np.full((len(points_cam), 2), np.nan)
        ahead = points_cam[:, 2] > 0
        if ahead.any():
            pixels[ahead] = img_from_cam(camera, points_cam[ahead])
        return pixels

    def rms_px(self, camera: Camera, mount: Mount, scale: float = 1.0) -> Floats:
        """Return how far each view is missed under each listing, rms in pixels: (V, L).

        Infinite where a corner that was seen would lie behind the camera.
        """
        projected = self.project(camera, mount, scale)
        n_views = len(self.tracking_from_tracker)
        rms_px = np.full((n_views, len(self.listings)), np.inf)
        for look, listing in enumerate(self.listings):
            seen = is_seen(listing)
            squares = ((listing[seen] - projected[seen]) ** 2).sum(axis=1)
            count = np.bincount(self.view[seen], minlength=n_views)
            total = np.bincount(
                self.view[seen], np.where(np.isfinite(squares), squares, np.inf), n_views
            )
            some = count > 0
            rms_px[some, look] = np.sqrt(total[some] / count[some])
        return rms_px


def residuals_of(camera: Camera, views: list[MountedView], mount: Mount) -> Floats:
    """Return observed minus projected corners of all views, (M, 2) pixels, those seen."""
    stack = _Stack.of(views, any_look=False)
    seen = is_seen(stack.listings[0])
    return np.asarray((stack.listings[0] - stack.project(camera, mount))[seen])


def rms_of(residuals: Floats) -> float:
    """Return the root mean square of residuals (N, 2), pixels."""
    return float(np.sqrt((residuals**2).sum(axis=1).mean()))


def _refine(camera: Camera, views: list[MountedView], mount: Mount) -> Mount:
    """Return the mount that misses all corners of the views least.

    SciPy's least squares take twice the time, and end up to 4e-9 m away.
    """
    problem = _MountProblem(camera, views)
    start = problem.projected(mount)
    limits = Limits(_MAX_STEPS, _COST_SHARE, len(start.residuals) * FLOOR_PX**2)
    return minimized(problem, start, limits).state.mount


@dataclass(frozen=True, slots=True, eq=False)
class _Projected:
    """A mount, and by what (M, 2) it misses the corners."""

    mount: Mount
    residuals: Floats


@dataclass(frozen=True, slots=True, eq=False)
class _MountProblem:
    """What least squares need: shared are both poses of the mount, and there are no blocks."""

    camera: Camera
    views: list[MountedView]

    def projected(self, mount: Mount) -> _Projected:
        return _Projected(mount, residuals_of(self.camera, self.views, mount))

    def cost(self, state: _Projected) -> float:
        return float((state.residuals**2).sum())

    def normal_equations(self, state: _Projected) -> NormalEquations:
        jacobian = jacobian_of(self.camera, self.views, state.mount).parameters
        normal = NormalEquations.zeros(jacobian.shape[1])
        normal.shared[:] = jacobian.T @ jacobian
        normal.shared_right[:] = jacobian.T @ state.residuals.ravel()
        return normal

    def moved(self, state: _Projected, step: Step) -> _Projected:
        poses = np.array([state.mount.cam_from_tracker, state.mount.world_from_tracking])
        return self.projected(Mount(*turned_pose(poses, step.shared.reshape(2, -1))))


@dataclass(frozen=True, slots=True, eq=False)
class _Jacobian:
    """How the pixels of all seen corners move, x and y of each corner in turn.

    Attributes
    ----------
    parameters : (2 M, 12) float64
        With the unknowns.
    scale : (2 M,) float64
        With the tracker's unit of length.
    pose : (2 M, 6) float64
        With the camera's pose in that view.
    instant : (2 M,) int64
        Of which instant each row is.
    """

    parameters: Floats
    scale: Floats
    pose: Floats
    instant: NDArray[np.int64]


def jacobian_of(camera: Camera, views: list[MountedView], mount: Mount) -> _Jacobian:
    """Return the derivatives of all residuals by what is adjusted."""
    cam_from_tracker, world_from_tracking = mount.cam_from_tracker, mount.world_from_tracking
    parts: list[list[Floats]] = []
    for view in views:
        points = view.points_world[is_seen(view.pixels)]
        cam_from_tracking = compose(cam_from_tracker, invert(view.tracking_from_tracker))
        cam_from_world = compose(cam_from_tracking, invert(world_from_tracking))
        turned = points @ cam_from_world[:, :3].T  # of the whole chain
        points_cam = turned + cam_from_world[:, 3]
        of_cam = points_cam - cam_from_tracker[:, 3]
        # The last link is inverted: p_tracking = R^T (p - t).
        rotation = cam_from_world[:, :3]
        by_pose = np.concatenate(
            [-cross_matrix(points_cam - cam_from_world[:, 3]), _eyes(points)], axis=2
        )
        by_mount = np.concatenate([-cross_matrix(of_cam), _eyes(points)], axis=2)
        from_world = points - world_from_tracking[:, 3]
        by_world = np.concatenate(
            [rotation @ cross_matrix(from_world), np.broadcast_to(-rotation, (len(points), 3, 3))],
            axis=2,
        )
        to_tracker = -cam_from_tracking[:, :3] @ view.tracking_from_tracker[:, 3]
        by_scale = np.broadcast_to(to_tracker, points.shape)[..., None]
        parts.append([points_cam, np.concatenate([by_mount, by_world, by_scale, by_pose], axis=2)])
    points_cam = np.concatenate([part[0] for part in parts])
    of_point = _lens_slopes(camera, points_cam)  # (M, 2, 3)
    rows = (of_point @ np.concatenate([part[1] for part in parts])).reshape(-1, 19)
    counts = [2 * len(part[0]) for part in parts]
    instant = np.repeat([view.instant for view in views], counts)
    return _Jacobian(rows[:, :12], rows[:, 12], rows[:, 13:], instant)


def _lens_slopes(camera: Camera, points_cam: Floats) -> Floats:
    """Return how pixels move with points in front of the camera, (M, 2, 3) px a metre."""
    depth = points_cam[:, 2:]
    rays = points_cam / depth
    slopes = np.zeros((len(rays), 2, 3))
    for axis in range(2):
        step = np.zeros(3)
        step[axis] = _RAY_STEP
        ends = img_from_cam(camera, rays + step) - img_from_cam(camera, rays - step)
        slopes[:, :, axis] = ends / (2 * _RAY_STEP) / depth
    slopes[:, :, 2] = -np.einsum("mij,mj->mi", slopes[:, :, :2], rays[:, :2])
    return slopes


def _eyes(points: Floats) -> Floats:
    return np.broadcast_to(np.eye(3), (len(points), 3, 3))
