"""The numbers that a report comes down to."""

import re
from collections import Counter
from collections.abc import Collection
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.plain import to_json
from hybridve.hull.contact.verdict import VERDICTS, worst
from hybridve.hull.report.read import ObjectColumns, Report


def summarize(report: Report) -> dict[str, Any]:
    """Return what a report found, as plain JSON values; None where something is not known.

    Returns
    -------
    dict
        ``trusted`` (whether the cameras agree so far that the session may be believed), ``causes``
        (what is wrong with them; see `hybridve.hull.agreement.record.NamedCause`), ``cameras``
        (by name, how they fit the others; see `CameraAgreement` there), ``verdict`` (the worst of
        all objects and frames), ``objects_by_verdict`` (how many have which), ``report``,
        ``frames``, ``frames_invalid``, ``frames_contradictory`` (of these), ``reasons`` (text to
        count) and ``reason_frames`` (text to numbers of frames),
        ``rests_on`` (what the emptiness of frames without a hull rests on, to count),
        ``kept_rests_on`` (which cameras saw nothing in any frame, in words: all that is kept rests
        on that; else empty),
        ``frames_without_hull`` (see `count_without_hull`), ``seconds`` (from first to last frame),
        ``engine``, ``renderer``, ``stage_ms_mean``, ``viewports`` (smallest and largest),
        ``samples``, ``sample_spacing_m`` (largest) and ``objects``, worst first: for each ``name``,
        ``verdict`` (its worst; see `hybridve.hull.contact.verdict`), ``frames_by_verdict``,
        ``why`` (reasons of these frames to their number), frames by what is known of them
        (``frames_colliding``: sampled or certified; frames without a sample but with a witness are
        those that sampling alone would have missed; ``frames_inside`` besides), the most points,
        triangles and patches in one frame and ``spans`` of clashing frames, each with its first
        contact and the speed of approach. Frames that were not evaluated do not end a span.

        ``closed`` (whether the mesh closes off a volume: whether something is inside can be told).
        Where they were computed, ``clearance``: the smallest one, its bounds, where, when, and what
        it is at least at 95 %; ``depth``: the deepest, bounds and when; ``recovery``: the longest
        D_rec, as published too, in how many frames V_rec does not leave the hull, in how many
        moving by D_rec was asked to free the whole object and does, and the shift along V_rec that
        does in every frame (None if one has none); ``frames_below_required``: clashing frames and
        those in which the hull is certainly nearer than ``required_clearance_m``, and
        ``frames_perhaps_below_required``: others in which it may be; ``frames_hinging``: clashing
        frames whose verdict one camera could turn, and ``hinges_on``, those cameras;
        ``frames_unsure``: clashing frames of a volume that may hold nothing real.
    """
    is_valid = report.reason == ""
    every = list(report.objects.values())
    objects = [
        {
            "name": name,
            **_about_verdict(rows),
            **_about_touching(rows, report, is_valid),
            **_about_clearance(rows, report, is_valid),
            **_about_recovery(rows, report),
            **_about_doubt(rows),
        }
        for name, rows in report.objects.items()
    ]
    objects.sort(key=_badness)
    verdicts = Counter(str(found["verdict"]) for found in objects)
    return {
        "trusted": report.agreement.is_trusted,
        "causes": to_json(report.agreement.causes),
        "cameras": to_json(report.agreement.cameras),
        "verdict": worst(set(verdicts)),
        "objects_by_verdict": {one: verdicts[one] for one in VERDICTS if verdicts[one]},
        "report": str(report.path),
        "frames": len(report.index),
        "frames_invalid": int((~is_valid).sum()),
        "frames_contradictory": int((report.state == "contradictory").sum()),
        "reasons": dict(Counter(report.reason[~is_valid].tolist())),
        "reason_frames": {
            why: report.index[report.reason == why].tolist()
            for why in dict.fromkeys(report.reason[~is_valid].tolist())
        },
        "rests_on": dict(Counter(text for text in report.rests_on.tolist() if text)),
        "kept_rests_on": report.agreement.rests_on,
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
        "objects": objects,
    }


def _badness(found: dict[str, Any]) -> tuple[int, float, int]:
    """Return what objects are sorted by: the worst first, of equals the nearest, the longest."""
    lower_m = (found["clearance"] or {}).get("lower_m")
    spare_m = np.inf if lower_m is None else lower_m - found["required_clearance_m"]
    frames = found["frames_by_verdict"].get(found["verdict"], 0)
    return VERDICTS.index(found["verdict"]), spare_m, -frames


def count_without_hull(report: Report) -> int | None:
    """Return how many evaluated frames have no hull near any object; None if nobody looked.

    As a rule a camera's silhouette is empty there: everything is free, which says little.
    """
    uppers_m = [
        rows["clearance_m"][:, 1] for rows in report.objects.values() if "clearance_m" in rows
    ]
    return int(np.isinf(uppers_m).all(axis=0).sum()) if uppers_m else None


def failing(summary: dict[str, Any], let_pass: Collection[str] = ()) -> list[str]:
    """Return the names of the objects of which not every frame says that they keep their distance.

    Of a session that is not to be trusted, these are all, whatever is let pass.

    Parameters
    ----------
    summary : dict
        What `summarize` returned.
    let_pass : collection of str
        Verdicts besides "kept" that are good enough.
    """
    good = {"kept", *let_pass}
    return [
        found["name"]
        for found in summary["objects"]
        if not summary["trusted"]
        or not found["frames_by_verdict"]
        or not good.issuperset(found["frames_by_verdict"])
    ]


def _about_verdict(rows: ObjectColumns) -> dict[str, Any]:
    counts = Counter(rows.verdict.tolist())
    return {
        "verdict": worst(set(counts)),
        "frames_by_verdict": {one: counts[one] for one in VERDICTS if counts[one]},
        "why": dict(Counter(_kind(why) for why in rows.why.tolist() if why)),
    }


def _kind(reason: str) -> str:
    """Return a reason without its numbers, so that reasons of a kind are counted together."""
    return re.sub(r"\d+(\.\d+)?", "..", reason) if " mm " in reason else reason


def _about_touching(
    rows: ObjectColumns, report: Report, is_valid: NDArray[np.bool_]
) -> dict[str, Any]:
    proved_free = (rows.certificate == "free") & ~rows.is_inside
    has_witness = rows.certificate == "colliding"
    is_open = rows.certificate == "open"
    # Something was seen, and no hull came of it: a contact may go on.
    is_doubtful = (report.rests_on != "") & (rows.verdict == "open")
    offset = rows.patches.get("offset", np.zeros(1, np.uint64))
    return {
        "frames_colliding": int(rows.touches.sum()),
        "frames_sampled_colliding": int(rows.collides.sum()),
        "frames_with_witness": int(has_witness.sum()),
        "frames_inside": int(rows.is_inside.sum()),
        "frames_proved_free": int(proved_free.sum()),
        "frames_open": int(is_open.sum()),
        "open_at_m": float(rows.open_at_m[is_open].max()) if is_open.any() else None,
        "points_most": int(rows.n_points.max(initial=0)),
        "triangles_most": int(rows.n_triangles.max(initial=0)),
        "patches_most": int(np.diff(offset.astype(np.int64)).max(initial=0)),
        "sample_spacing_m": rows.about.get("sample_spacing_m"),
        "spans": [
            {
                "first_frame": int(report.index[first]),
                "last_frame": int(report.index[last]),
                "start_s": float(report.time_s[first]),
                "stop_s": float(report.time_s[last]),
                **{name: to_json(rows[name][first]) for name in _ENTRY if name in rows},
            }
            for first, last in spans(rows.clashes, ~is_valid | is_doubtful)
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
        "lower_m": to_json(lower_m[row]),
        "upper_m": to_json(upper_m[row]),
        "at_least_95_m": None
        if at_least_m is None
        else to_json(np.fmin.reduce(np.where(lower_m > 0, at_least_m, 0.0)[valid])),
        "frame": int(report.index[row]),
        "time_s": float(report.time_s[row]),
        "on_object_m": to_json(rows["clearance_on_object_m"][row]),
        "on_hull_m": to_json(rows["clearance_on_hull_m"][row]),
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
    if "d_rec_m" not in rows:
        return {"recovery": None}
    no_exit = int((rows["response_status"] == "no exit").sum())
    d_rec_m = rows["d_rec_m"]
    if np.isnan(d_rec_m).all() and not no_exit:
        return {"recovery": None}
    row = int(np.argmax(np.nan_to_num(d_rec_m, nan=-1.0)))
    frees = rows.get("recovery_frees")
    asked = np.zeros(len(d_rec_m), np.bool_) if frees is None else frees != ""
    shift_m = np.nan if frees is None or not asked.any() else rows["free_shift_m"][asked, 1].max()
    return {
        "recovery": {
            "d_rec_m": to_json(d_rec_m[row]),
            "frames_no_exit": no_exit,
            "frames_asked_to_free": int(asked.sum()),
            "frames_freed": 0 if frees is None else int((frees == "yes").sum()),
            "free_shift_m": to_json(shift_m),
            "d_rec_paper_m": to_json(rows["d_rec_paper_m"][row]),
            "v_rec": to_json(rows["v_rec"][row]),
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


def spans(
    flags: NDArray[np.bool_], unknown: NDArray[np.bool_] | None = None
) -> list[tuple[int, int]]:
    """Return the first and last row of each run of true flags.

    Rows of which nothing is known do not end a run that goes on behind them.

    Examples
    --------
    >>> flags = np.array([False, True, True, False, True])
    >>> spans(flags)
    [(1, 2), (4, 4)]
    >>> spans(flags, np.array([True, False, False, True, False]))
    [(1, 4)]
    """
    if unknown is not None and unknown.any():
        known = np.flatnonzero(~unknown)
        runs = spans(flags[known])
        return [(int(known[first]), int(known[last])) for first, last in runs]
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]])))
    return [(int(a), int(b) - 1) for a, b in list(pairwise(edges.tolist()))[::2]]
