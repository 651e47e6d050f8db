"""How cameras that were calibrated alone hang together: one rig, from closed-form poses.

Every view of a board ties a camera to a board at a moment. Cameras that stand fixed to one another
form a part, boards of one body whose places on it are known another; at first each is a part of its
own. Parts are joined one by one, the surest join first: two parts of cameras by the relative pose
that their common moments share, two parts of boards by what one part of cameras saw of both at
once. So cameras that never see a board at the same time are linked through others, and two cameras
before and behind a body through the boards on it; where no camera ever sees both, the two unknown
poses are found together.

Cameras and boards come in order of name (`hybridve.calib.calibrate.solve_rig` sees to it), and
views are sorted here, so that nothing depends on the order in which they are listed.

This work is based on: Kruskal, *On the shortest spanning subtree of a graph*, Proc. AMS 7, 1956;
Shah, *Solving the robot-world/hand-eye calibration problem using the Kronecker product*, J.
Mechanisms Robotics 5(3), 2013 (cameras and boards that never meet).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.boards.board import Board, Observations, Sighting, is_seen
from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.image_io import natural_order
from hybridve.calib.lens import img_from_cam
from hybridve.calib.placing.moments import Body, Moment, OnBody, PoseKey, body_of
from hybridve.calib.pose import Pose, compose, invert, transform
from hybridve.calib.solving.bundle import BundleView
from hybridve.calib.solving.consensus import CommonPose, common_pose, pose_distances
from hybridve.calib.solving.lens_fit import locate_board, rms, view_label

#: Common views that differ by more than this (radians plus shares of the board's distance, median)
#: share no relative pose.
_DISAGREE = 0.2

#: Another look of a symmetric board must fit worse by this factor and this margin.
_CLEAR_FACTOR = 3.0
_CLEAR_MARGIN = 0.05

#: A view is left out where it misses the place that the others give its board by this share of the
#: board's size in the image, and by so many times what its camera misses by in the median. From a
#: smaller share on it is asked whether another view places the board better.
_LEFT_OUT_SHARE = 0.1
_DOUBTFUL_SHARE = 0.02
_LEFT_OUT_MEDIANS = 5.0

#: A clip that misses its lens by more than so many times what the stills do, or than the limit
#: (both median root mean squares), is suspicious; another camera's lens explains it if it misses
#: less than a share of that. Beyond the last limit no view can be trusted. From the first factor on
#: it is worth a warning: the error of 40 points varies by 8 %.
_CLIP_DOUBTFUL_FACTOR = 1.5
_CLIP_FACTOR = 3.0
_CLIP_LIMIT_PX = 0.1
_EXPLAINS_SHARE = 1.0 / 3.0
_CLIP_HOPELESS_PX = 5.0

#: Views from which it is told how far a lens misses a clip, or stills.
_TYPICAL_VIEWS = 12

#: Corners of two cameras that differ by less come from one picture, or from one that was encoded
#: twice (pixels); cameras nearer than this (shares of the board's distance, radians) stand in one
#: place.
_SAME_PICTURE_PX = 1e-6
_ALIKE_PX = 1.0
_SAME_PLACE = 1e-3

#: Moments from which the poses of cameras and boards that never meet are found, at least; how far
#: their rotations must be from turning about one axis only (share of the largest singular value).
_MIN_JOINT_MOMENTS = 4
_JOINT_GAP = 1e-3

_MIRROR_IMAGE = np.diag([-1.0, 1.0, 1.0])


class NamedBoard(Board, OnBody, Protocol):
    """A board that may be mounted on a body together with others."""


class SolvedLens(Protocol):
    """What linking needs of a lens that was fitted to the views of one camera."""

    @property
    def camera(self) -> Camera:
        """The lens; its pose is not used."""
        ...

    @property
    def views(self) -> Mapping[tuple[str, int], Pose]:
        """By image and board, where the board lay as the camera saw it: cam_from_board."""
        ...

    @property
    def pixels(self) -> Mapping[tuple[str, int], NDArray[np.float64]]:
        """Their points: (N, 2) pixels, NaN where not seen or an outlier."""
        ...

    @property
    def dropped(self) -> Mapping[str, str]:
        """Views that do not fit, by `view_label`, and why."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Linked:
    """Cameras, boards and bodies in one frame, all by closed forms: the start of an adjustment.

    Attributes
    ----------
    cam_from_rig : tuple of (3, 4) float64
        In the order of the cameras; the rig's frame is that of the first.
    body_from_board : tuple of (3, 4) float64
        In the order of the boards; a body's frame is that of its first board.
    rig_from_body : tuple of (3, 4) float64
        One for each instant, or still, in which a body was seen.
    views : tuple of BundleView
        All views that agree, symmetric boards listed alike in all of them.
    pose_keys : tuple of PoseKey
        What each of `rig_from_body` is of, in order.
    left_out : dict of str to str
        Views that disagree with what the others say, "cam1: image: board", and by how much.
    warnings : tuple of str
        What is suspicious but no reason to stop.
    """

    cam_from_rig: tuple[Pose, ...]
    body_from_board: tuple[Pose, ...]
    rig_from_body: tuple[Pose, ...]
    views: tuple[BundleView, ...]
    pose_keys: tuple[PoseKey, ...]
    left_out: dict[str, str] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()


#: Cameras, or boards, whose relative poses are known, as indices in order of name.
_Part = tuple[int, ...]


@dataclass(frozen=True, slots=True, eq=False)
class _Look:
    """A located view.

    Attributes
    ----------
    cam_from_board : (L, 3, 4) float64
        One pose for each look of the board, for `moment` and the pixels as given.
    weight : float
        How sure the board's tilt is: 1 / rad^2 for noise of one pixel.
    """

    camera: int
    board: int
    moment: Moment
    image: str
    pixels: NDArray[np.float64]
    cam_from_board: NDArray[np.float64]
    weight: float


@dataclass(frozen=True, slots=True, eq=False)
class _Join:
    """How two parts may be joined: ``second_from_first`` and what speaks for it."""

    common: CommonPose
    moments: tuple[Moment, ...]
    weight: float
    is_clear: bool

    @property
    def is_sound(self) -> bool:
        """Whether most of the common moments share the pose, and no other as well."""
        return self.common.error <= _DISAGREE and self.is_clear


def link_cameras(
    boards: Sequence[NamedBoard],
    lenses: Sequence[SolvedLens],
    observations: Sequence[Observations],
    is_labelled: bool,
) -> Linked:
    """Chain cameras, and the boards of bodies, by what they saw at the same time.

    Parameters
    ----------
    boards : sequence of NamedBoard
        The boards, in order of name; `Sighting.board` counts them.
    lenses : sequence of SolvedLens
        The lenses of the cameras, and where the boards lay in the views they were fitted to. Other
        stills are not used, nor are views that the lens dropped; the clip's others are located.
    observations : sequence of Observations
        What the same cameras saw, in order of their names.
    is_labelled : bool
        Whether boards that look the same when turned are listed consistently in the clip already.

    Raises
    ------
    CalibrationError
        Naming the cameras, if some cannot be linked to the others (then also the edge that is
        missing and what to record), if two show the same pictures, if their clips are exchanged,
        if a picture is mirrored, if common views share no relative pose or do not tell which way
        round they saw a symmetric board, and if boards of one body are never seen together.
    """
    warnings = _refuse_copies(boards, observations)
    warnings += _refuse_exchanged(boards, lenses, observations)
    chain = _Chain.of(boards, lenses, observations, is_labelled)
    chain.join_all()
    if len(chain.camera_parts) > 1:
        raise _not_linked(chain)
    chain.require_whole_bodies()
    return _read_out(chain, _Whole.of(chain), warnings)


# --- Parts and how they are joined ------------------------------------------------------------


class _Chain:
    """Cameras and boards, the parts they form so far, and what could join these.

    `cam_from_part` and `part_from_board` place each camera and board in its part.
    """

    def __init__(
        self,
        boards: Sequence[NamedBoard],
        cameras: Sequence[Camera],
        looks: Sequence[_Look],
    ) -> None:
        self.boards = boards
        self.cameras = cameras
        self.looks = looks
        self.camera_parts: list[_Part] = [(rank,) for rank in range(len(cameras))]
        self.board_parts: list[_Part] = [(rank,) for rank in range(len(boards))]
        self.cam_from_part = [np.eye(3, 4) for _ in cameras]
        self.part_from_board = [np.eye(3, 4) for _ in boards]
        self._placed: dict[
            tuple[_Part, _Part], dict[Moment, tuple[NDArray[np.float64], float]]
        ] = {}
        self._joins: dict[tuple[str, _Part, _Part, tuple[_Part, ...]], _Join | None] = {}
        distances = [float(np.linalg.norm(look.cam_from_board[0][:, 3])) for look in looks]
        self.length_m = float(np.median(distances)) if distances else 1.0

    @classmethod
    def of(
        cls,
        boards: Sequence[NamedBoard],
        lenses: Sequence[SolvedLens],
        observations: Sequence[Observations],
        is_labelled: bool,
    ) -> "_Chain":
        """Locate all views and put them in order."""
        looks: dict[tuple[Moment, int, int], _Look] = {}
        for camera, (lens, seen) in enumerate(zip(lenses, observations, strict=True)):
            for sighting in seen.sightings:
                look = _located(boards, lens, camera, sighting, is_labelled)
                if look is not None:
                    key = (look.moment, look.camera, look.board)
                    if key not in looks or sighting.image < looks[key].image:
                        looks[key] = look
        return cls(boards, [lens.camera for lens in lenses], [looks[key] for key in sorted(looks)])

    def body_of(self, board: int) -> Body:
        """Return the body of a board."""
        return body_of(self.boards[board])

    def join_all(self) -> None:
        """Join parts, the surest join first, until none is left that could be."""
        while True:
            joins = [
                (join.weight, [-rank for rank in first + second], kind, first, second, join)
                for kind, first, second, join in self.candidates()
                if join.is_sound
            ]
            if joins:
                _, _, kind, first, second, join = max(joins, key=lambda item: item[:2])
                self._join(kind, first, second, join.common.pose)
            elif not self._join_through_bodies():
                return

    def candidates(self) -> list[tuple[str, _Part, _Part, _Join]]:
        """Return all pairs of parts that have common moments, with what these say."""
        found = []
        for first, second in combinations(sorted(self.camera_parts), 2):
            key = ("cameras", first, second, tuple(sorted(self.board_parts)))
            if key not in self._joins:
                self._joins[key] = self._join_of_cameras(first, second)
            join = self._joins[key]
            if join is not None:
                found.append(("cameras", first, second, join))
        for first, second in combinations(sorted(self.board_parts), 2):
            if self.body_of(first[0]) != self.body_of(second[0]):
                continue
            key = ("boards", first, second, tuple(sorted(self.camera_parts)))
            if key not in self._joins:
                self._joins[key] = self._join_of_boards(first, second)
            join = self._joins[key]
            if join is not None:
                found.append(("boards", first, second, join))
        return found

    def placed(
        self, cameras: _Part, boards: _Part
    ) -> dict[Moment, tuple[NDArray[np.float64], float]]:
        """Return where a part of cameras saw a part of boards: by moment poses and their weight.

        The poses (K, 3, 4), cameras_from_boards, are those that a symmetric board leaves open.
        """
        key = (cameras, boards)
        if key not in self._placed:
            by_moment: dict[Moment, list[_Look]] = {}
            for look in self.looks:
                if look.camera in cameras and look.board in boards:
                    by_moment.setdefault(look.moment, []).append(look)
            self._placed[key] = {
                moment: (self._agreed(looks), sum(look.weight for look in looks))
                for moment, looks in by_moment.items()
            }
        return self._placed[key]

    def in_part(self, look: _Look) -> NDArray[np.float64]:
        """Return where a view places its board's part in its camera's part: (L, 3, 4)."""
        return _placed_by(look, self.cam_from_part[look.camera], self.part_from_board[look.board])

    def _agreed(self, looks: Sequence[_Look]) -> NDArray[np.float64]:
        """Return the poses of the surest view that the others at this moment agree with."""
        surest = max(looks, key=lambda look: look.weight)
        poses = self.in_part(surest)
        if len(looks) == 1 or len(poses) == 1:
            return poses
        misses = np.zeros(len(poses))
        for look in looks:
            if look is not surest:
                misses += pose_distances(poses, self.in_part(look), self.length_m).min(axis=1)
        return np.asarray(poses[misses <= misses.min() + _DISAGREE])

    def _join_of_cameras(self, first: _Part, second: _Part) -> _Join | None:
        measured, weights, moments = [], [], []
        for boards in sorted(self.board_parts):
            one, other = self.placed(first, boards), self.placed(second, boards)
            for moment in sorted(one.keys() & other.keys()):
                (from_first, sure), (from_second, as_sure) = one[moment], other[moment]
                if len(boards) == 1 and len(from_first) == len(from_second):
                    from_first = from_first[:1]  # turning the board for both changes nothing
                measured.append(_products(from_second, _inverses(from_first)))
                weights.append(1.0 / (1.0 / sure + 1.0 / as_sure))
                moments.append(moment)
        return self._common(measured, weights, moments, must_be_clear=True)

    def _join_of_boards(self, first: _Part, second: _Part) -> _Join | None:
        measured, weights, moments = [], [], []
        for cameras in sorted(self.camera_parts):
            one, other = self.placed(cameras, first), self.placed(cameras, second)
            for moment in sorted(one.keys() & other.keys()):
                (from_first, sure), (from_second, as_sure) = one[moment], other[moment]
                measured.append(_products(_inverses(from_second), from_first))
                weights.append(1.0 / (1.0 / sure + 1.0 / as_sure))
                moments.append(moment)
        # Which look of a symmetric board is called the first is free: none is wrong.
        return self._common(measured, weights, moments, must_be_clear=False)

    def _common(
        self,
        measured: Sequence[NDArray[np.float64]],
        weights: Sequence[float],
        moments: Sequence[Moment],
        must_be_clear: bool,
    ) -> _Join | None:
        if not measured:
            return None
        counted = np.array(weights)
        common = common_pose(measured, counted, self.length_m)
        is_open = must_be_clear and any(len(poses) > 1 for poses in measured)
        is_clear = not is_open or (
            common.rival_error > _CLEAR_FACTOR * common.error + _CLEAR_MARGIN
        )
        return _Join(common, tuple(moments), float(counted[common.agrees].sum()), is_clear)

    def _join(self, kind: str, first: _Part, second: _Part, second_from_first: Pose) -> None:
        """Make one part of two; its frame is the first one's."""
        whole = tuple(sorted(first + second))
        if kind == "cameras":
            for rank in second:
                self.cam_from_part[rank] = compose(self.cam_from_part[rank], second_from_first)
            parts = self.camera_parts
        else:
            first_from_second = invert(second_from_first)
            for rank in second:
                self.part_from_board[rank] = compose(first_from_second, self.part_from_board[rank])
            parts = self.board_parts
        parts.remove(first)
        parts.remove(second)
        parts.append(whole)

    def _join_through_bodies(self) -> bool:
        """Join two parts of cameras that see different boards of one body; tell if any were."""
        best: tuple[float, _Part, _Part, _Part, _Part, Pose, Pose] | None = None
        for first, second in combinations(sorted(self.camera_parts), 2):
            for one, other in combinations(sorted(self.board_parts), 2):
                if self.body_of(one[0]) != self.body_of(other[0]):
                    continue
                for near, far in ((one, other), (other, one)):
                    seen, seen_too = self.placed(first, near), self.placed(second, far)
                    moments = sorted(seen.keys() & seen_too.keys())
                    if any(len(seen[m][0]) > 1 or len(seen_too[m][0]) > 1 for m in moments):
                        continue  # which way round a symmetric board was seen is not to be told
                    found = solve_joint(
                        np.array([seen[moment][0][0] for moment in moments]),
                        np.array([seen_too[moment][0][0] for moment in moments]),
                        self.length_m,
                    )
                    weight = sum(
                        1.0 / (1.0 / seen[moment][1] + 1.0 / seen_too[moment][1])
                        for moment in moments
                    )
                    if found is not None and (best is None or weight > best[0]):
                        best = (weight, first, second, near, far, *found)
        if best is None:
            return False
        _, first, second, near, far, second_from_first, far_from_near = best
        self._join("cameras", first, second, second_from_first)
        if near < far:
            self._join("boards", near, far, far_from_near)
        else:
            self._join("boards", far, near, invert(far_from_near))
        return True

    def require_whole_bodies(self) -> None:
        """Refuse boards of one body that were seen, but never together.

        Raises
        ------
        CalibrationError
            Naming the boards and what to record.
        """
        seen = {look.board for look in self.looks}
        for first, second in combinations(sorted(self.board_parts), 2):
            if self.body_of(first[0]) != self.body_of(second[0]):
                continue
            if seen.isdisjoint(first) or seen.isdisjoint(second):
                continue
            one, other = (
                ", ".join(repr(self.boards[rank].name) for rank in part) for part in (first, second)
            )
            raise CalibrationError(
                f"board {one} and board {other} of body {self.boards[first[0]].body!r} are never "
                "seen at the same time, or their views share no relative pose; record the body so "
                "that cameras see both at once, or give the boards different bodies"
            )


def _located(
    boards: Sequence[NamedBoard],
    lens: SolvedLens,
    camera: int,
    sighting: Sighting,
    is_labelled: bool,
) -> _Look | None:
    """Return a view with its poses; None if it was dropped, or has none."""
    board = boards[sighting.board]
    key = (sighting.image, sighting.board)
    pose, pixels = lens.views.get(key), lens.pixels.get(key, sighting.pixels)
    is_dropped = view_label(boards, sighting.image, sighting.board) in lens.dropped
    if pose is None and sighting.instant is not None and not is_dropped:
        located = locate_board(lens.camera, board.points_board, pixels)
        pose = None if located is None else located[0]
    if pose is None:
        return None
    # Stills are listed as they were found: only what was seen at once can be listed consistently.
    n_looks = 1 if is_labelled and sighting.instant is not None else len(board.looks)
    turned = [compose(pose, board.board_from_turned(look)) for look in range(n_looks)]
    moment = (
        Moment.of_still(camera, sighting.image)
        if sighting.instant is None
        else Moment.of_clip(sighting.instant)
    )
    points_cam = transform(pose, board.points_board[is_seen(pixels)])
    weight = _tilt_weight(points_cam, float(lens.camera.pinhole[0, 0]))
    return _Look(camera, sighting.board, moment, sighting.image, pixels, np.stack(turned), weight)


def _residuals(
    camera: Camera, cam_from_board: Pose, board: NamedBoard, pixels: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return observed minus projected, (S, 2) pixels, of the points that were seen.

    A point behind the camera misses by more than the image.
    """
    seen = is_seen(pixels)
    points_cam = transform(cam_from_board, board.points_board[seen])
    projected = np.full((len(points_cam), 2), 10.0 * camera.width_px)
    ahead = points_cam[:, 2] > 0
    if ahead.any():
        projected[ahead] = img_from_cam(camera, points_cam[ahead])
    return np.asarray(pixels[seen] - np.where(np.isfinite(projected), projected, 1e5))


def _tilt_weight(points_cam: NDArray[np.float64], focal_px: float) -> float:
    """Return 1 / variance of a board's tilt (rad^-2) for corners that are wrong by one pixel."""
    x, y, z = points_cam.T
    zero, one = np.zeros_like(z), np.ones_like(z)
    along_u = np.stack([one / z, zero, -x / z**2], axis=-1)
    along_v = np.stack([zero, one / z, -y / z**2], axis=-1)
    gradients = focal_px * np.concatenate([along_u, along_v])  # (2N, 3)
    points = np.concatenate([points_cam, points_cam]) - points_cam.mean(axis=0)
    jacobian = np.concatenate([np.cross(points, gradients), gradients], axis=1)  # (2N, 6)
    normal = jacobian.T @ jacobian
    scale = np.sqrt(np.diag(normal)) + 1e-12
    covariance = np.linalg.pinv(normal / np.outer(scale, scale), hermitian=True)
    variance = float(np.trace((covariance / np.outer(scale, scale))[:3, :3]))
    return 1.0 / max(variance, 1e-12)


def _placed_by(look: _Look, cam_from_rig: Pose, body_from_board: Pose) -> NDArray[np.float64]:
    """Return where a view places its board's body in its camera's rig: (L, 3, 4)."""
    from_cam, from_body = invert(cam_from_rig), invert(body_from_board)
    return np.stack([compose(from_cam, compose(pose, from_body)) for pose in look.cam_from_board])


def _inverses(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.stack([invert(pose) for pose in poses])


def _products(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return every pose of (K, 3, 4) after every one of (L, 3, 4): (K L, 3, 4)."""
    return np.stack([compose(one, other) for one in first for other in second])


def solve_joint(
    first_from_near: NDArray[np.float64], second_from_far: NDArray[np.float64], length_m: float
) -> tuple[Pose, Pose] | None:
    """Find two cameras and two boards of one body where each camera only sees a board of its own.

    ``second_from_far @ far_from_near = second_from_first @ first_from_near`` at every moment:
    rotations by the Kronecker product, translations by least squares. Moments that disagree with
    the solution of all are left out, and it is found again.

    Parameters
    ----------
    first_from_near, second_from_far : (M, 3, 4) float64
        Where each camera saw its board.
    length_m : float
        The length that counts as much as a radian where moments are compared.

    Returns
    -------
    second_from_first, far_from_near : (3, 4) float64
        None where there are too few moments, where they turn the body about one axis only, or
        where they do not agree.
    """
    kept = np.ones(len(first_from_near), np.bool_)
    found = None
    for _ in range(5):
        if kept.sum() < _MIN_JOINT_MOMENTS:
            return None
        found = _solve_joint_of_all(first_from_near[kept], second_from_far[kept])
        if found is None:
            return None
        second_from_first, far_from_near = found
        misses = np.array(
            [
                pose_distances(
                    compose(second_from_first, near)[None],
                    compose(far, far_from_near)[None],
                    length_m,
                )[0, 0]
                for near, far in zip(first_from_near, second_from_far, strict=True)
            ]
        )
        median = float(np.median(misses))
        again = misses <= max(0.02, 3.0 * median)
        if (again == kept).all():
            break
        kept = again
    return found if median <= _DISAGREE / 2.0 else None


def _solve_joint_of_all(
    first_from_near: NDArray[np.float64], second_from_far: NDArray[np.float64]
) -> tuple[Pose, Pose] | None:
    # R2 W = Z R1, so vec(W) = (R1^T kron R2^T) vec(Z): with K the sum of R2 kron R1 over the
    # moments, Z and W are its first singular vectors (row-major vec).
    total = np.zeros((9, 9))
    for near, far in zip(first_from_near, second_from_far, strict=True):
        total += np.kron(far[:, :3], near[:, :3])
    u, singular, vt = np.linalg.svd(total)
    if singular[0] - singular[1] < _JOINT_GAP * singular[0]:
        return None
    z, w = u[:, 0].reshape(3, 3), vt[0].reshape(3, 3)
    sign = np.sign(np.linalg.det(z))
    rotation_z, rotation_w = _nearest_rotation(sign * z), _nearest_rotation(sign * w)
    # t2 + R2 t_w = Z t1 + t_z
    n = len(first_from_near)
    matrix, right = np.zeros((3 * n, 6)), np.zeros(3 * n)
    for row, (near, far) in enumerate(zip(first_from_near, second_from_far, strict=True)):
        here = slice(3 * row, 3 * row + 3)
        matrix[here, :3], matrix[here, 3:] = np.eye(3), -far[:, :3]
        right[here] = far[:, 3] - rotation_z @ near[:, 3]
    solution, _, _, values = np.linalg.lstsq(matrix, right, rcond=None)
    if values[-1] < np.sqrt(_JOINT_GAP) * values[0]:
        return None
    return (
        np.column_stack([rotation_z, solution[:3]]),
        np.column_stack([rotation_w, solution[3:]]),
    )


def _nearest_rotation(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    u, _, vt = np.linalg.svd(matrix)
    return np.asarray(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt)


# --- The whole --------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _Whole:
    """Cameras and boards that are all joined.

    Attributes
    ----------
    cam_from_rig : tuple of (3, 4) float64
        The rig's frame is that of the first camera.
    body_from_board : tuple of (3, 4) float64
        A body's frame is that of its first board.
    length_m : float
        The length that counts as much as a radian.
    """

    cam_from_rig: tuple[Pose, ...]
    body_from_board: tuple[Pose, ...]
    length_m: float

    @classmethod
    def of(cls, chain: _Chain) -> "_Whole":
        """Return what a chain of which all cameras are one part has found."""
        first_from_part = chain.cam_from_part[0]
        body_from_board = [np.eye(3, 4) for _ in chain.boards]
        for part in chain.board_parts:
            body_from_part = invert(chain.part_from_board[part[0]])
            for board in part:
                body_from_board[board] = compose(body_from_part, chain.part_from_board[board])
        return cls(
            tuple(compose(pose, invert(first_from_part)) for pose in chain.cam_from_part),
            tuple(body_from_board),
            chain.length_m,
        )

    def proposed(self, look: _Look) -> NDArray[np.float64]:
        """Return where a view places its body in the rig: (L, 3, 4)."""
        return _placed_by(look, self.cam_from_rig[look.camera], self.body_from_board[look.board])


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """A view, and how it suits the pose of its body.

    Attributes
    ----------
    look : _Look
        The view.
    turn : int
        The look of the board that suits the pose.
    missed_px, size_px : float
        By how far the pose misses it, rms, and how large the board is in the image.
    """

    look: _Look
    turn: int
    missed_px: float
    size_px: float


def _read_out(chain: _Chain, whole: _Whole, warnings: Sequence[str]) -> Linked:
    together: dict[PoseKey, list[_Look]] = {}
    for look in chain.looks:
        key = PoseKey(look.moment, chain.body_of(look.board))
        together.setdefault(key, []).append(look)
    rig_from_body: dict[PoseKey, Pose] = {}
    fits: dict[PoseKey, list[_Fit]] = {}
    for key, looks in sorted(together.items()):
        proposed = [whole.proposed(look) for look in looks]
        pose = _middle_pose(proposed, looks, whole.length_m)
        found = _fits(chain, whole, looks, proposed, pose)
        if any(fit.missed_px > _DOUBTFUL_SHARE * fit.size_px for fit in found):
            # A board whose tilt was taken for the other one that a plane allows fits its own image
            # only: the right pose fits all.
            trials = [
                (pose, _fits(chain, whole, looks, proposed, pose))
                for pose in np.concatenate(proposed)
            ]
            pose, found = min(trials, key=lambda trial: _total_share(trial[1]))
        rig_from_body[key], fits[key] = pose, found
    left_out = _disagreeing(chain, [fit for found in fits.values() for fit in found])
    kept = {key: [fit for fit in fits[key] if id(fit.look) not in left_out] for key in fits}
    keys = tuple(key for key in kept if kept[key])
    views = tuple(
        BundleView(
            camera=fit.look.camera,
            pose=index,
            board=fit.look.board,
            pixels=fit.look.pixels[chain.boards[fit.look.board].looks[fit.turn]],
            image=fit.look.image,
        )
        for index, key in enumerate(keys)
        for fit in kept[key]
    )
    return Linked(
        whole.cam_from_rig,
        whole.body_from_board,
        tuple(rig_from_body[key] for key in keys),
        views,
        keys,
        dict(left_out.values()),
        (*warnings, *_same_places(chain.cameras, whole)),
    )


def _middle_pose(
    proposed: Sequence[NDArray[np.float64]], looks: Sequence[_Look], length_m: float
) -> Pose:
    """Return the pose proposed by one view that is nearest to those of all, surer ones first."""
    surest = int(np.argmax([look.weight for look in looks]))
    everything = np.concatenate([proposed[surest], *proposed])
    misses = np.zeros(len(everything))
    for poses, look in zip(proposed, looks, strict=True):
        apart = pose_distances(everything, poses, length_m).min(axis=1)
        misses += look.weight * np.minimum(apart, _DISAGREE)
    return np.asarray(everything[int(np.argmin(misses))])


def _fits(
    chain: _Chain,
    whole: _Whole,
    looks: Sequence[_Look],
    proposed: Sequence[NDArray[np.float64]],
    rig_from_body: Pose,
) -> list[_Fit]:
    """Return how views suit a pose of their body, each by the look of its board that does."""
    found = []
    for look, poses in zip(looks, proposed, strict=True):
        turn = int(np.argmin(pose_distances(rig_from_body[None], poses, whole.length_m)[0]))
        board = chain.boards[look.board]
        pixels = look.pixels[board.looks[turn]]
        cam_from_board = compose(
            whole.cam_from_rig[look.camera],
            compose(rig_from_body, whole.body_from_board[look.board]),
        )
        missed_px = rms(_residuals(chain.cameras[look.camera], cam_from_board, board, pixels))
        found.append(_Fit(look, turn, missed_px, _size_px(pixels)))
    return found


def _total_share(fits: Sequence[_Fit]) -> float:
    """Return how badly a pose suits views: wrong ones count no more than just wrong."""
    return sum(min(fit.missed_px / fit.size_px, _LEFT_OUT_SHARE) for fit in fits)


def _size_px(pixels: NDArray[np.float64]) -> float:
    seen = pixels[is_seen(pixels)]
    return float(np.linalg.norm(seen.max(axis=0) - seen.min(axis=0)))


def _disagreeing(chain: _Chain, fits: Sequence[_Fit]) -> dict[int, tuple[str, str]]:
    """Return the views that miss what the others say: by id their name and the reason."""
    shares: dict[int, list[float]] = {}
    for fit in fits:
        shares.setdefault(fit.look.camera, []).append(fit.missed_px / fit.size_px)
    found = {}
    for fit in fits:
        look = fit.look
        limit = max(_LEFT_OUT_SHARE, _LEFT_OUT_MEDIANS * float(np.median(shares[look.camera])))
        if fit.missed_px > limit * fit.size_px:
            name, board = chain.cameras[look.camera].name, chain.boards[look.board].name
            found[id(look)] = (
                f"{name}: {look.image}: {board}",
                f"misses by {fit.missed_px:.0f} px where the other views see the board, which is "
                f"{fit.size_px:.0f} px large here",
            )
    return found


def _same_places(cameras: Sequence[Camera], whole: _Whole) -> tuple[str, ...]:
    warnings = []
    for one, other in combinations(range(len(cameras)), 2):
        pose, other_pose = whole.cam_from_rig[one], whole.cam_from_rig[other]
        if pose_distances(pose[None], other_pose[None], whole.length_m)[0, 0] < _SAME_PLACE:
            apart_m = np.linalg.norm(invert(pose)[:, 3] - invert(other_pose)[:, 3])
            warnings.append(
                f"cameras {cameras[one].name!r} and {cameras[other].name!r} stand in "
                f"one place ({apart_m * 1000:.2f} mm apart) and look the same way: is one "
                "recording listed twice?"
            )
    return tuple(warnings)


# --- What may be wrong with a recording -------------------------------------------------------


def _refuse_copies(boards: Sequence[NamedBoard], observations: Sequence[Observations]) -> list[str]:
    """Refuse two cameras whose corners are the same to the pixel; warn where they nearly are."""
    clips = [
        {(s.instant, s.board): s.pixels for s in seen.sightings if s.instant is not None}
        for seen in observations
    ]
    warnings = []
    for one, other in combinations(range(len(observations)), 2):
        common = clips[one].keys() & clips[other].keys()
        apart_px = [
            min(
                _largest_px(clips[one][key] - clips[other][key][look])
                for look in boards[key[1]].looks
            )
            for key in common
        ]
        apart_px = [px for px in apart_px if np.isfinite(px)]
        if not apart_px:
            continue
        names = f"cameras {observations[one].name!r} and {observations[other].name!r}"
        if max(apart_px) < _SAME_PICTURE_PX:
            raise CalibrationError(
                f"{names} show the same pictures: in {len(apart_px)} common views the corners are "
                "the same to the pixel; list each camera once, with its own files"
            )
        if np.median(apart_px) < _ALIKE_PX:
            warnings.append(
                f"the pictures of {names} are alike: in {len(apart_px)} common views the corners "
                f"are {np.median(apart_px):.2f} px apart at most (median); is one recording listed "
                "twice?"
            )
    return warnings


def _largest_px(apart: NDArray[np.float64]) -> float:
    """Return the largest of distances (N, 2); infinite where no point was seen twice."""
    both = is_seen(apart)
    return float(np.linalg.norm(apart[both], axis=1).max()) if both.any() else np.inf


def _refuse_exchanged(
    boards: Sequence[NamedBoard],
    lenses: Sequence[SolvedLens],
    observations: Sequence[Observations],
) -> list[str]:
    """Refuse stills and clips that cannot both have been recorded through one lens.

    Return warnings where they hardly can.
    """
    suspects: list[tuple[Camera, Observations, str, float]] = []
    warnings = []
    for lens, seen in zip(lenses, observations, strict=True):
        of_clip = _typical_error(boards, lens.camera, seen, "clip", lens.views)
        of_stills = _typical_error(boards, lens.camera, seen, "stills", lens.views)
        what, missed_px = ("clip", of_clip) if of_clip > of_stills else ("stills", of_stills)
        usual_px = min(of_clip, of_stills) or _CLIP_HOPELESS_PX  # 0: nothing to compare with
        if missed_px > max(_CLIP_LIMIT_PX, _CLIP_FACTOR * usual_px):
            suspects.append((lens.camera, seen, what, missed_px))
        if of_clip > max(_CLIP_LIMIT_PX, _CLIP_DOUBTFUL_FACTOR * usual_px):
            warnings.append(
                f"camera {seen.name!r}: the board clip misses its lens by {of_clip:.2f} px, its "
                f"stills by {of_stills:.2f} px; were both recorded with the same zoom and focus, "
                "and is the board the same, and flat?"
            )
    for (own, seen, what, px), (others, other, other_what, other_px) in combinations(suspects, 2):
        exchanged_px = _typical_error(boards, others, seen, what)
        other_exchanged_px = _typical_error(boards, own, other, other_what)
        if (
            what == other_what
            and exchanged_px < _EXPLAINS_SHARE * px
            and other_exchanged_px < _EXPLAINS_SHARE * other_px
        ):
            raise CalibrationError(
                f"the clips of {seen.name!r} and {other.name!r} seem to be exchanged, or their "
                f"stills: the {what} miss the lenses by {px:.2f} and {other_px:.2f} px, exchanged "
                f"by {exchanged_px:.2f} and {other_exchanged_px:.2f} px; name the clip of each "
                "camera beside its own stills"
            )
    for _, seen, what, missed_px in suspects:
        if missed_px > _CLIP_HOPELESS_PX:
            raise CalibrationError(
                f"camera {seen.name!r}: the board {what} misses its lens by {missed_px:.1f} px; "
                "were clip and stills recorded by this camera, with the same zoom, and is the "
                "board the same?"
            )
    return warnings


def _typical_error(
    boards: Sequence[NamedBoard],
    camera: Camera,
    seen: Observations,
    what: str,
    views: Mapping[tuple[str, int], Pose] | None = None,
) -> float:
    """Return how far a lens misses the boards of the clip or the stills, median of rms, pixels.

    0 where there are none, infinite where the lens is that of another image size. Views that were
    located need not be so again.
    """
    if (camera.width_px, camera.height_px) != tuple(seen.size_px):
        return np.inf
    sightings = sorted(
        (s for s in seen.sightings if (s.instant is None) == (what == "stills")),
        key=lambda s: (s.instant or 0, natural_order(s.image), boards[s.board].name),
    )
    count = min(len(sightings), _TYPICAL_VIEWS)
    chosen = np.linspace(0, len(sightings) - 1, count).round().astype(int)
    errors = []
    for sighting in (sightings[index] for index in chosen):
        board = boards[sighting.board]
        pose = (views or {}).get((sighting.image, sighting.board))
        if pose is not None:
            errors.append(rms(_residuals(camera, pose, board, sighting.pixels)))
            continue
        located = locate_board(camera, board.points_board, sighting.pixels)
        if located is not None:
            errors.append(located[1])
    return float(np.median(errors)) if errors else 0.0


def _not_linked(chain: _Chain) -> CalibrationError:
    """Return what to say of cameras that do not hang together."""
    names = [camera.name for camera in chain.cameras]
    parts = sorted(chain.camera_parts, key=lambda part: (-len(part), part))
    tried = {
        (first, second): join
        for kind, first, second, join in chain.candidates()
        if kind == "cameras"
    }
    # The surest pair of parts that see boards at once and yet could not be joined.
    for (first, second), join in sorted(tried.items(), key=lambda item: -item[1].weight):
        if not join.is_clear and join.common.error <= _DISAGREE:
            one, other = _surest_pair(chain, first, second)
            return CalibrationError(
                f"cameras {names[one]!r} and {names[other]!r}: their {len(join.moments)} common "
                "views of a board that looks the same when turned do not tell which way round they "
                "saw it; tilt and move the board more, let it lie still, or use one with an odd "
                "sum of columns and rows"
            )
    main = parts[0]
    for part in parts[1:]:
        key = (min(main, part), max(main, part))
        if key in tried:
            return _contradiction(chain, main, part, tried[key])
    groups = "; ".join(", ".join(repr(names[rank]) for rank in part) for part in parts)
    part = parts[1]
    lost = ", ".join(repr(names[rank]) for rank in part)
    others = " or ".join(repr(names[rank]) for rank in range(len(names)) if rank not in part)
    return CalibrationError(
        f"camera {lost} never sees the board at the same time as {others}: these hang together: "
        f"{groups}; {_what_to_record(chain, part)}"
    )


def _surest_pair(chain: _Chain, first: _Part, second: _Part) -> tuple[int, int]:
    """Return the cameras of two parts that share most moments."""

    def moments(camera: int) -> set[tuple[Moment, int]]:
        return {(look.moment, look.board) for look in chain.looks if look.camera == camera}

    pairs = [(len(moments(i) & moments(j)), -i, -j) for i in first for j in second]
    _, i, j = max(pairs)
    return -i, -j


def _what_to_record(chain: _Chain, part: _Part) -> str:
    """Name the missing edge: the pair across that came nearest to seeing a board at once."""
    names = [camera.name for camera in chain.cameras]
    instants: list[list[int]] = [[] for _ in names]
    for look in chain.looks:
        if look.moment.is_clip:
            instants[look.camera].append(look.moment.instant)
    blind = [rank for rank in part if not instants[rank]]
    if len(blind) == len(part):
        return (
            f"{names[part[0]]!r} sees no board in the clip that all cameras recorded, or too "
            "little of one; record the board where it and another camera see it at once"
        )
    gaps = [
        (abs(one - other), inside, outside)
        for inside in part
        for outside in range(len(names))
        if outside not in part
        for one in instants[inside]
        for other in instants[outside]
    ]
    if not gaps:
        return "no other camera sees a board in the clip; record the board where two see it at once"
    gap, inside, outside = min(gaps)
    nearest = (
        f"its nearest in time: {gap} frames between their views"
        if gap
        else "they see different boards at the same time; mounted on one body these would link them"
    )
    return (
        f"record the board where {names[inside]!r} and {names[outside]!r} ({nearest}) see it at "
        "once"
    )


def _contradiction(chain: _Chain, main: _Part, part: _Part, join: _Join) -> CalibrationError:
    """Return what to say of cameras whose common views share no relative pose."""
    names = [camera.name for camera in chain.cameras]
    lost = ", ".join(repr(names[rank]) for rank in part)
    others = ", ".join(repr(names[rank]) for rank in main)
    told = (
        f"{len(join.moments)} common views share no relative pose (they differ by "
        f"{join.common.error:.2f}, radians and shares of the board's distance)"
    )
    mirrored = _mirrored_error(chain, main, part)
    if mirrored is not None and mirrored < min(_DISAGREE, join.common.error) / 3.0:
        who = (
            f"camera {lost}: its picture seems to be mirrored, or those of all others"
            if len(main) > 1
            else f"the picture of camera {lost} or of {others} seems to be mirrored"
        )
        return CalibrationError(
            f"{who}: {told}, but flipped left to right it agrees to {mirrored:.3f}; record "
            "it unmirrored"
        )
    return CalibrationError(
        f"camera {lost} contradicts {others}: their {told}; were the clips recorded at the same "
        'time, frame by frame (sync = "estimate" if some are late), by these cameras, and of a '
        "board as it is described?"
    )


def _mirrored_error(chain: _Chain, main: _Part, part: _Part) -> float | None:
    """Return how far common views disagree if the pictures of a part are flipped in x."""
    best = None
    mirrors: list[Callable[[NamedBoard], NDArray[np.float64]]] = [_mirror_x, _mirror_y, _mirror_z]
    for mirror in mirrors:
        measured, weights = [], []
        for boards in chain.board_parts:
            seen = chain.placed(main, boards)
            for look in chain.looks:
                if look.camera not in part or look.board not in boards or len(part) > 1:
                    continue
                if look.moment not in seen:
                    continue
                flipped = np.stack(
                    [
                        _unmirrored(pose, mirror(chain.boards[look.board]))
                        for pose in look.cam_from_board
                    ]
                )
                from_part = invert(chain.part_from_board[look.board])
                in_camera = np.stack([compose(pose, from_part) for pose in flipped])
                measured.append(_products(in_camera, _inverses(seen[look.moment][0])))
                weights.append(look.weight)
        if len(measured) >= 3:
            error = common_pose(measured, np.array(weights), chain.length_m).error
            best = error if best is None else min(best, error)
    return best


def _unmirrored(cam_from_board: Pose, mirror: NDArray[np.float64]) -> Pose:
    """Return the pose that a mirrored picture hides; `mirror` (3, 4) maps the board onto itself."""
    rotation = _MIRROR_IMAGE @ cam_from_board[:, :3] @ mirror[:, :3]
    shift = _MIRROR_IMAGE @ (cam_from_board[:, :3] @ mirror[:, 3] + cam_from_board[:, 3])
    return np.column_stack([rotation, shift])


def _mirror_x(board: NamedBoard) -> NDArray[np.float64]:
    return np.column_stack([np.diag([-1.0, 1.0, 1.0]), board.center_board * [2.0, 0.0, 0.0]])


def _mirror_y(board: NamedBoard) -> NDArray[np.float64]:
    return np.column_stack([np.diag([1.0, -1.0, 1.0]), board.center_board * [0.0, 2.0, 0.0]])


def _mirror_z(board: NamedBoard) -> NDArray[np.float64]:
    """Return the mirror that leaves each point: markers name the points of a mirrored picture."""
    del board
    return np.column_stack([np.diag([1.0, 1.0, -1.0]), np.zeros(3)])
