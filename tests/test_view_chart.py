"""The charts of accuracy against time, and of clearance against time."""

from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO

import cv2
import numpy as np
import pytest
from matplotlib.collections import FillBetweenPolyCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.text import Annotation
from numpy.typing import NDArray

from hybridve.calib.errors import ReportError
from hybridve.hull.view.chart import (
    ClearanceCurve,
    Curve,
    draw_chart,
    draw_clearances,
    write_chart,
    write_clearances,
)

U = 4


def curve(name: str, factor: float = 1.0) -> Curve:
    time_ms = factor * np.array([1.0, 2.0, 5.0, 3.0])
    error_mm = np.array([40.0, 20.0, 5.0, 10.0])
    return Curve(
        name=name,
        labels=("4", "8", "16", ""),
        time_ms=time_ms,
        time_range_ms=np.stack([0.9 * time_ms, 1.2 * time_ms]),
        error_mm=error_mm,
        predicted_mm=1.5 * error_mm,
        missed_percent=np.array([9.0, 3.0, 0.0, 1.0]),
        viewport=np.array([4, 8, 16, 0]),
        on_front=np.array([True, True, False, True]),
        is_chosen=np.array([False, False, False, True]),
    )


CURVES = [curve("stencil", 20.0), curve("native")]


def lines_of(figure: Figure, panel: int) -> list[tuple[list[float], list[float]]]:
    return [
        (np.asarray(line.get_xdata()).tolist(), np.asarray(line.get_ydata()).tolist())
        for line in figure.axes[panel].lines
    ]


@pytest.mark.slow
def test_the_picture_shows_every_engine_in_a_colour_of_its_own(tmp_path: Path) -> None:
    path = tmp_path / "chart.png"

    write_chart(path, CURVES, "accuracy 5 mm", title="horseman: 20 frames", subtitle="a machine")

    image = cv2.imread(str(path))
    assert image is not None
    assert min(image.shape[:2]) > 600
    rgb = image[..., ::-1].astype(int)
    for colour in ("#0072B2", "#D55E00"):
        wanted = np.round(255 * np.array(to_rgb(colour)))
        assert (np.abs(rgb - wanted).max(axis=-1) < 8).sum() > 500, colour
    assert list(tmp_path.iterdir()) == [path]


def test_measured_predicted_front_and_chosen_are_where_they_belong() -> None:
    figure = draw_chart(CURVES, "accuracy 5 mm", title="horseman")

    lines = lines_of(figure, 0)
    for one in CURVES:
        uniform = one.time_ms[:3].tolist()
        assert (uniform, one.error_mm[:3].tolist()) in lines
        assert (uniform, one.predicted_mm[:3].tolist()) in lines
        assert ([one.time_ms[3]], [one.error_mm[3]]) in lines
    # On the front of both engines: their first, second and chosen points, in order of time.
    front = ([1.0, 2.0, 3.0, 20.0, 40.0, 60.0], [40.0, 20.0, 10.0, 40.0, 20.0, 10.0])
    assert lines.count(front) == 2
    assert ([4, 8, 16], [9.0, 3.0, 0.0]) in lines_of(figure, 1)
    texts = [text.get_text() for text in figure.axes[0].texts]
    assert texts == ["4", "8", "16", "4", "8", "16"]
    legend = figure.axes[0].get_legend()
    assert legend is not None
    named = [text.get_text() for text in legend.get_texts()]
    expected = ["stencil", "native", "predicted, edge/(u-1)", "accuracy 5 mm", "Pareto front"]
    assert named == expected
    assert figure.axes[0].get_xscale() == figure.axes[0].get_yscale() == "log"


@pytest.mark.parametrize("error_mm", [np.nan, 0.0])
def test_what_was_not_measured_or_is_nought_is_labelled_where_it_was_predicted(
    tmp_path: Path, error_mm: float
) -> None:
    nothing = replace(CURVES[0], error_mm=np.full(U, error_mm), on_front=np.zeros(U, np.bool_))

    write_chart(tmp_path / "chart.png", [nothing], "accuracy", title="", note="nothing collides")

    figure = draw_chart([nothing], "accuracy", title="", note="nothing collides")
    notes = [text for text in figure.axes[0].texts if isinstance(text, Annotation)]
    assert len(notes) == len(figure.axes[0].texts)
    heights = [text.xy[1] for text in notes]
    assert heights == nothing.predicted_mm[:3].tolist()


@pytest.mark.parametrize("suffix", ["svg", "pdf"])
def test_charts_can_be_drawn_to_scale(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"chart.{suffix}"

    write_chart(path, CURVES, "accuracy", title="horseman")

    assert path.read_bytes()[:5] == {"svg": b"<?xml", "pdf": b"%PDF-"}[suffix]


def test_other_endings_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"charts are \.png, \.svg, \.pdf"):
        write_chart(tmp_path / "chart.gif", CURVES, "accuracy", title="")


def test_a_chart_cut_off_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(self: Figure, file: BinaryIO, **_: object) -> None:
        file.write(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr(Figure, "savefig", interrupt)

    with pytest.raises(KeyboardInterrupt):
        write_chart(tmp_path / "chart.png", CURVES, "accuracy", title="")

    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_is_not_there_is_told(tmp_path: Path) -> None:
    with pytest.raises(ReportError, match="cannot be written"):
        write_chart(tmp_path / "no" / "chart.png", CURVES, "accuracy", title="")


def test_a_chart_of_times_alone_can_be_drawn(tmp_path: Path) -> None:
    unknown = np.full(U, np.nan)
    nothing = replace(
        CURVES[0], error_mm=unknown, predicted_mm=unknown, on_front=np.zeros(U, np.bool_)
    )

    write_chart(tmp_path / "chart.png", [nothing], "accuracy", title="")

    assert cv2.imread(str(tmp_path / "chart.png")) is not None


N_FRAMES = 8


def clearance_curve(name: str = "payload", **changes: Any) -> ClearanceCurve:
    """Return one that comes near, collides in frames 3 to 5, and was not evaluated in frame 6."""
    lower_mm = np.array([40.0, 20.0, 5.0, -8.0, -12.0, -3.0, np.nan, 30.0])
    made = ClearanceCurve(
        name=name,
        time_s=np.arange(N_FRAMES) / 10,
        lower_mm=lower_mm,
        upper_mm=lower_mm + 2.0,
        at_least_mm=np.maximum(lower_mm - 4.0, 0.0),
        clashes=lower_mm < 0,
        required_mm=10.0,
        first_contact_s=np.array([0.26]),
    )
    return replace(made, **changes)


def legend_of(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.legends[0].get_texts()]


def bands_of(figure: Figure, panel: int) -> list[NDArray[np.float64]]:
    """Return the corners of each filled band, drawn or not."""
    return [
        np.concatenate([path.vertices for path in band.get_paths()])
        for band in figure.axes[panel].collections
        if isinstance(band, FillBetweenPolyCollection)
    ]


def test_clearances_are_drawn_as_a_band_with_all_that_belongs_to_it() -> None:
    curve = clearance_curve()

    figure = draw_clearances([curve], title="a report", note="the nearest")

    lines = lines_of(figure, 0)
    edges = [y for x, y in lines if x == curve.time_s.tolist()]
    for expected in (curve.lower_mm, curve.upper_mm, curve.at_least_mm):
        assert any(np.array_equal(edge, expected, equal_nan=True) for edge in edges)
    assert ([0.26], [0.0]) in lines
    assert any(y == [10.0, 10.0] for _, y in lines), "the required clearance"
    bounds, depth = bands_of(figure, 0)
    assert bounds[:, 1].min() == -12.0
    assert bounds[:, 1].max() == 42.0
    # Depth hangs below zero in the colliding frames, and nowhere else.
    assert (depth[:, 1].min(), depth[:, 1].max()) == (-12.0, 0.0)
    np.testing.assert_allclose([depth[:, 0].min(), depth[:, 0].max()], [0.3, 0.5])
    (shade,) = [patch for patch in figure.axes[0].patches if isinstance(patch, Rectangle)]
    np.testing.assert_allclose([shade.get_x(), shade.get_x() + shade.get_width()], [0.25, 0.55])
    names = ["bounds", "at least, at 95 % (estimate)", "required", "first contact (estimate)"]
    assert sorted(legend_of(figure)) == sorted([*names, "collides"])
    assert figure.get_suptitle() == "a report\nthe nearest"


def test_what_an_object_has_not_is_not_drawn() -> None:
    plain = clearance_curve(
        lower_mm=np.full(N_FRAMES, 30.0),
        upper_mm=np.full(N_FRAMES, np.nan),
        at_least_mm=np.full(N_FRAMES, np.nan),
        clashes=np.zeros(N_FRAMES, np.bool_),
        required_mm=0.0,
        first_contact_s=np.zeros(0),
    )

    figure = draw_clearances([plain], title="")

    assert legend_of(figure) == ["bounds"]
    assert not figure.axes[0].patches
    assert np.isfinite(figure.axes[0].get_ylim()).all()


def test_every_object_has_a_panel_and_the_picture_shows_collisions(tmp_path: Path) -> None:
    path = tmp_path / "curves.png"
    curves = [clearance_curve("payload"), clearance_curve("bracket", clashes=np.zeros(8, np.bool_))]

    write_clearances(path, curves, title="a report")

    titles = [axes.get_title("left") for axes in draw_clearances(curves, title="").axes]
    assert titles == ["payload", "bracket"]
    image = cv2.imread(str(path))
    assert image is not None
    rgb = image[..., ::-1].astype(int)
    # The shade of a collision: its colour at 15 % over white.
    shade = np.round(255 * (0.15 * np.array(to_rgb("#D55E00")) + 0.85))
    is_shaded = (np.abs(rgb - shade).max(axis=-1) < 4).mean(axis=1)
    half = len(is_shaded) // 2
    assert is_shaded[:half].max() > 0.3
    assert is_shaded[half:].max() < 0.1, "only the first object collides; the legend has a patch"
    assert list(tmp_path.iterdir()) == [path]


def test_one_frame_alone_can_be_drawn(tmp_path: Path) -> None:
    one = clearance_curve(
        time_s=np.zeros(1),
        lower_mm=np.array([-3.0]),
        upper_mm=np.array([-2.0]),
        at_least_mm=np.zeros(1),
        clashes=np.array([True]),
    )

    write_clearances(tmp_path / "one.svg", [one], title="")

    assert (tmp_path / "one.svg").read_bytes()[:5] == b"<?xml"


def test_curves_of_other_endings_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"charts are \.png, \.svg, \.pdf"):
        write_clearances(tmp_path / "curves.gif", [clearance_curve()], title="")


@pytest.mark.parametrize("dip_mm", [10.0, -10.0])
def test_a_dip_of_10_mm_shows_beside_800(dip_mm: float) -> None:
    """In one frame of many something comes as near: a share of the panel that nobody overlooks."""
    lower_mm = np.full(N_FRAMES, 800.0)
    lower_mm[3] = dip_mm
    curve = clearance_curve(
        lower_mm=lower_mm,
        upper_mm=lower_mm + 0.1,
        at_least_mm=lower_mm,
        clashes=lower_mm < 0,
        required_mm=5.0,
    )

    figure = draw_clearances([curve, clearance_curve("near")], title="two")

    far, near = figure.axes
    figure.canvas.draw()
    bottom, top = (far.transData.transform((0, y))[1] for y in far.get_ylim())
    zero, dip = (far.transData.transform((0, y))[1] for y in (0.0, dip_mm))
    assert abs(dip - zero) / (top - bottom) > 0.2
    # What is near all the time is drawn evenly: half as high is half as high.
    heights = near.transData.transform([(0, 0.0), (0, 20.0), (0, 40.0)])[:, 1]
    assert heights[1] - heights[0] == pytest.approx(heights[2] - heights[1])
