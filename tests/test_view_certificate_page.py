"""The certificate of a calibration as a page, and its figures."""

import base64
import re
from collections.abc import Callable
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from helpers.boards import LENSES, look_at, make_camera, ring
from helpers.records import make_opinion, make_record
from helpers.thorough import asked
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.colors import to_rgba_array
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.quiver import Quiver
from numpy.typing import NDArray

from hybridve.calib.boards.target import Chessboard
from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.files import Sink
from hybridve.calib.judging.certificate import (
    Certificate,
    SeenPoints,
    Volume,
    certify,
    coverage,
    working_volume,
)
from hybridve.calib.lens import cam_from_img, parameter_names, project_points
from hybridve.calib.record import CalibrationRecord, Noise, NoOpinion
from hybridve.calib.rig import POSE_PARAMETERS, Rig, RigCovariance
from hybridve.calib.solving.errors_in_space import point_errors
from hybridve.hull.view.certificate_charts import CELLS, binned_means, cell_counts, draw_camera
from hybridve.hull.view.certificate_page import state_of, write_certificate_page
from hybridve.hull.view.chart_marks import nice
from hybridve.hull.view.pages import page_template
from hybridve.hull.view.rig_charts import draw_errors, draw_rig, frustum, slice_errors

NOISE_PX = 0.25
NOISE = Noise(NOISE_PX, NOISE_PX, NOISE_PX * np.sqrt(2.0), 0.987, 1234, 56)
BOARD = Chessboard(8, 6, 0.1)

#: Elements that have no end tag.
VOID = {"meta", "img", "br"}


def rig_of(cameras: list[Camera], std: float = 1e-3) -> Rig:
    """Return a rig whose parameters are unsure: radians and metres, and a hundredfold in pixels."""
    labels, deviations = [], []
    for camera in cameras:
        for name in (*POSE_PARAMETERS, *parameter_names(camera.model)):
            labels.append(f"{camera.name} {name}")
            deviations.append(std * (100.0 if name[0] in "fc" else 1.0))
    return Rig(tuple(cameras), covariance=RigCovariance(tuple(labels), np.diag(deviations) ** 2))


def seen_by(camera: Camera, count: int, seed: int = 0) -> SeenPoints:
    rng = np.random.default_rng(seed)
    size = np.array([camera.width_px, camera.height_px])
    return SeenPoints(
        rng.uniform(0.2, 0.8, (count, 2)) * size, rng.normal(0.0, NOISE_PX, (count, 2))
    )


def record_of(rig: Rig) -> CalibrationRecord:
    return make_record([camera.name for camera in rig.cameras], noise=NOISE)


def case_of(
    names: list[str], count: int = 60
) -> tuple[Rig, Certificate, dict[str, SeenPoints], Volume]:
    cameras = ring(BOARD, ["OPENCV"] * len(names))
    rig = rig_of([replace(one, name=name) for one, name in zip(cameras, names, strict=True)])
    seen = {camera.name: seen_by(camera, count, k) for k, camera in enumerate(rig.cameras)}
    volume = working_volume(rig)
    return rig, certify(rig, record_of(rig), seen, volume), seen, volume


@pytest.fixture(scope="module")
def two() -> tuple[Rig, Certificate, dict[str, SeenPoints], Volume]:
    return case_of(["left", "right"])


class Page(HTMLParser):
    """A page, read strictly: every element must be closed, in order."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self.folded: list[str] = []  # the text inside <details>
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if "style" not in self.open:
            (self.folded if "details" in self.open else self.words).append(data.strip())

    @property
    def text(self) -> str:
        return " ".join(" ".join([*self.words, *self.folded]).split())

    def images(self) -> list[str]:
        """Return the figures' SVG."""
        sources = [attrs["src"] for tag, attrs in self.elements if tag == "img"]
        prefix = "data:image/svg+xml;base64,"
        assert all(source is not None and source.startswith(prefix) for source in sources)
        return [
            base64.b64decode(source.removeprefix(prefix)).decode("utf-8")
            for source in sources
            if source is not None
        ]


def page_of(
    folder: Path,
    case: tuple[Rig, Certificate, dict[str, SeenPoints], Volume],
    **options: Any,
) -> Page:
    path = folder / "certificate.html"
    rig, certificate, seen, volume = case
    settings = {"title": "a hall", "details": {}} | options
    write_certificate_page(path, rig, certificate, seen, volume, **settings)
    assert list(folder.iterdir()) == [path]
    return Page(path.read_text(encoding="utf-8"))


# --- The page ---------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_page_says_what_the_certificate_says(
    tmp_path: Path, two: tuple[Rig, Certificate, dict[str, SeenPoints], Volume]
) -> None:
    certificate = two[1]

    page = page_of(tmp_path, two, title="hall 7")

    assert certificate.verdict in page.text
    assert "hall 7" in page.text
    assert "Not in these errors" in page.text
    assert "the choice of a lens model" in page.text
    for error_m in (
        certificate.error95_m,
        certificate.median_error95_m,
        certificate.largest_error95_m,
    ):
        written = re.search(rf"(?<![\d.])({1000 * error_m:.0f}|{1000 * error_m:.1f}) mm", page.text)
        assert written, error_m
    assert "0.25 px" in page.text
    assert "99 %" in page.text
    assert "1234 points" in page.text
    for told in certificate.cameras:
        assert page.words.count(told.name) >= 2  # in the table, and above its picture
        assert f"{told.rms_px:.3f}" in page.text
        assert f"{told.error95_px:.2f}" in page.text
        assert f"{told.edge_error95_px:.2f}" in page.text
        assert f"{100 * told.coverage:.0f} %" in page.text
        if told.undetermined:
            assert ", ".join(told.undetermined) in page.words
    for warning in certificate.warnings:
        assert warning in page.words
    assert certificate.limit is not None
    assert certificate.limit.advice in page.text
    assert two[0].covariance is not None
    for label in two[0].covariance.labels:
        assert label in page.folded
    # One figure a camera, the map, and the cameras.
    assert len(page.images()) == len(certificate.cameras) + 2


@pytest.mark.slow
@pytest.mark.parametrize("is_there", [True, False])
def test_a_second_opinion_is_told_or_why_there_is_none(tmp_path: Path, is_there: bool) -> None:
    rig, certificate, seen, volume = case_of(["left", "right"])
    opinion = make_opinion(1.7) if is_there else NoOpinion("COLMAP has no <lens>")

    page = page_of(tmp_path, (rig, replace(certificate, second_opinion=opinion), seen, volume))

    told = ["1.7 mm", "1.7 standard deviations", "3.0 mm"] if is_there else ["COLMAP has no <lens>"]
    for words in ("second opinion", *told):
        assert words in page.text, words


@pytest.mark.slow
def test_nothing_is_fetched_and_nothing_runs(
    tmp_path: Path, two: tuple[Rig, Certificate, dict[str, SeenPoints], Volume]
) -> None:
    page = page_of(tmp_path, two, details={"see": "https://example.org/"})

    assert {tag for tag, _ in page.elements}.isdisjoint({"script", "link", "iframe", "object"})
    for tag, attrs in page.elements:
        assert not any(name.startswith("on") or name == "srcset" for name in attrs), tag
        assert str(attrs.get("href", "#")).startswith("#"), tag  # within the page
    text = (tmp_path / "certificate.html").read_text(encoding="utf-8")
    assert "url(" not in text
    assert "@import" not in text
    for image in page.images():
        for element in ElementTree.fromstring(image).iter():
            for name, value in element.attrib.items():
                if name.endswith("href"):
                    assert value.startswith(("#", "data:image/png"))
            assert not element.tag.endswith("script")


@pytest.mark.slow
def test_markup_in_names_and_values_is_text(tmp_path: Path) -> None:
    bad = '<script>alert("1")</script>&amp;\'$x_$ --> \u4e8c'
    case = case_of([bad, "b"])
    details = {bad: [{bad: bad}, {"plain": [bad] * 20}], "deep": {bad: {bad: (bad, 1)}}}

    page = page_of(tmp_path, case, title=bad, details=details)

    assert "script" not in {tag for tag, _ in page.elements}
    assert page.words.count(bad) >= 2
    assert page.folded.count(bad) >= 22
    assert f"{bad} fx" in page.folded
    alternatives = [attrs["alt"] for tag, attrs in page.elements if tag == "img"]
    assert sum(bad in (alternative or "") for alternative in alternatives) == 2
    for image in page.images():
        ElementTree.fromstring(image)


@pytest.mark.slow
def test_equal_input_gives_the_same_bytes(
    tmp_path: Path, two: tuple[Rig, Certificate, dict[str, SeenPoints], Volume]
) -> None:
    texts = []
    for folder in (tmp_path / "a", tmp_path / "b"):
        folder.mkdir()
        page_of(folder, two, details={"set": {"x", "y", "z"}})
        texts.append((folder / "certificate.html").read_bytes())

    assert texts[0] == texts[1]


def test_one_camera_has_a_page_without_millimetres(tmp_path: Path) -> None:
    case = case_of(["alone"])
    assert np.isnan(case[1].error95_m)

    page = page_of(tmp_path, case)

    assert "unknown" in page.words
    assert not re.search(r"\bnan\b", page.text, re.IGNORECASE)
    assert "no point has an error in mm" in page.text
    assert len(page.images()) == 2  # no map


@pytest.mark.slow
def test_a_camera_that_saw_nothing_and_points_without_numbers_are_told(tmp_path: Path) -> None:
    rig, _, seen, volume = case_of(["blind", "half"])
    certificate = certify(rig, record_of(rig), {"half": seen["half"]}, volume)
    gaps = SeenPoints(
        np.concatenate([seen["half"].pixels, [[np.nan, 1.0], [3.0, 4.0]]]),
        np.concatenate([seen["half"].residuals_px, [[0.0, 0.0], [np.nan, np.inf]]]),
    )

    page = page_of(tmp_path, (rig, certificate, {"half": gaps}, volume), details={"x": np.nan})

    assert ": it saw no board: show it one" in page.words
    assert not re.search(r"\b(nan|inf)\b", page.text, re.IGNORECASE)
    figure = draw_camera(rig, 1, gaps, NOISE_PX, volume)
    assert figure.axes[0].get_title().startswith("60 points")


def test_a_volume_that_nobody_sees_has_a_page(
    tmp_path: Path, two: tuple[Rig, Certificate, dict[str, SeenPoints], Volume]
) -> None:
    rig, _, seen, _ = two
    volume = Volume(np.zeros((0, 3)), np.zeros(3), np.ones(3), 2, "asked")
    certificate = certify(rig, record_of(rig), seen, volume)

    page = page_of(tmp_path, (rig, certificate, seen, volume))

    assert certificate.verdict in page.text
    assert "nothing limits it" in page.text


@pytest.mark.slow
def test_the_first_sight_follows_the_gate_and_the_warnings(
    tmp_path: Path, two: tuple[Rig, Certificate, dict[str, SeenPoints], Volume]
) -> None:
    good = replace(two[1], warnings=(), error95_m=2e-3)
    lost = replace(good, error95_m=np.nan)

    assert state_of(good) == state_of(good, 2e-3) == "good"
    assert state_of(good, 1.9e-3) == "refused"
    assert state_of(replace(good, warnings=("look",))) == "limits"
    assert state_of(lost) == "refused"  # two cameras that place nothing
    alone = replace(lost, cameras=lost.cameras[:1])
    assert state_of(alone) == "limits"
    assert state_of(alone, 1.0) == "refused"
    page = page_of(tmp_path, two, max_error_m=1e-6)
    assert any("refused" in word for word in page.words)
    assert "Asked for: 0.0010 mm or better." in page.words


def test_a_rig_without_covariance_or_of_other_cameras_is_refused(
    tmp_path: Path, two: tuple[Rig, Certificate, dict[str, SeenPoints], Volume]
) -> None:
    rig, certificate, seen, volume = two

    with pytest.raises(ValueError, match="no covariance"):
        page_of(tmp_path, (Rig(rig.cameras), certificate, seen, volume))
    with pytest.raises(ValueError, match="not that of the cameras right, left"):
        page_of(tmp_path, (rig.only(["right", "left"]), certificate, seen, volume))


@pytest.mark.slow
def test_a_page_cut_off_leaves_nothing(
    tmp_path: Path,
    two: tuple[Rig, Certificate, dict[str, SeenPoints], Volume],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with pytest.raises(CalibrationError, match="cannot be written"):
        page_of(tmp_path / "no", two)

    whole = Sink.write

    def interrupt(self: Sink, data: bytes) -> int:
        whole(self, data[: len(data) // 2])
        raise KeyboardInterrupt

    monkeypatch.setattr(Sink, "write", interrupt)
    with pytest.raises(KeyboardInterrupt):
        page_of(tmp_path, two)
    assert list(tmp_path.iterdir()) == []


WORDS = st.text("abcdefghij<>&'\" ", min_size=1, max_size=8).filter(lambda word: word.strip())
PLAIN = st.recursive(
    WORDS | st.integers(-9, 9) | st.floats() | st.booleans() | st.none(),
    lambda inner: st.lists(inner, max_size=15) | st.dictionaries(WORDS, inner, max_size=14),
    max_leaves=40,
)


def shown(value: Any) -> Page:
    """Return how the page shows a value of the details."""
    return Page(vars(page_template("values.html.jinja").module)["shown"](value))


def words_of(value: Any) -> list[str]:
    if isinstance(value, dict):
        return [word for pair in value.items() for one in pair for word in words_of(one)]
    if isinstance(value, list):
        return [word for one in value for word in words_of(one)]
    return [value] if isinstance(value, str) else []


@settings(max_examples=asked(60))
@given(value=PLAIN)
def test_every_word_of_the_details_is_there_however_nested(value: Any) -> None:
    page = shown(value)

    for word in words_of(value):
        assert " ".join(word.split()) in page.text
    assert not re.search(r"\b(nan|inf)\b", page.text)


def test_long_lists_are_folded_and_short_ones_are_not() -> None:
    short, long = shown(list("abcdef")), shown([f"view {k}" for k in range(30)])
    rows = shown([{"camera": f"cam{k}", "px": 0.5} for k in range(5)])

    assert short.words == ["a, b, c, d, e, f"]
    assert shown(set("fbdace")).words == short.words
    assert long.words == []
    assert "view 17" in long.text
    assert [tag for tag, _ in rows.elements].count("th") == 2  # each key once
    assert rows.words.count("0.5") == 5


# --- The figures ------------------------------------------------------------------------------


@given(
    shares=st.lists(st.tuples(st.floats(-0.2, 1.2), st.floats(-0.2, 1.2)), max_size=40),
    size_px=st.tuples(st.integers(8, 4000), st.integers(8, 4000)),
)
def test_covered_cells_are_those_of_the_certificate(
    shares: list[tuple[float, float]], size_px: tuple[int, int]
) -> None:
    camera = make_camera("a", "PINHOLE", look_at((1.0, 1.0, 1.0), (0.0, 0.0, 0.0)), size_px)
    pixels = np.array(shares).reshape(-1, 2) * size_px

    counts = cell_counts(camera, pixels)

    assert (counts > 0).mean() == coverage(camera, pixels)
    inside = ((pixels >= 0) & (pixels < size_px)).all(axis=1)
    assert counts.sum() == inside.sum()


def test_empty_cells_are_hatched(
    two: tuple[Rig, Certificate, dict[str, SeenPoints], Volume],
) -> None:
    rig, _, _, volume = two
    # One point, in the second cell from the left of the lowest row.
    seen = SeenPoints(np.array([[1.5 * 640 / CELLS[0], 475.0]]), np.array([[0.1, 0.2]]))

    figure = draw_camera(rig, 0, seen, NOISE_PX, volume)

    hatched = [
        patch.get_xy()
        for patch in figure.axes[0].patches
        if isinstance(patch, Rectangle) and patch.get_hatch()
    ]
    assert len(hatched) == CELLS[0] * CELLS[1] - 1
    assert (640 / CELLS[0], 480 * 5 / CELLS[1]) not in hatched
    assert (0.0, 480 * 5 / CELLS[1]) in hatched


def test_many_residuals_are_drawn_as_their_means() -> None:
    camera = make_camera("a", "PINHOLE", look_at((1.0, 1.0, 1.0), (0.0, 0.0, 0.0)))
    pixels = np.random.default_rng(0).uniform((0.0, 0.0), (640.0, 480.0), (4000, 2))
    slope = np.array([[1e-3, 0.0], [0.0, -2e-3]])

    places, means, counts, step_px = binned_means(camera, pixels, pixels @ slope + 0.1)

    # A field that is linear is, in the mean, what it is at the mean place.
    np.testing.assert_allclose(means, places @ slope + 0.1, atol=1e-12)
    assert counts.sum() == 4000
    assert len(places) == 16 * 12
    assert step_px == 40.0
    few = binned_means(camera, pixels[:50], pixels[:50] @ slope)
    np.testing.assert_array_equal(few[0], pixels[:50])
    np.testing.assert_array_equal(few[1], pixels[:50] @ slope)


def arrows_of(figure: Figure) -> dict[str, Quiver]:
    found = [one for one in figure.axes[1].collections if isinstance(one, Quiver)]
    red = [np.atleast_2d(to_rgba_array(one.get_facecolor()))[0, 0] for one in found]
    return {"orange" if r > 0.5 else "blue": one for r, one in zip(red, found, strict=True)}


def test_arrows_are_as_long_as_is_said_and_patterns_stand_out(
    two: tuple[Rig, Certificate, dict[str, SeenPoints], Volume],
) -> None:
    rig, _, _, volume = two
    noise = seen_by(rig.cameras[0], 3000)
    # In the left half all residuals have something in common.
    shift = np.where(noise.pixels[:, :1] < 320.0, [[0.4, 0.0]], [[0.0, 0.0]])
    bent = SeenPoints(noise.pixels, noise.residuals_px + shift)

    figure = draw_camera(rig, 0, bent, NOISE_PX, volume)

    arrows = arrows_of(figure)
    said = re.search(r"([\d.e+]+) times as long", figure.axes[1].get_title())
    assert said is not None
    for one in arrows.values():
        assert one.scale == pytest.approx(1.0 / float(said[1]))
        assert one.angles == one.scale_units == "xy"
    orange, blue = (np.asarray(arrows[colour].XY) for colour in ("orange", "blue"))
    assert (orange[:, 0] < 320.0).mean() > 0.95
    assert (blue[:, 0] > 320.0 - 40.0).mean() > 0.95
    assert set(arrows_of(draw_camera(rig, 0, noise, NOISE_PX, volume))) == {"blue"}
    lengths_px = np.concatenate([np.hypot(one.U, one.V) for one in arrows.values()])
    drawn_px = float(said[1]) * float(np.quantile(lengths_px, 0.9))
    assert 14.0 < drawn_px < 37.0  # cells are 40 px wide


def test_residuals_of_rounding_are_told_as_none(
    two: tuple[Rig, Certificate, dict[str, SeenPoints], Volume],
) -> None:
    rig, _, seen, volume = two
    exact = SeenPoints(seen["left"].pixels, 1e-14 * seen["left"].residuals_px)

    figure = draw_camera(rig, 0, exact, 1e-14, volume)

    assert [text.get_text() for text in figure.axes[1].texts] == ["all residuals are zero"]


def test_slices_hold_the_error_of_their_places_and_blanks_where_too_few_see() -> None:
    rig, _, _, volume = case_of(["a", "b", "c"])
    low, high = np.array([-0.9, -0.2, 0.1]), np.array([1.0, 0.5, 0.9])
    volume = Volume(volume.points_world, low, high, 3, "asked")

    x, y, z, errors_m = slice_errors(rig, volume)

    assert errors_m.shape == (len(z), len(y), len(x))
    assert (x[0], y[0], x[-1], y[-1]) == (low[0], low[1], high[0], high[1])
    assert low[2] < z[0] < z[1] < z[2] < high[2]
    n_seeing = []
    for k, row, column in (
        (k, row, column) for k in range(3) for row in (3, 16, 30) for column in (2, 8, 16, 31)
    ):
        point = np.array([[x[column], y[row], z[k]]])
        found = point_errors(rig, point)
        expected = found.radius95_m[0] if found.n_seeing[0] == 3 else np.nan
        np.testing.assert_allclose(errors_m[k, row, column], expected, rtol=1e-9)
        n_seeing.append(int(found.n_seeing[0]))
    assert {2, 3} <= set(n_seeing), "the test would prove too little"


def test_the_map_has_one_scale_and_says_what_its_lines_are() -> None:
    rig, _, _, volume = case_of(["a", "b", "c"])

    figure = draw_errors(rig, volume)

    assert figure is not None
    panels = figure.axes[:3]
    assert len({panel.images[0].get_clim() for panel in panels}) == 1
    _, _, z, errors_m = slice_errors(rig, volume)
    for panel, height_m, layer in zip(panels, z, errors_m, strict=True):
        assert f"z = {height_m:.2f} m" in panel.get_title()
        drawn = np.ma.filled(np.ma.asarray(panel.images[0].get_array()).astype(float), np.nan)
        np.testing.assert_allclose(drawn, 1000.0 * layer)
        names = {text.get_text() for text in panel.texts}
        assert {"a", "b", "c"} <= names
        assert any(re.fullmatch(r"[\d.]+", name) for name in names), "no line is labelled"


@pytest.mark.parametrize("model", sorted(LENSES))
def test_what_a_camera_looks_at_ends_at_the_borders_of_its_image(model: str) -> None:
    camera = make_camera("a", model, look_at((1.0, 2.0, 1.5), (0.2, 0.1, 0.0), 20.0))

    rim = frustum(camera, 0.3)

    pixels, depth_m = project_points(camera, rim)
    assert (depth_m > 0).all()
    lengths_m = np.linalg.norm(rim - camera.center_world, axis=1)
    assert lengths_m.max() == pytest.approx(0.3)
    np.testing.assert_allclose(rim[0], rim[-1])
    corners = pixels[:-1:5]
    size = np.array([640.0, 480.0])
    corners_px = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)]) * size
    # The corners, from the top left clockwise; of lenses that do not map them, of a part.
    share = (corners / size - 0.5) / ([-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5])
    np.testing.assert_allclose(share, share[0, 0], atol=1e-3)
    # Of all of it, if the lens maps its corners.
    whole = np.isfinite(cam_from_img(camera, 0.999 * (corners_px - size / 2) + size / 2)).all()
    assert share[0, 0] == pytest.approx(1.0) if whole else 0.29 < share[0, 0] < 0.9


def extents_of(figure: Figure, panel: int) -> list[tuple[str, NDArray[np.float64]]]:
    figure.draw_without_rendering()
    return [
        (text.get_text(), np.asarray(text.get_window_extent().extents))
        for text in figure.axes[panel].texts
    ]


def row_of(count: int) -> list[Camera]:
    """Return cameras side by side, closer to each other than their names are wide."""
    return [
        make_camera(f"cam{k}", "PINHOLE", look_at((0.12 * k, -1.6, 1.0), (0.12 * k, 0.0, 0.3)))
        for k in range(count)
    ]


@pytest.mark.slow
@pytest.mark.parametrize("draw", [draw_rig, draw_errors])
@pytest.mark.parametrize("cameras", [ring(BOARD, ["PINHOLE"] * 16), row_of(6)], ids=["ring", "row"])
def test_the_names_of_many_cameras_can_be_read_from_above(
    draw: Callable[[Rig, Volume], Figure | None], cameras: list[Camera]
) -> None:
    rig = rig_of(cameras)

    figure = draw(rig, working_volume(rig))

    assert figure is not None
    panel = 1 if draw is draw_rig else 0
    placed = [(name, box) for name, box in extents_of(figure, panel) if name.startswith("cam")]
    assert sorted(name for name, _ in placed) == sorted(camera.name for camera in cameras)
    frame = np.asarray(figure.axes[panel].get_window_extent().extents)
    for index, (name, box) in enumerate(placed):
        assert (box[:2] >= frame[:2] - 1).all(), name
        assert (box[2:] <= frame[2:] + 1).all(), name
        for other, another in placed[index + 1 :]:
            shared = np.minimum(box[2:], another[2:]) - np.maximum(box[:2], another[:2])
            assert shared.min() <= 0, (name, other)


def test_cameras_stand_where_they_are() -> None:
    rig, _, _, volume = case_of(["a", "b", "c"])

    figure = draw_rig(rig, volume)

    above = figure.axes[1]
    dots = [line for line in above.lines if line.get_marker() == "o"]
    assert len(dots) == 1
    np.testing.assert_allclose(np.asarray(dots[0].get_xydata()), rig.centers_world[:, :2])


def test_a_rig_far_from_the_worlds_origin_fills_the_picture() -> None:
    shift = np.array([2000.0, -3000.0, 500.0])
    cameras = [
        replace(
            camera,
            cam_from_world=np.column_stack(
                [
                    camera.cam_from_world[:, :3],
                    camera.cam_from_world[:, 3] - camera.cam_from_world[:, :3] @ shift,
                ]
            ),
        )
        for camera in ring(BOARD, ["PINHOLE"] * 3)
    ]
    rig = rig_of(cameras)

    figure = draw_rig(rig, working_volume(rig, has_floor=False))

    (left, right), (bottom, top) = figure.axes[1].get_xlim(), figure.axes[1].get_ylim()
    assert max(right - left, top - bottom) < 10.0


@given(value=st.floats(1e-12, 1e12))
def test_nice_numbers_are_one_two_or_five(value: float) -> None:
    found = nice(value)

    assert found <= value * 1.00001
    assert found > value / 2.5001
    assert f"{found:.6e}"[0] in "125"
    assert set(f"{found:.6e}".split("e")[0][1:]) <= set(".0")
