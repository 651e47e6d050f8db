"""The photograph of a certificate: where the world is in what a camera saw."""

from pathlib import Path

import cv2
import numpy as np
from helpers.boards import look_at
from helpers.records import make_record

from hybridve.calib.camera import Camera
from hybridve.calib.lens import project_points
from hybridve.calib.rig import Rig
from hybridve.hull.capture.session import load_session
from hybridve.hull.view.world_photo import axis_length_m, draw_world, share_in_picture
from hybridve.hull.world_photo import world_photo

LENS = np.array([500.0, 500.0, 320.0, 240.0, -0.25, 0.05, 0.0, 0.0])


def camera_at(name: str, eye: tuple[float, float, float], at: tuple[float, float, float]) -> Camera:
    return Camera(name, "OPENCV", 640, 480, LENS, look_at(eye, at))


def test_the_axes_are_drawn_where_the_lens_shows_them() -> None:
    camera = camera_at("cam", (1.5, -2.0, 1.6), (0.3, 0.4, 0.0))
    grey = np.full((480, 640, 3), 128, np.uint8)

    image = draw_world(grey, camera).astype(int)

    length_m = axis_length_m(camera)
    assert length_m == 0.5, "a quarter of 2.97 m, rounded"
    middles, _ = project_points(camera, 0.6 * length_m * np.eye(3))
    for axis, (x, y) in enumerate(middles):
        blue, green, red = image[int(y), int(x)]
        assert (red, green, blue)[axis] == max(red, green, blue)
        assert max(red, green, blue) > min(red, green, blue) + 60
    beyond, _ = project_points(camera, 1.6 * length_m * np.array([[0.0, 0.0, 1.0]]))
    x, y = beyond[0].astype(int)
    assert (image[y - 3 : y + 3, x - 3 : x + 3] == 128).all(), "Z ends"


def test_a_camera_that_looks_away_sees_nothing_of_the_world() -> None:
    assert share_in_picture(camera_at("to", (2.0, -2.0, 1.5), (0.0, 0.0, 0.0))) == 1.0
    assert share_in_picture(camera_at("away", (2.0, -2.0, 1.5), (4.0, -4.0, 1.5))) == 0.0


def write_session(folder: Path) -> Path:
    """Write two cameras whose board clips are single pictures, of even grey 50 and 200."""
    lines = ['format = "hybridve-session"', "version = 1", ""]
    lines += ["[target]", 'kind = "chessboard"', "columns = 8", "rows = 6", "square_mm = 100", ""]
    for name, grey in (("near", 50), ("away", 200)):
        for what in ("board", "video"):
            cv2.imwrite(str(folder / f"{name}_{what}.png"), np.full((480, 640, 3), grey, np.uint8))
        lines += ["[[camera]]", f'name = "{name}"', f'extrinsics = "{name}_board.png"']
        lines += [f'background = "{name}_video.png"', f'video = "{name}_video.png"', ""]
    path = folder / "session.toml"
    path.write_text("\n".join(lines), encoding="utf-8")
    return path


def test_the_picture_is_of_the_camera_that_sees_the_axes(tmp_path: Path) -> None:
    session = load_session(write_session(tmp_path))
    near = camera_at("near", (2.0, -2.0, 1.5), (0.0, 0.0, 0.0))
    away = camera_at("away", (1.0, -1.0, 1.0), (4.0, -4.0, 1.5))
    record = make_record(["near", "away"])

    photo = world_photo(session, Rig((near, away)), record)

    assert photo is not None
    assert photo.camera == "near"
    assert photo.axis_m == axis_length_m(near)
    assert (photo.image == 50).all(axis=2).mean() > 0.8, "its board clip's picture"
    assert world_photo(session, Rig((away,)), record) is None
