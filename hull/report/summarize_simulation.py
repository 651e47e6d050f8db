"""What a simulation found, in numbers."""

from typing import Any

import numpy as np

from hybridve.calib.plain import to_plain
from hybridve.hull.report.simulation_data import StoredGroup, StoredSimulation


def summarize_simulation(simulation: StoredSimulation) -> dict[str, Any]:
    """Return what a simulation found, as plain JSON values."""
    paused = [str(reason) for reason in simulation.reason if reason]
    time_s = simulation.time_s
    return {
        "simulation": str(simulation.path),
        "session": simulation.settings["session"],
        "scene": simulation.settings["scene"],
        "frames": len(time_s),
        "seconds": float(time_s[-1] - time_s[0]) if len(time_s) else 0.0,
        "steps": int(simulation.n_steps.sum()),
        "step_s": simulation.settings["step_s"],
        "hull": simulation.settings["hull"],
        "seed": simulation.settings["seed"],
        "solvers": simulation.settings["solvers"],
        "trusted": simulation.agreement.is_trusted,
        "causes": [to_plain(cause) for cause in simulation.agreement.causes],
        "rests_on": simulation.agreement.rests_on,
        "frames_paused": len(paused),
        "reasons": {reason: paused.count(reason) for reason in dict.fromkeys(paused)},
        "stopped": simulation.stopped,
        "stage_ms_mean": {
            stage: 1e3 * float(seconds.mean()) for stage, seconds in simulation.stage_s.items()
        },
        "effects": [{"name": name, **_effect(group)} for name, group in simulation.groups.items()],
    }


def _effect(group: StoredGroup) -> dict[str, Any]:
    values = group.values
    energy_j = values["kinetic_j"] + values["potential_j"]
    ms = 1e3 * values["step_s"]
    return {
        "kind": group.kind,
        "frames_met": int(np.count_nonzero(values["n_contacts"])),
        "contacts": int(values["n_contacts"].sum()),
        "penetration_m": float(np.nanmax(values["penetration_m"], initial=0.0)),
        "energy_j": [float(energy_j[0]), float(energy_j.max()), float(energy_j[-1])],
        "hull_work_j": float(values["hull_work_j"][-1]),
        "ms_median": float(np.median(ms)),
        "ms_p95": float(np.percentile(ms, 95)),
        "together_with": group.about["together_with"],
        "notes": list(group.about.get("notes", [])),
        "last": {
            name: to_plain(column[-1])
            for name, column in values.items()
            if column[-1].size <= _MOST_LISTED
        },
    }


#: Values with more numbers than this are left to the file.
_MOST_LISTED = 16
