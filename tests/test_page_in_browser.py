"""The page of a report, opened and used in a real browser."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from helpers.browser import Tab, browser
from helpers.sessions import write_ball_session, write_cube_scene

from hybridve.cli.main import cli
from hybridve.hull.report.read import Report, read_report

pytestmark = pytest.mark.slow

#: The ball comes from afar, goes through the cube, and leaves.
CENTERS = np.array([[x, 0.0, 0.0] for x in (0.7, 0.5, 0.25, 0.1, 0.4, 0.6)])

#: Names and comments that would be markup, were they not text.
BAD_NAME = "<script>broken=1"
BAD_COMMENT = "</script><script>broken=1</script>"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session, its report, and pages of it with the session and without."""
    folder = tmp_path_factory.mktemp("page")
    session = write_ball_session(folder, CENTERS, n_cameras=4)
    scene = write_cube_scene(folder, {"hit": (0.0, 0.0, 0.0), BAD_NAME: (0.0, 0.0, 450.0)})
    report = folder / "report.h5"

    def run(*arguments: object) -> None:
        ran = CliRunner().invoke(cli, [str(one) for one in arguments], catch_exceptions=False)
        assert ran.exit_code == 0, ran.output

    run("detect", session, "--scene", scene, "-o", report, "--no-progress")
    run("export", report, "--html", folder / "first.html", "--no-progress")
    ledger = (folder / "report.clashes.toml").read_text(encoding="utf-8")
    entry = next(line for line in ledger.splitlines() if line.startswith("id ="))
    name = entry.partition('"')[2].strip('"')
    run("clashes", report, "--approve", name, "--comment", BAD_COMMENT)
    run("export", report, "--html", folder / "alone.html", "--no-progress")
    run("export", report, "--html", folder / "page.html", "--session", session, "--no-progress")
    return folder


@pytest.fixture(scope="module")
def report(folder: Path) -> Report:
    return read_report(folder / "report.h5")


@pytest.fixture(scope="module")
def chromium(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Tab]:
    with browser(tmp_path_factory.mktemp("chromium")) as tab:
        yield tab


@pytest.fixture
def tab(chromium: Tab) -> Iterator[Tab]:
    """A tab that complains of nothing and asks nobody."""
    yield chromium
    assert chromium.complaints() == []
    asked = chromium.asked()
    assert asked
    assert all(address.startswith(("file:", "data:", "blob:")) for address in asked), asked
    assert chromium.run("return window.broken") is None


def frame_of(tab: Tab) -> str:
    return str(tab.one("#now").text)


def readout(tab: Tab) -> dict[str, list[str]]:
    """What the table of the chosen frame says, by object."""
    rows = tab.run(
        "return [...document.querySelectorAll('#readout tbody tr')]"
        ".map((row) => [...row.cells].map((cell) => cell.textContent))"
    )
    return {row[0]: row[1:] for row in rows}


def test_the_answer_is_that_of_the_summary(folder: Path, tab: Tab) -> None:
    ran = CliRunner().invoke(cli, ["summary", str(folder / "report.h5")])
    tab.open(folder / "page.html")

    first = ran.stdout.splitlines()[0].replace("+-", "±")
    assert first == f"clash: {tab.one('#answer').text}"
    assert tab.one("[aria-label=verdict] .state").text.endswith("CLASH")


def test_the_slider_goes_through_the_frames_by_keyboard(
    folder: Path, report: Report, tab: Tab
) -> None:
    from selenium.webdriver.common.keys import Keys

    tab.open(folder / "page.html")
    slider = tab.one("#scrubber")
    slider.send_keys(Keys.HOME)
    for row, time_s in enumerate(report.time_s.tolist()):
        assert frame_of(tab) == f"frame {row}, {time_s:.2f} s"
        told = readout(tab)
        for name, rows in report.objects.items():
            assert told[name][0] == rows.verdict[row]
            lower_m, upper_m = rows["clearance_m"][row]
            value, _, off = told[name][1].partition(" ±")
            assert abs(float(value) - 500.0 * (lower_m + upper_m)) <= float(off or 0) + 1e-3
        assert f"frame {row}, {time_s:.2f} seconds" in str(slider.get_attribute("aria-valuetext"))
        slider.send_keys(Keys.ARROW_RIGHT)
    slider.send_keys(Keys.PAGE_UP)
    assert frame_of(tab).startswith("frame 5")


def test_the_timeline_is_scrubbed_with_the_mouse(folder: Path, tab: Tab) -> None:
    from selenium.webdriver.common.action_chains import ActionChains

    tab.open(folder / "page.html")
    lanes = tab.one("#lanes")
    half = lanes.size["width"] // 2
    chain = ActionChains(tab.driver).move_to_element_with_offset(lanes, -half + 2, 0)
    chain.click_and_hold().perform()
    assert frame_of(tab).startswith("frame 0,")
    chain = ActionChains(tab.driver).move_to_element_with_offset(lanes, half - 2, 0)
    chain.release().perform()
    assert frame_of(tab).startswith("frame 5,")


def test_a_clash_that_is_clicked_shows_its_worst_frame(
    folder: Path, report: Report, tab: Tab
) -> None:
    from selenium.webdriver.common.keys import Keys

    tab.open(folder / "page.html")
    tab.one("#scrubber").send_keys(Keys.END)
    before = tab.run("return document.getElementById('canvas').toDataURL()")
    button = tab.one("[data-clash='0']")
    wanted = int(button.text.split()[2])
    button.click()

    assert frame_of(tab).startswith(f"frame {wanted},")
    deepest = int(np.argmax(report.objects["hit"]["depth_m"][:, 1]))
    assert wanted == deepest
    tab.until(f"return document.getElementById('canvas').toDataURL() !== {before!r}")
    assert "deep" in tab.one("#clash-1 .words").text
    images = tab.run(
        "return [...document.querySelectorAll('#clash-1 img')].map((one) => one.naturalWidth)"
    )
    assert len(images) >= 2
    assert min(images) > 100


def test_the_scene_follows_a_camera_and_hides_what_is_unchecked(folder: Path, tab: Tab) -> None:
    picture = "return document.getElementById('canvas').toDataURL()"
    tab.open(folder / "page.html")
    outside = tab.run(picture)
    tab.one("#view option[value='2']").click()
    tab.until("return document.querySelector('.border') !== null")
    tab.until(f"return document.getElementById('canvas').toDataURL() !== {outside!r}")
    through = tab.run(picture)
    assert tab.one("#view option[value='2']").text == "through cam2"

    tab.one("#show-hull").click()
    tab.until(f"return document.getElementById('canvas').toDataURL() !== {through!r}")
    tab.one("#whole").click()
    tab.until("return document.querySelector('.border') === null")


def test_what_each_camera_saw_changes_with_the_frame(folder: Path, tab: Tab) -> None:
    from selenium.webdriver.common.keys import Keys

    tab.open(folder / "page.html")
    pictures = "return [...document.querySelectorAll('#seen img')].map((one) => [one.alt, one.src])"
    tab.one("#scrubber").send_keys(Keys.HOME)
    first = tab.run(pictures)
    tab.one("#scrubber").send_keys(Keys.END)
    last = tab.run(pictures)

    assert "ready masks and no pictures" in tab.one(".missing").text
    assert [alt.split()[1] for alt, _ in first] == ["cam0", "cam1", "cam2", "cam3"]
    assert all("frame 0" in alt for alt, _ in first)
    assert all("frame 5" in alt for alt, _ in last)
    assert all(one != other for (_, one), (_, other) in zip(first, last, strict=True))


def test_names_and_comments_that_look_like_markup_are_text(folder: Path, tab: Tab) -> None:
    tab.open(folder / "page.html")

    assert BAD_NAME in readout(tab)
    lanes = tab.run(
        "return [...document.querySelectorAll('.lane b')].map((one) => one.textContent)"
    )
    assert lanes == ["hit", BAD_NAME]
    assert BAD_COMMENT in tab.one("#clash-1 dl").text
    assert "approved" in tab.one("#clash-1 h3").text


def test_without_the_session_the_page_says_what_it_lacks(folder: Path, tab: Tab) -> None:
    tab.open(folder / "alone.html")

    assert "Without the session" in tab.one(".missing").text
    there = "return document.querySelector({}) !== null"
    assert not tab.run(there.format("'#seen'"))
    assert not tab.run(there.format("'#show-hull'"))
    assert tab.run(there.format("'#clash-1 img'"))  # drawn of CAD and points
    assert tab.one("#view option[value='0']").text == "through cam0"


@pytest.mark.parametrize("width_px", [390, 1366])
def test_the_page_is_as_wide_as_the_screen(folder: Path, tab: Tab, width_px: int) -> None:
    tab.open(folder / "page.html", width_px=width_px)

    assert tab.run("return document.documentElement.scrollWidth") <= width_px
    assert tab.one("#canvas").size["width"] <= width_px


def test_in_the_dark_the_ground_is_dark_and_the_ink_is_light(folder: Path, tab: Tab) -> None:
    def brightness(name: str) -> int:
        style = f"return getComputedStyle(document.body).{name}"
        return sum(int(one) for one in str(tab.run(style)).strip("rgb()").split(",")[:3])

    tab.open(folder / "page.html", dark=True)
    assert brightness("backgroundColor") < 150 < 500 < brightness("color")
    tab.open(folder / "page.html")
    assert brightness("color") < 150 < 500 < brightness("backgroundColor")


def test_every_picture_and_control_has_a_name(folder: Path, tab: Tab) -> None:
    tab.open(folder / "page.html")
    tree = tab.command("Accessibility.getFullAXTree")["nodes"]

    wanted = {"button", "slider", "combobox", "checkbox", "img", "image", "main", "heading"}
    found: dict[str, list[str]] = {}
    for node in tree:
        role = node.get("role", {}).get("value")
        if role in wanted and not node.get("ignored"):
            found.setdefault(role, []).append(node.get("name", {}).get("value", ""))
    assert {"button", "slider", "combobox", "checkbox", "main", "heading"} <= set(found)
    nameless = {role: names.count("") for role, names in found.items() if role != "main"}
    assert not any(nameless.values()), nameless
    assert found["slider"] == ["Frame"]
    assert len(found["main"]) == 1


def test_the_table_says_what_the_timeline_draws(folder: Path, report: Report, tab: Tab) -> None:
    tab.open(folder / "page.html")
    rows = tab.run(
        "return [...document.querySelectorAll('details caption')][0].parentElement.rows.length"
    )

    assert rows == 1 + len(report.index)
    text = tab.run("return document.querySelector('details caption').parentElement.textContent")
    assert all(verdict in text for verdict in set(report.objects["hit"].verdict.tolist()))
