"""Results as curves: clearances of a report, energy and penetration of a simulation."""

from pathlib import Path

import numpy as np

from hybridve.calib.errors import ReportError
from hybridve.hull.report.read import ObjectColumns, Report
from hybridve.hull.report.simulation_data import StoredSimulation
from hybridve.hull.report.summarize import count_without_hull
from hybridve.hull.view.chart import ClearanceCurve, write_clearances
from hybridve.hull.view.simulation_chart import EffectCurve, write_effects

#: Panels in one picture, the nearest objects; more could not be read.
_MOST_PANELS = 12


def write_curves(path: Path, report: Report) -> None:
    """Draw the clearance of each object of a report against time.

    Raises
    ------
    ReportError
        If it cannot be written, or the report has no clearances or no frames.
    """
    curves = [
        curve_of(name, rows, report)
        for name, rows in report.objects.items()
        if "clearance_m" in rows
    ]
    if not curves:
        raise ReportError(
            f"{report.path}: holds no clearances to draw; make it again without --clearance-mm 0"
        )
    nearest = sorted(curves, key=_nearest_mm)[:_MOST_PANELS]
    shown = [curve for curve in curves if curve in nearest]  # in the scene's order
    notes = []
    if len(shown) < len(curves):
        notes.append(f"the nearest {len(shown)} of {len(curves)} objects")
    if n_empty := count_without_hull(report):
        notes.append(f"{n_empty} of {len(report.index)} frames have no hull and no curve")
    title = f"{report.path.name}: clearance between the hull and each object"
    write_clearances(path, shown, title=title, note="; ".join(notes))


def curve_of(name: str, rows: ObjectColumns, report: Report) -> ClearanceCurve:
    """Return the clearance of an object against time, depth counting as negative."""
    lower_m, upper_m = rows["clearance_m"].T
    # Where there is no hull, the lower bound is how far was looked: metres, beyond all that counts.
    lower_m, upper_m = (np.where(np.isfinite(upper_m), edge, np.nan) for edge in (lower_m, upper_m))
    shallow_m, deep_m = np.nan_to_num(rows["depth_m"]).T
    at_least_m = rows.get("clearance_at_least_m")
    first_s = rows.get("first_contact_s")
    return ClearanceCurve(
        name=name,
        time_s=report.time_s,
        lower_mm=1e3 * (lower_m - deep_m),
        upper_mm=1e3 * (upper_m - shallow_m),
        at_least_mm=1e3 * at_least_m if at_least_m is not None else np.full(len(lower_m), np.nan),
        clashes=rows.clashes,
        required_mm=1e3 * float(rows.about.get("required_clearance_m", 0.0)),
        first_contact_s=np.zeros(0) if first_s is None else first_s[np.isfinite(first_s)],
    )


def _nearest_mm(curve: ClearanceCurve) -> float:
    return float(np.fmin.reduce(curve.lower_mm, initial=np.inf))


def write_simulation_curves(path: Path, simulation: StoredSimulation) -> None:
    """Draw energy and penetration of each effect of a simulation against time.

    Raises
    ------
    ReportError
        If it cannot be written.
    """
    curves = []
    for name, group in list(simulation.groups.items())[:_MOST_PANELS]:
        energy_j = group.values["kinetic_j"] + group.values["potential_j"]
        curves.append(
            EffectCurve(
                name=f"{name} ({group.kind})",
                time_s=simulation.time_s,
                energy_j=energy_j,
                given_j=energy_j[0] + group.values["hull_work_j"],
                penetration_mm=1e3 * group.values["penetration_m"],
                is_met=group.values["n_contacts"] > 0,
            )
        )
    left_out = len(simulation.groups) - len(curves)
    more = f" (the first {len(curves)} of {len(simulation.groups)} effects)" if left_out else ""
    write_effects(path, curves, title=f"{simulation.path.name}: what every effect met{more}")
