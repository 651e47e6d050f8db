"""The numbers that a report comes down to."""

from collections import Counter
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.report.read import ObjectColumns, Report


def summarize(report: Report) -> dict[str, Any]:
    """Return what a report found, as plain JSON values.

    Returns
    -------
    dict
        ``report``, ``frames``, ``frames_invalid``, ``reasons`` (text to count), ``seconds`` (from
        first to last frame), ``engine``, ``renderer``, ``stage_ms_mean``, ``viewports`` (smallest
        and largest), ``samples``, ``sample_spacing_m`` (largest) and ``objects``: for
        each ``name``, ``verdict`` ("colliding", "free": proved in every evaluated frame, "open": so
        but for contacts thinner than ``open_at_m``, "clear": no sample collided, nothing more was
        asked), frames by what is known of them (``frames_colliding``: sampled or certified; frames
        without a sample but with a witness are those that sampling alone would have missed),
        ``spans`` of touching frames and the most points and triangles in one frame.
    """
    is_valid = report.reason == ""
    every = list(report.objects.values())
    return {
        "report": str(report.path),
        "frames": len(report.index),
        "frames_invalid": int((~is_valid).sum()),
        "reasons": dict(Counter(report.reason[~is_valid].tolist())),
        "seconds": float(report.time_s[-1] - report.time_s[0]) if len(report.time_s) else 0.0,
        "engine": report.attributes.get("engine", ""),
        "renderer": report.attributes.get("renderer", ""),
        "stage_ms_mean": {
            stage: float(np.mean(seconds)) * 1e3 for stage, seconds in report.stage_s.items()
        },
        "viewports": [
            min((rows.about.get("smallest_viewport", 0) for rows in every), default=0),
            max((rows.about.get("largest_viewport", 0) for rows in every), default=0),
        ],
        "samples": sum(rows.about.get("samples", 0) for rows in every),
        "sample_spacing_m": max(
            (rows.about["sample_spacing_m"] for rows in every if "sample_spacing_m" in rows.about),
            default=None,
        ),
        "objects": [
            {"name": name, **_summarize_object(rows, report, is_valid)}
            for name, rows in report.objects.items()
        ],
    }


def _summarize_object(
    rows: ObjectColumns, report: Report, is_valid: NDArray[np.bool_]
) -> dict[str, Any]:
    proved_free = rows.certificate == "free"
    has_witness = rows.certificate == "colliding"
    is_open = rows.certificate == "open"
    if (rows.collides | has_witness).any():
        verdict = "colliding"
    elif is_valid.any() and proved_free[is_valid].all():
        verdict = "free"
    elif is_valid.any() and (proved_free | is_open)[is_valid].all():
        verdict = "open"
    else:
        verdict = "clear" if is_valid.any() else "unknown"
    return {
        "verdict": verdict,
        "frames_colliding": int((rows.collides | has_witness).sum()),
        "frames_sampled_colliding": int(rows.collides.sum()),
        "frames_with_witness": int(has_witness.sum()),
        "frames_proved_free": int(proved_free.sum()),
        "frames_open": int(is_open.sum()),
        "open_at_m": float(rows.open_at_m[is_open].max()) if is_open.any() else None,
        "points_most": int(rows.n_points.max(initial=0)),
        "triangles_most": int(rows.n_triangles.max(initial=0)),
        "sample_spacing_m": rows.about.get("sample_spacing_m"),
        "spans": [
            {
                "first_frame": int(report.index[first]),
                "last_frame": int(report.index[last]),
                "start_s": float(report.time_s[first]),
                "stop_s": float(report.time_s[last]),
            }
            for first, last in spans(rows.collides | has_witness)
        ],
    }


def spans(flags: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return the first and last row of each run of true flags.

    Examples
    --------
    >>> spans(np.array([False, True, True, False, True]))
    [(1, 2), (4, 4)]
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]])))
    return [(int(a), int(b) - 1) for a, b in list(pairwise(edges.tolist()))[::2]]
