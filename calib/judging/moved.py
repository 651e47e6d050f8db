"""How a camera stands that is not as the rig says: elsewhere, or with another focal length."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from hybridve.calib.judging.case import Case, State, placed_by
from hybridve.calib.judging.comparison import LEAST_NOISE_PX, chance_of
from hybridve.calib.pose import angle_between, compose, invert
from hybridve.calib.solving.bundle import POSE
from hybridve.calib.solving.consensus import common_pose
from hybridve.calib.solving.locate import rms
from hybridve.calib.solving.placement import place_boards, residuals_of
from hybridve.calib.verdict import Moved

#: A focal length explains a camera where it leaves less than this share of what another pose does.
_EXPLAINS = 0.5


def how_moved(case: Case, index: int, kept: State, everything: State) -> Moved:
    """Return how a camera stands to the boards that others placed."""
    table = case.table
    by_others = np.isin(table.camera, kept.cameras)
    n_others = np.bincount(table.place[by_others], minlength=len(case.moments))
    by_others &= n_others[table.place] > 0
    own = (table.camera == index) & (n_others[table.place] > 0)
    scale = kept.placed.scale
    others = placed_by(
        case.rig.cameras,
        table.of(by_others),
        case.cam_from_middle[by_others],
        len(case.moments),
        scale,
    )
    measured = []
    for number in np.flatnonzero(own):
        cam_from_middle = case.cam_from_middle[number].copy()
        cam_from_middle[:, 3] *= scale
        middle_from_world = invert(others.boards[table.place[number]])
        measured.append(compose(cam_from_middle, middle_from_world)[None])
    length_m = scale * float(np.median(np.linalg.norm(case.cam_from_middle[own, :, 3], axis=1)))
    pose = common_pose(measured, np.ones(len(measured)), length_m).pose
    stated = case.rig.cameras[index]
    cameras = list(case.rig.cameras)
    cameras[index] = replace(stated, cam_from_world=pose)
    views = table.of(by_others | own)
    mine = views.camera == index
    fits = {
        "pose": place_boards(
            views,
            replace(others, cameras=tuple(cameras)),
            [index],
            scaled=case.tells_scale,
            loss_px=case.loss_px,
        ),
        "lens": place_boards(
            views, others, (), [index], scaled=case.tells_scale, loss_px=case.loss_px
        ),
    }
    fits["pose and lens"] = place_boards(
        views, fits["pose"], [index], [index], scaled=case.tells_scale, loss_px=case.loss_px
    )
    left = {what: rms(residuals_of(views, fit)[mine]) for what, fit in fits.items()}
    what = _explanation(left, 2 * int(views.seen[mine].sum()))
    found = fits[what].cameras[index]
    true_scale = fits[what].scale
    at_stated = replace(fits["pose and lens"], cameras=case.rig.cameras)
    p_value = None
    if case.rig.covariance is not None:
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


def lens_only(case: Case, state: State, index: int) -> Moved:
    """Return by what factor a camera's focal length differs, the poses being as stated."""
    fit = place_boards(
        case.table, state.placed, (), [index], scaled=case.tells_scale, loss_px=case.loss_px
    )
    factor = fit.cameras[index].pinhole[0, 0] / case.rig.cameras[index].pinhole[0, 0]
    missed = residuals_of(case.table, replace(fit, cameras=case.rig.cameras))
    missed_px = rms(missed[case.table.camera == index])
    return Moved("lens", 0.0, 0.0, float(factor), missed_px, None)


def which_zoomed(case: Case, state: State) -> dict[int, Moved]:
    """Return which of two cameras a change of its focal length explains, if of one."""
    table = case.table
    free = residuals_of(table, state.today)
    n_values = 2 * int(table.seen.sum())
    found: dict[int, tuple[float, Moved]] = {}
    p_value = state.p_value if case.rig.covariance is not None else None
    for index in state.cameras:
        fit = place_boards(
            table, state.placed, (), [index], scaled=case.tells_scale, loss_px=case.loss_px
        )
        left = {"pose": rms(free), "lens": rms(residuals_of(table, fit))}
        factor = fit.cameras[index].pinhole[0, 0] / case.rig.cameras[index].pinhole[0, 0]
        if _explanation(left, n_values) == "lens":
            missed = rms(residuals_of(table, replace(fit, cameras=case.rig.cameras)))
            told = Moved("lens", 0.0, 0.0, float(factor), missed, p_value)
            found[index] = (left["lens"], told)
    if not found:
        return {}
    best = min(found, key=lambda index: found[index][0])
    if any(found[i][0] < found[best][0] / _EXPLAINS for i in found if i != best):
        return {}
    return {best: found[best][1]}


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
