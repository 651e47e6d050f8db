"""What is told of a rig that is only drawn, against closed forms and a calibration of it."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from hybridve.calib.boards.board import Observations, Sighting
from hybridve.calib.calibrate import solve_rig
from hybridve.calib.pose import transform
from hybridve.calib.provenance import MadeElsewhere
from hybridve.calib.rig import Rig, RigCovariance
from hybridve.calib.solving.errors_in_space import point_errors
from hybridve.hull.plan.calibration import calibrate_drawing
from hybridve.hull.plan.drawing import Drawing, draw, pixels_of, places_in, sees_ball, stills_of
from hybridve.hull.plan.example import EXAMPLE
from hybridve.hull.plan.tables import read_plan
from hybridve.hull.plan.trial import SIDES, ball_mask, try_places

Run = Callable[..., int]

RADIUS_M = 0.045


def plan_file(folder: Path, cameras: str = "", replaced: dict[str, str] | None = None) -> Path:
    """Write the example, with cameras of its own instead of the ring where some are given."""
    text = EXAMPLE
    if cameras:
        text = text.replace("[ring] ", "#").replace("cameras = 4", "").replace("radius_m = 2.5", "")
        text = text.replace("height_m = 2.2", "").replace(
            "looks_at_m = [0.0, 0.0, 0.8]\n# f", "# f"
        )
        text += cameras
    for old, new in (replaced or {}).items():
        assert old in text
        text = text.replace(old, new, 1)
    path = folder / "plan.toml"
    path.write_text(text, encoding="utf-8")
    return path


def drawing_of(path: Path, **changes: str) -> Drawing:
    return draw(*read_plan(path, changes))


def far_cameras(*azimuths_deg: float, distance_m: float = 20.0) -> str:
    """Return cameras far off in one plane, with long lenses: their rays are all but parallel."""
    tables = []
    for azimuth_deg in azimuths_deg:
        x, y = (distance_m * f(np.deg2rad(azimuth_deg)) for f in (np.cos, np.sin))
        tables.append(
            f'[[camera]]\nname = "at {azimuth_deg:g}"\nat_m = [{x}, {y}, 1.0]\n'
            'looks_at_m = [0, 0, 1.0]\nacross_deg = 5\nsize_px = "1600x1200"\n'
        )
    return "\n" + "\n".join(tables)


def exact(drawing: Drawing) -> Rig:
    """Return the cameras as a rig that knows itself exactly but for a trifle."""
    size = sum(6 + len(camera.params) for camera in drawing.cameras)
    labels = tuple(
        f"{camera.name} p{index}"
        for camera in drawing.cameras
        for index in range(6 + len(camera.params))
    )
    covariance = RigCovariance(labels, np.eye(size) * 1e-24)
    return Rig(drawing.cameras, MadeElsewhere({}), covariance)


def overhang_m(drawing: Drawing, center: tuple[float, float, float]) -> NDArray[np.float64]:
    """Return how much nearer the hull of a ball is than the ball, on six sides."""
    told = try_places(exact(drawing), np.array([center]), RADIUS_M, 1e-3, lambda: None)
    return np.asarray(told.hull_m[0])


def test_two_cameras_see_a_ball_as_the_rhombus_between_their_tangents(tmp_path: Path) -> None:
    drawing = drawing_of(plan_file(tmp_path, far_cameras(-30.0, 30.0)))

    found_m = overhang_m(drawing, (0.0, 0.0, 1.0))

    # Of parallel rays: along the bisector a tip at r / sin(30), across it one at r / cos(30).
    along_m, across_m = RADIUS_M / np.sin(np.pi / 6), RADIUS_M / np.cos(np.pi / 6)
    expected_m = np.array([along_m, across_m, RADIUS_M] * 2) - RADIUS_M
    # A pixel is 1.1 mm; a tip of 60 degrees doubles it; rays that meet 20 m off add 0.3 %.
    np.testing.assert_allclose(found_m, expected_m, atol=2.5e-3)


def test_between_cameras_that_face_each_other_nothing_ends_the_hull(tmp_path: Path) -> None:
    drawing = drawing_of(plan_file(tmp_path, far_cameras(0.0, 180.0)))

    found_m = overhang_m(drawing, (0.0, 0.0, 1.0))

    gap_m = 4.0 * RADIUS_M  # all that there is
    assert found_m[SIDES[:, 0] != 0].tolist() == pytest.approx([gap_m, gap_m])
    np.testing.assert_allclose(found_m[SIDES[:, 0] == 0], 0.0, atol=2.5e-3)


def test_no_camera_more_makes_the_hull_larger(tmp_path: Path) -> None:
    azimuths = [-50.0, 30.0, 140.0, 80.0]
    before_m = np.full(6, np.inf)

    for count in (2, 3, 4):
        drawing = drawing_of(plan_file(tmp_path, far_cameras(*azimuths[:count])))
        found_m = overhang_m(drawing, (0.01, -0.02, 1.03))
        assert (found_m <= before_m + 5e-4).all()  # the tolerance of a clearance
        before_m = found_m

    assert (before_m > -2.5e-3).all()  # a hull holds the ball, but for a pixel


def test_a_silhouette_is_the_circle_that_a_ball_before_a_camera_has(tmp_path: Path) -> None:
    camera = drawing_of(plan_file(tmp_path)).cameras[0]
    distance_m, radius_m = 1.7, 0.3
    center = transform(
        np.column_stack([camera.cam_from_world[:, :3].T, camera.center_world]),
        np.array([[0.0, 0.0, distance_m]]),
    )[0]

    mask = ball_mask(camera, center, radius_m)

    radius_px = camera.params[0] * radius_m / np.sqrt(distance_m**2 - radius_m**2)
    y, x = np.nonzero(mask)
    off_px = np.hypot(x + 0.5 - camera.params[2], y + 0.5 - camera.params[3])
    assert off_px.max() <= radius_px
    assert (mask > 0).sum() == pytest.approx(np.pi * radius_px**2, rel=2e-3)


def test_a_ball_off_the_axis_is_where_its_points_are(tmp_path: Path) -> None:
    camera = drawing_of(plan_file(tmp_path)).cameras[0]
    center, radius_m = np.array([0.3, -0.25, 1.2]), 0.12
    rng = np.random.default_rng(3)
    normals = rng.normal(size=(4000, 3))
    points = center + radius_m * normals / np.linalg.norm(normals, axis=1, keepdims=True)

    mask = ball_mask(camera, center, radius_m)

    points_cam = transform(camera.cam_from_world, points)
    pixels = camera.params[0] * points_cam[:, :2] / points_cam[:, 2:] + camera.params[2:4]
    near = mask.copy()
    near[1:] |= mask[:-1]
    near[:-1] |= mask[1:]
    near[:, 1:] |= near[:, :-1].copy()
    near[:, :-1] |= near[:, 1:].copy()
    column, row = np.floor(pixels).astype(int).T
    assert (near[row, column] > 0).all()  # the middle of the next pixel may be off the ball
    # The ellipse that a ball is off the axis.
    at = transform(camera.cam_from_world, center[None])[0]
    focal_px, deep = camera.params[0], at[2] ** 2 - radius_m**2
    long_px = focal_px * radius_m * np.sqrt(at @ at - radius_m**2) / deep
    wide_px = focal_px * radius_m / np.sqrt(deep)
    assert (mask > 0).sum() == pytest.approx(np.pi * long_px * wide_px, rel=3e-3)
    assert sees_ball(camera, center, radius_m)


def test_a_ball_is_seen_until_it_reaches_the_side_of_the_picture(tmp_path: Path) -> None:
    camera = drawing_of(plan_file(tmp_path)).cameras[0]
    half = np.deg2rad(70.0 / 2.0)
    depth_m, radius_m = 2.0, 0.2
    # It touches the plane through the picture's left side where its centre is r off that plane.
    touches_m = (depth_m * np.sin(half) - radius_m) / np.cos(half)
    world_from_cam = np.column_stack([camera.cam_from_world[:, :3].T, camera.center_world])

    def at(x_m: float) -> NDArray[np.float64]:
        return np.asarray(transform(world_from_cam, np.array([[-x_m, 0.0, depth_m]]))[0])

    assert sees_ball(camera, at(touches_m - 1e-6), radius_m)
    assert not sees_ball(camera, at(touches_m + 1e-6), radius_m)


def test_twice_the_noise_is_twice_the_error(tmp_path: Path) -> None:
    path = plan_file(tmp_path)
    errors_m = []
    for corner_px in ("0.2", "0.4"):
        plan, target = read_plan(path, {"calibration.corner_px": corner_px})
        drawing = draw(plan, target)
        rig = calibrate_drawing(drawing, plan.calibration).rig
        errors_m.append(point_errors(rig, places_in(drawing, 2)).radius95_m)

    # What is known without pictures changes it by less than a millionth.
    np.testing.assert_allclose(errors_m[1], 2.0 * errors_m[0], rtol=1e-4)


@pytest.mark.slow
def test_a_calibration_of_what_is_drawn_states_the_error_that_the_plan_told(
    tmp_path: Path,
) -> None:
    plan, target = read_plan(plan_file(tmp_path), {"ring.cameras": "3"})
    drawing = draw(plan, target)
    rng = np.random.default_rng(5)

    def seen(pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        return pixels + rng.normal(0.0, plan.calibration.corner_px, pixels.shape)

    observations = []
    for index, camera in enumerate(drawing.cameras):
        at_rest = np.eye(3, 4)
        unplaced = type(camera)(
            camera.name, camera.model, camera.width_px, camera.height_px, camera.params, at_rest
        )
        sightings = []
        stills = stills_of(camera, drawing.board, plan.calibration.stills, index)
        for number, pose in enumerate(stills):
            pixels = pixels_of(unplaced, drawing.board, pose)
            assert pixels is not None
            sightings.append(Sighting(f"{number}.png", None, 0, seen(pixels)))
        pixels = pixels_of(camera, drawing.board, drawing.world_from_board, is_on_floor=True)
        assert pixels is not None
        sightings.append(Sighting("board clip", 0, 0, seen(pixels)))
        size_px = (camera.width_px, camera.height_px)
        observations.append(
            Observations(camera.name, camera.model, size_px, tuple(sightings), is_still=True)
        )
    calibrated = solve_rig([drawing.board], observations).rig

    points = places_in(drawing, 3)
    planned_m = point_errors(calibrate_drawing(drawing, plan.calibration).rig, points).radius95_m
    # The board's own frame is the world of a calibration.
    stated_m = point_errors(calibrated, points - drawing.world_from_board[:, 3]).radius95_m

    # It finds the noise from some thousand corners, to two per cent or so.
    np.testing.assert_allclose(stated_m, planned_m, rtol=0.15)


# --- The command --------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_example_is_a_plan_and_its_answer_is_json(
    run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("plan", "--example") == 0
    path = tmp_path / "plan.toml"
    path.write_text(capsys.readouterr().out, encoding="utf-8")

    assert run("plan", path, "--json", "--vary", "ball.radius_mm=20,45") == 0

    told = json.loads(capsys.readouterr().out)
    assert [row["value"] for row in told] == ["20", "45"]
    assert [row["ball_radius_mm"] for row in told] == [20.0, 45.0]
    for row in told:
        assert row["seen_by_all"] > 0.9
        assert row["notes"] == []
        # What a ball of four cameras bulges grows with it; outlines err alike.
        assert 0 < row["hull_mm"]["median"] <= row["hull_mm"]["most"] < 2.0 * row["ball_radius_mm"]
    assert told[1]["hull_mm"]["at_95_percent"] > told[0]["hull_mm"]["at_95_percent"]
    assert told[1]["doubt_mm"]["median"] == pytest.approx(told[0]["doubt_mm"]["median"], rel=0.3)


BAD = {
    "no camera": ({"cameras = 4": "camera = 4"}, "ring.camera: there is no such key; did you mean"),
    "one camera": ({"cameras = 4": "cameras = 1"}, "ring.cameras"),
    "a volume upside down": ({"high_m = [0.6, 0.6, 1.6]": "high_m = [0.6, 0.6, 0.1]"}, "along z"),
    "a size in words": ({"# [lens] ": '[lens]\nsize_px = "HD"  #'}, "expected width x height"),
    "no board": ({'kind = "chessboard"': 'kind = "grid"'}, "chessboard, charuco, aprilgrid"),
    "a board out of view": (
        {"# [calibration]": "[calibration]\nlies_at_m = [9.0, 9.0, 0.0]"},
        "the board on the floor is wholly seen by 0 of 4 cameras",
    ),
    "a camera that looks at itself": (
        {"radius_m = 2.5": "radius_m = 1e-9", "height_m = 2.2": "height_m = 0.8"},
        "looks at where it stands",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_a_plan_that_cannot_be_is_refused_in_one_line(
    run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    replaced, message = BAD[name]

    assert run("plan", plan_file(tmp_path, replaced=replaced)) == 1

    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: ")
    assert message in line


def test_a_key_that_is_varied_is_checked_before_anything_is_worked_out(
    run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("plan", plan_file(tmp_path), "--vary", "ring.camera=3,4") == 1

    assert "did you mean cameras?" in capsys.readouterr().err
