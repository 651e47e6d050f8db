"""Silhouettes that contradict each other are not emptiness; an empty hull says what it rests on."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.sessions import SIZE_PX, ball_mask, ring_matrix, write_ball_session, write_cube_scene

from hybridve.hull.report.read import read_report
from hybridve.hull.report.summarize import summarize

Run = Callable[..., int]

N_CAMERAS = 4
AWAY, TOUCHING = (-0.6, 0.0, 0.0), (-0.25, 0.0, 0.0)
#: Beside the ball in camera 2 alone: what it would see of one that stands there.
ELSEWHERE = (0.6, 0.5, 0.4)


@pytest.fixture
def session(tmp_path: Path) -> Path:
    """Away, touching three times, away; in the middle camera 2 saw a ball that is not there."""
    centers = np.array([AWAY, TOUCHING, TOUCHING, TOUCHING, AWAY])
    path = write_ball_session(tmp_path / "session", centers, n_cameras=N_CAMERAS)
    wrong = ball_mask(ring_matrix(2, N_CAMERAS), np.array(ELSEWHERE))
    cv2.imwrite(str(path.parent / "cam2" / "2.png"), wrong)
    return path


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    return write_cube_scene(tmp_path, {"hit": (0.0, 0.0, 0.0)})


def put(session: Path, camera: int, frame: int, value: int) -> None:
    """Replace a camera's silhouette of a frame by one that is all the same."""
    width, height = SIZE_PX
    mask = np.full((height, width), value, np.uint8)
    cv2.imwrite(str(session.parent / f"cam{camera}" / f"{frame}.png"), mask)


@pytest.mark.slow
def test_a_contradiction_is_a_row_of_its_own_and_splits_no_contact(
    run: Run, tmp_path: Path, session: Path, scene: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "report.h5"
    asked = ("detect", session, "--scene", scene, "-o", path, "--fail-on-clash")

    assert run(*asked, "--let-pass", "clash") == 3
    told = capsys.readouterr().out
    assert run(*asked, "--overwrite", "--let-pass", "clash", "--let-pass", "unknown") == 0

    report = read_report(path)
    hit = report.objects["hit"]
    assert report.state.tolist() == ["evaluated"] * 2 + ["contradictory"] + ["evaluated"] * 2
    assert "no point is in all of them" in report.reason[2]
    assert "without cam2 the others agree" in report.reason[2]
    assert hit.verdict.tolist() == ["kept", "clash", "unknown", "clash", "kept"]
    assert hit.why[2] == report.reason[2]
    assert report.rests_on[2] == ""
    assert hit.certificate[2] == ""
    assert np.isnan(hit["clearance_m"][2]).all()
    # It began once, before; where nothing is known of the frame before, nobody saw it begin.
    assert np.isfinite(hit["first_contact_s"]).tolist() == [False, True, False, False, False]
    (span,) = summarize(report)["objects"][0]["spans"]
    assert (span["first_frame"], span["last_frame"]) == (1, 3)
    assert "without cam2 the others agree" in told
    assert "1 frame could not be evaluated" in told
    assert told.count("no point is in all of them") == 2  # of the frame, and of the object
    assert "(frame 2)" in told
    shares = [of_camera["object_share"] for of_camera in report.cameras.values()]
    assert (np.array(shares) > 0).all()


def test_what_the_others_deny_of_a_silhouette_is_a_number_of_its_camera(
    run: Run, tmp_path: Path, session: Path, scene: Path
) -> None:
    """Camera 3 sees objects wherever it looks; the hull is that of the others, and they know."""
    put(session, 3, 1, 255)
    path = tmp_path / "report.h5"

    assert run("detect", session, "--scene", scene, "-o", path) == 0

    report = read_report(path)
    assert report.state[1] == "evaluated"
    denied_px = np.array([of_camera["denied_px"] for of_camera in report.cameras.values()])
    ball_px = (ball_mask(ring_matrix(3, N_CAMERAS), np.array(TOUCHING)) > 0).sum()
    assert 0.5 * np.prod(SIZE_PX) < denied_px[3, 1] <= np.prod(SIZE_PX) - ball_px
    assert (denied_px[:3, 1] == 0).all()
    assert (denied_px[:, [0, 3, 4]] == 0).all()


def test_what_an_empty_hull_rests_on_is_said(
    run: Run, tmp_path: Path, session: Path, scene: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    put(session, 1, 0, 0)  # camera 1 saw nothing, though the ball is in its image
    for camera in (1, 2, 3):
        put(session, camera, 3, 0)  # what camera 0 saw may be outside of the others' images
    for camera in range(N_CAMERAS):
        put(session, camera, 4, 0)  # nobody saw anything
    path = tmp_path / "report.h5"

    assert run("detect", session, "--scene", scene, "-o", path) == 0

    report, told = read_report(path), capsys.readouterr().out
    hit = report.objects["hit"]
    assert hit.verdict.tolist() == ["unknown", "clash", "unknown", "kept", "kept"]
    assert report.state[0] == "contradictory"
    assert report.reason[0].startswith("cam1 saw nothing, while others did: no place")
    assert report.rests_on[3].startswith("cam1, cam2, cam3 saw nothing, while others did")
    assert hit.why[3] == report.rests_on[3]
    assert report.rests_on[4] == ""
    assert hit.why[4] == ""
    assert "cam1, cam2, cam3 saw nothing, while others did" in told
    assert "a camera saw nothing" not in told


def test_outlines_that_miss_each_other_by_little_prove_nothing(
    run: Run, tmp_path: Path, scene: Path
) -> None:
    """A thing a pixel wide, a pixel off in one camera: no hull, and no freedom either."""
    session = write_ball_session(tmp_path / "session", np.array([AWAY]), n_cameras=N_CAMERAS)
    for camera in range(N_CAMERAS):
        h = ring_matrix(camera, N_CAMERAS) @ [*AWAY, 1.0]
        column, row = np.floor(h[:2] / h[2]).astype(int)
        mask = np.zeros(SIZE_PX[::-1], np.uint8)
        mask[row - 2 * (camera == 2), column] = 255
        cv2.imwrite(str(session.parent / f"cam{camera}" / "0.png"), mask)
    path = tmp_path / "report.h5"

    assert run("detect", session, "--scene", scene, "-o", path, "--fail-on-clash") == 3

    report = read_report(path)
    assert report.state.tolist() == ["evaluated"]
    assert report.objects["hit"].verdict.tolist() == ["open"]
    assert "unless they are off by up to" in report.objects["hit"].why[0]


def test_cameras_with_nothing_in_common_are_refused(
    run: Run, tmp_path: Path, session: Path, scene: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One pose turned around: every part would be free, whatever is there."""
    rig = session.parent / "rig.csv"
    rows = rig.read_text(encoding="utf-8").splitlines()
    name, *values = rows[1].split(",")
    matrix = np.array([float(value) for value in values]).reshape(3, 4)
    eye = -np.linalg.solve(matrix[:, :3], matrix[:, 3])
    turned = matrix[:, :3] @ np.diag([-1.0, -1.0, 1.0])  # about the vertical
    values = np.column_stack([turned, -turned @ eye]).ravel().tolist()
    rows[1] = ",".join([name, *map(repr, values)])
    rig.write_text("\n".join(rows) + "\n", encoding="utf-8")

    assert run("detect", session, "--scene", scene, "-o", tmp_path / "report.h5") == 1

    error = capsys.readouterr().err
    assert "nothing can be in the hull" in error
    assert "cam1" in error
    assert not (tmp_path / "report.h5").exists()


@pytest.mark.slow
def test_a_part_that_no_camera_sees_is_not_seen(
    run: Run, tmp_path: Path, session: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = write_cube_scene(tmp_path, {"far": (0.0, 9000.0, 0.0), "near": (0.0, 300.0, 0.0)})
    path = tmp_path / "report.h5"

    assert run("detect", session, "--scene", scene, "-o", path, "--fail-on-clash") == 3

    report = read_report(path)
    far, near = report.objects["far"], report.objects["near"]
    assert far.verdict.tolist() == ["not seen", "not seen", "unknown", "not seen", "not seen"]
    assert "outside what the cameras can tell" in far.why[0]
    assert near.verdict[0] == "kept"
    assert near.why[0] == ""
    assert "not seen" in capsys.readouterr().out
