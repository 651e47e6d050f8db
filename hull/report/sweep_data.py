"""What a sweep measured, as it stands in memory."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.report.machine import Run

#: By how much of the time measured the cost model may be off in any row and yet hold.
_COST_HOLDS = 0.2


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
