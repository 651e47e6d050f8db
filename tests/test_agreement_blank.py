"""Cameras that are empty, nearly all object, or the same all the time: told, and never refused."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.sessions import (
    FOCAL_PX,
    SIZE_PX,
    ball_mask,
    ring_matrix,
    write_ball_session,
    write_cube_scene,
)
from numpy.typing import NDArray

from hybridve.calib.formats.rig_json import write_rig
from hybridve.calib.formats.rigs import import_rig
from hybridve.calib.lens import undistortion
from hybridve.calib.rig import Rig
from hybridve.hull.agreement.blank import (
    Blank,
    BlankLooks,
    blank_cameras,
    blank_message,
    rests_on_text,
)

Run = Callable[..., int]
Mask = NDArray[np.uint8]

N_CAMERAS, N_FRAMES = 4, 12

#: The ball moves above the cube: outside of what the last camera, of four times the focal length,
#: sees, and inside of what the others see.
CENTERS = np.column_stack(
    [np.linspace(-0.1, 0.1, N_FRAMES), np.zeros(N_FRAMES), np.full(N_FRAMES, 0.55)]
)
NEARER = np.array([[4.0, 0.0, -1.5 * SIZE_PX[0]], [0.0, 4.0, -1.5 * SIZE_PX[1]], [0.0, 0.0, 1.0]])

EFFECT = '[[effect]]\nkind = "proximity"\nobject = "cube"\nzones_mm = [100]\n'
MOVE = ("--move", "cube", "--along", "0,0,-1", "--range-mm", "0:50")


def kinds(shares: list[list[float]], is_same: list[bool]) -> list[tuple[str, tuple[int, ...]]]:
    found = blank_cameras(np.array(shares), np.array(is_same))
    return [(one.kind, one.cameras) for one in found]


def test_a_camera_is_empty_only_if_no_frame_that_was_read_has_an_object_pixel() -> None:
    nan = np.nan

    assert kinds([[0.0, 0.1], [nan, nan], [0.0, 0.2]], [True, False]) == [("saw nothing", (0,))]
    assert kinds([[0.0, 0.1], [1e-9, 0.2]], [False, False]) == []
    assert kinds([[nan, nan]], [True, True]) == []
    assert kinds([[0.0, 0.0]], [True, True]) == [("saw nothing", (0, 1))]


def test_nearly_all_of_a_picture_is_told_of_each_camera_by_its_mean() -> None:
    shares = [[0.98, 1.0, 0.89], [0.98, 0.7, 0.91]]

    assert kinds(shares, [True, False, False]) == [("all object", (0,))]
    assert kinds([[1.0, 1.0]], [True, True]) == [("all object", (0,)), ("all object", (1,))]


def test_silhouettes_that_never_change_are_told_where_there_are_frames_enough() -> None:
    shares = [[0.1, 0.1]] * N_FRAMES

    assert kinds(shares, [True, False]) == [("unchanging", (0,))]
    assert kinds(shares, [True, True]) == [("unchanging", (0, 1))]
    assert kinds(shares[:9], [True, False]) == []


def test_looks_know_shares_and_what_is_the_same() -> None:
    looks = BlankLooks()
    still = np.array([[1, 0], [0, 0]], np.uint8)
    moved = np.array([[0, 1], [0, 0]], np.uint8)  # of the same area
    looks.take(3, [still, still])
    looks.take(5, [still, moved])

    assert looks.index == [3, 5]
    np.testing.assert_array_equal(looks.shares, np.full((2, 2), 0.25))
    np.testing.assert_array_equal(looks.is_same, [True, False])


def test_a_line_says_what_to_ask() -> None:
    one = Blank("saw nothing", (1,), 40, 0.0, is_every=False)

    for_masks = blank_message(one, ["a", "b"], has_masks=True)
    assert for_masks == (
        "b saw nothing in all 40 frames, and all that is kept or free rests on that; does it see "
        "where the task is, and are these its masks?"
    )
    assert blank_message(one, ["a", "b"], has_masks=False).endswith("and is this its recording?")
    assert rests_on_text(["b"], 40) == "b having seen nothing in all 40 frames"


@pytest.fixture
def session(tmp_path: Path) -> Path:
    """A ball above, which the last camera does not see: it looks at the cube from nearer."""
    path = write_ball_session(tmp_path / "session", CENTERS, n_cameras=N_CAMERAS)
    name = f"cam{N_CAMERAS - 1}"
    matrix = NEARER @ ring_matrix(N_CAMERAS - 1, N_CAMERAS)
    rig = path.parent / "rig.csv"
    rows = rig.read_text(encoding="utf-8").splitlines()[:-1]
    rows.append(",".join([name, *(repr(float(value)) for value in matrix.ravel())]))
    rig.write_text("\n".join(rows) + "\n", encoding="utf-8")
    for frame, center in enumerate(CENTERS):
        mask = ball_mask(matrix, center)
        assert not mask.any()
        cv2.imwrite(str(path.parent / name / f"{frame}.png"), mask)
    return path


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    path = write_cube_scene(tmp_path / "cubes", {"cube": (0.0, 0.0, 0.0)})
    path.write_text(path.read_text(encoding="utf-8") + EFFECT, encoding="utf-8")
    return path


def redraw(session: Path, camera: str, drawn: Callable[[Mask], Mask]) -> None:
    for path in (session.parent / camera).glob("*.png"):
        image = np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), np.uint8)
        cv2.imwrite(str(path), drawn(image))


@pytest.mark.slow  # the first loads what is compiled
def test_what_is_kept_says_that_it_rests_on_a_camera_that_saw_nothing(
    run: Run, tmp_path: Path, session: Path, scene: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rests_on = "cam3 having seen nothing in all 12 frames"
    asks = "cam3 saw nothing in all 12 frames, and all that is kept or free rests on that"
    report = tmp_path / "report.h5"

    # Nobody need enter a camera's view: it is said, and is no reason to fail.
    asked = ("detect", session, "--scene", scene, "-o", report, "--fail-on-doubt")
    assert run(*asked, "--fail-on-clash") == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == (
        f"kept: the object keeps the distance, which is proved; what is kept rests on {rests_on}"
    )
    assert sum(line.strip().startswith(asks) for line in lines) == 1
    assert run("summary", report, "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["kept_rests_on"] == rests_on
    assert [(one["kind"], one["cameras"], one["is_gross"]) for one in found["causes"]] == [
        ("saw nothing", ["cam3"], False)
    ]

    assert run("spacing", session, "--scene", scene, *MOVE) == 0
    told = capsys.readouterr().out
    assert asks in told
    assert rests_on in told
    assert run("simulate", session, "--scene", scene, "-o", tmp_path / "sim.h5", "--json") == 0
    assert json.loads(capsys.readouterr().out)["rests_on"] == rests_on
    assert run("segment", session) == 0
    assert asks in capsys.readouterr().out


@pytest.mark.slow
def test_where_no_camera_saw_anything_that_is_what_kept_rests_on(
    run: Run, tmp_path: Path, session: Path, scene: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for camera in range(N_CAMERAS):
        redraw(session, f"cam{camera}", np.zeros_like)

    assert run("detect", session, "--scene", scene, "-o", tmp_path / "r.h5") == 0

    told = capsys.readouterr().out
    assert "cam0 and cam1 and cam2 and cam3 having seen nothing" in told.splitlines()[0]
    assert "no camera saw anything in all 12 frames" in told
    assert "is this the recording of the task?" in told


def all_but_a_strip(mask: Mask) -> Mask:
    full = np.full_like(mask, 255)
    full[:, :3] = 0
    return full


def always_the_first(session: Path) -> Callable[[Mask], Mask]:
    first = cv2.imread(str(session.parent / "cam1" / "0.png"), cv2.IMREAD_GRAYSCALE)
    return lambda _: np.asarray(first, np.uint8)


@pytest.mark.slow
def test_masks_that_are_nearly_all_object_or_never_change_are_told(
    run: Run, tmp_path: Path, session: Path, scene: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    still = "cam1 shows the very same silhouette in all 12 frames"
    for drawn, told in (
        (always_the_first(session), still),
        (all_but_a_strip, "cam1 is 98% object in all 12 frames, on average; are the masks black"),
    ):
        redraw(session, "cam1", drawn)
        report = tmp_path / "r.h5"
        assert run("detect", session, "--scene", scene, "-o", report, "--overwrite") == 0
        assert told in capsys.readouterr().out
        # Without a rig the cameras say nothing of each other; this is told all the same.
        assert run("segment", session, "--unconfirmed", "--overwrite") == 0
        assert told in capsys.readouterr().out
        (session.parent / "silhouettes.h5").unlink()


def bend(session: Path, strength: float) -> float:
    """Give cam1 a lens that bends inwards; return which share of its pinhole image it recorded."""
    sizes_px = {f"cam{camera}": SIZE_PX for camera in range(N_CAMERAS)}
    rig = import_rig(session.parent, "rig.csv", "m", 0.5, sizes_px, None)
    params = np.array([FOCAL_PX, SIZE_PX[0] / 2, SIZE_PX[1] / 2, strength])
    bent = replace(rig.cameras[1], model="SIMPLE_RADIAL", params=params, skew_px=0.0)
    write_rig(session.parent / "rig.json", Rig((rig.cameras[0], bent, *rig.cameras[2:])))
    text = session.read_text(encoding="utf-8")
    text = text.replace('rig = "rig.csv"\nrig_unit = "m"', 'rig = "rig.json"')
    session.write_text(text, encoding="utf-8")
    seen = undistortion(bent).seen
    assert seen is not None
    return float(seen.mean())


@pytest.mark.slow
def test_of_a_bent_lens_the_share_is_that_of_what_it_recorded(
    run: Run, tmp_path: Path, session: Path, scene: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    redraw(session, "cam1", lambda mask: np.full_like(mask, 255))

    assert bend(session, -0.4) < 0.85
    assert run("detect", session, "--scene", scene, "-o", tmp_path / "r.h5") == 0

    told = capsys.readouterr().out
    assert "cam1 is 100% object in all 12 frames, on average; are the masks black on white?" in told
