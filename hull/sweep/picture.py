"""A sweep as curves: what the chart of `hybridve.hull.view.chart` shows."""

from pathlib import Path

import numpy as np

from hybridve.hull.report.simulation_sweep import SimulationSweep
from hybridve.hull.report.sweep_data import Sweep
from hybridve.hull.view.chart import Curve, write_chart
from hybridve.hull.view.simulation_sweep_chart import CostCurve, write_cost


def write_picture_of(path: Path, sweep: Sweep) -> None:
    """Draw accuracy against time, one curve an engine.

    Raises
    ------
    ReportError
        If it cannot be written.
    """
    rows, frames = sweep.rows, sweep.frames
    colliding = int(frames.triangles_colliding.sum())
    near_m = rows.predicted_near_m
    predicted_m = np.where(np.isnan(near_m), rows.predicted_m, near_m)
    curves = []
    for engine in sweep.engines:
        low_s, high_s = np.percentile(engine.time_s, (25, 75), axis=1)
        curves.append(
            Curve(
                name=engine.name,
                labels=tuple(str(viewport or "") for viewport in rows.viewport.tolist()),
                time_ms=1e3 * engine.time_median_s,
                time_range_ms=1e3 * np.stack([low_s, high_s]),
                error_mm=1e3 * engine.distance_max_m,
                predicted_mm=1e3 * predicted_m,
                missed_percent=100.0 * engine.triangles_missed / max(colliding, 1),
                viewport=rows.viewport.astype(np.int64),
                on_front=engine.on_front,
                is_chosen=rows.viewport == 0,
            )
        )
    objects = sweep.settings["objects"]
    triangles = sum(one["triangles"] for one in objects)
    title = (
        f"{Path(sweep.settings['session']).resolve().parent.name}: {len(frames.index)} frames "
        f"({sweep.settings['frames']}), {len(objects)} objects, {triangles:,} triangles, "
        f"{sweep.cameras} cameras"
    )
    note = ""
    if not colliding:
        note = "nothing collides in these frames: accuracy was not measured"
    elif most := max(int(engine.objects_missed.max()) for engine in sweep.engines):
        note = f"distances leave out objects missed altogether: {most} at most, over all frames"
    write_chart(path, curves, rows.labels[-1], title=title, subtitle=sweep.run.machine, note=note)


def write_simulation_picture(path: Path, sweep: SimulationSweep) -> None:
    """Draw what a step, or a viewport, costs a simulation.

    Raises
    ------
    ReportError
        If it cannot be written.
    """
    settings = sweep.settings
    is_step = settings["over"] == "step"
    order = np.argsort(sweep.value)
    values = sweep.value[order]
    low_s, median_s, high_s = np.percentile(sweep.time_s[order], (25, 50, 75), axis=1)
    curve = CostCurve(
        labels=tuple(f"{1e3 * value:g} ms" if is_step else f"{value:g}" for value in values),
        time_ms=1e3 * median_s,
        time_range_ms=1e3 * np.stack([low_s, high_s]),
        penetration_mm=1e3 * sweep.penetration_m[order],
        excess_percent=100 * sweep.excess_share[order],
        distance_mm=1e3 * sweep.distance_max_m[order],
        on_front=sweep.on_front[order],
        is_chosen=np.isclose(values, settings["chosen"], rtol=1e-9, atol=0.0),
    )
    name = Path(settings["session"]).resolve().parent.name
    chosen = "the step of `simulate`" if is_step else "the paper's viewport"
    what = "step" if is_step else "viewport"
    write_cost(
        path,
        curve,
        chosen,
        title=f"{name}: {', '.join(settings['effects'])}, {settings['n_frames']} frames, by {what}",
        note=sweep.run.machine,
    )
