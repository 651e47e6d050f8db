"""The verdict on a rig in words."""

from collections.abc import Sequence
from dataclasses import replace

from hybridve.calib.boards.board import Board
from hybridve.calib.judging.accused import Finding
from hybridve.calib.judging.case import SIGNIFICANCE
from hybridve.calib.judging.comparison import chance_of
from hybridve.calib.judging.turns import Turns
from hybridve.calib.judging.twins import twins_text
from hybridve.calib.verdict import Moved, RigCheck

#: Boards contradict a rig that has no covariance if its scale is off by more than this: independent
#: careful calibrations of one recording differ by up to 4 %.
SCALE_TOLERANCE = 0.05

#: The squares of a board are known to this share, by a ruler: a smaller scale is told, not blamed.
_SQUARES_KNOWN = 0.005


def read_out(
    found: Finding,
    boards: Sequence[Board],
    exchanged: tuple[str, str] | None,
    turns: Turns,
    twins: tuple[tuple[str, ...], ...],
) -> RigCheck:
    """Return what boards say of a rig, with its verdict in one line."""
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
