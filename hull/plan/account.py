"""What a rig that is only drawn will be able to tell."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.plain import Told
from hybridve.calib.solving.errors_in_space import point_errors
from hybridve.hull.capture.session_tables import TargetTable
from hybridve.hull.plan.calibration import calibrate_drawing
from hybridve.hull.plan.drawing import (
    LEAST_SQUARE_PX,
    Drawing,
    draw,
    places_in,
    sees_ball,
    square_px,
)
from hybridve.hull.plan.tables import PlanTable
from hybridve.hull.plan.trial import try_places
from hybridve.hull.watcher import Watcher

#: Places a side of the volume at which is asked what is seen, and at which the ball is tried.
_SEEN_PLACES, _TRIED_PLACES = 9, 3

#: Less of the volume than this in all pictures is told.
_LEAST_SEEN = 0.95


@dataclass(frozen=True, slots=True)
class Spread(Told):
    """Values over the volume.

    Attributes
    ----------
    median, at_95_percent, most : float or None
        Half of them, 95 % of them, all of them are below it; None where there are none.
    """

    median: float | None
    at_95_percent: float | None
    most: float | None

    @classmethod
    def of(cls, values: NDArray[np.float64]) -> "Spread":
        """Return the spread of the values that are no NaN."""
        known = values[np.isfinite(values)]
        if len(known) == 0:
            return cls(None, None, None)
        median, high, most = np.quantile(known, [0.5, 0.95, 1.0])
        return cls(float(median), float(high), float(most))


@dataclass(frozen=True, slots=True)
class PlannedCamera(Told):
    """One camera.

    Attributes
    ----------
    name : str
        The camera.
    at_m : (x, y, z)
        Where it stands, metres.
    distance_m : float
        From there to the middle of the volume.
    mm_per_px : float
        What a pixel is there.
    seen_share : float
        The share of the volume in which it sees all of the ball.
    square_px : float
        How small the board's smallest square (of an AprilGrid: tag) is in its picture of the board
        on the floor; 0 where it does not see all of it.
    """

    name: str
    at_m: tuple[float, float, float]
    distance_m: float
    mm_per_px: float
    seen_share: float
    square_px: float


@dataclass(frozen=True, slots=True)
class PlanAccount(Told):
    """What a plan comes to. Lengths are millimetres.

    Attributes
    ----------
    plan : str
        The file.
    cameras : tuple of PlannedCamera
        In the plan's order.
    seen_by_all, seen_by_two : float
        Shares of the volume in which all, or two or more cameras, see all of the ball.
    calibration_mm : Spread
        The error of a point from the rig alone, 95 % of calibrations, over the volume.
    hull_mm : Spread
        How much nearer the hull is than the ball.
    doubt_mm : Spread
        By how much less is told at 95 %, as outlines and rig err.
    total_mm : Spread
        How much farther than it must be a part has to be, to be told to keep its distance.
    ball_radius_mm : float
        Of the ball.
    blur_mm, out_of_step_mm, between_frames_mm : float
        How far a hand moves while the shutter is open, between cameras, and between frames.
    notes : tuple of str
        What is worth a look.
    """

    plan: str
    cameras: tuple[PlannedCamera, ...]
    seen_by_all: float
    seen_by_two: float
    calibration_mm: Spread
    hull_mm: Spread
    doubt_mm: Spread
    total_mm: Spread
    ball_radius_mm: float
    blur_mm: float
    out_of_step_mm: float
    between_frames_mm: float
    notes: tuple[str, ...]


def account_of(name: str, plan: PlanTable, target: TargetTable, watcher: Watcher) -> PlanAccount:
    """Return what a plan comes to.

    Parameters
    ----------
    name : str
        Of the plan, for messages.
    plan, target
        What it says; see `hybridve.hull.plan.tables.read_plan`.
    watcher : Watcher
        Told as places are tried.

    Raises
    ------
    HybridveError
        If a camera or the board cannot be as drawn, or fewer than two cameras can be placed.
    """
    drawing = draw(plan, target)
    radius_m = plan.ball.radius_mm / 1000.0
    watcher.say("calibrating what is drawn")
    calibrated = calibrate_drawing(drawing, plan.calibration)
    places = places_in(drawing, _SEEN_PLACES, radius_m)
    sees = np.array(
        [[sees_ball(one, place, radius_m) for place in places] for one in drawing.cameras]
    )
    n_seeing = sees.sum(axis=0)
    errors_m = point_errors(calibrated.rig, places).radius95_m
    tried = places_in(drawing, _TRIED_PLACES, radius_m)
    with watcher.steps("places", len(tried), unit="place") as advance:
        told = try_places(
            calibrated.rig, tried, radius_m, plan.silhouettes.outline_px, lambda: advance(1)
        )
    cameras = tuple(_camera(drawing, index, sees[index]) for index in range(len(drawing.cameras)))
    seen_by_all = float((n_seeing == len(cameras)).mean())
    timing = plan.timing
    return PlanAccount(
        plan=name,
        cameras=cameras,
        seen_by_all=seen_by_all,
        seen_by_two=float((n_seeing >= 2).mean()),
        calibration_mm=Spread.of(1000.0 * errors_m),
        hull_mm=Spread.of(1000.0 * told.hull_m),
        doubt_mm=Spread.of(1000.0 * told.doubt_m),
        total_mm=Spread.of(1000.0 * told.total_m),
        ball_radius_mm=plan.ball.radius_mm,
        blur_mm=timing.speed_m_s * timing.exposure_ms,
        out_of_step_mm=timing.speed_m_s * timing.out_of_step_ms,
        between_frames_mm=1000.0 * timing.speed_m_s / timing.fps,
        notes=tuple(_notes(cameras, calibrated.not_placed, seen_by_all, plan)),
    )


def _camera(drawing: Drawing, index: int, sees: NDArray[np.bool_]) -> PlannedCamera:
    camera = drawing.cameras[index]
    middle = (drawing.low_world + drawing.high_world) / 2.0
    at = camera.center_world
    distance_m = float(np.linalg.norm(middle - at))
    return PlannedCamera(
        camera.name,
        (float(at[0]), float(at[1]), float(at[2])),
        distance_m,
        1000.0 * distance_m / float(camera.params[0]),
        float(sees.mean()),
        square_px(camera, drawing.board, drawing.world_from_board),
    )


def _notes(
    cameras: Sequence[PlannedCamera],
    not_placed: Sequence[str],
    seen_by_all: float,
    plan: PlanTable,
) -> list[str]:
    notes = []
    if not_placed:
        notes.append(
            f"{', '.join(not_placed)}: no board ties {'it' if len(not_placed) == 1 else 'them'} to "
            "the board on the floor, so that what is told below leaves "
            f"{'it' if len(not_placed) == 1 else 'them'} out; move the board, or have it carried "
            "about (calibration.moved)"
        )
    small = [one.name for one in cameras if 0 < one.square_px < LEAST_SQUARE_PX]
    if small:
        notes.append(
            f"{', '.join(small)}: squares of the board on the floor are less than "
            f"{LEAST_SQUARE_PX:g} px, and may not be found; print it larger"
        )
    if seen_by_all < _LEAST_SEEN:
        notes.append(
            f"all cameras together see {seen_by_all:.0%} of the volume: what only some see is lost "
            'with unseen = "carve"; look from farther, take wider lenses, or say unseen = "keep"'
        )
    timing = plan.timing
    if timing.speed_m_s * timing.exposure_ms > 10.0:
        notes.append(
            f"an exposure of {timing.exposure_ms:g} ms smears a hand by "
            f"{timing.speed_m_s * timing.exposure_ms:.0f} mm; expose for less, with more light"
        )
    if timing.speed_m_s * timing.out_of_step_ms > 5.0:
        notes.append(
            f"cameras {timing.out_of_step_ms:g} ms out of step see a hand "
            f"{timing.speed_m_s * timing.out_of_step_ms:.0f} mm apart; trigger them together, or "
            "give offset_s"
        )
    return notes
