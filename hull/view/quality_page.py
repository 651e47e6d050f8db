"""The page of a session's silhouettes: what to look at first, curves, pictures with outlines."""

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.errors import ReportError
from hybridve.calib.files import write_whole
from hybridve.hull.agreement.record import NamedCause
from hybridve.hull.view.packed import webp
from hybridve.hull.view.pages import page_template
from hybridve.hull.view.silhouette_chart import draw_silhouettes

#: Quality of its pictures, as WebP counts it.
_QUALITY = 70

#: Frames without silhouettes that are listed one by one.
_MOST_LISTED = 20


@dataclass(frozen=True, slots=True, eq=False)
class LookAt:
    """One frame: its number, why it is to be looked at, and what the cameras saw, BGR."""

    frame: int
    why: str
    sheet: NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class _Shown:
    frame: int
    why: str
    webp: str


def write_quality_page(
    path: Path,
    *,
    title: str,
    names: Sequence[str],
    time_s: NDArray[np.float64],
    shares: NDArray[np.float64],
    supported: NDArray[np.float64],
    invalid: Sequence[tuple[int, str]],
    causes: Sequence[NamedCause],
    is_trusted: bool,
    is_confirmed: bool,
    looks: Sequence[LookAt],
    usual: Sequence[LookAt],
) -> None:
    """Write the page, which appears only when it is complete.

    Parameters
    ----------
    path : Path
        An .html.
    title : str
        The session.
    names, time_s, shares, supported
        As of `hybridve.hull.view.silhouette_chart.draw_silhouettes`.
    invalid : sequence of (int, str)
        Frames that have no silhouettes, and why.
    causes, is_trusted
        What the cameras say about each other.
    is_confirmed : bool
        Whether there was a rig by which they could.
    looks, usual : sequence of LookAt
        Frames that are to be looked at first, and some others.

    Raises
    ------
    ReportError
        If it cannot be written.
    """
    with mpl.rc_context({"svg.fonttype": "path", "svg.hashsalt": "hybridve"}):
        figure = draw_silhouettes(names, time_s, shares, supported, [one.frame for one in looks])
        buffer = io.BytesIO()
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    text = page_template("quality.html.jinja").render(
        title=title,
        n_frames=len(time_s),
        cameras=[
            {
                "name": name,
                "share": _mean(shares[:, number]),
                "supported": _least(supported[:, number]),
            }
            for number, name in enumerate(names)
        ],
        curves=base64.b64encode(buffer.getvalue()).decode("ascii"),
        invalid=invalid[:_MOST_LISTED],
        n_invalid=len(invalid),
        causes=causes,
        is_trusted=is_trusted,
        is_confirmed=is_confirmed,
        looks=[_Shown(one.frame, one.why, webp(one.sheet, _QUALITY)) for one in looks],
        usual=[_Shown(one.frame, one.why, webp(one.sheet, _QUALITY)) for one in usual],
    )
    try:
        write_whole(path, text)
    except OSError as error:
        raise ReportError(f"{path}: cannot be written: {error}") from error


def _mean(shares: NDArray[np.float64]) -> float:
    """Return the mean of those that are known."""
    known = shares[np.isfinite(shares)]
    return float(known.mean()) if len(known) else np.nan


def _least(supported: NDArray[np.float64]) -> float:
    """Return what is supported in all but one of twenty frames."""
    known = supported[np.isfinite(supported)]
    return float(np.quantile(known, 0.05)) if len(known) else np.nan
