"""``hybridve render`` of ready masks: what has no colours, from a head, around, and of no frame."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.boards import look_at
from helpers.sessions import write_ball_session, write_cube_scene
from helpers.view_scene import is_blue_grey
from numpy.typing import NDArray

from hybridve.calib.pose import invert

pytestmark = pytest.mark.gl

Run = Callable[..., int]

N_FRAMES = 3


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session of ready masks of a ball that stays, and a cube beside it, towards +y."""
    folder = tmp_path_factory.mktemp("render")
    write_ball_session(folder, np.zeros((N_FRAMES, 3)))
    write_cube_scene(folder, {"cube": (0.0, 700.0, 0.0)})
    return folder


def drawn(run: Run, folder: Path, output: Path, *more: object) -> int:
    usual = ("--scene", folder / "scene.toml", "--size", "320x200", "--no-progress")
    return run("render", folder, *usual, "-o", output, *more)


def pictures_of(path: Path) -> list[NDArray[np.uint8]]:
    import av

    with av.open(str(path)) as film:
        pictures = [frame.to_ndarray(format="bgr24") for frame in film.decode(video=0)]
    return [np.asarray(picture, np.uint8) for picture in pictures]


def write_head(path: Path, eyes: dict[int, tuple[float, float, float]]) -> Path:
    """Write the poses of a head that looks at the origin from somewhere, by frame."""
    lines = ["frame,m11,m12,m13,m14,m21,m22,m23,m24,m31,m32,m33,m34"]
    for frame, eye in eyes.items():
        pose = invert(look_at(eye, (0.0, 0.3, 0.0)))
        lines.append(",".join([str(frame), *(f"{value:.12g}" for value in pose.ravel())]))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


@pytest.mark.slow
def test_masks_have_no_colours_and_a_film_of_them_is_plain(
    run: Run, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert drawn(run, folder, tmp_path / "a.png", "--texture") == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "its cameras have masks and no pictures" in line
    assert "draw it with --plain" in line
    assert list(tmp_path.iterdir()) == []

    assert drawn(run, folder, tmp_path / "a.mp4") == 0

    assert len(pictures_of(tmp_path / "a.mp4")) == N_FRAMES


@pytest.mark.slow
def test_a_head_sees_the_cube_on_its_own_right(run: Run, folder: Path, tmp_path: Path) -> None:
    """From +x it stands to the right of the ball, from -x to the left; frame 1 has no pose."""
    head = write_head(tmp_path / "head.csv", {0: (3.0, 0.3, 0.4), 2: (-3.0, 0.3, 0.4)})

    assert drawn(run, folder, tmp_path / "a.mp4", "--from", head) == 0

    pictures = pictures_of(tmp_path / "a.mp4")
    assert len(pictures) == 2
    for picture, is_right in zip(pictures, (True, False), strict=True):
        _, columns = np.nonzero(is_blue_grey(picture[40:160]))
        assert len(columns) > 40
        assert (np.median(columns) > 160) == is_right


@pytest.mark.slow
def test_a_head_that_is_nowhere_makes_no_film(
    run: Run, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    head = write_head(tmp_path / "head.csv", {7: (3.0, 0.3, 0.4)})

    assert drawn(run, folder, tmp_path / "a.mp4", "--from", head) == 1
    assert "there is no picture to make a film of" in capsys.readouterr().err
    assert drawn(run, folder, tmp_path / "a.png", "--from", head) == 1
    assert "has no pose of frame 0" in capsys.readouterr().err
    assert [one.name for one in tmp_path.iterdir()] == ["head.csv"]


@pytest.mark.slow
def test_through_a_camera_of_masks_one_sees_its_silhouette(
    run: Run, folder: Path, tmp_path: Path
) -> None:
    path = tmp_path / "a.png"
    mask = cv2.imread(str(folder / "cam1" / "0.png"), cv2.IMREAD_GRAYSCALE)
    assert mask is not None
    size = f"{mask.shape[1]}x{mask.shape[0]}"

    assert drawn(run, folder, path, "--from", "cam1", "--size", size) == 0

    picture = cv2.imread(str(path))
    assert picture is not None
    inner = cv2.erode(mask, np.ones((9, 9), np.uint8)) > 0
    text = np.zeros(mask.shape, np.bool_)
    text[:60], text[-50:] = True, True
    grey = (picture.max(axis=2) - picture.min(axis=2) < 8) & (picture[..., 0] > 60)
    assert grey[inner & ~text].mean() > 0.9
