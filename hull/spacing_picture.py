"""The room that tasks need as curves: how many frames violate against the shift."""

from pathlib import Path

import numpy as np

from hybridve.hull.contact.spacing import covers
from hybridve.hull.report.spacing_file import SessionSpacing, Spacing
from hybridve.hull.view.spacing_chart import DoubtCurve, ShiftCurve, write_spacing_chart


def write_picture_of(path: Path, spacing: Spacing) -> None:
    """Draw how many frames violate against the shift, one curve a session.

    Raises
    ------
    ReportError
        If it cannot be written.
    """
    settings = spacing.settings
    curves = [curve_of(one) for one in spacing.sessions]
    direction = ", ".join(f"{value:.3g}" for value in settings["direction"])
    required = ", ".join(f"{1e3 * one:g}" for one in dict.fromkeys(settings["required_m"]))
    title = (
        f"{', '.join(settings['move'])} along ({direction}), keeping {required} mm: frames that "
        "violate it"
    )
    write_spacing_chart(path, curves, title=title)


def curve_of(one: SessionSpacing) -> ShiftCurve:
    """Return the curve of one session with every step where it is, not where it was counted."""
    frames, counted_m = one.frames, one.curve.shift_m
    ends_m = [frames.violated.shift_m.ravel(), frames.undecided.shift_m.ravel()]
    if one.doubt is not None:
        ends_m.append(one.doubt.unsure.shift_m.ravel())
    shift_m = np.unique(np.concatenate([counted_m[[0, -1]], *ends_m]))
    middle_m = 0.5 * (shift_m[1:] + shift_m[:-1])
    violated, at_most, unsure = (np.zeros(len(middle_m)) for _ in range(3))
    for row in range(len(frames.index)):
        certain = covers(frames.violated.of(row), middle_m)
        violated += certain
        at_most += certain | covers(frames.undecided.of(row), middle_m)
        if one.doubt is not None:
            unsure += covers(one.doubt.unsure.of(row), middle_m)
    return ShiftCurve(
        name=f"{one.name} ({frames.n_valid} frames)",
        shift_mm=1e3 * shift_m,
        violated=violated,
        at_most=at_most,
        answer_mm=1e3 * one.shift_m,
        doubt=None if one.doubt is None else DoubtCurve(unsure, 1e3 * one.doubt.shift_m),
    )
