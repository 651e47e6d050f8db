"""``hybridve segment``: what is said of silhouettes, on page and film, against hand masks."""

import base64
import json
import re
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.sessions import write_ball_session
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from hybridve.hull.capture.scoring import Score
from hybridve.hull.capture.silhouette_io import SilhouetteReader
from hybridve.hull.quality import frames_to_look_at

Run = Callable[..., int]
Captured = pytest.CaptureFixture[str]

N_FRAMES = 30

#: A ball that moves slowly: no frame differs much from those around it.
CENTERS = np.column_stack(
    [np.linspace(-0.1, 0.1, N_FRAMES), np.zeros(N_FRAMES), np.zeros(N_FRAMES)]
)


@pytest.fixture
def session(tmp_path: Path) -> Path:
    return write_ball_session(tmp_path / "ball", CENTERS)


def spoil(session: Path, camera: str, frame: int, shift_px: int) -> None:
    """Move a camera's silhouette in one frame to the right."""
    path = session.parent / camera / f"{frame}.png"
    mask = np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), np.uint8)
    cv2.imwrite(str(path), np.roll(mask, shift_px, axis=1))


# --- Frames to look at --------------------------------------------------------------------------


@pytest.mark.slow
def test_sound_silhouettes_have_nothing_to_look_at(
    run: Run, session: Path, capsys: Captured
) -> None:
    assert run("segment", session, "--json") == 0

    told = json.loads(capsys.readouterr().out)
    assert told["frames_to_look_at"] == 0
    page = (session.parent / "silhouettes.html").read_text(encoding="utf-8")
    assert "nothing stands out" in page
    assert "the cameras support each other" in page


@pytest.mark.slow
def test_the_frame_of_a_silhouette_beside_its_thing_is_the_first_to_look_at(
    run: Run, session: Path, capsys: Captured
) -> None:
    spoil(session, "cam2", 17, 40)

    assert run("segment", session, "--json") == 0

    assert json.loads(capsys.readouterr().out)["frames_to_look_at"] >= 1
    page = (session.parent / "silhouettes.html").read_text(encoding="utf-8")
    first = page.partition("Frames to look at first")[2].partition("</figure>")[0]
    assert re.search(r"frame 17: .*cam2", first)
    picture = re.search(r'src="data:image/webp;base64,([^"]+)"', first)
    assert picture is not None
    image = cv2.imdecode(np.frombuffer(base64.b64decode(picture[1]), np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    assert image.shape[1] > 4 * 400  # four cameras side by side


def arrays(
    n_frames: int, n_cameras: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    shape = (n_frames, n_cameras)
    return np.full(shape, 0.05), np.ones(shape), np.zeros(shape, np.bool_)


@given(
    frame=st.integers(0, 39),
    camera=st.integers(0, 2),
    factor=st.sampled_from([0.0, 0.5, 0.75, 1.4]),
)
def test_an_area_that_jumps_is_named_with_its_camera_and_by_how_much(
    frame: int, camera: int, factor: float
) -> None:
    shares, supported, denies = arrays(40, 3)
    shares[frame, camera] *= factor

    ((found, why),) = frames_to_look_at(("a", "b", "c"), shares, supported, denies)

    assert found == frame
    than = "larger" if factor > 1 else "smaller"
    assert why == f"{'abc'[camera]} is {abs(factor - 1):.0%} {than} than in frames around it"


def test_a_camera_that_denies_the_others_goes_before_one_that_is_little_supported() -> None:
    shares, supported, denies = arrays(60, 2)
    supported[5, 0] = 0.4
    supported[30, 1] = 0.7
    denies[50, 1] = True

    found = frames_to_look_at(("a", "b"), shares, supported, denies)

    assert [frame for frame, _ in found] == [50, 5, 30]
    assert found[0][1] == "b denies what several others see"
    assert found[1][1] == "40% of a is supported by the other cameras"


def test_of_neighbours_that_show_the_same_one_is_named() -> None:
    shares, supported, denies = arrays(60, 1)
    supported[20:26, 0] = 0.5

    assert len(frames_to_look_at(("a",), shares, supported, denies)) == 1


def test_a_person_who_comes_in_slowly_is_no_jump() -> None:
    shares, supported, denies = arrays(60, 1)
    shares[:, 0] = np.geomspace(0.01, 0.2, 60)
    shares[::7] = np.nan  # frames without silhouettes

    assert not frames_to_look_at(("a",), shares, supported, denies)


# --- Page and film ------------------------------------------------------------------------------


@pytest.mark.slow
def test_without_a_page_an_older_one_goes(run: Run, session: Path) -> None:
    assert run("segment", session) == 0
    assert run("segment", session, "--overwrite", "--no-page") == 0

    assert not (session.parent / "silhouettes.html").exists()


@pytest.mark.slow
def test_a_name_of_markup_stands_as_text(run: Run, tmp_path: Path) -> None:
    session = write_ball_session(tmp_path / "<script>x", CENTERS[:3])

    assert run("segment", session) == 0

    page = (session.parent / "silhouettes.html").read_text(encoding="utf-8")
    assert "&lt;script&gt;x: silhouettes" in page
    assert "<script>x" not in page


@pytest.mark.slow
def test_the_film_has_every_frame(run: Run, session: Path, tmp_path: Path) -> None:
    import av

    assert run("segment", session, "--no-page", "--film", tmp_path / "outlines.mp4") == 0

    with av.open(str(tmp_path / "outlines.mp4")) as film:
        frames = [frame.to_ndarray(format="bgr24") for frame in film.decode(video=0)]
    assert len(frames) == N_FRAMES
    # The ball is drawn: frames are not all alike, and each shows something.
    assert all(frame.std() > 5.0 for frame in frames)
    assert np.abs(frames[0].astype(int) - frames[-1].astype(int)).max() > 50


def test_a_film_of_another_kind_is_refused_before_the_work(
    run: Run, session: Path, tmp_path: Path, capsys: Captured
) -> None:
    assert run("segment", session, "--film", tmp_path / "outlines.gif") == 1

    assert "outlines.gif: films are written as .mp4" in capsys.readouterr().err
    assert not (session.parent / "silhouettes.h5").exists()


# --- Against masks made by hand -----------------------------------------------------------------


def square(left: int, right: int) -> NDArray[np.uint8]:
    mask = np.zeros((10, 20), np.uint8)
    mask[2:8, left:right] = 1
    return mask


def test_scores_are_those_of_overlapping_squares() -> None:
    """Of widths 6 and 8 that share 4: 4 of 10, and so on."""
    found, truth = square(2, 8), square(4, 12).astype(np.bool_)

    score = Score.of(found, truth, np.ones(truth.shape, np.bool_))

    assert score.iou == pytest.approx(4 / 10)
    assert score.precision == pytest.approx(4 / 6)
    assert score.recall == pytest.approx(4 / 8)
    assert score.f1 == pytest.approx(2 * (4 / 6) * (4 / 8) / (4 / 6 + 4 / 8))
    # What does not count is neither found nor missed.
    counts = np.ones(truth.shape, np.bool_)
    counts[:, 8:] = False
    assert Score.of(found, truth, counts).recall == 1.0
    nothing = Score.of(square(2, 2), square(2, 2).astype(np.bool_), counts)
    assert (nothing.iou, nothing.f1) == (1.0, 1.0)


@pytest.mark.slow
def test_silhouettes_are_scored_by_camera_and_frame(
    run: Run, session: Path, tmp_path: Path, capsys: Captured
) -> None:
    """Hand masks are the silhouettes themselves; of one the right half is painted over."""
    by_hand = tmp_path / "by hand"
    run("segment", session, "--no-page")
    with SilhouetteReader(session.parent / "silhouettes.h5") as reader:
        for frame in (3, 20):
            masks, _ = reader.frame(frame)
            assert masks is not None
            for camera in (0, 1):
                mask = masks[camera] * np.uint8(255)
                if (camera, frame) == (1, 20):
                    columns = np.flatnonzero(mask.any(axis=0))
                    mask[:, (columns[0] + columns[-1] + 1) // 2 :] = 0
                    half = mask.sum() / (masks[camera].sum() * 255.0)
                (by_hand / f"cam{camera}").mkdir(parents=True, exist_ok=True)
                cv2.imwrite(str(by_hand / f"cam{camera}" / f"gt{frame:04d}.png"), mask)
    capsys.readouterr()
    pattern = str(by_hand / "{camera}" / "gt{frame}.png")

    assert run("segment", session, "--overwrite", "--no-page", "--evaluate", pattern, "--json") == 0

    told = json.loads(capsys.readouterr().out)
    found = {(one["camera"], one["frame"]): one["iou"] for one in told["masks"]}
    assert found == {
        ("cam0", 3): 1.0,
        ("cam0", 20): 1.0,
        ("cam1", 3): 1.0,
        ("cam1", 20): pytest.approx(half),
    }
    assert told["scores"]["cam0"]["f1"] == 1.0
    assert told["scores"]["mean_iou"] == pytest.approx((3.0 + half) / 4)
    assert run("segment", session, "--overwrite", "--no-page", "--evaluate", pattern) == 0
    assert "cam1: IoU 0.7" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("pattern", "line"),
    [
        ("{camera}/nothing{frame}.png", "there is no such mask of any camera and frame"),
        ("cam0/{frame}.png", "one mask cannot be that of 4 cameras"),
    ],
)
def test_masks_that_are_not_there_are_told_before_the_work(
    run: Run, session: Path, capsys: Captured, pattern: str, line: str
) -> None:
    assert run("segment", session, "--evaluate", session.parent / pattern) == 1

    assert line in capsys.readouterr().err
    assert not (session.parent / "silhouettes.h5").exists()


@pytest.mark.slow
def test_a_hand_mask_of_another_size_is_told(
    run: Run, session: Path, tmp_path: Path, capsys: Captured
) -> None:
    cv2.imwrite(str(tmp_path / "cam0.png"), np.zeros((7, 9), np.uint8))

    assert run("segment", session, "--evaluate", tmp_path / "{camera}.png") == 1

    assert "cam0.png: is 9x7, pictures of camera 'cam0' are" in capsys.readouterr().err


def test_grey_levels_to_ignore_go_with_masks(run: Run, session: Path) -> None:
    assert run("segment", session, "--ignore", 85) == 2
