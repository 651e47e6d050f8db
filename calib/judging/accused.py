"""Which cameras are set aside, one by one, until the rest agrees with the rig."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hybridve.calib.judging.case import CLEAR_FACTOR, Case, State
from hybridve.calib.judging.comparison import variance_of
from hybridve.calib.judging.moved import how_moved, lens_only, which_zoomed
from hybridve.calib.solving.bundle import POSE
from hybridve.calib.solving.placement import Placed, place_boards, residuals_of
from hybridve.calib.verdict import Moved

#: Images contradict a rig that, each camera for itself, show a focal length that differs by more
#: than this share, and by so many standard deviations.
ZOOM_TOLERANCE = 0.05
_ZOOM_SIGMAS = 4.0

#: Two cameras whose guilt differs by less than this (log odds, doubled) are both named.
_CLEAR_ODDS = 9.0


@dataclass(frozen=True, slots=True, eq=False)
class Finding:
    """The verdict on a rig, before it is put into words."""

    case: Case
    kept: State
    everything: State
    moved: dict[int, Moved]
    suspects: tuple[int, ...]
    untested: tuple[str, ...]

    @property
    def agrees(self) -> bool:
        """Whether all cameras agree with the rig, its scale apart."""
        return self.kept.agrees and not self.moved and not self.suspects


def examine(case: Case) -> Finding:
    """Set cameras aside until the rest agrees with the rig."""
    everyone = tuple(range(len(case.names)))
    everything = case.state_of(everyone)
    if case.drop_outliers(everything):
        everything = case.state_of(everyone, everything)
    zooms = _own_zooms(case) if case.rig.covariance is None else {}
    if len(everyone) == 2 and zooms:
        zoomed = {index: lens_only(case, everything, index) for index in zooms}
        return Finding(case, everything, everything, zoomed, (), case.untested)
    state = everything
    aside = list(zooms) if len(everyone) - len(zooms) > 1 else []
    if aside:
        state = case.state_of(tuple(i for i in everyone if i not in aside), everything)
    suspects: tuple[int, ...] = ()
    while not state.agrees and not suspects:
        if len(state.cameras) == 2:
            suspects = everyone if aside else state.cameras
            break
        worst = sorted(state.cameras, key=lambda index: state.alone[index])
        without = case.state_of(_less(state.cameras, worst[0]), state)
        suspects = _equally_guilty(case, state, without, worst)
        if not suspects:
            aside.append(worst[0])
            state = without
    if suspects:
        zoomed = which_zoomed(case, everything) if len(everyone) == 2 else {}
        suspects = () if zoomed else suspects
        return Finding(case, everything, everything, zoomed, suspects, case.untested)
    # Who was set aside for another's fault comes back.
    back = [index for index in aside if index not in zooms]
    for index in back if len(aside) > 1 else []:
        again = case.state_of(tuple(sorted((*state.cameras, index))), everything)
        if again.agrees:
            aside.remove(index)
            state = again
    moved = {index: how_moved(case, index, state, everything) for index in sorted(aside)}
    return Finding(case, state, everything, moved, (), case.untested)


def _own_zooms(case: Case) -> dict[int, float]:
    """Return the cameras whose own images contradict their focal length, and by what factor.

    Each view has a board of its own here: no camera speaks for another.
    """
    n_views = len(case.table.place)
    views = replace(case.table, place=np.arange(n_views))
    at_origin = tuple(replace(c, cam_from_world=np.eye(3, 4)) for c in case.rig.cameras)
    start = Placed(at_origin, case.cam_from_middle, 1.0)
    as_stated = place_boards(views, start, scaled=False, loss_px=case.loss_px)
    everyone = range(len(case.names))
    found = place_boards(views, as_stated, (), everyone, scaled=False, loss_px=case.loss_px)
    before, after = residuals_of(views, as_stated), residuals_of(views, found)
    zooms = {}
    for index, (stated, zoomed) in enumerate(zip(case.rig.cameras, found.cameras, strict=True)):
        own = views.camera == index
        gain = float(np.nansum(before[own] ** 2) - np.nansum(after[own] ** 2))
        variance = variance_of(views, after, [index])
        factor = float(zoomed.pinhole[0, 0] / stated.pinhole[0, 0])
        if abs(np.log(factor)) > ZOOM_TOLERANCE and gain > _ZOOM_SIGMAS**2 * variance:
            zooms[index] = factor
    return zooms


def _equally_guilty(
    case: Case, state: State, without: State, worst: Sequence[int]
) -> tuple[int, ...]:
    """Return the cameras any of which may be the odd one; none where one stands out."""
    if not without.agrees:
        return ()
    if case.rig.covariance is not None:
        odds = {index: state.alone[index] - state.alone[worst[0]] for index in worst}
        guilty = [index for index in worst if odds[index] < _CLEAR_ODDS]
        return tuple(sorted(guilty)) if len(guilty) > 1 else ()
    least = max(state.alone[worst[0]], float(POSE * len(state.cameras)))
    if state.alone[worst[1]] > CLEAR_FACTOR**2 * least:
        return ()
    other = case.state_of(_less(state.cameras, worst[1]), state)
    return tuple(sorted(worst[:2])) if other.agrees else ()


def _less(cameras: tuple[int, ...], index: int) -> tuple[int, ...]:
    return tuple(camera for camera in cameras if camera != index)
