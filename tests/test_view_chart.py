"""The chart of accuracy against time."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from hybridve.calib.errors import ReportError
from hybridve.hull.view.chart import Curve, draw_chart, write_chart

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
    heights = [text.xy[1] for text in figure.axes[0].texts]
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
    def interrupt(self: Figure, path: Path, **_: object) -> None:
        Path(path).write_bytes(b"half")
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
