"""Whether a rig agrees with pictures of boards that several of its cameras saw at once.

Boards of known squares tell the scale of a rig. Calibrated from the boards anew, with its lenses as
they are, the rig shows which cameras stand elsewhere than it says: the two are compared up to what
boards cannot tell (where the world is, and the rig's scale), in the metric of what the boards tell
about the cameras. Cameras are set aside one by one, each time the one without which the others
agree best, until the rest agrees.

Where the rig knows its own errors (its covariance), these and the noise of the corners say how
large a disagreement may be; else fixed tolerances do.

Cameras that agree may still be turned about a board that looks the same when turned
(`hybridve.calib.judging.turns`). A rig of which that cannot be told is neither trustworthy nor
refuted.

This work is based on: Koch, *Parameter estimation and hypothesis testing in linear models*, 2nd
ed., 1999 (section 4.5, tests for single shifts).
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.boards.board import Board, Observations, Sighting, is_seen
from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.image_io import natural_order
from hybridve.calib.judging.comparison import (
    LEAST_NOISE_PX,
    Comparison,
    chance_of,
    root_of,
    variance_of,
)
from hybridve.calib.judging.turns import ListedView, Turns, judge_turns
from hybridve.calib.judging.twins import find_twins, twins_text
from hybridve.calib.pose import Pose, angle_between, compose, invert, transform
from hybridve.calib.rig import Rig
from hybridve.calib.solving.bundle import POSE
from hybridve.calib.solving.consensus import common_pose
from hybridve.calib.solving.lens_fit import board_residuals, locate_board, rms
from hybridve.calib.solving.placement import (
    Placed,
    Views,
    information_of,
    place_boards,
    residuals_of,
)
from hybridve.calib.verdict import Moved, RigCheck

#: Boards contradict a rig that has no covariance beyond these: the rig's scale by more than 5 %
#: (independent careful calibrations of one recording differ by up to 4 %), or its corners by more
#: than 1 % of the image's width.
SCALE_TOLERANCE = 0.05
REPROJECTION_TOLERANCE = 0.01

#: So do images that, each camera for itself, show a focal length that differs by more than this
#: share, and by so many standard deviations.
ZOOM_TOLERANCE = 0.05
_ZOOM_SIGMAS = 4.0

#: With a covariance: a rig is accused if what it shows happens in less than this share of rigs
#: that have not been touched; each camera's part in it alone, or all of it together. Every rig is
#: tested in every session that uses it, so that good ones must hardly ever be accused; a camera
#: moved by 5 mm and 0.3 degrees at 2 m shows by less than 1 in 10^17 all the same. What chance
#: does to the rest of a rig that is known to be wrong must not hide who was moved, either.
SIGNIFICANCE = 1e-4

#: The squares of a board are known to this share, by a ruler: a smaller scale is told, not blamed.
_SQUARES_KNOWN = 0.005

#: Two cameras whose guilt differs by less than this (log odds, doubled) are both named.
_CLEAR_ODDS = 9.0

#: Without a covariance, a camera is named though another could be it too, where the others miss by
#: so many times less without it.
_CLEAR_FACTOR = 3.0

#: Cameras nearer to one another than this share of their distance from the boards tell no scale.
_LEAST_BASELINE = 0.01

#: Placements that are used of each two cameras, at least if there are as many: more change nothing.
_PAIR_PLACEMENTS = 40

#: A corner that misses by more than both is an outlier, if not more than a share of its view are.
_OUTLIER_SIGMAS = 6.0
_OUTLIER_PX = 3.0
_OUTLIER_SHARE = 0.1

#: Points that miss by more than this, and by so many times what a camera alone misses, weigh less.
_LEAST_LOSS_PX = 2.0
_LOSS_ALONE = 3.0

#: Cameras let free that miss by more than so many times what each alone does are not yet placed.
_CLOSE_FACTOR = 1.5

#: Two cameras are tried in each other's place where the rig misses by more than so many times
#: REPROJECTION_TOLERANCE, on so many placements.
_EXCHANGE_TOLERANCES = 3.0
_EXCHANGE_PLACEMENTS = 6

#: With more pairs of cameras than this, only those that are accused are tried.
_MAX_EXCHANGES = 28

#: Points of a view from which it is told which camera places its board best, about.
_PROPOSAL_POINTS = 12

#: A focal length explains a camera where it leaves less than this share of what another pose does.
_EXPLAINS = 0.5


class NotTestableError(CalibrationError):
    """Nothing was seen by which a rig could be tested: it is neither right nor wrong."""


def check_rig(rig: Rig, boards: Sequence[Board], observations: Sequence[Observations]) -> RigCheck:
    """Check a rig against boards that several of its cameras saw at once.

    Each board at each moment is placed in the rig's world by position and orientation, all at one
    scale, so that its corners are reprojected best: the scale tells the rig's, what remains tells
    whether the cameras agree with one another. Which way round a symmetric board was seen follows
    from the rig.

    Parameters
    ----------
    rig : Rig
        The rig to be checked. Cameras that are mounted on trackers are not tested.
    boards : sequence of Board
        The boards, with their true squares; `Sighting.board` counts them.
    observations : sequence of Observations
        What cameras saw of them; what was seen at no common instant is not used. Their pictures of
        a clip in which boards lie still tell whether cameras are turned about one.

    Raises
    ------
    NotTestableError
        If fewer than two cameras of the rig see a board at once.
    CalibrationError
        If a lens cannot have seen what its camera did.
    """
    sightings = {seen.name: seen.sightings for seen in observations}
    case = _Case.of(rig, boards, sightings)
    found = case.examine()
    exchanged = None
    if not found.agrees and case.misses_far(found):
        for first, second in case.exchangeable(found):
            other = _Case.of(rig, boards, _exchange(sightings, first, second)).examine()
            if other.agrees:
                found, exchanged = other, (first, second)
                break
    turns = Turns({}, (), ())
    if found.agrees and exchanged is None:
        turns = found.case.turns(found.kept.placed, {seen.name: seen for seen in observations})
    return _read_out(found, boards, exchanged, turns, find_twins(rig))


def _exchange(
    sightings: Mapping[str, Sequence[Sighting]], first: str, second: str
) -> dict[str, Sequence[Sighting]]:
    exchanged = dict(sightings)
    exchanged[first], exchanged[second] = sightings[second], sightings[first]
    return exchanged


# --- What was seen ----------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _View:
    """One board in one image: where it lies as this camera alone sees it."""

    camera: str
    moment: tuple[int, int]  # instant and board
    pixels: NDArray[np.float64]
    cam_from_board: Pose
    look: int = 0  # in which the list is read that was found


def _located(
    rig: Rig, boards: Sequence[Board], sightings: Mapping[str, Sequence[Sighting]]
) -> tuple[dict[tuple[int, int], list[_View]], list[str]]:
    """Return by moment the views of two cameras or more, and the cameras that see a board."""
    known = {camera.name for camera in rig.cameras if camera.name not in rig.mounts}
    seen: dict[tuple[int, int], dict[str, NDArray[np.float64]]] = {}
    for name in sorted(known & set(sightings), key=natural_order):
        for sighting in sightings[name]:
            if sighting.instant is not None and is_seen(sighting.pixels).sum() >= 4:
                seen.setdefault((sighting.instant, sighting.board), {})[name] = sighting.pixels
    seeing = sorted({name for views in seen.values() for name in views}, key=natural_order)
    found: dict[tuple[int, int], list[_View]] = {}
    failed: Counter[str] = Counter()
    n_views: Counter[str] = Counter()
    for moment in _enough(seen):
        board = boards[moment[1]]
        views = []
        for name, pixels in seen[moment].items():
            n_views[name] += 1
            located = locate_board(rig[name], board.points_board, pixels, refine=False)
            if located is None:
                failed[name] += 1
            else:
                views.append(_View(name, moment, pixels, located[0]))
        if len(views) > 1:
            found[moment] = views
    for name, count in n_views.items():
        if failed[name] == count:
            raise CalibrationError(
                f"camera {name!r}: its lens cannot have seen the board's corners; "
                "check the image size and the unit of its parameters"
            )
    return found, seeing


def _enough(
    seen: Mapping[tuple[int, int], Mapping[str, NDArray[np.float64]]],
) -> list[tuple[int, int]]:
    """Return moments from which each two cameras are compared often enough, spread over all."""
    moments = sorted(moment for moment, views in seen.items() if len(views) > 1)
    used: Counter[tuple[str, str]] = Counter()
    chosen = []
    # By the bits of their numbers, reversed: any first few are spread over the whole clip.
    n_bits = max(1, (len(moments) - 1).bit_length())
    order = sorted(range(len(moments)), key=lambda number: f"{number:0{n_bits}b}"[::-1])
    for number in order:
        pairs = list(combinations(sorted(seen[moments[number]]), 2))
        if any(used[pair] < _PAIR_PLACEMENTS for pair in pairs):
            used.update(pairs)
            chosen.append(moments[number])
    return sorted(chosen)


def _largest_group(found: Mapping[tuple[int, int], Sequence[_View]]) -> set[str]:
    """Return the cameras that common boards hold together, the most."""
    groups: list[set[str]] = []
    for views in found.values():
        joined = {view.camera for view in views}
        apart = [group for group in groups if not group & joined]
        for group in groups:
            if group & joined:
                joined |= group
        groups = [*apart, joined]
    return max(groups, key=lambda group: (len(group), min(group)))


def _listed_alike(rig: Rig, views: Sequence[_View], board: Board) -> list[_View]:
    """Return views of one placement with the corners of a symmetric board in one order.

    The looks are those under which the cameras of the rig agree on the board's orientation best,
    which does not depend on the rig's scale.
    """
    if len(board.looks) == 1:
        return list(views)
    turned = [
        [compose(view.cam_from_board, board.board_from_turned(look)) for look in range(n_looks)]
        for view in views
        for n_looks in [len(board.looks)]
    ]
    in_world = np.array(
        [
            [rig[view.camera].cam_from_world[:, :3].T @ pose[:, :3] for pose in poses]
            for view, poses in zip(views, turned, strict=True)
        ]
    )  # (K, L, 3, 3)
    alike = np.einsum("ilab,jmab->iljm", in_world, in_world)
    best, best_total = np.zeros(len(views), np.intp), -np.inf
    for reference in range(len(views)):
        looks = alike[reference, 0].argmax(axis=1)
        looks[reference] = 0
        rows = alike[np.arange(len(views)), looks]
        total = float(rows[:, np.arange(len(views)), looks].sum())
        if total > best_total + 1e-9:
            best, best_total = looks, total
    return [
        replace(
            view,
            pixels=view.pixels[board.looks[look]],
            cam_from_board=poses[look],
            look=int(look),
        )
        for view, poses, look in zip(views, turned, best, strict=True)
    ]


# --- Which cameras agree ----------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _State:
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


@dataclass(frozen=True, slots=True, eq=False)
class _Finding:
    """The verdict on a rig, before it is put into words."""

    case: "_Case"
    kept: _State
    everything: _State
    moved: dict[int, Moved]
    suspects: tuple[int, ...]
    untested: tuple[str, ...]

    @property
    def agrees(self) -> bool:
        """Whether all cameras agree with the rig, its scale apart."""
        return self.kept.agrees and not self.moved and not self.suspects


class _Case:
    """Cameras of a rig, in order of name, and what they saw."""

    def __init__(
        self,
        rig: Rig,
        boards: Sequence[Board],
        views: Sequence[_View],
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
    ) -> "_Case":
        """Locate what was seen, and list symmetric boards alike."""
        found, seeing = _located(rig, boards, sightings)
        if not found:
            told = f"{len(seeing)} of its cameras see the board, expected two or more"
            if len(seeing) > 1:
                told = "no two of its cameras see the board at the same time"
            raise NotTestableError(
                f"the rig cannot be checked: {told} (rig: "
                f"{', '.join(camera.name for camera in rig.cameras)}; board: "
                f"{', '.join(seeing) or 'none'})"
            )
        group = _largest_group(found)
        views = [
            view
            for moment, together in sorted(found.items())
            if together[0].camera in group
            for view in _listed_alike(rig, together, boards[moment[1]])
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

    def examine(self) -> _Finding:
        """Set cameras aside until the rest agrees with the rig."""
        everyone = tuple(range(len(self.names)))
        everything = self.state_of(everyone)
        if self._drop_outliers(everything):
            everything = self.state_of(everyone, everything)
        zooms = self._own_zooms() if self.rig.covariance is None else {}
        if len(everyone) == 2 and zooms:
            zoomed = {index: self._lens_only(everything, index) for index in zooms}
            return _Finding(self, everything, everything, zoomed, (), self.untested)
        state = everything
        aside = list(zooms) if len(everyone) - len(zooms) > 1 else []
        if aside:
            state = self.state_of(tuple(i for i in everyone if i not in aside), everything)
        suspects: tuple[int, ...] = ()
        while not state.agrees and not suspects:
            if len(state.cameras) == 2:
                suspects = everyone if aside else state.cameras
                break
            worst = sorted(state.cameras, key=lambda index: state.alone[index])
            without = self.state_of(_less(state.cameras, worst[0]), state)
            suspects = self._equally_guilty(state, without, worst)
            if not suspects:
                aside.append(worst[0])
                state = without
        if suspects:
            zoomed = self._zoomed(everything) if len(everyone) == 2 else {}
            suspects = () if zoomed else suspects
            return _Finding(self, everything, everything, zoomed, suspects, self.untested)
        # Who was set aside for another's fault comes back.
        back = [index for index in aside if index not in zooms]
        for index in back if len(aside) > 1 else []:
            again = self.state_of(tuple(sorted((*state.cameras, index))), everything)
            if again.agrees:
                aside.remove(index)
                state = again
        moved = {index: self._moved(index, state, everything) for index in sorted(aside)}
        return _Finding(self, state, everything, moved, (), self.untested)

    def _own_zooms(self) -> dict[int, float]:
        """Return the cameras whose own images contradict their focal length, and by what factor.

        Each view has a board of its own here: no camera speaks for another.
        """
        n_views = len(self.table.place)
        views = replace(self.table, place=np.arange(n_views))
        at_origin = tuple(replace(c, cam_from_world=np.eye(3, 4)) for c in self.rig.cameras)
        start = Placed(at_origin, self.cam_from_middle, 1.0)
        as_stated = place_boards(views, start, scaled=False, loss_px=self.loss_px)
        everyone = range(len(self.names))
        found = place_boards(views, as_stated, (), everyone, scaled=False, loss_px=self.loss_px)
        before, after = residuals_of(views, as_stated), residuals_of(views, found)
        zooms = {}
        for index, (stated, zoomed) in enumerate(zip(self.rig.cameras, found.cameras, strict=True)):
            own = views.camera == index
            gain = float(np.nansum(before[own] ** 2) - np.nansum(after[own] ** 2))
            variance = variance_of(views, after, [index])
            factor = float(zoomed.pinhole[0, 0] / stated.pinhole[0, 0])
            if abs(np.log(factor)) > ZOOM_TOLERANCE and gain > _ZOOM_SIGMAS**2 * variance:
                zooms[index] = factor
        return zooms

    def _drop_outliers(self, state: _State) -> bool:
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

    def _equally_guilty(
        self, state: _State, without: _State, worst: Sequence[int]
    ) -> tuple[int, ...]:
        """Return the cameras any of which may be the odd one; none where one stands out."""
        if not without.agrees:
            return ()
        if self.rig.covariance is not None:
            odds = {index: state.alone[index] - state.alone[worst[0]] for index in worst}
            guilty = [index for index in worst if odds[index] < _CLEAR_ODDS]
            return tuple(sorted(guilty)) if len(guilty) > 1 else ()
        least = max(state.alone[worst[0]], float(POSE * len(state.cameras)))
        if state.alone[worst[1]] > _CLEAR_FACTOR**2 * least:
            return ()
        other = self.state_of(_less(state.cameras, worst[1]), state)
        return tuple(sorted(worst[:2])) if other.agrees else ()

    def state_of(self, cameras: tuple[int, ...], before: _State | None = None) -> _State:
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
        start = _placed_by(stated, views, poses, len(self.moments), scale)
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
        return _placed_by(stated, views, poses, len(self.moments), 1.0)

    def _compared(
        self,
        cameras: tuple[int, ...],
        views: Views,
        placed: Placed,
        today: Placed,
        rms_px: dict[int, float],
    ) -> _State:
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
        return _State(
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

    def _apart(self, cameras: tuple[int, ...]) -> _State:
        """Return the state of cameras that saw nothing together: they cannot agree."""
        boards = np.tile(np.eye(3, 4), (len(self.moments), 1, 1))
        placed = Placed(self.rig.cameras, boards, 1.0)
        nothing = dict.fromkeys(cameras, 0.0)
        return _State(
            cameras, placed, placed, nothing, 0.0, nothing, 0.0, 0.0, np.inf, agrees=False
        )

    # --- A camera that is not as the rig says ---

    def _moved(self, index: int, kept: _State, everything: _State) -> Moved:
        """Return how a camera stands to the boards that others placed."""
        table = self.table
        by_others = np.isin(table.camera, kept.cameras)
        n_others = np.bincount(table.place[by_others], minlength=len(self.moments))
        by_others &= n_others[table.place] > 0
        own = (table.camera == index) & (n_others[table.place] > 0)
        scale = kept.placed.scale
        others = _placed_by(
            self.rig.cameras,
            table.of(by_others),
            self.cam_from_middle[by_others],
            len(self.moments),
            scale,
        )
        measured = []
        for number in np.flatnonzero(own):
            cam_from_middle = self.cam_from_middle[number].copy()
            cam_from_middle[:, 3] *= scale
            middle_from_world = invert(others.boards[table.place[number]])
            measured.append(compose(cam_from_middle, middle_from_world)[None])
        length_m = scale * float(np.median(np.linalg.norm(self.cam_from_middle[own, :, 3], axis=1)))
        pose = common_pose(measured, np.ones(len(measured)), length_m).pose
        stated = self.rig.cameras[index]
        cameras = list(self.rig.cameras)
        cameras[index] = replace(stated, cam_from_world=pose)
        views = table.of(by_others | own)
        mine = views.camera == index
        fits = {
            "pose": place_boards(
                views,
                replace(others, cameras=tuple(cameras)),
                [index],
                scaled=self.tells_scale,
                loss_px=self.loss_px,
            ),
            "lens": place_boards(
                views, others, (), [index], scaled=self.tells_scale, loss_px=self.loss_px
            ),
        }
        fits["pose and lens"] = place_boards(
            views, fits["pose"], [index], [index], scaled=self.tells_scale, loss_px=self.loss_px
        )
        left = {what: rms(residuals_of(views, fit)[mine]) for what, fit in fits.items()}
        what = _explanation(left, 2 * int(views.seen[mine].sum()))
        found = fits[what].cameras[index]
        true_scale = fits[what].scale
        at_stated = replace(fits["pose and lens"], cameras=self.rig.cameras)
        p_value = None
        if self.rig.covariance is not None:
            drop = everything.statistic - everything.alone[index]
            p_value = chance_of(max(drop, 0.0), POSE)
        shift = np.linalg.norm(found.center_world - stated.center_world) / true_scale
        turn = angle_between(found.cam_from_world, stated.cam_from_world)
        return Moved(
            what,
            float(1000.0 * shift) if what != "lens" else 0.0,
            float(np.rad2deg(turn)) if what != "lens" else 0.0,
            float(found.pinhole[0, 0] / stated.pinhole[0, 0]),
            rms(residuals_of(views, at_stated)[mine]),
            p_value,
        )

    def _lens_only(self, state: _State, index: int) -> Moved:
        """Return by what factor a camera's focal length differs, the poses being as stated."""
        fit = place_boards(
            self.table, state.placed, (), [index], scaled=self.tells_scale, loss_px=self.loss_px
        )
        factor = fit.cameras[index].pinhole[0, 0] / self.rig.cameras[index].pinhole[0, 0]
        missed = residuals_of(self.table, replace(fit, cameras=self.rig.cameras))
        missed_px = rms(missed[self.table.camera == index])
        return Moved("lens", 0.0, 0.0, float(factor), missed_px, None)

    def _zoomed(self, state: _State) -> dict[int, Moved]:
        """Return which of two cameras a change of its focal length explains, if of one."""
        table = self.table
        free = residuals_of(table, state.today)
        n_values = 2 * int(table.seen.sum())
        found: dict[int, tuple[float, Moved]] = {}
        p_value = state.p_value if self.rig.covariance is not None else None
        for index in state.cameras:
            fit = place_boards(
                table, state.placed, (), [index], scaled=self.tells_scale, loss_px=self.loss_px
            )
            left = {"pose": rms(free), "lens": rms(residuals_of(table, fit))}
            factor = fit.cameras[index].pinhole[0, 0] / self.rig.cameras[index].pinhole[0, 0]
            if _explanation(left, n_values) == "lens":
                missed = rms(residuals_of(table, replace(fit, cameras=self.rig.cameras)))
                told = Moved("lens", 0.0, 0.0, float(factor), missed, p_value)
                found[index] = (left["lens"], told)
        if not found:
            return {}
        best = min(found, key=lambda index: found[index][0])
        if any(found[i][0] < found[best][0] / _EXPLAINS for i in found if i != best):
            return {}
        return {best: found[best][1]}

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

    # --- Two cameras in each other's place ---

    def misses_far(self, found: _Finding) -> bool:
        """Whether the rig misses so far that cameras may be exchanged."""
        return any(
            missed > _EXCHANGE_TOLERANCES * self.limits_px[index]
            for index, missed in found.everything.rms_px.items()
        )

    def exchangeable(self, found: _Finding) -> list[tuple[str, str]]:
        """Return pairs of cameras in whose places the others' pictures fit better, best first."""
        pairs = list(combinations(range(len(self.names)), 2))
        if len(pairs) > _MAX_EXCHANGES:
            odd = {*found.moved, *found.suspects}
            pairs = [pair for pair in pairs if set(pair) <= odd]
        places = np.unique(self.table.place)
        some = np.linspace(0, len(places) - 1, min(len(places), _EXCHANGE_PLACEMENTS)).round()
        chosen = {self.moments[int(places[int(number)])] for number in some}
        sightings: dict[str, list[Sighting]] = {name: [] for name in self.names}
        for view in self.views:
            if view.moment in chosen:
                sightings[view.camera].append(Sighting("", *view.moment, view.pixels))
        now = _Case.of(self.rig, self.boards, sightings).worst_miss()
        ranked = []
        for i, j in pairs:
            first, second = self.names[i], self.names[j]
            sizes = [(c.width_px, c.height_px) for c in (self.rig[first], self.rig[second])]
            if sizes[0] != sizes[1]:
                continue
            try:
                case = _Case.of(self.rig, self.boards, _exchange(sightings, first, second))
            except CalibrationError:
                continue  # a lens cannot have seen what the other did
            missed = case.worst_miss()
            if missed < now / _CLEAR_FACTOR:
                ranked.append((missed, (first, second)))
        return [pair for _, pair in sorted(ranked)]

    def worst_miss(self) -> float:
        """Return the largest miss of a camera, in shares of what is allowed."""
        scale = float(np.median(list(self.scale_of_pair.values()))) if self.tells_scale else 1.0
        start = _placed_by(
            self.rig.cameras, self.table, self.cam_from_middle, len(self.moments), scale
        )
        residuals = residuals_of(
            self.table, place_boards(self.table, start, scaled=self.tells_scale)
        )
        return max(
            rms(residuals[self.table.camera == index]) / float(limit_px)
            for index, limit_px in enumerate(self.limits_px)
        )


def _less(cameras: tuple[int, ...], index: int) -> tuple[int, ...]:
    return tuple(camera for camera in cameras if camera != index)


def _placed_by(
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


def _explanation(left_px: Mapping[str, float], n_values: int) -> str:
    """Return what explains a camera, from the miss (pixels) that each explanation leaves.

    By the Bayesian information criterion; two changes at once must explain twice as much as one.
    """
    unknowns = {"pose": POSE, "lens": 1}
    score = {
        what: n_values * np.log(left_px[what] ** 2 + LEAST_NOISE_PX**2) + count * np.log(n_values)
        for what, count in unknowns.items()
    }
    best = min(sorted(score, reverse=True), key=lambda what: score[what])
    both = left_px.get("pose and lens", np.inf)
    if both**2 + LEAST_NOISE_PX**2 < _EXPLAINS * (left_px[best] ** 2 + LEAST_NOISE_PX**2):
        return "pose and lens"
    return best


# --- The verdict ------------------------------------------------------------------------------


def _read_out(
    found: _Finding,
    boards: Sequence[Board],
    exchanged: tuple[str, str] | None,
    turns: Turns,
    twins: tuple[tuple[str, ...], ...],
) -> RigCheck:
    case, kept = found.case, found.kept
    names = case.names
    has_covariance = case.rig.covariance is not None
    pair_scales = {f"{names[i]} {names[j]}": scale for (i, j), scale in case.scale_of_pair.items()}
    rms_px = {
        name: found.moved[index].miss_px if index in found.moved else kept.rms_px[index]
        for index, name in enumerate(names)
    }
    scale = kept.placed.scale
    if has_covariance:
        off = abs(kept.log_scale)
        chance = chance_of((off / max(kept.log_scale_sigma, 1e-12)) ** 2, 1)
        is_scaled = off > _SQUARES_KNOWN and chance < SIGNIFICANCE
    else:
        is_scaled = abs(scale - 1.0) > SCALE_TOLERANCE
    moved = {names[index]: told for index, told in found.moved.items()}
    is_refuted = not found.agrees or is_scaled or exchanged is not None or bool(turns.turned)
    check = RigCheck(
        scale=scale,
        pair_scales=pair_scales,
        rms_px=rms_px,
        odd_camera=next(iter(moved)) if len(moved) == 1 else None,
        is_trustworthy=not is_refuted and not turns.undecided,
        is_refuted=is_refuted,
        message="",
        moved=moved,
        suspects=tuple(names[index] for index in found.suspects),
        exchanged=exchanged,
        turned={names[index]: told for index, told in turns.turned.items()},
        turned_sides=tuple(tuple(names[index] for index in side) for side in turns.sides),
        undecided=tuple(names[index] for index in turns.undecided),
        twins=twins,
        untested=found.untested,
        p_value=found.everything.p_value if has_covariance else None,
        scale_sigma=scale * kept.log_scale_sigma if has_covariance else None,
        n_placements=len(case.moments),
    )
    square_m = boards[case.moments[0][1]].square_m
    return replace(check, message=_verdict(check, square_m, is_scaled))


def _verdict(check: RigCheck, square_m: float, is_scaled: bool) -> str:
    scales = check.pair_scales.values()
    sigma = f" +- {check.scale_sigma:.3f}" if check.scale_sigma is not None else ""
    measured = "its scale cannot be told: the cameras stand in one place"
    if scales:
        measured = (
            f"the board's squares measure {check.scale * square_m * 1000:.1f} mm in the rig, "
            f"{square_m * 1000:g} mm in truth: scale {check.scale:.3f}{sigma} "
            f"(by pairs of cameras {min(scales):.3f} to {max(scales):.3f})"
        )
    worst = max(check.rms_px, key=lambda name: check.rms_px[name])
    missed = f"its corners are missed by {check.rms_px[worst]:.1f} px in camera {worst!r}"
    untested = f"; not tested: {', '.join(check.untested)}" if check.untested else ""
    if check.twins:
        untested += f"; {twins_text(check.twins)}"
    if check.exchanged is not None:
        first, second = check.exchanged
        return (
            f"cameras {first!r} and {second!r} are exchanged: each one's pictures fit the other's "
            f"place; {measured}; exchange their names, or their recordings{untested}"
        )
    if check.moved:
        told = "; ".join(_told(name, moved) for name, moved in check.moved.items())
        n_others = len(check.rms_px) - len(check.moved)
        them = "it" if len(check.moved) == 1 else "them"
        agree = f"without {them} the others agree; " if n_others > 1 else ""
        return f"{told}; {agree}{measured}; calibrate again{untested}"
    if check.suspects:
        who = " and ".join(repr(name) for name in check.suspects)
        if len(check.suspects) > 2 and len(check.suspects) == len(check.rms_px):
            which = "no two of them agree with the rig"
        else:
            which = f"one of {who} stands elsewhere than the rig says, or has another zoom"
        return f"the cameras disagree: {which}; {missed}; {measured}; calibrate again{untested}"
    if check.turned:
        return f"{_told_turned(check)}; {measured}; {missed}; calibrate again{untested}"
    if is_scaled:
        return f"{measured}; {missed}; check the rig's unit, or calibrate again{untested}"
    if check.undecided:
        who = " and ".join(map(repr, check.undecided))
        stand = "stands" if len(check.undecided) == 1 else "stand"
        return (
            f"it cannot be told whether {who} {stand} as the rig says, or turned about the board, "
            "which looks the same turned: what is seen around it does not say; mark its corners by "
            "hand in one order, move it about, or use one with an odd sum of columns and rows; "
            f"{measured}; {missed}: up to such a turn the rig agrees with the board{untested}"
        )
    return f"{measured}; {missed}: the rig agrees with the board{untested}"


def _told_turned(check: RigCheck) -> str:
    sides = [" and ".join(map(repr, side)) for side in check.turned_sides]
    told = list(check.turned.values())
    angles = " and ".join(f"{angle:.0f}" for angle in sorted({one.turn_deg for one in told}))
    far_m, sigma = max(one.shift_m for one in told), min(one.sigma for one in told)
    if len(told) == 1:
        who, far = f"camera {sides[0]} stands", f"{far_m:.2f} m from where the rig has it"
    else:
        either = "either " if len(sides) > 1 else "cameras "
        who = f"{either}{' or '.join(sides)} stand"
        far = f"up to {far_m:.2f} m from where the rig has them"
    return (
        f"{who} elsewhere than the rig says: turned by {angles} degrees about the board, which "
        f"looks the same then, {far}; so what is seen around the board shows, by {sigma:.1f} "
        "standard deviations"
    )


def _told(name: str, moved: Moved) -> str:
    zoom = f"its focal length is {moved.focal_factor:.3f} times what the rig says"
    pose = f"moved by {moved.shift_mm:.1f} mm, turned by {moved.turn_deg:.2f} degrees"
    if moved.what == "lens":
        return f"camera {name!r} has another lens or zoom than the rig says: {zoom}"
    if moved.what == "pose":
        return f"camera {name!r} stands elsewhere than the rig says: {pose}"
    return f"camera {name!r} stands elsewhere than the rig says: {pose}, and {zoom}"
