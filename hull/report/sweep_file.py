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
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, TypeVar

import h5py
import numpy as np
from numpy.typing import NDArray

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

#: By how much of the time measured the cost model may be off in any row and yet hold.
_COST_HOLDS = 0.2

Loaded = TypeVar("Loaded")


@dataclass(frozen=True, slots=True, eq=False)
class SweepRows:
    """What was asked: U rows, the same for every engine.

    Attributes
    ----------
    viewport : (U,) uint32
        Samples along every edge; 0 where each triangle has its own.
    accuracy_m : (U,) float64
        The accuracy by which each triangle was given its viewport; NaN elsewhere.
    viewport_most : (U,) uint32
        The largest viewport of any triangle.
    samples : (U,) uint64
        Of all objects together.
    predicted_m : (U,) float64
        Section 4.4.3: the largest edge / (u - 1) of any triangle.
    predicted_near_m : (U,) float64
        The same over triangles that are not proved free in every frame; NaN if there is none.
    """

    viewport: NDArray[np.uint32]
    accuracy_m: NDArray[np.float64]
    viewport_most: NDArray[np.uint32]
    samples: NDArray[np.uint64]
    predicted_m: NDArray[np.float64]
    predicted_near_m: NDArray[np.float64]

    @property
    def labels(self) -> tuple[str, ...]:
        """How each row is called: "16", or "accuracy 5 mm"."""
        return tuple(
            f"{viewport}" if viewport else f"accuracy {accuracy_m * 1e3:.3g} mm"
            for viewport, accuracy_m in zip(self.viewport, self.accuracy_m, strict=True)
        )


@dataclass(frozen=True, slots=True, eq=False)
class SweepFrames:
    """The F frames that were asked, and what truly collides in them.

    Attributes
    ----------
    index : (F,) uint32
        Numbers of the frames in the session.
    decode_s, segment_s, hull_s, boxes_s : (F,) float64
        Seconds spent once a frame: pictures, silhouettes, hull, bounding boxes.
    certify_s, sample_s : (F,) float64
        Seconds that the truth took: the certificates, and sampling it densely.
    triangles_asked, triangles_colliding, triangles_open : (F,) uint32
        Of the objects whose box is not proved free; how many are certified to collide; of how
        many the certificate proves nothing.
    objects_colliding : (F,) uint32
        Objects with a triangle that is certified to collide.
    truth_points : (F,) uint64
        True collision points that the distance is measured from.
    """

    index: NDArray[np.uint32]
    decode_s: NDArray[np.float64]
    segment_s: NDArray[np.float64]
    hull_s: NDArray[np.float64]
    boxes_s: NDArray[np.float64]
    certify_s: NDArray[np.float64]
    sample_s: NDArray[np.float64]
    triangles_asked: NDArray[np.uint32]
    triangles_colliding: NDArray[np.uint32]
    triangles_open: NDArray[np.uint32]
    objects_colliding: NDArray[np.uint32]
    truth_points: NDArray[np.uint64]


@dataclass(frozen=True, slots=True)
class TruthSettings:
    """How the truth was found.

    Attributes
    ----------
    open_at_m : float
        Collisions smaller than a disc of this diameter might be missing from it, as was asked.
    open_most_m : float
        The same for the worst of the triangles that were left open, which may be larger where the
        work was bounded; 0 if none was left open, infinite if nothing is known of one.
    spacing_wanted_m, spacing_m : float
        A quarter of the finest accuracy predicted, and the spacing that was affordable; NaN if
        nothing is near the hull.
    points_most : int
        Points kept of one object in one frame, beside one witness a triangle.
    """

    open_at_m: float
    open_most_m: float
    spacing_wanted_m: float
    spacing_m: float
    points_most: int


@dataclass(frozen=True, slots=True, eq=False)
class CostModel:
    """Seconds a frame as section 4.4.2 of the paper has them, fitted to one engine's medians.

    ``t = fixed + fill_s_per_px * fill_px + read_back_s_per_px * read_back_px``, none negative.
    Triangles and cameras are the same in all rows, so that the cost of a transform cannot be told
    from that of a frame: `fixed_s` is the two together.

    Attributes
    ----------
    fixed_s : float
        c0 + a n m, with n cameras and m triangles.
    transform_most_s : float
        What one transform costs at most: `fixed_s` over n m.
    fill_s_per_px : float
        b: of one of the n m u^2 / 2 pixels filled.
    read_back_s_per_px : float
        c: of one pixel, or sample inside the hull, read back.
    read_back : str
        What is read back: "window pixel" or "sample inside".
    residual_rms, residual_most : float
        Of the rows fitted, relative to the time measured.
    freedom : int
        Rows fitted less terms: with none left, a small residual says nothing.
    condition : float
        Of the scaled system; beyond 100 fill and read-back are hardly told apart.
    fitted : (U,) bool
        Which rows were fitted; the others are foretold by them.
    fill_px, read_back_px, predicted_s, residual : (U,) float64
        The terms, the model's seconds a frame, and their difference to the measured, relative.
    """

    fixed_s: float
    transform_most_s: float
    fill_s_per_px: float
    read_back_s_per_px: float
    read_back: str
    residual_rms: float
    residual_most: float
    freedom: int
    condition: float
    fitted: NDArray[np.bool_]
    fill_px: NDArray[np.float64]
    read_back_px: NDArray[np.float64]
    predicted_s: NDArray[np.float64]
    residual: NDArray[np.float64]

    @property
    def holds(self) -> bool | None:
        """Whether no fitted row is off by more than a fifth; None if hardly any could be."""
        if self.residual_most > _COST_HOLDS:
            return False
        return None if self.freedom == 0 else True


@dataclass(frozen=True, slots=True, eq=False)
class EngineSweep:
    """One engine's answers to the U rows, asked R times.

    Attributes
    ----------
    name, renderer : str
        The engine.
    query_s, place_s : (U, R) float64
        Seconds a frame, mean over the frames: from hull to samples; from samples to points.
    points : (U,) float64
        Collision points a frame, mean.
    triangles_missed, objects_missed : (U,) uint32
        Certified to collide and without a sample, summed over the frames.
    triangles_against_proof : (U,) uint32
        With a sample although proved free: errors of the engine.
    distance_max_m, distance_p99_m, distance_median_m : (U,) float64
        From a true collision point to the nearest reported one of the same object, over all
        frames; objects missed are left out. The largest is that of witnesses and dense samples,
        the other two of dense samples alone, which are spread evenly. NaN if there is none.
    within_predicted : (U,) float64
        Share of those true points that have a reported one within the accuracy predicted.
    on_front : (U,) bool
        No row of any engine is as quick, as near, misses as few objects, and better in one.
    cost : CostModel or None
        None where there are too few viewports to fit it.
    """

    name: str
    renderer: str
    query_s: NDArray[np.float64]
    place_s: NDArray[np.float64]
    points: NDArray[np.float64]
    triangles_missed: NDArray[np.uint32]
    objects_missed: NDArray[np.uint32]
    triangles_against_proof: NDArray[np.uint32]
    distance_max_m: NDArray[np.float64]
    distance_p99_m: NDArray[np.float64]
    distance_median_m: NDArray[np.float64]
    within_predicted: NDArray[np.float64]
    on_front: NDArray[np.bool_]
    cost: CostModel | None

    @property
    def time_s(self) -> NDArray[np.float64]:
        """Seconds a frame of every repeat, (U, R): query and place."""
        return self.query_s + self.place_s

    @property
    def time_median_s(self) -> NDArray[np.float64]:
        """Median over the repeats, (U,)."""
        return np.asarray(np.median(self.time_s, axis=1))

    @property
    def time_iqr_s(self) -> NDArray[np.float64]:
        """Interquartile range over the repeats, (U,)."""
        low, high = np.percentile(self.time_s, (25, 75), axis=1)
        return np.asarray(high - low)


@dataclass(frozen=True, slots=True, eq=False)
class Sweep:
    """Accuracy against time, over viewports and engines.

    Attributes
    ----------
    run : Run
        Which run made it.
    settings : dict
        As in a report.
    cameras : int
        n of the cost model.
    rows, frames, truth, engines
        What was asked, of what, and what came of it.
    """

    run: Run
    settings: dict[str, Any]
    cameras: int
    rows: SweepRows
    frames: SweepFrames
    truth: TruthSettings
    engines: tuple[EngineSweep, ...]


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
            **{name: _number(value) for name, value in asdict(sweep.truth).items()},
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
                        "accuracy_m": _number(rows.accuracy_m[row]),
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
                        "distance_max_m": _number(engine.distance_max_m[row]),
                        "distance_p99_m": _number(engine.distance_p99_m[row]),
                        "distance_median_m": _number(engine.distance_median_m[row]),
                        "predicted_m": float(rows.predicted_m[row]),
                        "predicted_near_m": _number(rows.predicted_near_m[row]),
                        "within_predicted": _number(engine.within_predicted[row]),
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


def _number(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value
