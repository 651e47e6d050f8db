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

Parts are joined in `hybridve.calib.placing.chain`; what may be wrong with a recording is asked in
`hybridve.calib.placing.recording_faults` before, and in `hybridve.calib.placing.not_linked` after.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.boards.board import Board, Observations, is_seen
from hybridve.calib.camera import Camera
from hybridve.calib.placing.chain import Chain
from hybridve.calib.placing.looks import (
    DISAGREE,
    Look,
    SolvedLens,
    corner_residuals,
    placed_by,
)
from hybridve.calib.placing.moments import PoseKey
from hybridve.calib.placing.not_linked import explain_not_linked
from hybridve.calib.placing.recording_faults import refuse_copies, refuse_exchanged
from hybridve.calib.pose import Pose, compose, invert
from hybridve.calib.solving.bundle import BundleView
from hybridve.calib.solving.consensus import pose_distances
from hybridve.calib.solving.locate import rms

#: A view is left out where it misses the place that the others give its board by this share of the
#: board's size in the image, and by so many times what its camera misses by in the median. From a
#: smaller share on it is asked whether another view places the board better.
_LEFT_OUT_SHARE = 0.1
_DOUBTFUL_SHARE = 0.02
_LEFT_OUT_MEDIANS = 5.0

#: Cameras nearer than this (shares of the board's distance, radians) stand in one place.
_SAME_PLACE = 1e-3


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


def link_cameras(
    boards: Sequence[Board],
    lenses: Sequence[SolvedLens],
    observations: Sequence[Observations],
    is_labelled: bool,
) -> Linked:
    """Chain cameras, and the boards of bodies, by what they saw at the same time.

    Parameters
    ----------
    boards : sequence of Board
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
    warnings = refuse_copies(boards, observations)
    warnings += refuse_exchanged(boards, lenses, observations)
    chain = Chain.of(boards, lenses, observations, is_labelled)
    chain.join_all()
    if len(chain.camera_parts) > 1:
        raise explain_not_linked(chain)
    chain.require_whole_bodies()
    return _read_out(chain, _Whole.of(chain), warnings)


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
    def of(cls, chain: Chain) -> "_Whole":
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

    def proposed(self, look: Look) -> NDArray[np.float64]:
        """Return where a view places its body in the rig: (L, 3, 4)."""
        return placed_by(look, self.cam_from_rig[look.camera], self.body_from_board[look.board])


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """A view, and how it suits the pose of its body.

    Attributes
    ----------
    look : Look
        The view.
    turn : int
        The look of the board that suits the pose.
    missed_px, size_px : float
        By how far the pose misses it, rms, and how large the board is in the image.
    """

    look: Look
    turn: int
    missed_px: float
    size_px: float


def _read_out(chain: Chain, whole: _Whole, warnings: Sequence[str]) -> Linked:
    together: dict[PoseKey, list[Look]] = {}
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
    proposed: Sequence[NDArray[np.float64]], looks: Sequence[Look], length_m: float
) -> Pose:
    """Return the pose proposed by one view that is nearest to those of all, surer ones first."""
    surest = int(np.argmax([look.weight for look in looks]))
    everything = np.concatenate([proposed[surest], *proposed])
    misses = np.zeros(len(everything))
    for poses, look in zip(proposed, looks, strict=True):
        apart = pose_distances(everything, poses, length_m).min(axis=1)
        misses += look.weight * np.minimum(apart, DISAGREE)
    return np.asarray(everything[int(np.argmin(misses))])


def _fits(
    chain: Chain,
    whole: _Whole,
    looks: Sequence[Look],
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
        missed_px = rms(corner_residuals(chain.cameras[look.camera], cam_from_board, board, pixels))
        found.append(_Fit(look, turn, missed_px, _size_px(pixels)))
    return found


def _total_share(fits: Sequence[_Fit]) -> float:
    """Return how badly a pose suits views: wrong ones count no more than just wrong."""
    return sum(min(fit.missed_px / fit.size_px, _LEFT_OUT_SHARE) for fit in fits)


def _size_px(pixels: NDArray[np.float64]) -> float:
    seen = pixels[is_seen(pixels)]
    return float(np.linalg.norm(seen.max(axis=0) - seen.min(axis=0)))


def _disagreeing(chain: Chain, fits: Sequence[_Fit]) -> dict[int, tuple[str, str]]:
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
