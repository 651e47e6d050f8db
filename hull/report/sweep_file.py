"""``SWEEP.h5``: accuracy against time, written complete or not at all, read back by version.

::

    /                    attrs: format, version, created_utc, command, machine, versions, cameras
    /settings            the resolved configuration, JSON
    /rows/               what was asked: one row a viewport, and last the viewports of an accuracy
    /frames/             the frames, what each cost once, and what truly collides in it
    /truth               attrs: how finely the truth was sampled
    /engines/NAME/       per row: seconds of every repeat, what was missed, how far off
    /engines/NAME/cost   the cost model of section 4.4.2 of the paper, fitted; absent if it was not
"""

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, TypeVar

import h5py
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.plain import to_json
from hybridve.hull.report.result_file import (
    Described,
    read_run,
    reading,
    store_fields,
    store_text,
    write_run,
    writing,
)
from hybridve.hull.report.sweep_data import (
    CostModel,
    EngineSweep,
    Sweep,
    SweepFrames,
    SweepRows,
    TruthSettings,
)

VERSION = 1

Loaded = TypeVar("Loaded")

_ROW_COLUMNS = (
    Described(
        "viewport",
        "1",
        "exact",
        "samples along every edge; 0 where each triangle has its own viewport",
    ),
    Described(
        "accuracy_m",
        "m",
        "exact",
        "accuracy by which each triangle was given its viewport; else NaN",
    ),
    Described("viewport_most", "1", "exact", "the largest viewport of any triangle"),
    Described("samples", "1", "exact", "samples of all objects"),
    Described(
        "predicted_m",
        "m",
        "exact",
        "largest edge / (u - 1) of any triangle: the accuracy predicted",
    ),
    Described(
        "predicted_near_m", "m", "exact", "the same over triangles not proved free in every frame"
    ),
)
_FRAME_COLUMNS = (
    Described("index", "1", "exact", "number of the frame in the session"),
    Described("decode_s", "s", "exact", "reading the pictures, summed over the cameras"),
    Described("segment_s", "s", "exact", "cutting out the silhouettes, summed over the cameras"),
    Described("hull_s", "s", "exact", "integral images of the silhouettes"),
    Described("boxes_s", "s", "exact", "asking the bounding boxes of the objects"),
    Described(
        "certify_s",
        "s",
        "exact",
        "certificates of the triangles; part of the truth, not of a query",
    ),
    Described(
        "sample_s", "s", "exact", "sampling the truth densely; part of the truth, not of a query"
    ),
    Described(
        "triangles_asked", "1", "exact", "triangles of the objects whose box is not proved free"
    ),
    Described(
        "triangles_colliding",
        "1",
        "exact",
        "triangles with a witness inside the hull, in double precision",
    ),
    Described("triangles_open", "1", "exact", "triangles neither proved free nor with a witness"),
    Described("objects_colliding", "1", "exact", "objects with a triangle certified to collide"),
    Described(
        "truth_points", "1", "sampled", "true collision points that distances are measured from"
    ),
)
_ENGINE_COLUMNS = (
    Described(
        "query_s",
        "s",
        "exact",
        "seconds a frame of every repeat, mean over frames: hull to samples",
    ),
    Described(
        "place_s",
        "s",
        "exact",
        "seconds a frame of every repeat, mean over frames: samples to points",
    ),
    Described("time_s", "s", "exact", "seconds a frame of every repeat: query and place"),
    Described("time_median_s", "s", "exact", "median of time_s over the repeats"),
    Described("time_iqr_s", "s", "exact", "interquartile range of time_s over the repeats"),
    Described("points", "1", "sampled", "collision points a frame, mean"),
    Described(
        "triangles_missed",
        "1",
        "sampled",
        "triangles certified to collide without a sample, over all frames",
    ),
    Described(
        "objects_missed",
        "1",
        "sampled",
        "objects certified to collide without a point, over all frames",
    ),
    Described(
        "triangles_against_proof", "1", "sampled", "triangles with a sample although proved free"
    ),
    Described(
        "distance_max_m",
        "m",
        "sampled",
        "largest distance of a true collision point to a reported one",
    ),
    Described(
        "distance_p99_m",
        "m",
        "sampled",
        "99th percentile of that distance over dense samples of the truth",
    ),
    Described(
        "distance_median_m",
        "m",
        "sampled",
        "median of that distance over dense samples of the truth",
    ),
    Described(
        "within_predicted",
        "1",
        "sampled",
        "share of true points with a reported one within predicted_near_m",
    ),
    Described(
        "on_front",
        "1",
        "sampled",
        "on the Pareto front of time, largest distance and objects missed",
    ),
)
_COST_COLUMNS = (
    Described("fitted", "1", "exact", "whether the row was fitted; the others are foretold"),
    Described("fill_px", "1", "exact", "n m u^2 / 2 a frame: pixels filled in all cameras"),
    Described(
        "read_back_px", "1", "exact", "window pixels, or samples inside the hull, read back a frame"
    ),
    Described("predicted_s", "s", "estimate", "seconds a frame of the model"),
    Described("residual", "1", "estimate", "model less measured median, relative to the median"),
)
_COST_ATTRIBUTES = (
    "fixed_s",
    "transform_most_s",
    "fill_s_per_px",
    "read_back_s_per_px",
    "read_back",
    "residual_rms",
    "residual_most",
    "freedom",
    "condition",
)


def write_sweep(path: Path, sweep: Sweep) -> None:
    """Write a sweep; the file appears only when it is complete.

    Raises
    ------
    ReportError
        If it cannot be written.
    """
    with writing(path) as file:
        _write(file, sweep)


def read_sweep(path: Path) -> Sweep:
    """Return what a sweep file holds.

    Raises
    ------
    ReportError
        If there is no such file, it is not a sweep, of an unknown version, or damaged.
    """
    with reading(path, "sweep", VERSION) as file:
        return _read(file)


def _write(file: h5py.File, sweep: Sweep) -> None:
    write_run(file, "sweep", VERSION, sweep.run)
    file.attrs["cameras"] = sweep.cameras
    store_text(file, "settings", json.dumps(sweep.settings), "the resolved configuration, JSON")
    rows = file.create_group("rows")
    store_fields(rows, sweep.rows, _ROW_COLUMNS)
    store_fields(file.create_group("frames"), sweep.frames, _FRAME_COLUMNS)
    file.create_group("truth").attrs.update(asdict(sweep.truth))
    engines = file.create_group("engines", track_order=True)
    for engine in sweep.engines:
        group = engines.create_group(engine.name)
        group.attrs["renderer"] = engine.renderer
        group["viewport"] = rows["viewport"]  # the same dataset, so that a group says all
        group["predicted_near_m"] = rows["predicted_near_m"]
        store_fields(group, engine, _ENGINE_COLUMNS)
        if engine.cost is not None:
            cost = group.create_group("cost")
            store_fields(cost, engine.cost, _COST_COLUMNS)
            cost.attrs.update({name: getattr(engine.cost, name) for name in _COST_ATTRIBUTES})


def _read(file: h5py.File) -> Sweep:
    return Sweep(
        run=read_run(file),
        settings=json.loads(file["settings"].asstr()[()]),
        cameras=int(file.attrs["cameras"]),
        rows=_load(SweepRows, file["rows"], _ROW_COLUMNS),
        frames=_load(SweepFrames, file["frames"], _FRAME_COLUMNS),
        truth=TruthSettings(**_attributes(file["truth"])),
        engines=tuple(
            _load(
                EngineSweep,
                group,
                _ENGINE_COLUMNS,
                name=name,
                renderer=group.attrs["renderer"],
                cost=_load(CostModel, group["cost"], _COST_COLUMNS, **_attributes(group["cost"]))
                if "cost" in group
                else None,
            )
            for name, group in file["engines"].items()
        ),
    )


def _load(
    kind: type[Loaded], group: h5py.Group, columns: Sequence[Described], **others: Any
) -> Loaded:
    wanted = {field.name for field in fields(kind)}  # type: ignore[arg-type]  # all are dataclasses
    return kind(**{c.name: group[c.name][()] for c in columns if c.name in wanted}, **others)


def _attributes(group: h5py.Group) -> dict[str, Any]:
    return {
        name: value.item() if isinstance(value, np.generic) else value
        for name, value in group.attrs.items()
    }


def _median_and_iqr(values: NDArray[np.float64]) -> dict[str, float]:
    first, median, third = np.percentile(values, [25, 50, 75]).tolist()
    return {"median": median, "iqr": third - first}


def sweep_as_dict(sweep: Sweep) -> dict[str, Any]:
    """Return what a sweep found, as plain JSON values; numbers that are not there are None."""
    rows, frames = sweep.rows, sweep.frames
    asked, n_open = int(frames.triangles_asked.sum()), int(frames.triangles_open.sum())
    colliding = int(frames.triangles_colliding.sum())
    return {
        "command": sweep.run.command,
        "machine": sweep.run.machine,
        "created_utc": sweep.run.created_utc,
        "frames": frames.index.tolist(),
        "cameras": sweep.cameras,
        "stage_ms": {
            stage: _median_and_iqr(1e3 * getattr(frames, f"{stage}_s"))
            for stage in ("decode", "segment", "hull", "boxes", "certify", "sample")
        },
        "truth": {
            **to_json(asdict(sweep.truth)),
            "triangles_asked": asked,
            "triangles_colliding": colliding,
            "triangles_open": n_open,
            "open_share": n_open / asked if asked else None,
            "objects_colliding": int(frames.objects_colliding.sum()),
            "points": int(frames.truth_points.sum()),
        },
        "engines": [
            {
                "name": engine.name,
                "renderer": engine.renderer,
                "rows": [
                    {
                        "label": rows.labels[row],
                        "viewport": int(rows.viewport[row]) or None,
                        "accuracy_m": to_json(rows.accuracy_m[row]),
                        "samples": int(rows.samples[row]),
                        "ms_median": 1e3 * float(engine.time_median_s[row]),
                        "ms_iqr": 1e3 * float(engine.time_iqr_s[row]),
                        "query_ms_median": 1e3 * float(np.median(engine.query_s[row])),
                        "place_ms_median": 1e3 * float(np.median(engine.place_s[row])),
                        "ms_repeats": (1e3 * engine.time_s[row]).tolist(),
                        "points": float(engine.points[row]),
                        "triangles_missed": int(engine.triangles_missed[row]),
                        "triangles_missed_share": (
                            int(engine.triangles_missed[row]) / colliding if colliding else None
                        ),
                        "objects_missed": int(engine.objects_missed[row]),
                        "triangles_against_proof": int(engine.triangles_against_proof[row]),
                        "distance_max_m": to_json(engine.distance_max_m[row]),
                        "distance_p99_m": to_json(engine.distance_p99_m[row]),
                        "distance_median_m": to_json(engine.distance_median_m[row]),
                        "predicted_m": float(rows.predicted_m[row]),
                        "predicted_near_m": to_json(rows.predicted_near_m[row]),
                        "within_predicted": to_json(engine.within_predicted[row]),
                        "held": held(engine, row),
                        "on_front": bool(engine.on_front[row]),
                    }
                    for row in range(len(rows.viewport))
                ],
                "cost": None
                if engine.cost is None
                else {
                    **{name: getattr(engine.cost, name) for name in _COST_ATTRIBUTES},
                    "holds": engine.cost.holds,
                    "residual": engine.cost.residual.tolist(),
                    "fitted": engine.cost.fitted.tolist(),
                },
            }
            for engine in sweep.engines
        ],
    }


def held(engine: EngineSweep, row: int) -> bool | None:
    """Tell whether the accuracy predicted held: no true point is farther, no object missed.

    None where nothing collides, so that nothing was measured.
    """
    if engine.objects_missed[row]:
        return False
    if math.isnan(engine.within_predicted[row]):
        return None
    return bool(engine.within_predicted[row] == 1.0)
