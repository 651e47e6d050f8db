"""The cameras of a rig and what they saw: whether some of them agree with the rig."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.boards.board import Board, Observations, Sighting
from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.image_io import natural_order
from hybridve.calib.judging.common_views import View, largest_group, listed_alike, locate_common
from hybridve.calib.judging.comparison import (
    LEAST_NOISE_PX,
    Comparison,
    chance_of,
    root_of,
    variance_of,
)
from hybridve.calib.judging.turns import ListedView, Turns, judge_turns
from hybridve.calib.pose import Pose, compose, invert, transform
from hybridve.calib.rig import Rig
from hybridve.calib.solving.bundle import POSE
from hybridve.calib.solving.consensus import common_pose
from hybridve.calib.solving.locate import board_residuals, rms
from hybridve.calib.solving.placement import (
    Placed,
    Views,
    information_of,
    place_boards,
    residuals_of,
)

#: Boards contradict a rig that has no covariance if it misses their corners by more than this share
#: of the image's width.
REPROJECTION_TOLERANCE = 0.01

#: With a covariance: a rig is accused if what it shows happens in less than this share of rigs
#: that have not been touched; each camera's part in it alone, or all of it together. Every rig is
#: tested in every session that uses it, so that good ones must hardly ever be accused; a camera
#: moved by 5 mm and 0.3 degrees at 2 m shows by less than 1 in 10^17 all the same. What chance
#: does to the rest of a rig that is known to be wrong must not hide who was moved, either.
SIGNIFICANCE = 1e-4

#: Without a covariance, a camera is named though another could be it too, where the others miss by
#: so many times less without it.
CLEAR_FACTOR = 3.0

#: Cameras nearer to one another than this share of their distance from the boards tell no scale.
_LEAST_BASELINE = 0.01

#: A corner that misses by more than both is an outlier, if not more than a share of its view are.
_OUTLIER_SIGMAS = 6.0
_OUTLIER_PX = 3.0
_OUTLIER_SHARE = 0.1

#: Points that miss by more than this, and by so many times what a camera alone misses, weigh less.
_LEAST_LOSS_PX = 2.0
_LOSS_ALONE = 3.0

#: Cameras let free that miss by more than so many times what each alone does are not yet placed.
_CLOSE_FACTOR = 1.5

#: Points of a view from which it is told which camera places its board best, about.
_PROPOSAL_POINTS = 12


class NotTestableError(CalibrationError):
    """Nothing was seen by which a rig could be tested: it is neither right nor wrong."""


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """What was found of some of the cameras: whether they agree with the rig, and how far."""

    cameras: tuple[int, ...]
    placed: Placed  # boards in the rig's world, by these cameras, at the scale found
    today: Placed  # these cameras anew, in a world of their own, at true scale
    rms_px: dict[int, float]
    statistic: float  # squared disagreement with the rig, in units of its variance
    alone: dict[int, float]  # the same with one camera let free
    p_value: float
    log_scale: float  # by boards and covariance together
    log_scale_sigma: float
    agrees: bool


class Case:
    """Cameras of a rig, in order of name, and what they saw."""

    def __init__(
        self,
        rig: Rig,
        boards: Sequence[Board],
        views: Sequence[View],
        untested: Sequence[str],
    ) -> None:
        self.views = views
        self.boards = boards
        names = sorted({view.camera for view in views}, key=natural_order)
        self.rig = rig.only(names)
        self.untested = tuple(untested)
        moments = sorted({view.moment for view in views})
        self.moments = moments
        place_of = {moment: number for number, moment in enumerate(moments)}
        camera_of = {name: index for index, name in enumerate(names)}
        n_points = max(len(view.pixels) for view in views)
        points = np.zeros((len(views), n_points, 3))
        pixels = np.full((len(views), n_points, 2), np.nan)
        for number, view in enumerate(views):
            board = boards[view.moment[1]]
            points[number, : len(view.pixels)] = board.points_board - board.center_board
            pixels[number, : len(view.pixels)] = view.pixels
        self.table = Views(
            np.array([camera_of[view.camera] for view in views], np.intp),
            np.array([place_of[view.moment] for view in views], np.intp),
            points,
            pixels,
        )
        alone = [
            rms(board_residuals(self.rig[view.camera], view.cam_from_board, corners, view.pixels))
            for view in views
            for corners in [boards[view.moment[1]].points_board]
        ]
        self.alone_px = float(np.median(alone))
        self.loss_px = max(_LEAST_LOSS_PX, _LOSS_ALONE * self.alone_px)
        # Boards are placed by their middles: a turn about it moves the corners least.
        self.cam_from_middle = np.array(
            [
                np.column_stack(
                    [
                        view.cam_from_board[:, :3],
                        transform(view.cam_from_board, boards[view.moment[1]].center_board[None])[
                            0
                        ],
                    ]
                )
                for view in views
            ]
        )
        self.limits_px = np.array(
            [REPROJECTION_TOLERANCE * camera.width_px for camera in self.rig.cameras]
        )
        self.together = self._together()
        self.scale_of_pair = self._scales_of_pairs()
        self.tells_scale = bool(self.scale_of_pair)

    @classmethod
    def of(
        cls, rig: Rig, boards: Sequence[Board], sightings: Mapping[str, Sequence[Sighting]]
    ) -> "Case":
        """Locate what was seen, and list symmetric boards alike."""
        found, seeing = locate_common(rig, boards, sightings)
        if not found:
            told = f"{len(seeing)} of its cameras see the board, expected two or more"
            if len(seeing) > 1:
                told = "no two of its cameras see the board at the same time"
            raise NotTestableError(
                f"the rig cannot be checked: {told} (rig: "
                f"{', '.join(camera.name for camera in rig.cameras)}; board: "
                f"{', '.join(seeing) or 'none'})"
            )
        group = largest_group(found)
        views = [
            view
            for moment, together in sorted(found.items())
            if together[0].camera in group
            for view in listed_alike(rig, together, boards[moment[1]])
        ]
        tested = {view.camera for view in views}
        untested = [camera.name for camera in rig.cameras if camera.name not in tested]
        return cls(rig, boards, views, untested)

    @property
    def names(self) -> list[str]:
        """The cameras' names."""
        return [camera.name for camera in self.rig.cameras]

    def _together(self) -> dict[tuple[int, int], list[tuple[int, int]]]:
        """Return for each two cameras their views of one placement: pairs of numbers."""
        by_place: dict[int, list[int]] = {}
        for number, place in enumerate(self.table.place):
            by_place.setdefault(int(place), []).append(number)
        found: dict[tuple[int, int], list[tuple[int, int]]] = {}
        for numbers in by_place.values():
            for a, b in combinations(sorted(numbers, key=lambda n: int(self.table.camera[n])), 2):
                pair = (int(self.table.camera[a]), int(self.table.camera[b]))
                found.setdefault(pair, []).append((a, b))
        return found

    def _scales_of_pairs(self) -> dict[tuple[int, int], float]:
        centers = self.rig.centers_world
        own = [invert(pose)[:, 3] for pose in self.cam_from_middle]
        distance_m = float(np.median(np.linalg.norm(self.cam_from_middle[:, :, 3], axis=1)))
        scales = {}
        for (i, j), shared in sorted(self.together.items()):
            by_board = float(np.median([np.linalg.norm(own[a] - own[b]) for a, b in shared]))
            in_rig = float(np.linalg.norm(centers[i] - centers[j]))
            if by_board > _LEAST_BASELINE * distance_m and in_rig > 0:
                scales[i, j] = in_rig / by_board
        return scales

    def drop_outliers(self, state: State) -> bool:
        """Forget single points that miss although cameras may stand anywhere; tell if any did."""
        missed = np.linalg.norm(residuals_of(self.table, state.today), axis=2)
        sigma_px = 1.4826 / np.sqrt(2.0) * float(np.nanmedian(missed))
        with np.errstate(invalid="ignore"):
            outliers = missed > max(_OUTLIER_SIGMAS * sigma_px, _OUTLIER_PX)
        outliers &= (outliers.sum(axis=1) <= _OUTLIER_SHARE * self.table.seen.sum(axis=1))[:, None]
        if outliers.any():
            pixels = np.where(outliers[..., None], np.nan, self.table.pixels)
            self.table = replace(self.table, pixels=pixels)
        return bool(outliers.any())

    def state_of(self, cameras: tuple[int, ...], before: State | None = None) -> State:
        """Return what the boards that some cameras saw together say of these."""
        chosen = np.isin(self.table.camera, cameras)
        counts = np.bincount(self.table.place[chosen], minlength=len(self.moments))
        chosen &= counts[self.table.place] > 1
        views, poses = self.table.of(chosen), self.cam_from_middle[chosen]
        scales = [scale for pair, scale in self.scale_of_pair.items() if set(pair) <= set(cameras)]
        stated = self.rig.cameras
        if not chosen.any():  # no two of them saw one board
            return self._apart(cameras)
        scale = float(np.median(scales)) if scales else 1.0
        start = placed_by(stated, views, poses, len(self.moments), scale)
        placed = place_boards(views, start, scaled=self.tells_scale)
        residuals = residuals_of(views, placed)
        rms_px = {index: rms(residuals[views.camera == index]) for index in cameras}
        today = self._today(cameras, views, poses, placed if before is None else before.today)
        return self._compared(cameras, views, placed, today, rms_px)

    def _today(
        self,
        cameras: tuple[int, ...],
        views: Views,
        poses: NDArray[np.float64],
        start: Placed,
    ) -> Placed:
        """Return cameras and boards anew, at true scale, in a world of their own.

        They start where they were found before; if that leaves more than each camera alone does,
        then where closed forms have them.
        """
        starts = [_rescaled(start)]
        loss_px = self.loss_px
        best = place_boards(views, starts[0], cameras[1:], scaled=False, loss_px=loss_px)
        left_px = _typical_px(residuals_of(views, best))
        if left_px > _CLOSE_FACTOR * self.alone_px + LEAST_NOISE_PX:
            chained = self._chained(cameras, views, poses)
            other = place_boards(views, chained, cameras[1:], scaled=False, loss_px=loss_px)
            if _typical_px(residuals_of(views, other)) < left_px:
                best = other
        return best

    def _chained(
        self, cameras: tuple[int, ...], views: Views, poses: NDArray[np.float64]
    ) -> Placed:
        """Return cameras, each placed by the one with which it saw most, and their boards."""
        stated = list(self.rig.cameras)
        found = {cameras[0]: np.eye(3, 4)}
        length_m = float(np.median(np.linalg.norm(poses[:, :, 3], axis=1)))
        while True:
            shared = {
                pair: numbers
                for pair, numbers in self.together.items()
                if set(pair) <= set(cameras) and (pair[0] in found) != (pair[1] in found)
            }
            if not shared:
                break
            pair = max(shared, key=lambda pair: (len(shared[pair]), pair))
            measured = [
                compose(self.cam_from_middle[b], invert(self.cam_from_middle[a]))[None]
                for a, b in shared[pair]
            ]
            second_from_first = common_pose(measured, np.ones(len(measured)), length_m).pose
            if pair[0] in found:
                found[pair[1]] = compose(second_from_first, found[pair[0]])
            else:
                found[pair[0]] = compose(invert(second_from_first), found[pair[1]])
        for index, pose in found.items():
            stated[index] = replace(stated[index], cam_from_world=pose)
        return placed_by(stated, views, poses, len(self.moments), 1.0)

    def _compared(
        self,
        cameras: tuple[int, ...],
        views: Views,
        placed: Placed,
        today: Placed,
        rms_px: dict[int, float],
    ) -> State:
        """Return how far cameras as the boards show them are from where the rig has them."""
        information, gradient, spans = information_of(views, today)
        variance = variance_of(views, residuals_of(views, today), cameras)
        covariance = self.rig.covariance
        comparison = Comparison(
            self.rig.cameras,
            today.cameras,
            cameras,
            spans,
            information / variance,
            gradient / variance,
            np.zeros((len(information), 0)) if covariance is None else root_of(covariance.matrix),
        )
        least = comparison.disagreement(cameras).cost
        whole = comparison.disagreement(())
        statistic = max(whole.cost - least, 0.0)
        alone = {
            index: max(comparison.disagreement((index,)).cost - least, 0.0) for index in cameras
        }
        n_cameras = len(cameras)
        p_value = chance_of(statistic, POSE * n_cameras - POSE - 1)
        p_alone = {i: chance_of(max(statistic - alone[i], 0.0), POSE) for i in cameras}
        if n_cameras > 2:  # the whole, and each camera: the least of these probabilities
            p_value = min(1.0, 2.0 * p_value, 2.0 * n_cameras * min(p_alone.values()))
        within = all(rms_px[index] <= self.limits_px[index] for index in cameras)
        return State(
            cameras,
            placed,
            today,
            rms_px,
            statistic,
            alone,
            p_value,
            whole.log_scale,
            whole.log_scale_sigma,
            within if covariance is None else p_value >= SIGNIFICANCE,
        )

    def _apart(self, cameras: tuple[int, ...]) -> State:
        """Return the state of cameras that saw nothing together: they cannot agree."""
        boards = np.tile(np.eye(3, 4), (len(self.moments), 1, 1))
        placed = Placed(self.rig.cameras, boards, 1.0)
        nothing = dict.fromkeys(cameras, 0.0)
        return State(cameras, placed, placed, nothing, 0.0, nothing, 0.0, 0.0, np.inf, agrees=False)

    def turns(self, placed: Placed, observations: Mapping[str, Observations]) -> Turns:
        """Return which cameras are turned about a board that looks the same then."""
        place_of = {moment: number for number, moment in enumerate(self.moments)}
        camera_of = {name: index for index, name in enumerate(self.names)}
        views = [
            ListedView(camera_of[view.camera], place_of[view.moment], view.moment[1], view.look)
            for view in self.views
        ]
        around = {camera_of[name]: seen for name, seen in observations.items() if name in camera_of}
        return judge_turns(self.boards, placed, views, self.limits_px, around)

    def worst_miss(self) -> float:
        """Return the largest miss of a camera, in shares of what is allowed."""
        scale = float(np.median(list(self.scale_of_pair.values()))) if self.tells_scale else 1.0
        start = placed_by(
            self.rig.cameras, self.table, self.cam_from_middle, len(self.moments), scale
        )
        residuals = residuals_of(
            self.table, place_boards(self.table, start, scaled=self.tells_scale)
        )
        return max(
            rms(residuals[self.table.camera == index]) / float(limit_px)
            for index, limit_px in enumerate(self.limits_px)
        )


def placed_by(
    cameras: Sequence[Camera],
    views: Views,
    cam_from_board: NDArray[np.float64],
    n_places: int,
    scale: float,
) -> Placed:
    """Place each board where the one of its cameras has it with which the others agree best."""
    boards = np.tile(np.eye(3, 4), (n_places, 1, 1))
    best = np.full(n_places, np.inf)
    proposed = np.zeros((len(cam_from_board), 3, 4))
    for number, (pose, index) in enumerate(zip(cam_from_board, views.camera, strict=True)):
        at_scale = np.column_stack([pose[:, :3], scale * pose[:, 3]])
        proposed[number] = compose(invert(cameras[index].cam_from_world), at_scale)
    # The n-th view of each placement proposes, for all placements at once.
    rank = np.zeros(len(proposed), np.intp)
    n_before = np.zeros(n_places, np.intp)
    for number, place in enumerate(views.place):
        rank[number] = n_before[place]
        n_before[place] += 1
    some = views.seen
    thin = np.zeros_like(some)
    thin[:, :: max(1, some.shape[1] // _PROPOSAL_POINTS)] = True
    pixels = np.where((some & thin)[..., None], views.pixels, np.nan)
    few = Views(views.camera, views.place, views.points, pixels)
    for turn in range(int(n_before.max(initial=0))):
        trial = boards.copy()
        trial[views.place[rank == turn]] = proposed[rank == turn]
        missed = residuals_of(few, Placed(tuple(cameras), trial, scale))
        lengths = np.sqrt(np.nansum(missed**2, axis=2)).sum(axis=1)
        totals = np.bincount(views.place, weights=lengths, minlength=n_places)
        better = (totals < best) & (n_before > turn)
        boards[better], best[better] = trial[better], totals[better]
    return Placed(tuple(cameras), boards, scale)


def _rescaled(placed: Placed) -> Placed:
    """Return the same in a world in which the boards have their true size."""

    def shrunk(pose: Pose) -> Pose:
        return np.column_stack([pose[:, :3], pose[:, 3] / placed.scale])

    boards = np.concatenate([placed.boards[:, :, :3], placed.boards[:, :, 3:] / placed.scale], 2)
    cameras = tuple(
        replace(camera, cam_from_world=shrunk(camera.cam_from_world)) for camera in placed.cameras
    )
    return Placed(cameras, boards, 1.0)


def _typical_px(residuals: NDArray[np.float64]) -> float:
    """Return the median over views of the root mean square miss, pixels."""
    return float(np.median(np.sqrt(np.nanmean((residuals**2).sum(axis=2), axis=1))))
