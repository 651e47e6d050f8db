"""``hybridve render --view agreement``: what each camera sees beside what the others say."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pytest
from helpers.agreement import shifted
from helpers.sessions import SIZE_PX, ball_mask, ring_matrix, write_ball_session, write_cube_scene

from hybridve.calib.plain import to_plain
from hybridve.hull.agreement.record import NamedCause, SessionAgreement
from hybridve.hull.agreement.told import brief

Run = Callable[..., int]

N_CAMERAS, N_FRAMES = 4, 6
BUMPED, SHIFT_PX = 2, 20
#: Camera 2's picture stands 20 px off from this frame on.
SINCE = 3


def bump(**changes: Any) -> NamedCause:
    known: dict[str, Any] = {
        "kind": "bumped",
        "cameras": (f"cam{BUMPED}",),
        "first_frame": SINCE,
        "last_frame": N_FRAMES - 1,
        "is_gross": True,
        "short": "cam2 bumped",
        "message": "cam2 has moved",
        "size": float(SHIFT_PX),
    }
    return NamedCause(**{**known, **changes})


@pytest.fixture
def session(tmp_path: Path) -> Path:
    centers = np.zeros((N_FRAMES, 3))
    path = write_ball_session(tmp_path / "session", centers, n_cameras=N_CAMERAS)
    mask = ball_mask(ring_matrix(BUMPED, N_CAMERAS), np.zeros(3))
    for frame in range(SINCE, N_FRAMES):
        cv2.imwrite(str(path.parent / f"cam{BUMPED}/{frame}.png"), shifted(mask, SHIFT_PX, 0))
    return path


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    return write_cube_scene(tmp_path, {"far": (5000.0, 0.0, 0.0)})


def filled(path: Path) -> tuple[list[int], list[int]]:
    """Return how many pixels each camera's picture has in the colour of what it sees alone.

    Then in that of what the others see alone.
    """
    picture = cv2.imread(str(path))
    assert picture is not None
    gap = 6
    bottom = picture.shape[0] - 2 * (SIZE_PX[1] + gap)
    head = int(np.flatnonzero((picture < 128).all(axis=2).mean(axis=1) > 0.5)[0])
    assert 0 < head < bottom
    own: list[int] = []
    others: list[int] = []
    for camera in range(N_CAMERAS):
        row, column = divmod(camera, 2)
        top, left = head + row * (SIZE_PX[1] + gap), gap + column * (SIZE_PX[0] + gap)
        part = picture[top + 30 : top + SIZE_PX[1], left : left + SIZE_PX[0]]
        blue, green, red = part.astype(int).transpose(2, 0, 1)
        is_own = (green > 120) & (green < 200) & (red < 80) & (blue > 90)
        is_others = (red > 130) & (red < 200) & (green < 130) & (blue < 60)
        for found, counts in ((is_own, own), (is_others, others)):
            # Where outlines are drawn colours mix, but not over 4 by 4 pixels.
            opened = cv2.morphologyEx(found.astype(np.uint8), cv2.MORPH_OPEN, np.ones((4, 4)))
            counts.append(int(opened.sum()))
    return own, others


def draw(run: Run, session: Path, scene: Path, *arguments: object) -> Path:
    path = session.parent / "seen.png"
    asked = ("render", session, "--scene", scene, "-o", path, "--view", "agreement", "--overwrite")
    assert run(*asked, *arguments) == 0
    return path


@pytest.mark.slow
def test_only_a_camera_that_was_bumped_sees_what_no_other_does(
    run: Run, session: Path, scene: Path
) -> None:
    before, _ = filled(draw(run, session, scene, "--frame", SINCE - 1))
    after, missed = filled(draw(run, session, scene, "--frame", SINCE))

    assert before == [0] * N_CAMERAS
    # The ball is 29 px wide; outlines are drawn over a part of what is filled.
    assert after[BUMPED] > 150
    assert missed[BUMPED] > 150
    # Four cameras blame each other, too: the hull of the rest is cut.
    assert max(after[:BUMPED] + after[BUMPED + 1 :]) < 2 * after[BUMPED]


@pytest.mark.slow
def test_a_report_chooses_the_middle_of_the_worst_cause(
    run: Run, session: Path, scene: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    report = session.parent / "report.h5"
    asked = ("detect", session, "--scene", scene, "-o", report, "--viewport", 2, "--no-response")
    assert run(*asked, "--no-progress") == 0
    agreement = SessionAgreement(True, (bump(), bump(first_frame=0, last_frame=0)))
    with h5py.File(report, "r+") as file:
        del file["hybridve/settings/agreement"]
        file["hybridve/settings/agreement"] = json.dumps(to_plain(agreement))
    capsys.readouterr()

    path = draw(run, session, scene, "--report", report)
    assert capsys.readouterr().out == f"{path}: frame 4\n"
    named = np.asarray(cv2.imread(str(path)))
    draw(run, session, scene, "--report", report, "--frame", 1)
    assert capsys.readouterr().out == f"{path}: frame 1\n"

    draw(run, session, scene, "--frame", 4)
    unnamed = np.asarray(cv2.imread(str(path)))
    assert (named != unnamed).any()
    differs = np.argwhere((named != unnamed).any(axis=2))
    middle = np.array(named.shape[:2]) / 2
    assert (differs.mean(axis=0) > middle * (1.0, 0.0)).all()  # cam2 is in the lower left
    assert differs[:, 1].max() < middle[1]


def test_a_frame_that_is_not_there_is_told_in_a_line(
    run: Run, session: Path, scene: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = session.parent / "seen.png"
    asked = ("render", session, "--scene", scene, "-o", path, "--view", "agreement")

    assert run(*asked, "--frame", N_FRAMES) == 1
    assert f"has no frame {N_FRAMES}" in capsys.readouterr().err
    assert not path.exists()


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, "bumped by 20.0 px"),
        ({"size": None}, "bumped"),
        ({"kind": "moved", "size": 3.21}, "moved by 3.2 px"),
        ({"kind": "late", "size": -1.5}, "1.50 frames early"),
        ({"kind": "late", "size": 2.0}, "2.00 frames late"),
        ({"kind": "exchanged", "cameras": ("cam2", "cam3")}, "exchanged with cam3"),
        ({"kind": "upside down"}, "upside down"),
        ({"kind": "frames", "first_frame": 3, "last_frame": 3}, "by 20.0 px in frame 3"),
        ({"kind": "frames", "size": None}, "fits none of the others in frames 3 to 5"),
        ({"kind": "contradictory"}, "contradicts the others"),
    ],
)
def test_a_cause_is_told_in_a_few_words(changes: dict[str, object], expected: str) -> None:
    assert brief(bump(**changes), "cam2").endswith(expected)
