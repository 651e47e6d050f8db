"""Boards that are not what was said of them: seen to be larger, or named for what they are."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from helpers.boards import board_poses, look_at, make_camera, render_board
from helpers.marker_boards import april_sheet, charuco_sheet, project_board, render_sheets
from numpy.typing import NDArray

from hybridve.calib.boards.beyond import lines_beyond
from hybridve.calib.boards.board import Board, Observations, Sighting
from hybridve.calib.boards.corners_io import read_given
from hybridve.calib.boards.markers import AprilGrid, Charuco
from hybridve.calib.boards.named import make_board
from hybridve.calib.boards.suggest import what_is_seen
from hybridve.calib.boards.target import Chessboard
from hybridve.calib.calibrate import solve_rig
from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.image_io import open_source
from hybridve.calib.judging.certificate import working_volume
from hybridve.calib.lens import img_from_cam
from hybridve.calib.pose import Pose, compose, invert, rotation_about_axes, transform
from hybridve.calib.seeing.inputs import CameraInput, ObserveSettings
from hybridve.calib.seeing.observe import find_boards, observe_boards

SIZE_PX = (480, 360)

#: A lens that bends the board as far as wide lenses do, and one that hardly does.
LENSES = ["OPENCV", "OPENCV_FISHEYE"]

TRUE = Chessboard(7, 5, 0.1)


def camera_of(model: str = "SIMPLE_RADIAL", size_px: tuple[int, int] = SIZE_PX) -> Camera:
    return make_camera("cam", model, np.eye(3, 4), size_px)


def picture_of(board: Chessboard, model: str = "SIMPLE_RADIAL", seed: int = 3) -> NDArray[np.uint8]:
    (pose,) = board_poses(board, 1, seed)
    return render_board(camera_of(model), board, pose, noise_grey=2.0, samples=2)


def part_px(
    model: str, first_column: int, first_row: int, columns: int, rows: int, seed: int
) -> NDArray[np.float64]:
    """Return where a part of `TRUE` is seen: (rows, columns, 2) pixels."""
    (pose,) = board_poses(TRUE, 1, seed)
    pixels = img_from_cam(camera_of(model), transform(pose, TRUE.points_board))
    grid = pixels.reshape(TRUE.rows, TRUE.columns, 2)
    return grid[first_row : first_row + rows, first_column : first_column + columns]


@pytest.mark.parametrize("model", LENSES)
@pytest.mark.parametrize("seed", [3, 4])
def test_corners_that_go_on_are_counted_wherever_the_part_lies(model: str, seed: int) -> None:
    grey = picture_of(TRUE, model, seed).astype(np.float32)

    for first_column, first_row, columns, rows in (
        (0, 0, 6, 5),
        (1, 0, 6, 5),
        (0, 1, 7, 4),
        (1, 1, 5, 3),
        (0, 0, 4, 3),
        (2, 1, 4, 3),
    ):
        part = part_px(model, first_column, first_row, columns, rows, seed)
        assert lines_beyond(grey, part) == (TRUE.columns - columns, TRUE.rows - rows)
        # Whichever way the corners are listed.
        assert lines_beyond(grey, part[::-1, ::-1]) == (TRUE.columns - columns, TRUE.rows - rows)


@pytest.mark.parametrize("model", LENSES)
@pytest.mark.parametrize("seed", [3, 4])
def test_a_true_board_ends_after_one_square(model: str, seed: int) -> None:
    grey = picture_of(TRUE, model, seed).astype(np.float32)

    assert lines_beyond(grey, part_px(model, 0, 0, TRUE.columns, TRUE.rows, seed)) == (0, 0)


def test_lines_outside_the_picture_are_no_lines() -> None:
    part = part_px("OPENCV", 0, 0, 6, 5, 3)
    left_px = int(part[..., 0].min() - 15)
    right_px = int(part[..., 0].max() + 15)
    grey = picture_of(TRUE, "OPENCV").astype(np.float32)[:, left_px:right_px]

    assert lines_beyond(np.ascontiguousarray(grey), part - [left_px, 0]) == (0, 0)


# --- Seen in recordings ----------------------------------------------------------------------


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> CameraInput:
    """Pictures of `TRUE`, moved before one camera."""
    folder = tmp_path_factory.mktemp("recorded")
    for index, pose in enumerate(board_poses(TRUE, 4, 5)):
        image = render_board(camera_of(size_px=(240, 180)), TRUE, pose, samples=3)
        cv2.imwrite(str(folder / f"{index}.png"), image)
    return CameraInput("cam", "SIMPLE_RADIAL", None, open_source(folder, "*.png"))


SETTINGS = ObserveSettings(threads=1)


@pytest.mark.slow
def test_a_board_that_is_larger_than_described_is_refused_with_its_count(
    recorded: CameraInput,
) -> None:
    smaller = Chessboard(6, 5, 0.1)
    told = (
        r"columns = 6, but corners go on beyond the edge in \d of \d pictures: the board has 7 x 5 "
        "inner corners; say columns = 7 and rows = 5"
    )

    with pytest.raises(CalibrationError, match=told):
        observe_boards([smaller], [recorded], SETTINGS)
    with pytest.raises(CalibrationError, match=told):
        find_boards([smaller], [recorded], SETTINGS)


def test_nothing_is_said_of_a_board_that_is_as_described(recorded: CameraInput) -> None:
    (seen,) = observe_boards([TRUE], [recorded], SETTINGS)

    assert [one.beyond for one in seen.sightings] == [(0, 0)] * 4


@pytest.mark.slow
def test_a_board_that_is_smaller_than_described_is_named(recorded: CameraInput) -> None:
    with pytest.raises(
        CalibrationError,
        match=r"no board of 8x6 inner corners.*7x5 inner corners is seen \(columns and rows count "
        r"the corners inside the board, not its squares\): say columns = 7, rows = 5$",
    ):
        observe_boards([Chessboard(8, 6, 0.1)], [recorded], SETTINGS)


# --- What is seen instead --------------------------------------------------------------------

CHARUCO = Charuco(8, 6, 0.08, 0.06, "DICT_4X4_250")
APRIL = AprilGrid(3, 2, 0.1, 0.03)


def facing(board: Board, distance_m: float, tilt_deg: float) -> NDArray[np.float64]:
    """Return cam_from_board of a board before the camera, leaning a little."""
    turn = rotation_about_axes((180.0 + tilt_deg, 0.6 * tilt_deg, 4.0))
    return np.column_stack([turn, [0.0, 0.0, distance_m] - turn @ board.center_board])


def charuco_picture(board: Charuco, legacy: bool = False) -> NDArray[np.uint8]:
    camera = camera_of(size_px=(640, 480))
    pose = facing(board, 0.75, 15.0)
    return render_sheets(camera, [(charuco_sheet(board, legacy), pose)], 2.0, samples=2)


@pytest.fixture(scope="module")
def charuco() -> NDArray[np.uint8]:
    return charuco_picture(CHARUCO)


@pytest.fixture(scope="module")
def april() -> NDArray[np.uint8]:
    sheet = april_sheet(3, 2, APRIL.tag_m, APRIL.gap_m)
    camera = camera_of(size_px=(640, 480))
    return render_sheets(camera, [(sheet, facing(APRIL, 0.6, 12.0))], 2.0, samples=2)


SAID_OF_CHARUCO: list[tuple[Board, str]] = [
    (
        Charuco(8, 6, 0.08, 0.06, "DICT_5X5_250"),
        'markers of DICT_4X4_50 are seen: say dictionary = "DICT_4X4_50"',
    ),
    (replace(CHARUCO, marker_m=0.04), "say marker_mm = 60"),
    (replace(CHARUCO, columns=6, rows=8), "say columns = 8, rows = 6"),
    (replace(CHARUCO, columns=7, rows=5), "say columns = 8, rows = 6"),
    (replace(CHARUCO, first_id=30), "say first_id = 0"),
    (replace(CHARUCO, first_id=10), "say first_id = 0"),  # every other row lies as described
    (replace(CHARUCO, rows=4), "say rows = 6"),
    (replace(CHARUCO, columns=6, rows=4), "say columns = 8, rows = 6"),
    (replace(CHARUCO, columns=10, rows=8), "say columns = 8, rows = 6"),
    (replace(CHARUCO, first_id=4), "say first_id = 0"),  # two rows on
    (replace(CHARUCO, first_id=1), "say first_id = 0"),  # two squares on
]


@pytest.mark.slow
@pytest.mark.parametrize(("said", "told"), SAID_OF_CHARUCO)
def test_a_charuco_board_is_named_for_what_it_is(
    charuco: NDArray[np.uint8], said: Board, told: str
) -> None:
    assert said.detect(charuco, "usual").corners is None
    seen = what_is_seen(said, [charuco])

    assert seen is not None
    assert seen.endswith(told)


@pytest.mark.parametrize("first_row", [0, 1])
def test_a_grid_of_tags_that_goes_on_is_not_the_one_described(
    april: NDArray[np.uint8], first_row: int
) -> None:
    said = replace(APRIL, rows=1, first_id=APRIL.columns * first_row)

    assert APRIL.detect(april, "usual").corners is not None
    assert "which go on beyond it" in said.detect(april, "quick").how
    assert said.detect(april, "quick").corners is None


@pytest.mark.slow
@pytest.mark.parametrize(("rows", "is_told"), [(8, True), (6, False)])
def test_rows_that_were_in_view_and_never_seen_are_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, rows: int, is_told: bool
) -> None:
    camera = camera_of(size_px=(640, 480))
    for number, tilt_deg in enumerate((-15.0, 5.0, 20.0)):
        sheet = charuco_sheet(CHARUCO), facing(CHARUCO, 1.2, tilt_deg)
        cv2.imwrite(str(tmp_path / f"{number}.png"), render_sheets(camera, [sheet], 2.0, samples=2))
    taken = CameraInput("cam", "SIMPLE_RADIAL", None, open_source(tmp_path, "*.png"))

    observe_boards([replace(CHARUCO, rows=rows)], [taken], SETTINGS)

    told = [record.getMessage() for record in caplog.records if "never seen" in record.message]
    assert len(told) == is_told
    if is_told:
        assert "rows = 8, but its lowest 2 were never seen" in told[0]
        assert "in 3 of 3 pictures: if it has fewer, say rows = 6" in told[0]


def test_markers_that_are_counted_from_another_number_are_told() -> None:
    later = Charuco(6, 4, 0.08, 0.05, "DICT_5X5_100", first_id=40)

    seen = what_is_seen(replace(later, first_id=0), [charuco_picture(later)])

    assert seen is not None
    assert seen.endswith("say first_id = 40")


@pytest.mark.slow
@pytest.mark.parametrize("way", ["mirrored", "negative"])
def test_a_board_that_is_turned_and_wrongly_described_is_named(
    charuco: NDArray[np.uint8], way: str
) -> None:
    turned = np.fliplr(charuco) if way == "mirrored" else 255 - charuco

    seen = what_is_seen(replace(CHARUCO, dictionary="DICT_6X6_250"), [turned])

    assert seen is not None
    assert seen.endswith('say dictionary = "DICT_4X4_50"')


def test_a_part_of_a_board_tells_its_dictionary_and_leaves_its_rows(
    charuco: NDArray[np.uint8],
) -> None:
    covered = charuco.copy()
    covered[300:] = 120

    seen = what_is_seen(replace(CHARUCO, dictionary="DICT_5X5_250"), [covered])

    assert seen is not None
    assert seen.endswith('say dictionary = "DICT_4X4_50"')


@pytest.mark.slow
def test_a_grid_of_tags_is_named_for_what_it_is(april: NDArray[np.uint8]) -> None:
    wider = what_is_seen(replace(APRIL, columns=2, rows=3), [april])
    other_gap = what_is_seen(replace(APRIL, gap_m=0.06), [april])
    other_kind = what_is_seen(Chessboard(5, 4, 0.1), [april])

    assert wider is not None
    assert wider.endswith("say columns = 3, rows = 2")
    assert other_gap is not None
    assert other_gap.endswith("say gap_mm = 30 (or tag_spacing = 0.3 in place of gap_mm)")
    assert other_kind is not None
    assert 'say kind = "aprilgrid", columns = 3, rows = 2' in other_kind
    assert "gap_mm = 30" in other_kind


@pytest.mark.slow
def test_a_chessboard_is_named_where_markers_were_described() -> None:
    seen = what_is_seen(Charuco(8, 6, 0.1, 0.07), [picture_of(TRUE)])

    assert seen is not None
    assert seen.startswith("a chessboard of 7x5 inner corners is seen")
    assert 'say kind = "chessboard", columns = 7, rows = 5' in seen


@pytest.mark.slow
def test_nothing_is_named_where_nothing_is_seen() -> None:
    noise = np.random.default_rng(2).integers(90, 160, (240, 320)).astype(np.uint8)

    assert what_is_seen(TRUE, [noise]) is None


# --- Seen from its back ----------------------------------------------------------------------


def through_glass(cameras: Sequence[Camera], poses: Sequence[Pose]) -> list[Observations]:
    """Return what cameras on both sides of a printed glass see of it: all of it, everywhere."""
    return [
        Observations(
            camera.name,
            camera.model,
            (camera.width_px, camera.height_px),
            tuple(
                Sighting(
                    f"board clip, frame {instant}",
                    instant,
                    0,
                    project_board(camera, compose(camera.cam_from_world, pose), CHARUCO),
                )
                for instant, pose in enumerate(poses)
            ),
            False,
        )
        for camera in cameras
    ]


@pytest.mark.slow
def test_cameras_on_both_sides_of_a_printed_glass_stand_where_they_are() -> None:
    cameras = [
        make_camera(f"cam{number}", "SIMPLE_RADIAL", look_at((x, y, z), (0.0, 0.0, 1.0)))
        for number, (x, y, z) in enumerate(
            [(1.4, 0.5, 1.2), (1.4, -0.5, 1.3), (-1.4, 0.5, 1.1), (-1.4, -0.5, 1.4)], start=1
        )
    ]
    rng = np.random.default_rng(5)
    upright = rotation_about_axes((90.0, 0.0, 90.0))  # its printed side towards the first two
    poses = []
    for _ in range(14):
        turn = upright @ rotation_about_axes(tuple(rng.uniform(-25, 25, 3)))
        middle = np.array([0.0, 0.0, 1.0]) + rng.uniform(-0.2, 0.2, 3)
        poses.append(np.column_stack([turn, middle - turn @ CHARUCO.center_board]))

    calibration = solve_rig([CHARUCO], through_glass(cameras, poses))

    world_from_room = invert(poses[0])
    true = transform(world_from_room, np.array([camera.center_world for camera in cameras]))
    np.testing.assert_allclose(calibration.rig.centers_world, true, atol=1e-4)  # m; no noise
    assert (true[:2, 2] > 0).all()
    assert (true[2:, 2] < 0).all()
    # The volume that they are judged in is on both sides of the sheet.
    volume = working_volume(calibration.rig, calibration.boards_world)
    assert volume.low_world[2] < 0 < volume.high_world[2]


# --- In another unit -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("said", "told"),
    [
        (
            {"kind": "chessboard", "square_mm": 0.024},
            "square_mm = 0.024: squares measure 1 to 2000 mm, and lengths are in millimetres; is "
            "it in metres? say square_mm = 24",
        ),
        ({"kind": "chessboard", "square_mm": 0.1}, "say square_mm = 100"),
        ({"kind": "chessboard", "square_mm": (0.1, 0.101)}, "say square_mm = [100, 101]"),
        ({"kind": "chessboard", "square_mm": 24000}, "in micrometres? say square_mm = 24"),
        (
            {"kind": "charuco", "square_mm": 0.08, "marker_mm": 0.06},
            "say square_mm = 80, marker_mm = 60",
        ),
        ({"kind": "charuco", "square_mm": 80, "marker_mm": 0.06}, "say marker_mm = 60"),
        ({"kind": "aprilgrid", "tag_mm": 0.088, "gap_mm": 0.0264}, "say tag_mm = 88"),
        ({"kind": "aprilgrid", "tag_mm": 88, "gap_mm": 0.0264}, "say gap_mm = 26.4"),
    ],
)
def test_lengths_in_another_unit_are_refused_with_the_likely_value(
    said: dict[str, Any], told: str
) -> None:
    with pytest.raises(CalibrationError) as refused:
        make_board({"columns": 8, "rows": 6, **said})

    assert str(refused.value).endswith(told)


@pytest.mark.parametrize("square_mm", [1, 2.4, 115, 2000])
def test_squares_that_are_printed_are_taken(square_mm: float) -> None:
    board = make_board({"kind": "chessboard", "columns": 8, "rows": 6, "square_mm": square_mm})

    assert board.square_m == pytest.approx(square_mm / 1000)


# --- Numbered by others ----------------------------------------------------------------------


@pytest.mark.parametrize("is_part", [False, True])
@pytest.mark.parametrize("tilt_deg", [5.0, 35.0])
def test_corners_of_a_charuco_board_are_taken_as_opencv_numbers_them(
    tmp_path: Path, is_part: bool, tilt_deg: float
) -> None:
    camera = camera_of(size_px=(640, 480))
    pixels = img_from_cam(camera, transform(facing(CHARUCO, 0.9, tilt_deg), CHARUCO.points_board))
    columns, rows = CHARUCO.columns - 1, CHARUCO.rows - 1
    seen = [k for k in range(columns * rows) if not is_part or k % 3]
    numbers = {
        "ours": seen,
        "opencv": [(rows - 1 - k // columns) * columns + k % columns for k in seen],
    }

    read = {}
    for whose, listed in numbers.items():
        path = tmp_path / f"{whose}.csv"
        lines = [
            f"0,{number},{pixels[k, 0] - 0.5:.9f},{pixels[k, 1] - 0.5:.9f}"
            for k, number in zip(seen, listed, strict=True)
        ]
        path.write_text("\n".join(["frame,corner,x,y", *lines]) + "\n", encoding="utf-8")
        (given,) = read_given(path, [CHARUCO])
        read[whose] = given.pixels

    expected = np.full_like(pixels, np.nan)
    expected[seen] = pixels[seen]
    np.testing.assert_allclose(read["ours"], expected, atol=1e-8)  # nine digits are written
    np.testing.assert_allclose(read["opencv"], expected, atol=1e-8)
