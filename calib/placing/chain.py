"""Parts of cameras and of boards, and how they are joined, the surest join first.

This work is based on: Kruskal, *On the shortest spanning subtree of a graph*, Proc. AMS 7, 1956.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.boards.board import Board, Observations
from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.placing.looks import (
    DISAGREE,
    Look,
    SolvedLens,
    inverses,
    locate,
    placed_by,
    products,
)
from hybridve.calib.placing.moments import Body, Moment, body_of
from hybridve.calib.placing.never_met import solve_joint
from hybridve.calib.pose import Pose, compose, invert
from hybridve.calib.solving.consensus import CommonPose, common_pose, pose_distances

#: Another look of a symmetric board must fit worse by this factor and this margin.
_CLEAR_FACTOR = 3.0
_CLEAR_MARGIN = 0.05

#: Cameras, or boards, whose relative poses are known, as indices in order of name.
Part = tuple[int, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Join:
    """How two parts may be joined: ``second_from_first`` and what speaks for it."""

    common: CommonPose
    moments: tuple[Moment, ...]
    weight: float
    is_clear: bool

    @property
    def is_sound(self) -> bool:
        """Whether most of the common moments share the pose, and no other as well."""
        return self.common.error <= DISAGREE and self.is_clear


class Chain:
    """Cameras and boards, the parts they form so far, and what could join these.

    `cam_from_part` and `part_from_board` place each camera and board in its part.
    """

    def __init__(
        self,
        boards: Sequence[Board],
        cameras: Sequence[Camera],
        looks: Sequence[Look],
    ) -> None:
        self.boards = boards
        self.cameras = cameras
        self.looks = looks
        self.camera_parts: list[Part] = [(rank,) for rank in range(len(cameras))]
        self.board_parts: list[Part] = [(rank,) for rank in range(len(boards))]
        self.cam_from_part = [np.eye(3, 4) for _ in cameras]
        self.part_from_board = [np.eye(3, 4) for _ in boards]
        self._placed: dict[tuple[Part, Part], dict[Moment, tuple[NDArray[np.float64], float]]] = {}
        self._joins: dict[tuple[str, Part, Part, tuple[Part, ...]], Join | None] = {}
        distances = [float(np.linalg.norm(look.cam_from_board[0][:, 3])) for look in looks]
        self.length_m = float(np.median(distances)) if distances else 1.0

    @classmethod
    def of(
        cls,
        boards: Sequence[Board],
        lenses: Sequence[SolvedLens],
        observations: Sequence[Observations],
        is_labelled: bool,
    ) -> "Chain":
        """Locate all views and put them in order."""
        looks: dict[tuple[Moment, int, int], Look] = {}
        for camera, (lens, seen) in enumerate(zip(lenses, observations, strict=True)):
            for sighting in seen.sightings:
                look = locate(boards, lens, camera, sighting, is_labelled)
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

    def candidates(self) -> list[tuple[str, Part, Part, Join]]:
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
        self, cameras: Part, boards: Part
    ) -> dict[Moment, tuple[NDArray[np.float64], float]]:
        """Return where a part of cameras saw a part of boards: by moment poses and their weight.

        The poses (K, 3, 4), cameras_from_boards, are those that a symmetric board leaves open.
        """
        key = (cameras, boards)
        if key not in self._placed:
            by_moment: dict[Moment, list[Look]] = {}
            for look in self.looks:
                if look.camera in cameras and look.board in boards:
                    by_moment.setdefault(look.moment, []).append(look)
            self._placed[key] = {
                moment: (self._agreed(looks), sum(look.weight for look in looks))
                for moment, looks in by_moment.items()
            }
        return self._placed[key]

    def in_part(self, look: Look) -> NDArray[np.float64]:
        """Return where a view places its board's part in its camera's part: (L, 3, 4)."""
        return placed_by(look, self.cam_from_part[look.camera], self.part_from_board[look.board])

    def _agreed(self, looks: Sequence[Look]) -> NDArray[np.float64]:
        """Return the poses of the surest view that the others at this moment agree with."""
        surest = max(looks, key=lambda look: look.weight)
        poses = self.in_part(surest)
        if len(looks) == 1 or len(poses) == 1:
            return poses
        misses = np.zeros(len(poses))
        for look in looks:
            if look is not surest:
                misses += pose_distances(poses, self.in_part(look), self.length_m).min(axis=1)
        return np.asarray(poses[misses <= misses.min() + DISAGREE])

    def _join_of_cameras(self, first: Part, second: Part) -> Join | None:
        measured, weights, moments = [], [], []
        for boards in sorted(self.board_parts):
            one, other = self.placed(first, boards), self.placed(second, boards)
            for moment in sorted(one.keys() & other.keys()):
                (from_first, sure), (from_second, as_sure) = one[moment], other[moment]
                if len(boards) == 1 and len(from_first) == len(from_second):
                    from_first = from_first[:1]  # turning the board for both changes nothing
                measured.append(products(from_second, inverses(from_first)))
                weights.append(1.0 / (1.0 / sure + 1.0 / as_sure))
                moments.append(moment)
        return self._common(measured, weights, moments, must_be_clear=True)

    def _join_of_boards(self, first: Part, second: Part) -> Join | None:
        measured, weights, moments = [], [], []
        for cameras in sorted(self.camera_parts):
            one, other = self.placed(cameras, first), self.placed(cameras, second)
            for moment in sorted(one.keys() & other.keys()):
                (from_first, sure), (from_second, as_sure) = one[moment], other[moment]
                measured.append(products(inverses(from_second), from_first))
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
    ) -> Join | None:
        if not measured:
            return None
        counted = np.array(weights)
        common = common_pose(measured, counted, self.length_m)
        is_open = must_be_clear and any(len(poses) > 1 for poses in measured)
        is_clear = not is_open or (
            common.rival_error > _CLEAR_FACTOR * common.error + _CLEAR_MARGIN
        )
        return Join(common, tuple(moments), float(counted[common.agrees].sum()), is_clear)

    def _join(self, kind: str, first: Part, second: Part, second_from_first: Pose) -> None:
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
        best: tuple[float, Part, Part, Part, Part, Pose, Pose] | None = None
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
