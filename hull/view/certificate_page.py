"""The certificate of a calibration as a page: one HTML file that needs nothing else.

Figures are inside it as vector graphics; nothing is fetched and nothing runs. Equal input gives
the same file to the byte.
"""

import base64
import io
import math
import warnings
from collections.abc import Collection, Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any, Literal

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from hybridve.calib.errors import CalibrationError
from hybridve.calib.files import appearing
from hybridve.calib.judging.certificate import Certificate, SeenPoints, Volume
from hybridve.calib.lens import parameter_names
from hybridve.calib.record import NoOpinion, SecondOpinion
from hybridve.calib.rig import Rig
from hybridve.calib.solving.bundle import POSE
from hybridve.calib.solving.covariance import parameter_slices
from hybridve.hull.view.certificate_charts import draw_camera
from hybridve.hull.view.rig_charts import draw_errors, draw_rig

#: What a page can say at first sight.
State = Literal["good", "limits", "refused"]

#: By state: a sign, words, the colour and the style of the border.
_STATES: dict[State, tuple[str, str, str, str]] = {
    "good": ("\u2713", "good", "#00684A", "solid"),
    "limits": ("!", "usable, with limits", "#8A5A00", "dashed"),
    "refused": ("\u2715", "refused", "#B00020", "double"),
}

#: Lists longer than this are folded; marks put in as images have this many dots an inch.
_MOST_SHOWN = 12
_DPI = 150

#: The error without its largest cause must be smaller by this factor for the cause to stand out.
_STANDS_OUT = 0.8

_UNKNOWN = '<span class="none">unknown</span>'

_STYLE = """
:root { color-scheme: light; }
body { background: #fff; color: #222; max-width: 1120px; margin: 0 auto; padding: 1.2rem;
       font: .94rem/1.45 system-ui, -apple-system, "Segoe UI", Roboto, "DejaVu Sans", sans-serif; }
h1 { font-size: 1.15rem; font-weight: 600; margin: 0 0 .8rem; color: #444; }
h2 { font-size: 1.2rem; margin: 2.2rem 0 .5rem; border-bottom: 1px solid #ccc; }
h3 { font-size: 1rem; margin: 1.2rem 0 .2rem; }
h3 small, .note { color: #555; font-weight: 400; font-size: .88rem; }
.note { max-width: 50rem; margin: .3rem 0; }
.verdict { border: 5px; border-color: var(--cue); padding: .8rem 1.1rem; border-radius: 4px; }
.verdict .state { color: var(--cue); font-weight: 700; letter-spacing: .08em;
                  text-transform: uppercase; }
.verdict .words { font-size: 1.6rem; line-height: 1.25; font-weight: 600; margin: .15rem 0 0; }
.numbers { display: flex; flex-wrap: wrap; gap: .5rem; margin: .9rem 0; }
.numbers div { flex: 1 1 13rem; border: 1px solid #ccc; border-radius: 4px; padding: .4rem .7rem; }
.numbers b { display: block; font-size: 1.35rem; }
.numbers span { font-size: .85rem; color: #444; }
.warnings li, .todo li { margin: .25rem 0; max-width: 55rem; }
figure { margin: .3rem 0 1rem; }
figure img { width: 100%; height: auto; display: block; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: .9rem; }
th, td { text-align: left; padding: .22rem .7rem .22rem 0; border-bottom: 1px solid #ddd;
         vertical-align: top; overflow-wrap: break-word; max-width: 40rem; }
th { font-weight: 600; color: #444; }
td.n, th.n { text-align: right; }
td.n { white-space: nowrap; }
.none { color: #777; font-style: italic; }
.bar { display: inline-block; height: .8rem; background: #0072B2; vertical-align: -.08rem;
       margin-right: .5rem; print-color-adjust: exact; -webkit-print-color-adjust: exact; }
.bar.less { background: #56B4E9; }
details { margin: .25rem 0; }
details > :not(summary) { margin-left: 1rem; }
summary { cursor: pointer; }
@media print {
  html { font-size: 9.5px; }
  body { max-width: none; padding: 0; }
  .scroll { overflow: visible; }
  figure, tr, .verdict, .numbers div { break-inside: avoid; }
  h2, h3 { break-after: avoid; }
  details::details-content { content-visibility: visible; block-size: auto; }
}
"""


def write_certificate_page(
    path: Path,
    rig: Rig,
    certificate: Certificate,
    seen: Mapping[str, SeenPoints],
    volume: Volume,
    *,
    title: str,
    details: Mapping[str, Any],
    max_error_m: float | None = None,
) -> None:
    """Write the page, which appears only when it is complete.

    Parameters
    ----------
    path : Path
        An .html.
    rig : Rig
        With its covariance.
    certificate : Certificate
        The verdict on it.
    seen : mapping of str to SeenPoints
        By camera what it saw of the boards; a camera that saw nothing may be missing.
    volume : Volume
        Where the rig was judged.
    title : str
        What was calibrated.
    details : mapping of str to anything
        Plain values, lists and mappings, nested at will: how the calibration came about.
    max_error_m : float, optional
        The error that is asked for: a rig that is worse, or has none, is refused.

    Raises
    ------
    CalibrationError
        If it cannot be written.
    ValueError
        If the rig has no covariance, or the certificate is that of other cameras.
    """
    if rig.covariance is None:
        raise ValueError("the rig has no covariance")
    names = [camera.name for camera in rig.cameras]
    if names != [told.name for told in certificate.cameras]:
        raise ValueError(f"the certificate is not that of the cameras {', '.join(names)}")
    svg = mpl.rc_context({"svg.fonttype": "path", "svg.hashsalt": "hybridve"})
    with svg, warnings.catch_warnings():
        # Letters that the font of the figures lacks become boxes there; the page's text has them.
        warnings.filterwarnings("ignore", "Glyph .* missing from")
        sections = [
            _verdict(rig, certificate, title, max_error_m),
            _limits(certificate),
            _cameras(rig, certificate),
            _error_map(rig, certificate, volume),
            _arrangement(rig, volume),
            _views(rig, certificate, seen, volume),
            _parameters(rig, certificate),
            _details(details),
        ]
    text = "\n".join(
        [
            '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<title>{escape(title)}: certificate of the calibration</title>",
            f"<style>{_STYLE}</style>\n</head>\n<body>",
            *sections,
            "</body>\n</html>\n",
        ]
    )
    try:
        with appearing(path) as partial:
            partial.write_text(text, encoding="utf-8")
    except OSError as error:
        raise CalibrationError(f"{path}: cannot be written: {error}") from error


def state_of(certificate: Certificate, max_error_m: float | None = None) -> State:
    """Return how good a rig is at first sight.

    Refused: there are doubts about it, its error is more than `max_error_m`, or there is none to
    state though it has several cameras, or though one is asked for. Limits: it comes with warnings.
    """
    is_known = math.isfinite(certificate.error95_m)
    if certificate.doubts:
        return "refused"
    if max_error_m is not None and not certificate.error95_m <= max_error_m:
        return "refused"
    if not is_known and len(certificate.cameras) > 1:
        return "refused"
    return "limits" if certificate.warnings or not is_known else "good"


# --- Text -------------------------------------------------------------------------------------


def _number(value: float, digits: int = 2) -> str:
    """Return a number to so many digits that count, or to whole ones; no power of ten if sane."""
    if not math.isfinite(value):
        return _UNKNOWN
    if value == 0:
        return "0"
    magnitude = math.floor(math.log10(abs(value)))
    if not -5 <= magnitude < 7:
        return f"{value:.{digits - 1}e}"
    return f"{value:.{max(0, digits - 1 - magnitude)}f}"


def _fixed(value: float, decimals: int) -> str:
    return f"{value:.{decimals}f}" if math.isfinite(value) else _UNKNOWN


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %" if math.isfinite(share) else _UNKNOWN


def _mm(length_m: float) -> str:
    return f"{_number(1000 * length_m)} mm" if math.isfinite(length_m) else _UNKNOWN


def _table(
    header: Sequence[str], rows: Iterable[Sequence[str]], numeric: Collection[int] = ()
) -> str:
    """Return a table of cells that are HTML; numeric columns stand to the right."""

    def cells(tag: str, row: Sequence[str]) -> str:
        return "".join(
            f'<{tag} class="n">{cell}</{tag}>' if column in numeric else f"<{tag}>{cell}</{tag}>"
            for column, cell in enumerate(row)
        )

    head = f"<thead><tr>{cells('th', header)}</tr></thead>" if header else ""
    body = "\n".join(f"<tr>{cells('td', row)}</tr>" for row in rows)
    return f'<div class="scroll"><table>{head}<tbody>\n{body}\n</tbody></table></div>'


def _figure(figure: Figure, says: str) -> str:
    """Return a figure as an image in the page, with what it shows in words."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="svg", dpi=_DPI, metadata={"Date": None})
    coded = base64.b64encode(buffer.getvalue()).decode("ascii")
    return f'<figure><img alt="{escape(says)}" src="data:image/svg+xml;base64,{coded}"></figure>'


# --- Sections ---------------------------------------------------------------------------------


def _verdict(rig: Rig, certificate: Certificate, title: str, max_error_m: float | None) -> str:
    state = state_of(certificate, max_error_m)
    sign, words, colour, border = _STATES[state]
    asked = ""
    if max_error_m is not None:
        asked = f'<p class="note">Asked for: {_mm(max_error_m)} or better.</p>'
    noise = certificate.noise
    low, high = certificate.volume_low_m, certificate.volume_high_m
    size = " x ".join(_fixed(b - a, 2) for a, b in zip(low, high, strict=True))
    corners = " to ".join("(" + ", ".join(_fixed(v, 2) for v in c) + ")" for c in (low, high))
    numbers = [
        (_mm(certificate.error95_m), "error of a point (95 %), kept by 95 % of the volume"),
        (_mm(certificate.median_error95_m), "the same for half of the volume"),
        (_mm(certificate.largest_error95_m), "the same where it is largest"),
        (
            f"{size} m",
            f"working volume: {corners}, seen by {certificate.volume_min_cameras} or more",
        ),
        (f"{_fixed(noise.rough_px, 2)} px", "noise of a coordinate of a point, standard deviation"),
        (
            _percent(noise.share_explained),
            f"of the residuals (rms {_fixed(noise.rms_px, 2)} px) explained by this noise",
        ),
        (
            f"{noise.n_points} points",
            f"of boards seen by {len(rig.cameras)} "
            f"camera{'' if len(rig.cameras) == 1 else 's'}; {noise.n_parameters} parameters",
        ),
        *_second_opinion(certificate.second_opinion),
    ]
    boxes = "\n".join(f"<div><b>{value}</b><span>{what}</span></div>" for value, what in numbers)
    listed = ""
    if certificate.warnings:
        items = "\n".join(f"<li>{escape(warning)}</li>" for warning in certificate.warnings)
        listed = f'<h3>Look at this</h3>\n<ul class="warnings">\n{items}\n</ul>'
    return (
        f"<h1>{escape(title)}: certificate of the calibration</h1>\n"
        f'<div class="verdict" style="--cue: {colour}; border-style: {border}">'
        f'<div class="state">{sign} {words}</div>'
        f'<p class="words">{escape(certificate.verdict)}</p>{asked}</div>\n'
        f'<div class="numbers">\n{boxes}\n</div>\n{listed}'
    )


def _second_opinion(opinion: SecondOpinion | NoOpinion | None) -> list[tuple[str, str]]:
    """Return what another adjustment says, as a number and what it is."""
    if opinion is None:
        return []
    if isinstance(opinion, NoOpinion):
        return [("none", f"second opinion: {escape(opinion.reason)}")]
    return [
        (
            _mm(max(opinion.difference95_m, 1e-6)),
            "second opinion: within this of where the rig does, COLMAP's own adjustment places "
            f"points (95 %); {_fixed(opinion.sigmas, 1)} standard deviations of its "
            f"error, {_mm(opinion.expected95_m)} (95 %)",
        )
    ]


def _limits(certificate: Certificate) -> str:
    limit = certificate.limit
    parts = ["<h2>What limits the error, and what to record next</h2>"]
    todo = []
    if limit is None:
        parts.append("<p>No error in space can be stated, so nothing limits it.</p>")
    else:
        what = f"the {escape(limit.what)} of {escape(limit.camera)}"
        stands_out = limit.error95_m < _STANDS_OUT * certificate.error95_m
        words = (
            f"The largest single cause is <b>{what}</b>."
            if stands_out
            else f"No single cause stands out; the largest is {what}."
        )
        whole = max(certificate.error95_m, limit.error95_m, 1e-300)
        rows = [
            (label, f'<span class="bar{kind}" style="width: {size:.1f}rem"></span>{_mm(error_m)}')
            for label, kind, error_m, size in (
                ("now", "", certificate.error95_m, 20 * certificate.error95_m / whole),
                (f"were {what} known", " less", limit.error95_m, 20 * limit.error95_m / whole),
            )
        ]
        parts += [f"<p>{words}</p>", _table((), rows)]
        todo.append((limit.camera, limit.advice))
    for told in sorted(certificate.cameras, key=lambda told: told.coverage):
        if told.n_points == 0:
            todo.append((told.name, "it saw no board: show it one"))
    items = [f"<li><b>{escape(name)}</b>: {escape(advice)}</li>" for name, advice in todo]
    if items:
        parts.append('<ul class="todo">\n' + "\n".join(items) + "\n</ul>")
    if certificate.warnings:
        parts.append('<p class="note">The warnings above say what else to record.</p>')
    return "\n".join(parts)


def _cameras(rig: Rig, certificate: Certificate) -> str:
    header = (
        *(
            "camera",
            "lens",
            "image<br>px",
            "points",
            "rms<br>px",
            "coverage",
            "stands at<br>x, y, z (m)",
        ),
        *("place<br>&plusmn; mm", "turn &plusmn;<br>mrad (deg)", "image error<br>95 %, px"),
        *("at its worst<br>95 %, px", "not<br>determined"),
    )
    rows = []
    for camera, told in zip(rig.cameras, certificate.cameras, strict=True):
        place = ", ".join(_fixed(float(value), 3) for value in camera.center_world)
        turn_mrad = 1000 * told.turn_std_rad
        undetermined = escape(", ".join(told.undetermined))
        rows.append(
            (
                escape(camera.name) + (" (moves)" if camera.name in rig.mounts else ""),
                camera.model,
                f"{camera.width_px}x{camera.height_px}",
                str(told.n_points),
                _fixed(told.rms_px, 3),
                _percent(told.coverage),
                place,
                _number(1000 * told.place_std_m),
                f"{_number(turn_mrad)} ({_number(math.degrees(told.turn_std_rad))})",
                _fixed(told.error95_px, 2),
                _fixed(told.edge_error95_px, 2),
                f"<b>{undetermined}</b>" if undetermined else "none",
            )
        )
    return (
        "<h2>Cameras</h2>\n"
        + _table(header, rows, range(3, 11))
        + "\n<p class=\"note\">rms: of the residuals' length. Coverage: share of the image's cells "
        "that hold points. &plusmn;: one standard deviation, length or angle. Image error: how far "
        "the image of a point of the working volume is off, and the same for the whole image "
        "where it is worst, 95 % of calibrations.</p>"
    )


def _error_map(rig: Rig, certificate: Certificate, volume: Volume) -> str:
    head = "<h2>Where the error is how large</h2>\n"
    figure = draw_errors(rig, volume) if len(volume.points_world) else None
    if figure is None:
        return head + "<p>No two cameras see a common volume: no point has an error in mm.</p>"
    says = (
        "Three level slices through the working volume from above, with the error in mm: "
        f"{_plain_mm(certificate.median_error95_m)} in the middle of all, "
        f"{_plain_mm(certificate.largest_error95_m)} at most."
    )
    return (
        head + _figure(figure, says) + '\n<p class="note">From above: the distance that the error '
        "of a point exceeds in 5 % of calibrations, for the rig's errors alone. Grey: seen by "
        f"fewer than {max(2, volume.min_cameras)} cameras.</p>"
    )


def _plain_mm(length_m: float) -> str:
    return f"{_number(1000 * length_m)} mm" if math.isfinite(length_m) else "unknown"


def _arrangement(rig: Rig, volume: Volume) -> str:
    names = ", ".join(camera.name for camera in rig.cameras)
    return (
        "<h2>Where the cameras stand</h2>\n"
        + _figure(draw_rig(rig, volume), f"The cameras {names} in perspective and from above.")
        + '\n<p class="note">Blue: what each camera looks at, with a roof over its upper border. '
        "Dashed: the working volume's box. Grid: z = 0.</p>"
    )


def _views(
    rig: Rig, certificate: Certificate, seen: Mapping[str, SeenPoints], volume: Volume
) -> str:
    parts = [
        "<h2>What each camera saw, and what the rig makes of it</h2>",
        '<p class="note">Left: points of boards; empty cells are hatched. Middle: by how much the '
        "rig misses them, magnified; arrows that have a pattern in common point at a lens model "
        "that does not fit, a bent board or a board that moved. Right: the same against the noise "
        "of single points.</p>",
    ]
    none = SeenPoints(np.zeros((0, 2)), np.zeros((0, 2)))
    for index, told in enumerate(certificate.cameras):
        name = told.name
        figure = draw_camera(rig, index, seen.get(name, none), certificate.noise.rough_px, volume)
        numbers = (
            f"{told.n_points} points, coverage {_percent(told.coverage)}, "
            f"rms {_fixed(told.rms_px, 3)} px"
        )
        says = f"{name}: coverage of the image, residuals and their distribution."
        parts.append(f"<h3>{escape(name)} <small>{numbers}</small></h3>\n{_figure(figure, says)}")
    return "\n".join(parts)


def _parameters(rig: Rig, certificate: Certificate) -> str:
    assert rig.covariance is not None
    deviations = np.sqrt(np.diag(rig.covariance.matrix))
    labels = rig.covariance.labels
    parts = ["<h2>Parameters</h2>"]
    for index, (camera, span) in enumerate(
        zip(rig.cameras, parameter_slices(rig.cameras), strict=True)
    ):
        told = certificate.cameras[index]
        rows = []
        names = parameter_names(camera.model)
        for row in range(span.start, span.stop):
            label, std = escape(labels[row]), float(deviations[row])
            column = row - span.start
            if column < POSE:
                unit = "mrad" if column < 3 else "mm"
                rows.append((label, "", _deviation(1000 * std), unit))
            else:
                name, value = names[column - POSE], float(camera.params[column - POSE])
                unit = "px" if name[0] in "fc" else ""
                if name in told.undetermined:
                    unit += " <b>not determined</b>"
                rows.append((label, _to_deviation(value, std), _deviation(std), unit))
        table = _table(("parameter", "value", "&plusmn; standard deviation", ""), rows, (1, 2))
        parts.append(
            f"<details><summary>{escape(camera.name)}: {camera.model}</summary>{table}</details>"
        )
    parts.append(
        '<p class="note">r and t: turn about, and shift along, the axes of the camera\'s own frame '
        "(x right, y down, z ahead).</p>"
    )
    return "\n".join(parts)


def _deviation(std: float) -> str:
    return _number(std) if std > 0 else "given"


def _to_deviation(value: float, std: float) -> str:
    """Return a value as far as its standard deviation makes sense of it."""
    if not std > 0:
        return f"{value:.9g}"
    decimals = int(np.clip(1 - math.floor(math.log10(std)), 0, 12))
    return f"{value:.{decimals}f}"


# --- Anything else ----------------------------------------------------------------------------


def _details(details: Mapping[str, Any]) -> str:
    if not details:
        return ""
    parts = [
        f"<details><summary>{escape(str(key))}{_count(value)}</summary>{render(value)}</details>"
        for key, value in details.items()
    ]
    return "<h2>How it came about</h2>\n" + "\n".join(parts)


def _count(value: Any) -> str:
    """Return how much is folded away."""
    if isinstance(value, Mapping | list | tuple | set | frozenset | np.ndarray) and np.ndim(
        value if isinstance(value, np.ndarray) else 1
    ) in (0, 1):
        return f' <span class="none">({len(value)})</span>'
    return ""


def render(value: Any) -> str:
    """Return any plain value as HTML: mappings as tables, long ones and lists folded."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, Mapping):
        return _render_mapping(value)
    if isinstance(value, set | frozenset):
        value = sorted(value, key=str)
    if isinstance(value, list | tuple):
        return _render_list(value)
    if value is None:
        return _UNKNOWN
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}" if math.isfinite(value) else _UNKNOWN
    return escape(str(value))


def _is_flat(value: Any) -> bool:
    return not isinstance(value, Mapping | list | tuple | set | frozenset | np.ndarray)


def _render_mapping(value: Mapping[Any, Any]) -> str:
    if not value:
        return '<span class="none">none</span>'
    rows = [(escape(str(key)), _fold(entry)) for key, entry in value.items()]
    return _table((), rows)


def _fold(value: Any) -> str:
    """Return a value, folded if it is long."""
    if isinstance(value, Mapping) and len(value) > _MOST_SHOWN:
        return f"<details><summary>{len(value)} entries</summary>{render(value)}</details>"
    return render(value)


def _render_list(value: Sequence[Any]) -> str:
    if not value:
        return '<span class="none">none</span>'
    if all(_is_flat(entry) for entry in value):
        texts = [render(entry) for entry in value]
        whole = (
            ", ".join(texts)
            if max(map(len, texts)) <= 40
            else "<ul>" + "".join(f"<li>{text}</li>" for text in texts) + "</ul>"
        )
        head = f"{len(value)}: {texts[0]} ... {texts[-1]}"
    elif all(isinstance(entry, Mapping) for entry in value):
        keys = list(dict.fromkeys(key for entry in value for key in entry))
        rows = [[_fold(entry[key]) if key in entry else "" for key in keys] for entry in value]
        whole = _table([escape(str(key)) for key in keys], rows)
        head = f"{len(value)} rows"
    else:
        whole = "<ol>" + "".join(f"<li>{_fold(entry)}</li>" for entry in value) + "</ol>"
        head = f"{len(value)} entries"
    if len(value) <= _MOST_SHOWN:
        return whole
    return f"<details><summary>{head}</summary>{whole}</details>"
