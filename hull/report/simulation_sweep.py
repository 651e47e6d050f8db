"""``SWEEP.h5`` of a simulation: what a step, or a viewport, costs in time and in accuracy.

::

    /            attrs: format, version, created_utc, command, machine, versions
    /settings    what was swept, and the configuration, JSON
    /rows/       a row a value
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.plain import to_json
from hybridve.hull.report.machine import Run
from hybridve.hull.report.result_file import (
    Described,
    read_run,
    reading,
    store_fields,
    store_text,
    write_run,
    writing,
)

VERSION = 1


@dataclass(frozen=True, slots=True, eq=False)
class SimulationSweep:
    """A simulation made again with each of V values.

    Attributes
    ----------
    run : Run
        Which run made it.
    settings : dict
        ``over``: "step" or "viewport"; ``chosen``: the value that is marked; ``finest``: the one
        that distances are from; and the configuration.
    value : (V,) float64
        Seconds a step, or samples along an edge.
    time_s : (V, R) float64
        Seconds a frame of every repeat, mean over the frames: hulls between frames, and effects.
    penetration_m : (V,) float64
        The deepest after any step.
    excess_j : (V,) float64
        The most energy that nothing real has put in: 0 where all of it is accounted for.
    excess_share : (V,) float64
        The same by the most energy that there was.
    distance_median_m, distance_max_m : (V,) float64
        How far what is shown is from where it is in the finest run: of the median of its points
        and frames, and the most.
    on_front : (V,) bool
        No other value is as quick and as near to the finest.
    """

    run: Run
    settings: dict[str, Any]
    value: NDArray[np.float64]
    time_s: NDArray[np.float64]
    penetration_m: NDArray[np.float64]
    excess_j: NDArray[np.float64]
    excess_share: NDArray[np.float64]
    distance_median_m: NDArray[np.float64]
    distance_max_m: NDArray[np.float64]
    on_front: NDArray[np.bool_]


_COLUMNS = (
    Described("value", "s or 1", "exact", "seconds a step, or samples along an edge"),
    Described(
        "time_s",
        "s",
        "exact",
        "seconds a frame of every repeat, mean over frames: hulls between frames, and effects",
    ),
    Described(
        "penetration_m", "m", "sampled", "the deepest that any sample was in the hull after a step"
    ),
    Described("excess_j", "J", "estimate", "the most energy that nothing real has put in"),
    Described("excess_share", "1", "estimate", "the same by the most energy that there was"),
    Described(
        "distance_median_m",
        "m",
        "estimate",
        "distance of what is shown to where the finest run has it, median over points and frames",
    ),
    Described("distance_max_m", "m", "estimate", "the most of it"),
    Described("on_front", "1", "estimate", "no other value is as quick and as near to the finest"),
)


def write_simulation_sweep(path: Path, sweep: SimulationSweep) -> None:
    """Write a sweep of a simulation; the file appears only when it is complete.

    Raises
    ------
    ReportError
        If it cannot be written.
    """
    with writing(path) as file:
        write_run(file, "simulation-sweep", VERSION, sweep.run)
        store_text(file, "settings", json.dumps(sweep.settings), "what was swept, JSON")
        store_fields(file.create_group("rows"), sweep, _COLUMNS)


def read_simulation_sweep(path: Path) -> SimulationSweep:
    """Return what `write_simulation_sweep` wrote.

    Raises
    ------
    ReportError
        If there is no such file, it is of another format, of an unknown version, or damaged.
    """
    with reading(path, "simulation-sweep", VERSION) as file:
        rows: h5py.Group = file["rows"]
        return SimulationSweep(
            run=read_run(file),
            settings=json.loads(file["settings"].asstr()[()]),
            **{column.name: rows[column.name][()] for column in _COLUMNS},
        )


def simulation_sweep_as_dict(sweep: SimulationSweep) -> dict[str, Any]:
    """Return what a sweep found, as plain JSON values."""
    low_s, median_s, high_s = np.percentile(sweep.time_s, (25, 50, 75), axis=1)
    return {
        "over": sweep.settings["over"],
        "chosen": sweep.settings["chosen"],
        "finest": sweep.settings["finest"],
        "machine": sweep.run.machine,
        "rows": [
            {
                "value": float(sweep.value[row]),
                "ms_median": 1e3 * float(median_s[row]),
                "ms_iqr": 1e3 * float(high_s[row] - low_s[row]),
                **{
                    name: to_json(getattr(sweep, name)[row])
                    for name in (
                        "penetration_m",
                        "excess_j",
                        "excess_share",
                        "distance_median_m",
                        "distance_max_m",
                        "on_front",
                    )
                },
            }
            for row in range(len(sweep.value))
        ],
    }
