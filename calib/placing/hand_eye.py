"""Where a moving camera sits on its tracker, from boards that lie still and tracked poses.

For every picture the boards give cam_from_world and the tracker tracking_from_tracker; of the chain

    cam_from_world = cam_from_tracker . tracker_from_tracking . tracking_from_world

the first and the last part never change and are found here (robot-world/hand-eye calibration,
A X = Z B). In closed form first: the nine-by-nine sum of Kronecker products of the rotations has
both unknown rotations as its leading singular vectors, and the translations then are linear. Wrong
poses (a board seen turned over, a tracker that jumped) are found by trying triples of pictures.
Then all corners are adjusted at once, over the twelve unknowns.

What cannot be found is asked first, since the equations would answer anyhow: a tracker that turned
about one axis only says nothing of the offset along it (Tsai and Lenz 1989, lemma IV).

How far the answer can be trusted comes from leaving out one instant at a time: what a tracker gets
wrong is the same for all corners of a picture, and counting corners would hide it.

This work is based on: Shah, *Solving the robot-world/hand-eye calibration problem using the
Kronecker product*, J. Mechanisms and Robotics 5(3), 2013; Tsai and Lenz, *A new technique for fully
autonomous and efficient 3D robotics hand/eye calibration*, IEEE Trans. Robotics and Automation
5(3), 1989; MacKinnon and White, *Some heteroskedasticity-consistent covariance matrix estimators*,
J. Econometrics 29, 1985 (HC3, the jackknife).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.boards.board import Board, Sighting, is_seen
from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.lens import img_from_cam
from hybridve.calib.pose import Pose, angle_between, compose, invert
from hybridve.calib.record import MountRecord
from hybridve.calib.rig import Mount
from hybridve.calib.solving.lens_fit import locate_board

Floats = NDArray[np.float64]

#: The unknowns: both poses as in a rig's covariance, (omega, dt) on the left of each.
PARAMETERS = tuple(
    f"{pose} {name}"
    for pose in ("cam_from_tracker", "world_from_tracking")
    for name in ("rx", "ry", "rz", "tx", "ty", "tz")
)

#: Instants without which nothing is begun, and without which leaving one out says nothing.
_LEAST_INSTANTS = 3
_LEAST_TO_LEAVE_OUT = 6

#: A tracker that turns less than this about an axis (rms, degrees) did not turn: an offset would
#: be known no better than the tracker's position times its inverse.
_LEAST_TURN_DEG = 1.0

#: A tracker that moves less than this (rad, metres) while the camera moves more than that is stuck.
_STUCK = 1e-6
_MOVED_RAD, _MOVED_M = 0.02, 0.01

#: Triples of pictures tried, and pictures by which each is judged.
_TRIPLES, _JUDGES = 80, 40

#: A picture is dropped if it fits this many times worse than the median, and than so many pixels.
_OUTLIER, _OUTLIER_PX = 4.0, 0.5

#: Poses and pictures do not belong together if the median picture is missed by more than this
#: share of the image's width; another reading of the poses is the right one if it fits this many
#: times better.
_MISSED, _FITS_BETTER = 0.02, 4.0

#: The tracker's unit is wrong if its lengths are off by more than this share, and so many sigmas.
_SCALE, _SCALE_SIGMAS = 0.05, 5.0

_UNITS = {0.001: "millimetres", 0.01: "centimetres", 0.0254: "inches", 0.3048: "feet"}

_MAX_STEPS, _MAX_TURNS = 60, 10

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
    if len(cam_from_world) < _LEAST_INSTANTS or len(cam_from_world) != len(tracking_from_tracker):
        raise ValueError(
            f"{len(cam_from_world)} poses of the camera and {len(tracking_from_tracker)} of the "
            f"tracker; expected as many, {_LEAST_INSTANTS} or more"
        )
    cameras = np.asarray(cam_from_world)
    trackers = np.array([invert(pose) for pose in tracking_from_tracker])  # from tracking
    # R_cam = X R_tracker Y, so vec(X^T) = (R_tracker kron R_cam) vec(Y), row by row.
    product = np.einsum("nij,nkl->ikjl", trackers[:, :, :3], cameras[:, :, :3]).reshape(9, 9)
    left, _, right = np.linalg.svd(product)
    first, second = left[:, 0].reshape(3, 3), right[0].reshape(3, 3)
    sign = 1.0 if np.linalg.det(first) > 0 else -1.0
    x, y = _nearest_rotation(sign * first).T, _nearest_rotation(sign * second)

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


def mount_camera(
    camera: Camera,
    boards: Sequence[Board],
    sightings: Sequence[Sighting],
    tracking_from_tracker: Mapping[int, Pose],
    world_from_board: Mapping[int, Pose] | None = None,
) -> tuple[Mount, MountRecord]:
    """Return where a camera sits on its tracker, and the tracker's world in ours.

    Parameters
    ----------
    camera : Camera
        Its lens is used and stays as it is; its pose is not used.
    boards : sequence of Board
        The session's boards.
    sightings : sequence of Sighting
        What the camera saw of them while it moved; those of no instant, or at an instant without a
        tracked pose, are left alone.
    tracking_from_tracker : mapping of int to (3, 4) float64
        The tracked poses by instant, metres.
    world_from_board : mapping of int to (3, 4) float64, optional
        By number the boards that lie still, and where. By default the board that was seen most
        often is the world.

    Returns
    -------
    mount : Mount
        Both fixed poses.
    told : MountRecord
        How that was found, and how sure it is, what the tracker gets wrong included.

    Raises
    ------
    CalibrationError
        One line that says what is wrong with the recording and what to record: too few instants, a
        tracker that is stuck, did not turn, or turned about one axis only, poses in another unit
        or inverted, or poses that do not belong to the pictures.
    """
    if world_from_board is None:
        numbers = [one.board for one in sightings if one.instant in tracking_from_tracker]
        # The smallest number where several were seen equally often.
        most = min(set(numbers), key=lambda number: (-numbers.count(number), number), default=0)
        world_from_board = {most: np.eye(3, 4)}
    views, missed, untracked = _make_views(
        camera, boards, sightings, tracking_from_tracker, world_from_board
    )
    views, stuck = _without_stuck(camera, views)
    turn_deg = _check_motion(camera, views, len(untracked), bool(stuck))
    views, chosen, fit = _fit(camera, views)
    missed |= stuck | {
        view.image: f"{rms_px:.2f} px rms, the median is {fit.median_px:.2f} px"
        for view, rms_px, is_used in zip(views, fit.rms_px, fit.used, strict=True)
        if not is_used
    }
    used = [view for view, is_used in zip(views, fit.used, strict=True) if is_used]
    instants = sorted({view.instant for view in used})
    sure = _uncertainty(camera, used, fit.mount)
    if abs(sure.scale - 1.0) > max(_SCALE, _SCALE_SIGMAS * sure.scale_std):
        raise _wrong_unit(camera, sure.scale)
    deviation = np.sqrt(np.diag(sure.covariance))
    return fit.mount, MountRecord(
        instants=len(instants),
        middle_instant=instants[len(instants) // 2],
        views=len(used),
        looks_turned=sum(view.look != 0 for view in used),
        untracked=tuple(untracked),
        dropped=missed,
        rms_px=_rms_of(_residuals(camera, used, fit.mount)),
        closed_form_rms_px=_rms_of(_residuals(camera, used, chosen)),
        turn_deg=tuple(turn_deg),
        tracker_scale=sure.scale,
        tracker_scale_std=sure.scale_std,
        parameters=PARAMETERS,
        covariance=_rows(sure.covariance),
        covariance_from=sure.covariance_from,
        offset_std_mm=float(1e3 * np.linalg.norm(deviation[3:6])),
        offset_std_deg=float(np.rad2deg(np.linalg.norm(deviation[:3]))),
        pose_covariance=_rows(sure.pose_covariance),
    )


def _rows(matrix: Floats) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(row) for row in matrix.tolist())


# --- what was seen --------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _View:
    """One board in one picture, the corners that were seen.

    Attributes
    ----------
    instant, image, board
        Of the sighting.
    points_world : (N, 3) float64
        Its corners in metres.
    listings : (L, N, 2) float64
        Their pixels in all orders that the board's looks allow, NaN where unseen.
    look : int
        The listing that holds.
    poses : sequence of L (3, 4) float64
        Where the camera was under each listing: cam_from_world, by this picture alone.
    tracking_from_tracker : (3, 4) float64
        Where the tracker was.
    """

    instant: int
    image: str
    board: int
    points_world: Floats
    listings: Floats
    look: int
    poses: Sequence[Pose]
    tracking_from_tracker: Pose

    @property
    def pixels(self) -> Floats:
        """The corners (N, 2), pixels; NaN where unseen."""
        return np.asarray(self.listings[self.look])

    @property
    def cam_from_world(self) -> Pose:
        """Where the camera was (3, 4), by this picture alone."""
        return self.poses[self.look]


def _make_views(
    camera: Camera,
    boards: Sequence[Board],
    sightings: Sequence[Sighting],
    tracking_from_tracker: Mapping[int, Pose],
    world_from_board: Mapping[int, Pose],
) -> tuple[list[_View], dict[str, str], list[int]]:
    """Return what can be used in a fixed order, what cannot and why, and instants not tracked."""
    views, missed, untracked = [], {}, set()
    for seen in sightings:
        if seen.instant is None or seen.board not in world_from_board:
            continue
        if seen.instant not in tracking_from_tracker:
            untracked.add(seen.instant)
            continue
        board, pose = boards[seen.board], world_from_board[seen.board]
        found = locate_board(camera, board.points_board, seen.pixels)
        if found is None:
            missed[seen.image] = "the board cannot be located"
            continue
        views.append(
            _View(
                seen.instant,
                seen.image,
                seen.board,
                board.points_board @ pose[:, :3].T + pose[:, 3],
                np.array([seen.pixels[look] for look in board.looks]),
                0,
                [
                    compose(compose(found[0], board.board_from_turned(look)), invert(pose))
                    for look in range(len(board.looks))
                ],
                tracking_from_tracker[seen.instant],
            )
        )
    views.sort(key=lambda view: (view.instant, view.board, view.image))
    return views, missed, sorted(untracked)


def _without_stuck(camera: Camera, views: list[_View]) -> tuple[list[_View], dict[str, str]]:
    """Return views without those at which the tracker repeated itself and the camera had moved."""
    kept: list[_View] = []
    stuck: dict[str, str] = {}
    for view in views:
        # The first of a run may be right, so it is the one that stays.
        last = kept[-1] if kept else None
        if (
            last is not None
            and last.instant != view.instant
            and not _differ(last.tracking_from_tracker, view.tracking_from_tracker, _STUCK, _STUCK)
            and _differ(last.cam_from_world, view.cam_from_world, _MOVED_RAD, _MOVED_M)
        ):
            stuck[view.image] = f"the tracker reports the pose of instant {last.instant} again"
        else:
            kept.append(view)
    return kept, stuck


def _differ(first: Pose, second: Pose, angle_rad: float, distance_m: float) -> bool:
    apart_m = np.linalg.norm(invert(first)[:, 3] - invert(second)[:, 3])
    return bool(angle_between(first, second) > angle_rad or apart_m > distance_m)


def _check_motion(
    camera: Camera, views: list[_View], n_untracked: int, was_stuck: bool
) -> list[float]:
    """Return how far the tracker turned about three axes, rms in degrees, most first.

    Raises
    ------
    CalibrationError
        If that does not determine a mount.
    """
    poses = {view.instant: view.tracking_from_tracker for view in views}
    name = f"camera {camera.name!r}"
    advice = (
        "record still boards from 20 or more places, and turn the camera by 20 degrees or more "
        "about two of its axes at least (nod, shake, tilt)"
    )
    if len(poses) < _LEAST_INSTANTS:
        if was_stuck:
            raise CalibrationError(
                f"{name}: its tracker is stuck: it reports one pose while the camera moves; look "
                "at the tracker, and record again"
            )
        lost = f" ({n_untracked} more without a tracked pose)" if n_untracked else ""
        raise CalibrationError(
            f"{name}: {len(poses)} instants with both a board and a tracked pose{lost}, expected "
            f"{_LEAST_INSTANTS} or more; {advice}"
        )
    rotations = np.array(list(poses.values()))[:, :, :3]
    mean = _nearest_rotation(rotations.sum(axis=0))
    turns = np.array([cv2.Rodrigues(mean.T @ rotation)[0].ravel() for rotation in rotations])
    _, spread, axes = np.linalg.svd(np.rad2deg(turns), full_matrices=False)
    turn_deg = [float(value) for value in spread / np.sqrt(len(turns))]
    if turn_deg[0] < _LEAST_TURN_DEG:
        positions = np.array(list(poses.values()))[:, :, 3]
        did = "only moved straight" if np.ptp(positions, axis=0).max() > _MOVED_M else "stood still"
        raise CalibrationError(
            f"{name}: its tracker {did} ({turn_deg[0]:.1f} degrees of turning, rms): where the "
            f"camera sits on it cannot be found; {advice}"
        )
    if turn_deg[1] < _LEAST_TURN_DEG:
        axis = axes[0] * np.sign(axes[0][np.abs(axes[0]).argmax()])
        raise CalibrationError(
            f"{name}: its tracker turned about one axis only, ({axis[0]:.2f}, {axis[1]:.2f}, "
            f"{axis[2]:.2f}) of its own frame: the camera's offset along that axis cannot be "
            f"found; {advice}"
        )
    return turn_deg


# --- fitting --------------------------------------------------------------------------------------


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


def _fit(camera: Camera, views: list[_View]) -> tuple[list[_View], Mount, _Fit]:
    """Return the views with the looks that hold, the mount in closed form, and the final fit.

    Raises
    ------
    CalibrationError
        If poses and pictures do not belong together, or the poses mean something else.
    """
    start = _consensus(camera, views)
    if not start.median_px < _MISSED * camera.width_px:
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


def _misfit(camera: Camera, views: list[_View], start: _Fit) -> CalibrationError:
    """Return what is wrong with poses that do not belong to the pictures."""
    scaled = _consensus(camera, views, free_scale=True)
    if scaled.median_px * _FITS_BETTER < start.median_px and abs(scaled.scale - 1.0) > _SCALE:
        return _wrong_unit(camera, scaled.scale)
    turned = [
        replace(view, tracking_from_tracker=invert(view.tracking_from_tracker)) for view in views
    ]
    if _consensus(camera, turned).median_px * _FITS_BETTER < start.median_px:
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


def _wrong_unit(camera: Camera, scale: float) -> CalibrationError:
    unit = next((name for size, name in _UNITS.items() if abs(scale / size - 1.0) < 0.1), None)
    found = f"they look like {unit}" if unit else "check the board's squares, or the tracker"
    return CalibrationError(
        f"camera {camera.name!r}: the lengths of its tracked poses have to be multiplied by "
        f"{scale:.4g} to fit the board, expected 1: poses are in metres; {found}"
    )


def _consensus(
    camera: Camera, views: list[_View], *, any_look: bool = True, free_scale: bool = False
) -> _Fit:
    """Return the mount in closed form of the views that agree with each other."""
    rng = np.random.default_rng(0)
    stack = _Stack.of(views, any_look=any_look)
    judges = _Stack.of([views[k] for k in _spread(len(views), _JUDGES)], any_look=any_look)
    best = _closed_form(views, free_scale)
    best_px = float(np.median(judges.rms_px(camera, best.mount, best.scale).min(axis=1)))
    for _ in range(_TRIPLES):
        chosen = rng.choice(len(views), _LEAST_INSTANTS, replace=False)
        found = _closed_form([views[k] for k in chosen], free_scale)
        median_px = float(np.median(judges.rms_px(camera, found.mount, found.scale).min(axis=1)))
        if median_px < best_px:
            best, best_px = found, median_px
    # Once more from all that agree: a triple alone carries its own errors far.
    rms_px = stack.rms_px(camera, best.mount, best.scale)
    agree = _inliers(rms_px.min(axis=1)) & (rms_px.argmin(axis=1) == 0)
    if agree.sum() >= _LEAST_INSTANTS:
        chosen = np.flatnonzero(agree)
        again = _closed_form([views[k] for k in chosen], free_scale)
        again_px = stack.rms_px(camera, again.mount, again.scale)
        if np.median(again_px.min(axis=1)) < np.median(rms_px.min(axis=1)):
            best, rms_px = again, again_px
    smallest_px = rms_px.min(axis=1)
    return _Fit(best.mount, smallest_px, _inliers(smallest_px), best.scale)


def _closed_form(views: list[_View], free_scale: bool) -> HandEye:
    return solve_hand_eye(
        [view.cam_from_world for view in views],
        [view.tracking_from_tracker for view in views],
        free_scale,
    )


def _inliers(rms_px: Floats) -> NDArray[np.bool_]:
    return np.asarray(rms_px <= max(_OUTLIER * float(np.median(rms_px)), _OUTLIER_PX))


def _spread(count: int, most: int) -> NDArray[np.intp]:
    return np.linspace(0, count - 1, min(count, most)).round().astype(np.intp)


def _with_looks(camera: Camera, views: list[_View], mount: Mount) -> list[_View]:
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
    def of(cls, views: Sequence[_View], *, any_look: bool) -> Self:
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


def _residuals(camera: Camera, views: list[_View], mount: Mount) -> Floats:
    """Return observed minus projected corners of all views, (M, 2) pixels, those seen."""
    stack = _Stack.of(views, any_look=False)
    seen = is_seen(stack.listings[0])
    return np.asarray((stack.listings[0] - stack.project(camera, mount))[seen])


def _rms_of(residuals: Floats) -> float:
    return float(np.sqrt((residuals**2).sum(axis=1).mean()))


def _refine(camera: Camera, views: list[_View], mount: Mount) -> Mount:
    """Return the mount that misses all corners of the views least (Levenberg and Marquardt)."""
    residuals = _residuals(camera, views, mount)
    cost, damping = float((residuals**2).sum()), 1e-6
    for _ in range(_MAX_STEPS):
        jacobian = _jacobian(camera, views, mount).parameters
        lengths = np.linalg.norm(jacobian, axis=0)
        scaled = jacobian / lengths
        damped = np.concatenate([scaled, np.sqrt(damping) * np.eye(scaled.shape[1])])
        wanted = np.concatenate([residuals.ravel(), np.zeros(scaled.shape[1])])
        step = np.linalg.lstsq(damped, wanted)[0]
        moved = _moved(mount, step / lengths)
        new = _residuals(camera, views, moved)
        new_cost = float((new**2).sum())
        if np.isfinite(new_cost) and new_cost <= cost:
            gained = cost - new_cost
            mount, residuals, cost = moved, new, new_cost
            damping = max(0.1 * damping, 1e-15)
            if gained <= 1e-14 * cost:
                break
        elif damping > 1e6:
            break
        else:
            damping *= 10.0
    return mount


def _moved(mount: Mount, step: Floats) -> Mount:
    """Return the mount a step (12,) further, in the order of `PARAMETERS`."""
    poses = []
    for pose, part in ((mount.cam_from_tracker, step[:6]), (mount.world_from_tracking, step[6:])):
        rotation = cv2.Rodrigues(part[:3])[0] @ pose[:, :3]
        poses.append(np.column_stack([_nearest_rotation(rotation), pose[:, 3] + part[3:]]))
    return Mount(*poses)


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


def _jacobian(camera: Camera, views: list[_View], mount: Mount) -> _Jacobian:
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
            [-_cross(points_cam - cam_from_world[:, 3]), _eyes(points)], axis=2
        )
        by_mount = np.concatenate([-_cross(of_cam), _eyes(points)], axis=2)
        from_world = points - world_from_tracking[:, 3]
        by_world = np.concatenate(
            [rotation @ _cross(from_world), np.broadcast_to(-rotation, (len(points), 3, 3))], axis=2
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


def _cross(vectors: Floats) -> Floats:
    """Return the matrices (N, 3, 3) of the cross products with vectors (N, 3)."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    return np.moveaxis(np.array(rows), 2, 0)


def _eyes(points: Floats) -> Floats:
    return np.broadcast_to(np.eye(3), (len(points), 3, 3))


def _nearest_rotation(matrix: Floats) -> Floats:
    left, _, right = np.linalg.svd(matrix)
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    return np.asarray(left @ flip @ right)


# --- how sure that is -----------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _Uncertainty:
    """How sure a mount is.

    Attributes
    ----------
    scale, scale_std : float
        The tracker's unit in metres as the pictures show it, and its standard deviation.
    covariance : (12, 12) float64
        Of the mount, in the order of `PARAMETERS`.
    covariance_from : str
        "instants left out" or "corners".
    pose_covariance : (6, 6) float64
        Of cam_from_world at one instant, in the form of a rig's covariance.
    """

    scale: float
    scale_std: float
    covariance: Floats
    covariance_from: str
    pose_covariance: Floats


def _uncertainty(camera: Camera, views: list[_View], mount: Mount) -> _Uncertainty:
    """Return how sure a mount is by the views it was fitted to."""
    residuals = _residuals(camera, views, mount).ravel()
    rows = _jacobian(camera, views, mount)
    instants = np.unique(rows.instant)
    n_instants = len(instants)
    jacobian = np.column_stack([rows.parameters, rows.scale])
    of_all, is_known = _left_out(jacobian[:, :12], residuals, rows.instant)
    # The scale on top of them all: what it would become, and how sure that is.
    step = np.linalg.lstsq(jacobian / _lengths(jacobian), residuals)[0] / _lengths(jacobian)
    with_scale, _ = _left_out(jacobian, residuals - jacobian @ step, rows.instant)
    # What each instant's pose is off, by its own corners; and what the mount may be off.
    errors = np.zeros((6, 6))
    by_corners = np.zeros((6, 6))
    unexplained = 0.0
    of_mount = np.zeros((6, 6))
    for instant in instants:
        mine = rows.instant == instant
        lengths = _lengths(rows.pose[mine])
        inverse = np.linalg.pinv(rows.pose[mine] / lengths, rcond=1e-9) / lengths[:, None]
        off = inverse @ residuals[mine]
        unexplained += float(((residuals[mine] - rows.pose[mine] @ off) ** 2).sum())
        errors += np.outer(off, off) / max(n_instants - 2, 1)
        by_corners += inverse @ inverse.T / n_instants
        by_mount = inverse @ rows.parameters[mine]
        of_mount += by_mount @ of_all @ by_mount.T / n_instants
    # Corners are off by themselves, which says nothing of the tracker.
    variance_px2 = unexplained / max(len(residuals) - 6 * n_instants, 1)
    pose_covariance = of_mount + _at_least_zero(errors - variance_px2 * by_corners)
    return _Uncertainty(
        float(1.0 + step[12]),
        float(np.sqrt(with_scale[12, 12])),
        of_all,
        "instants left out" if is_known else "corners",
        pose_covariance,
    )


def _at_least_zero(matrix: Floats) -> Floats:
    """Return the part of a symmetric matrix that is a covariance; its units may differ."""
    lengths = np.sqrt(np.abs(np.diag(matrix)))
    lengths = np.where(lengths > 0, lengths, 1.0)
    values, vectors = np.linalg.eigh(matrix / np.outer(lengths, lengths))
    kept = (vectors * np.maximum(values, 0.0)) @ vectors.T
    return np.asarray(kept * np.outer(lengths, lengths))


def _left_out(
    jacobian: Floats, residuals: Floats, instant: NDArray[np.int64]
) -> tuple[Floats, bool]:
    """Return the covariance (P, P) of a fit by leaving out one instant at a time.

    With few instants it comes from the corners as if each erred by itself; the second value says
    which it is.
    """
    lengths = _lengths(jacobian)
    scaled = jacobian / lengths
    normal = scaled.T @ scaled
    numbers = np.unique(instant)
    count = len(numbers)
    if count >= _LEAST_TO_LEAVE_OUT:
        covariance = np.zeros_like(normal)
        for number in numbers:
            mine = instant == number
            rest = normal - scaled[mine].T @ scaled[mine]
            change = np.linalg.lstsq(rest, scaled[mine].T @ residuals[mine])[0]
            covariance += np.outer(change, change)
        covariance *= (count - 1) / count
    else:
        free = max(len(residuals) - len(normal), 1)
        covariance = np.linalg.pinv(normal) * float(residuals @ residuals) / free
    covariance = 0.5 * (covariance + covariance.T)
    return covariance / np.outer(lengths, lengths), count >= _LEAST_TO_LEAVE_OUT


def _lengths(columns: Floats) -> Floats:
    lengths = np.linalg.norm(columns, axis=0)
    return np.where(lengths > 0, lengths, 1.0)
