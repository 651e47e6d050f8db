"""A sweep as curves: what the chart of `hybridve.hull.view.chart` shows."""

from pathlib import Path

import numpy as np

from hybridve.hull.report.sweep_file import Sweep
from hybridve.hull.view.chart import Curve, write_chart


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
