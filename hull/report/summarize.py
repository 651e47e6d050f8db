"""The numbers that a report comes down to."""

from collections import Counter
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.report.read import ObjectColumns, Report


def summarize(report: Report) -> dict[str, Any]:
    """Return what a report found, as plain JSON values; None where something is not known.

    Returns
    -------
    dict
        ``report``, ``frames``, ``frames_invalid``, ``reasons`` (text to count),
        ``frames_without_hull`` (see `count_without_hull`), ``seconds`` (from first to last frame),
        ``engine``, ``renderer``, ``stage_ms_mean``, ``viewports`` (smallest and largest),
        ``samples``, ``sample_spacing_m`` (largest) and ``objects``: for each ``name``, ``verdict``
        ("colliding"; "inside": never touched, but something was wholly inside the closed object;
        "free": proved in every evaluated frame; "open": so but for contacts thinner than
        ``open_at_m``; "clear": no sample collided, nothing more was
        asked), frames by what is known of them (``frames_colliding``: sampled or certified; frames
        without a sample but with a witness are those that sampling alone would have missed;
        ``frames_inside`` besides), the most points and triangles in one frame and ``spans`` of
        clashing frames, each with its first contact and the speed of approach.

        ``closed`` (whether the mesh closes off a volume: whether something is inside can be told).
        Where they were computed, ``clearance``: the smallest one, its bounds, where, when, and what
        it is at least at 95 %; ``depth``: the deepest, bounds and when; ``recovery``: the longest
        D_rec, as published too; ``frames_below_required``: clashing frames and those in which the
        hull is certainly nearer than ``required_clearance_m``, and
        ``frames_perhaps_below_required``: others in which it may be; ``frames_hinging``: clashing
        frames whose verdict one camera could turn, and ``hinges_on``, those cameras;
        ``frames_unsure``: clashing frames of a volume that may hold nothing real.
    """
    is_valid = report.reason == ""
    every = list(report.objects.values())
    return {
        "report": str(report.path),
        "frames": len(report.index),
        "frames_invalid": int((~is_valid).sum()),
        "reasons": dict(Counter(report.reason[~is_valid].tolist())),
        "frames_without_hull": count_without_hull(report),
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
            {
                "name": name,
                **_about_touching(rows, report, is_valid),
                **_about_clearance(rows, report, is_valid),
                **_about_recovery(rows, report),
                **_about_doubt(rows),
            }
            for name, rows in report.objects.items()
        ],
    }


def count_without_hull(report: Report) -> int | None:
    """Return how many evaluated frames have no hull near any object; None if nobody looked.

    As a rule a camera's silhouette is empty there: everything is free, which says little.
    """
    uppers_m = [
        rows["clearance_m"][:, 1] for rows in report.objects.values() if "clearance_m" in rows
    ]
    return int(np.isinf(uppers_m).all(axis=0).sum()) if uppers_m else None


def failing(summary: dict[str, Any]) -> list[str]:
    """Return the names of the objects that clash or are certainly nearer than they may be."""
    return [
        found["name"]
        for found in summary["objects"]
        if found["frames_colliding"] or found["frames_inside"] or found["frames_below_required"]
    ]


def _about_touching(
    rows: ObjectColumns, report: Report, is_valid: NDArray[np.bool_]
) -> dict[str, Any]:
    proved_free = (rows.certificate == "free") & ~rows.is_inside
    has_witness = rows.certificate == "colliding"
    is_open = rows.certificate == "open"
    if rows.touches.any():
        verdict = "colliding"
    elif rows.is_inside.any():
        verdict = "inside"
    elif is_valid.any() and proved_free[is_valid].all():
        verdict = "free"
    elif is_valid.any() and (proved_free | is_open)[is_valid].all():
        verdict = "open"
    else:
        verdict = "clear" if is_valid.any() else "unknown"
    return {
        "verdict": verdict,
        "frames_colliding": int(rows.touches.sum()),
        "frames_sampled_colliding": int(rows.collides.sum()),
        "frames_with_witness": int(has_witness.sum()),
        "frames_inside": int(rows.is_inside.sum()),
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
                **{name: _plain(rows[name][first]) for name in _ENTRY if name in rows},
            }
            for first, last in spans(rows.clashes)
        ],
    }


#: What the first frame of a span says of how it came about.
_ENTRY = (
    "first_contact_s",
    "first_contact_uncertainty_s",
    "first_contact_m",
    "first_contact_status",
    "approach_m_s",
)


def _about_clearance(
    rows: ObjectColumns, report: Report, is_valid: NDArray[np.bool_]
) -> dict[str, Any]:
    required_m = float(rows.about.get("required_clearance_m", 0.0))
    found: dict[str, Any] = {
        "closed": rows.about.get("closed"),
        "required_clearance_m": required_m,
        "frames_below_required": None,
        "frames_perhaps_below_required": None,
        "clearance": None,
        "depth": None,
    }
    if "clearance_m" not in rows or not is_valid.any():
        return found
    lower_m, upper_m = rows["clearance_m"].T
    is_below = is_valid & (upper_m < required_m)
    found["frames_below_required"] = int(is_below.sum())
    found["frames_perhaps_below_required"] = int(
        (is_valid & ~is_below & (lower_m < required_m)).sum()
    )
    valid = np.flatnonzero(is_valid)
    row = int(valid[np.lexsort((upper_m[valid], lower_m[valid]))[0]])
    at_least_m = rows.get("clearance_at_least_m")
    found["clearance"] = {
        "lower_m": _plain(lower_m[row]),
        "upper_m": _plain(upper_m[row]),
        "at_least_95_m": None
        if at_least_m is None
        else _plain(np.fmin.reduce(np.where(lower_m > 0, at_least_m, 0.0)[valid])),
        "frame": int(report.index[row]),
        "time_s": float(report.time_s[row]),
        "on_object_m": _plain(rows["clearance_on_object_m"][row]),
        "on_hull_m": _plain(rows["clearance_on_hull_m"][row]),
    }
    depth_m = np.nan_to_num(rows["depth_m"])
    row = int(depth_m[:, 0].argmax())
    if depth_m[row, 0] > 0:
        found["depth"] = {
            "lower_m": float(depth_m[row, 0]),
            "upper_m": float(depth_m[row, 1]),
            "frame": int(report.index[row]),
            "time_s": float(report.time_s[row]),
        }
    return found


def _about_recovery(rows: ObjectColumns, report: Report) -> dict[str, Any]:
    if "d_rec_m" not in rows or np.isnan(rows["d_rec_m"]).all():
        return {"recovery": None}
    row = int(np.nanargmax(rows["d_rec_m"]))
    return {
        "recovery": {
            "d_rec_m": float(rows["d_rec_m"][row]),
            "d_rec_paper_m": _plain(rows["d_rec_paper_m"][row]),
            "v_rec": _plain(rows["v_rec"][row]),
            "frame": int(report.index[row]),
            "time_s": float(report.time_s[row]),
        }
    }


def _about_doubt(rows: ObjectColumns) -> dict[str, Any]:
    if "survives" not in rows:
        return {"frames_hinging": None, "hinges_on": [], "frames_unsure": None}
    hinges = rows.clashes & (rows["survives"] == "no")
    cameras = {name for text in rows["hinges_on"][hinges] for name in text.split(", ") if name}
    return {
        "frames_hinging": int(hinges.sum()),
        "hinges_on": sorted(cameras),
        "frames_unsure": int((rows.clashes & (rows["component"] == "unsure")).sum()),
    }


def _plain(value: Any) -> Any:
    """Return a value as JSON has it; None for a number that is not finite."""
    if isinstance(value, np.ndarray):
        return [_plain(one) for one in value]
    if isinstance(value, np.floating):
        return float(value) if np.isfinite(value) else None
    return str(value)


def spans(flags: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return the first and last row of each run of true flags.

    Examples
    --------
    >>> spans(np.array([False, True, True, False, True]))
    [(1, 2), (4, 4)]
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]])))
    return [(int(a), int(b) - 1) for a, b in list(pairwise(edges.tolist()))[::2]]
