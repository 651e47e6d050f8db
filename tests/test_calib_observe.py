"""What pictures show of boards: found once, kept, and told for what it is."""

import itertools
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from helpers.boards import board_poses, look_at, make_camera, project, render_board
from numpy.typing import NDArray

from hybridve.calib.boards.board import Detection, Effort, Observations, Sighting
from hybridve.calib.boards.target import Chessboard, find_corners
from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.image_io import FrameSource, open_source
from hybridve.calib.pose import compose
from hybridve.calib.seeing import search
from hybridve.calib.seeing.corner_cache import CornerCache
from hybridve.calib.seeing.inputs import CameraInput, ObserveSettings
from hybridve.calib.seeing.observe import find_boards, observe_boards

#: Images searched at once; the tests share the machine.
SETTINGS = ObserveSettings(threads=2)

SIZE_PX = (360, 270)

#: Corners of rendered boards are found to this.
FOUND_PX = 0.3

#: The efforts with which boards were looked for.
CALLS: list[str] = []


class Counted(Chessboard):
    """A chessboard that tells how often it was looked for."""

    def detect(self, image: NDArray[Any], effort: Effort = "thorough") -> Detection:
        CALLS.append(effort)
        return super().detect(image, effort)


class Partial(Chessboard):
    """A chessboard of which every other corner is hidden, seen in a mirror."""

    def detect(self, image: NDArray[Any], effort: Effort = "thorough") -> Detection:
        found = super().detect(image, effort)
        if found.corners is None:
            return found
        corners = found.corners.copy()
        corners[::2] = np.nan
        return Detection(corners, found.how, ("mirrored",))


BOARD = Counted(7, 6, 0.1)
SMALL = Counted(5, 4, 0.1, name="small")


#: Where the stills of the two cameras show the board: all of it, not near the border.
POSES = [board_poses(BOARD, 3, seed) for seed in (23, 45)]


@pytest.fixture(autouse=True)
def _nobody_looked_yet() -> None:
    CALLS.clear()


@pytest.fixture
def kept(tmp_path: Path) -> Path:
    return tmp_path / "rig" / "corners"


@pytest.fixture
def no_decoding() -> Iterator[pytest.MonkeyPatch]:
    """Nothing may read a pixel while `forbid` has been called."""
    with pytest.MonkeyPatch.context() as patch:
        yield patch


def forbid(patch: pytest.MonkeyPatch) -> None:
    def decode(*_: object, **__: object) -> None:
        raise AssertionError("a picture was decoded")

    patch.setattr(FrameSource, "frames", decode)
    patch.setattr(FrameSource, "image", decode)
    patch.setattr(cv2, "imread", decode)


def write_images(folder: Path, images: list[NDArray[np.uint8]]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for number, image in enumerate(images):
        assert cv2.imwrite(str(folder / f"{number}.png"), image)


def two_cameras() -> list[Camera]:
    x, y, _ = BOARD.center_board
    return [
        make_camera("left", "PINHOLE", look_at((x - 0.9, y - 0.7, 1.0), (x, y, 0.0)), SIZE_PX),
        make_camera("right", "PINHOLE", look_at((x + 0.8, y - 0.7, 1.1), (x, y, 0.0)), SIZE_PX),
    ]


def bare() -> NDArray[np.uint8]:
    return np.full((SIZE_PX[1], SIZE_PX[0]), 90, np.uint8)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two cameras: four stills each (one shows no board), and a clip of five frames."""
    root = tmp_path_factory.mktemp("board")
    rng = np.random.default_rng(0)
    for index, camera in enumerate(two_cameras()):
        stills = [render_board(camera, BOARD, pose, samples=2) for pose in POSES[index]]
        stills.insert(1, bare())
        write_images(root / camera.name / "stills", stills)
        still = render_board(camera, BOARD, samples=3).astype(float)
        clip = []
        for frame in range(5):
            image = still + rng.normal(0.0, 3.0, still.shape)
            if frame == 2:
                image[:, 75:285] = 60.0  # somebody walks through
            clip.append(np.clip(np.round(image), 0, 255).astype(np.uint8))
        write_images(root / camera.name / "clip", clip)
    return root


def inputs(root: Path, clip: str = "clip/*.png", **changes: Any) -> list[CameraInput]:
    return [
        replace(
            CameraInput(
                name,
                "PINHOLE",
                open_source(root, f"{name}/stills/*.png"),
                open_source(root, f"{name}/{clip}"),
            ),
            **changes,
        )
        for name in ("left", "right")
    ]


def moving_inputs(root: Path) -> list[CameraInput]:
    """The stills, which move, as the clip; its second picture shows no board."""
    return inputs(root, "stills/*.png", intrinsics=None)


def told(observations: list[Observations]) -> list[object]:
    """All that was observed, so that equal means the same to the bit."""
    return [
        (
            seen.name,
            seen.model,
            seen.size_px,
            [(s.image, s.instant, s.board, s.pixels.tobytes()) for s in seen.sightings],
            seen.is_still,
            list(seen.missed.items()),
            None if seen.picture is None else (seen.picture.dtype, seen.picture.tobytes()),
            seen.how,
            seen.spread_px,
            seen.hand_look,
            seen.notes,
            seen.sources,
        )
        for seen in observations
    ]


def pixels_of(sightings: tuple[Sighting, ...]) -> dict[tuple[str, int], NDArray[np.float64]]:
    return {(sighting.image, sighting.board): sighting.pixels for sighting in sightings}


# --- What is found ----------------------------------------------------------------------------


@pytest.mark.slow
def test_stills_and_a_still_clip_are_told_apart(recorded: Path) -> None:
    observations = observe_boards([BOARD], inputs(recorded), SETTINGS)

    for index, (camera, seen) in enumerate(zip(two_cameras(), observations, strict=True)):
        assert (seen.name, seen.model, seen.size_px) == (camera.name, "PINHOLE", SIZE_PX)
        assert [(s.image, s.instant, s.board) for s in seen.sightings] == [
            ("0.png", None, 0),
            ("2.png", None, 0),
            ("3.png", None, 0),
            ("board clip", 0, 0),
        ]
        poses = [*POSES[index], camera.cam_from_world]
        for sighting, pose in zip(seen.sightings, poses, strict=True):
            assert np.abs(sighting.pixels - project(camera, pose, BOARD)).max() < FOUND_PX
        assert seen.missed == {"1.png": "no board found"}
        assert seen.is_still
        assert seen.how.startswith("detected (classic")
        assert seen.spread_px is not None
        assert 0 < seen.spread_px < 1
        assert seen.sources == {
            "intrinsics": f"{camera.name}/stills/*.png",
            "extrinsics": f"{camera.name}/clip/*.png",
            "corners": None,
        }


@pytest.mark.slow
def test_somebody_who_crosses_the_clip_leaves_no_trace(recorded: Path) -> None:
    (seen, _) = observe_boards([BOARD], inputs(recorded), SETTINGS)

    assert seen.picture is not None
    without = render_board(two_cameras()[0], BOARD, samples=3).astype(float)
    assert np.abs(seen.picture - without).mean() < 2.0  # noise; the person would leave 10


@pytest.mark.slow
def test_a_board_that_most_frames_hide_is_found_in_the_others(
    recorded: Path, tmp_path: Path
) -> None:
    for camera in two_cameras():
        image = render_board(camera, BOARD, samples=3)
        hidden = image.copy()
        hidden[:, 75:285] = 60
        write_images(tmp_path / camera.name / "clip", [hidden, hidden, image, hidden, image])
    cameras = inputs(
        recorded,
        extrinsics=None,
    )
    cameras = [
        replace(camera, extrinsics=open_source(tmp_path, f"{camera.name}/clip/*.png"))
        for camera in cameras
    ]

    for camera, seen in zip(two_cameras(), observe_boards([BOARD], cameras, SETTINGS), strict=True):
        assert seen.is_still
        assert "2 of 5 frames" in seen.how
        (clip,) = [sighting for sighting in seen.sightings if sighting.instant is not None]
        expected = project(camera, camera.cam_from_world, BOARD)
        assert np.abs(clip.pixels - expected).max() < FOUND_PX


def test_moving_boards_are_seen_frame_by_frame_and_may_be_missing(recorded: Path) -> None:
    observations = observe_boards([BOARD], moving_inputs(recorded), SETTINGS)

    for index, (camera, seen) in enumerate(zip(two_cameras(), observations, strict=True)):
        assert not seen.is_still
        assert seen.picture is None
        assert seen.missed == {}
        assert "3 of 4 frames" in seen.how
        assert [s.instant for s in seen.sightings] == [0, 2, 3]
        assert [s.image for s in seen.sightings] == [
            f"board clip, frame {frame}" for frame in (0, 2, 3)
        ]
        for sighting, pose in zip(seen.sightings, POSES[index], strict=True):
            assert np.abs(sighting.pixels - project(camera, pose, BOARD)).max() < FOUND_PX


@pytest.mark.slow
def test_a_board_that_moves_for_one_camera_moves_for_all(recorded: Path) -> None:
    left, right = inputs(recorded)[0], moving_inputs(recorded)[1]

    still, moving = observe_boards([BOARD], [left, right], SETTINGS)

    assert not still.is_still
    assert [s.instant for s in still.sightings if s.instant is not None] == [0, 1, 3, 4]
    assert [s.instant for s in moving.sightings] == [0, 2, 3]


@pytest.mark.slow
def test_a_board_that_is_nudged_does_not_lie_still(recorded: Path, tmp_path: Path) -> None:
    for camera in two_cameras():
        nudge = np.column_stack([np.eye(3), [0.02, 0.0, 0.0]])
        poses = [camera.cam_from_world, compose(camera.cam_from_world, nudge)]
        images = [render_board(camera, BOARD, pose, samples=2) for pose in poses]
        write_images(tmp_path / camera.name / "clip", [images[number // 3] for number in range(6)])
    nudged = [
        replace(camera, extrinsics=open_source(tmp_path, f"{camera.name}/clip/*.png"))
        for camera in inputs(recorded)
    ]

    seen = observe_boards([BOARD], nudged, SETTINGS)

    assert not any(observed.is_still for observed in seen)


@pytest.mark.parametrize(("every", "instants"), [(False, [0, 2]), (True, [0, 2, 3])])
def test_each_frame_is_looked_at_where_clocks_are_asked_for(
    recorded: Path, every: bool, instants: list[int]
) -> None:
    settings = replace(SETTINGS, clip_frames=2, every_clip_frame=every)

    (seen, _) = observe_boards([BOARD], moving_inputs(recorded), settings)

    assert [sighting.instant for sighting in seen.sightings] == instants


def test_clips_without_stills_serve_and_checking_needs_no_stills(recorded: Path) -> None:
    found = find_boards([BOARD], inputs(recorded, intrinsics=None), SETTINGS)

    assert find_boards([BOARD], inputs(recorded, extrinsics=None), SETTINGS) == []
    for camera, seen in zip(two_cameras(), found, strict=True):
        (sighting,) = seen.sightings
        assert seen.name == camera.name
        expected = project(camera, camera.cam_from_world, BOARD)
        assert np.abs(sighting.pixels - expected).max() < FOUND_PX


@pytest.mark.slow
def test_parts_of_boards_and_what_is_unusual_are_told(recorded: Path) -> None:
    whole = observe_boards([BOARD], inputs(recorded), SETTINGS)
    parts = observe_boards([Partial(7, 6, 0.1)], inputs(recorded), SETTINGS)

    for seen, expected in zip(parts, whole, strict=True):
        assert [s.image for s in seen.sightings] == [s.image for s in expected.sightings]
        for part, sighting in zip(seen.sightings, expected.sightings, strict=True):
            assert np.isnan(part.pixels[::2]).all()
            np.testing.assert_array_equal(part.pixels[1::2], sighting.pixels[1::2])
        assert seen.is_still
        assert seen.notes == (
            "0.png: mirrored",
            "2.png: mirrored",
            "3.png: mirrored",
            "board clip: mirrored",
        )


@pytest.fixture(scope="module")
def two_boards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The left camera sees both boards, the right one only the small one."""
    root = tmp_path_factory.mktemp("boards")
    pictures = {}
    for number, board in enumerate((BOARD, SMALL)):
        camera = make_camera("left", "PINHOLE", np.eye(3, 4), SIZE_PX)
        pose = np.column_stack([np.diag([1.0, -1.0, -1.0]), (-0.75 + 0.8 * number, 0.3, 1.9)])
        pictures[number] = render_board(camera, board, pose, samples=2)
    both = pictures[0].copy()
    both[:, 180:] = pictures[1][:, 180:]
    alone = np.full_like(both, 120)
    alone[:, 180:] = both[:, 180:]
    write_images(root / "left" / "clip", [both])
    write_images(root / "left" / "stills", [both, alone])
    write_images(root / "right" / "clip", [alone])
    write_images(root / "right" / "stills", [alone])
    return root


@pytest.mark.slow
def test_each_picture_may_show_any_of_the_boards(two_boards: Path) -> None:
    left, right = observe_boards([BOARD, SMALL], inputs(two_boards), SETTINGS)

    assert [(s.image, s.board) for s in left.sightings] == [
        ("0.png", 0),
        ("0.png", 1),
        ("1.png", 1),
        ("board clip", 0),
        ("board clip", 1),
    ]
    assert [(s.image, s.board) for s in right.sightings] == [("0.png", 1), ("board clip", 1)]
    assert left.missed == right.missed == {}
    assert right.how.startswith("board: not found; small: detected")
    pixels = pixels_of(left.sightings)
    assert pixels["0.png", 0][:, 0].max() < 180 < pixels["0.png", 1][:, 0].min()


@pytest.mark.slow
def test_a_part_of_a_larger_board_is_not_a_smaller_one(recorded: Path) -> None:
    class Part(Chessboard):
        def detect(self, image: NDArray[Any], effort: Effort = "thorough") -> Detection:
            found = BOARD.detect(image, effort)
            if found.corners is None:
                return found
            return Detection(found.corners.reshape(6, 7, 2)[:4, :5].reshape(-1, 2), "a part")

    alone = observe_boards([BOARD], inputs(recorded), SETTINGS)
    observations = observe_boards([Part(5, 4, 0.1), BOARD], inputs(recorded), SETTINGS)

    for seen, expected in zip(observations, alone, strict=True):
        assert {sighting.board for sighting in seen.sightings} == {1}
        assert pixels_of(seen.sightings).keys() == {
            (image, 1) for image, _ in pixels_of(expected.sightings)
        }


def test_boards_that_look_alike_are_refused(two_boards: Path) -> None:
    with pytest.raises(CalibrationError, match="'board' and 'turned' look alike"):
        observe_boards([BOARD, Chessboard(6, 7, 0.2, name="turned")], inputs(two_boards), SETTINGS)


def test_progress_counts_up_to_its_total(recorded: Path, kept: Path) -> None:
    for _ in range(2):
        steps: list[tuple[str, int, int]] = []

        def note(*step: Any, steps: list[Any] = steps) -> None:
            steps.append(step)

        observe_boards([BOARD], inputs(recorded), SETTINGS, note, CornerCache(kept))

        for what, group in itertools.groupby(steps, key=lambda step: step[0]):
            counts = [(done, total) for _, done, total in group]
            assert counts == sorted(counts), what
            assert counts[-1][0] == counts[-1][1], what
        assert {what for what, _, _ in steps} == {
            "board clips",
            *(
                f"stills of {name}{again}"
                for name in ("left", "right")
                for again in ("", ", again")
            ),
        }


@pytest.mark.slow
def test_the_order_of_cameras_does_not_matter(recorded: Path) -> None:
    cameras = inputs(recorded)

    forwards = observe_boards([BOARD], cameras, SETTINGS)
    backwards = observe_boards([BOARD], cameras[::-1], replace(SETTINGS, threads=1))

    assert told(forwards) == told(backwards[::-1])


# --- What is kept -----------------------------------------------------------------------------


def write_video(path: Path, images: list[NDArray[np.uint8]]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 25, SIZE_PX)
    assert writer.isOpened()
    for image in images:
        writer.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    writer.release()


@pytest.fixture(scope="module")
def filmed(recorded: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What was recorded, as videos."""
    root = tmp_path_factory.mktemp("filmed")
    for name, what in itertools.product(("left", "right"), ("stills", "clip")):
        paths = open_source(recorded, f"{name}/{what}/*.png").paths
        images = [
            np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), np.uint8) for path in paths
        ]
        write_video(root / name / f"{what}.avi", images)
    return root


def film_inputs(root: Path) -> list[CameraInput]:
    return [
        CameraInput(
            name,
            "PINHOLE",
            open_source(root, f"{name}/stills.avi"),
            open_source(root, f"{name}/clip.avi"),
        )
        for name in ("left", "right")
    ]


def moving_film_inputs(root: Path) -> list[CameraInput]:
    return [replace(c, intrinsics=None, extrinsics=c.intrinsics) for c in film_inputs(root)]


@pytest.mark.slow
@pytest.mark.parametrize(
    "make", [inputs, moving_inputs, film_inputs, moving_film_inputs], ids=lambda make: make.__name__
)
def test_a_second_run_gives_the_same_to_the_bit_and_reads_no_picture(
    recorded: Path, filmed: Path, kept: Path, no_decoding: pytest.MonkeyPatch, make: Any
) -> None:
    cameras = make(filmed if "film" in make.__name__ else recorded)
    without = observe_boards([BOARD], cameras, SETTINGS)
    first = observe_boards([BOARD], cameras, SETTINGS, None, CornerCache(kept))
    assert CALLS
    CALLS.clear()
    forbid(no_decoding)

    second = observe_boards([BOARD], cameras, SETTINGS, None, CornerCache(kept))

    assert CALLS == []
    assert told(without) == told(first) == told(second)


def test_a_copied_session_and_a_renamed_board_ask_nothing_anew(
    recorded: Path, kept: Path, tmp_path: Path
) -> None:
    first = observe_boards([BOARD], inputs(recorded), SETTINGS, None, CornerCache(kept))
    shutil.copytree(recorded, tmp_path / "elsewhere")
    CALLS.clear()

    renamed = Counted(7, 6, 0.1, name="floor", body="table")
    second = observe_boards(
        [renamed], inputs(tmp_path / "elsewhere"), SETTINGS, None, CornerCache(kept)
    )

    assert CALLS == []
    assert told(first) == told(second)


def test_only_a_picture_that_changed_is_searched_again(
    recorded: Path, kept: Path, tmp_path: Path
) -> None:
    root = tmp_path / "changed"
    shutil.copytree(recorded, root)
    observe_boards([BOARD], inputs(root), SETTINGS, None, CornerCache(kept))
    shutil.copy(root / "right" / "stills" / "0.png", root / "left" / "stills" / "2.png")
    pose = board_poses(BOARD, 3, 50)[0]
    image = render_board(two_cameras()[0], BOARD, pose, samples=2)
    cv2.imwrite(str(root / "left" / "stills" / "3.png"), image)
    CALLS.clear()

    (left, right) = observe_boards([BOARD], inputs(root), SETTINGS, None, CornerCache(kept))

    assert CALLS == ["quick"]  # of 3.png; the other is a copy of one that was searched
    pixels = pixels_of(left.sightings)
    np.testing.assert_array_equal(pixels["2.png", 0], pixels_of(right.sightings)["0.png", 0])
    expected = project(two_cameras()[0], pose, BOARD)
    assert np.abs(pixels["3.png", 0] - expected).max() < FOUND_PX


@pytest.mark.slow
def test_another_board_is_looked_for_anew(recorded: Path, kept: Path) -> None:
    cameras = inputs(recorded)[:1]
    first = observe_boards([BOARD], cameras, SETTINGS, None, CornerCache(kept))
    other = Partial(7, 6, 0.1)

    found = observe_boards([other], cameras, SETTINGS, None, CornerCache(kept))

    assert told(found) == told(observe_boards([other], cameras, SETTINGS))
    assert told(found) != told(first)
    again = observe_boards([BOARD], cameras, SETTINGS, None, CornerCache(kept))
    assert told(again) == told(first)


def test_another_version_of_the_code_looks_again(
    recorded: Path, kept: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cameras = inputs(recorded)[:1]
    observe_boards([BOARD], cameras, SETTINGS, None, CornerCache(kept))
    before = list(CALLS)
    CALLS.clear()

    monkeypatch.setattr(search, "_digest_of_code", lambda files: "new")
    observe_boards([BOARD], cameras, SETTINGS, None, CornerCache(kept))

    assert sorted(CALLS) == sorted(before)


def test_a_damaged_cache_costs_time_only(recorded: Path, kept: Path) -> None:
    cameras = inputs(recorded)[:1]
    first = observe_boards([BOARD], cameras, SETTINGS, None, CornerCache(kept))
    for path in kept.iterdir():
        path.write_bytes(path.read_bytes()[:-40])
    CALLS.clear()

    second = observe_boards([BOARD], cameras, SETTINGS, None, CornerCache(kept))

    assert CALLS
    assert told(first) == told(second)


def test_what_was_found_before_an_interruption_is_kept(recorded: Path, kept: Path) -> None:
    def interrupt(what: str, done: int, total: int) -> None:
        if what == "stills of right" and done == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        observe_boards([BOARD], inputs(recorded), SETTINGS, interrupt, CornerCache(kept))
    CALLS.clear()

    observe_boards([BOARD], inputs(recorded), SETTINGS, None, CornerCache(kept))

    assert CALLS == ["quick"] * 3  # the right camera's stills; the bare one is as the left one's


# --- Corners that are given -------------------------------------------------------------------


def truth_of(index: int) -> NDArray[np.float64]:
    camera = two_cameras()[index]
    return project(camera, camera.cam_from_world, BOARD)


def rows(pixels: NDArray[np.float64], *before: object) -> list[str]:
    """Lines of a CSV: numbered corners, as OpenCV counts pixels."""
    prefix = "".join(f"{cell}," for cell in before)
    return [
        f"{prefix}{corner},{x - 0.5},{y - 0.5}" for corner, (x, y) in enumerate(pixels.tolist())
    ]


def write_csv(path: Path, header: str, lines: list[str]) -> Path:
    path.write_text("\n".join([header, *lines]) + "\n", encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def hidden(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The clip of the left camera with the ends of the board hidden, so that none is found."""
    root = tmp_path_factory.mktemp("hidden")
    image = render_board(two_cameras()[0], BOARD, samples=3)
    for corner in truth_of(0)[[0, 6, 35, 41]]:
        x, y = np.round(corner).astype(int)
        cv2.circle(image, (int(x), int(y)), 10, 60, -1)
    write_images(root / "left" / "clip", [image])
    assert find_corners(image, BOARD) is None
    return root


def test_given_corners_stand_instead_of_those_that_would_be_found(
    recorded: Path, tmp_path: Path
) -> None:
    still = np.arange(84.0).reshape(42, 2)
    part = still[:10] + 7.25
    lines = rows(still, "0.png") + rows(part, "left/stills/1.png")
    path = write_csv(tmp_path / "given.csv", "image,corner,x,y", lines)
    left = replace(inputs(recorded)[0], corners=path)
    plain = observe_boards([BOARD], [inputs(recorded)[0]], SETTINGS)[0]

    with pytest.raises(CalibrationError, match=r"image '0\.png' is the name of 2 pictures"):
        observe_boards([BOARD], [left], SETTINGS)
    write_csv(
        path, "image,corner,x,y", [line.replace("0.png", "stills/0.png", 1) for line in lines]
    )
    (seen,) = observe_boards([BOARD], [left], SETTINGS)

    found = pixels_of(seen.sightings)
    np.testing.assert_allclose(found["0.png", 0], still, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found["1.png", 0][:10], part, rtol=0, atol=1e-12)
    assert np.isnan(found["1.png", 0][10:]).all()
    assert seen.missed == {}
    for image in ("2.png", "3.png", "board clip"):
        np.testing.assert_array_equal(found[image, 0], pixels_of(plain.sightings)[image, 0])


def test_given_frames_of_a_still_clip_are_its_corners(recorded: Path, tmp_path: Path) -> None:
    given = truth_of(0)[::-1] + 3.0
    lines = rows(given - 0.25, 1) + rows(given + 0.25, 3)
    path = write_csv(tmp_path / "given.csv", "frame,corner,x,y", lines)

    (seen,) = observe_boards([BOARD], [replace(inputs(recorded)[0], corners=path)], SETTINGS)

    assert seen.is_still
    assert seen.how == "given"
    np.testing.assert_allclose(pixels_of(seen.sightings)["board clip", 0], given, atol=1e-9)


def test_given_frames_of_a_moving_clip_are_taken_beside_those_that_are_found(
    recorded: Path, tmp_path: Path
) -> None:
    given = truth_of(0)
    path = write_csv(tmp_path / "given.csv", "frame,corner,x,y", rows(given, 1))
    left = replace(moving_inputs(recorded)[0], corners=path)

    (seen,) = observe_boards([BOARD], [left], replace(SETTINGS, clip_frames=2))

    assert [sighting.instant for sighting in seen.sightings] == [0, 1, 2]
    np.testing.assert_allclose(seen.sightings[1].pixels, given, atol=1e-9)


def test_corners_are_given_for_frames_of_videos(filmed: Path, tmp_path: Path) -> None:
    given = truth_of(0)
    lines = rows(given, "frame 1", "") + rows(given, "", 4)
    path = write_csv(tmp_path / "given.csv", "image,frame,corner,x,y", lines)

    (seen,) = observe_boards([BOARD], [replace(film_inputs(filmed)[0], corners=path)], SETTINGS)

    found = pixels_of(seen.sightings)
    assert {image for image, _ in found} == {*(f"frame {n}" for n in range(4)), "board clip"}
    for image in ("frame 1", "board clip"):
        np.testing.assert_allclose(found[image, 0], given, atol=1e-9)


@pytest.mark.slow
def test_given_corners_name_their_board(two_boards: Path, tmp_path: Path) -> None:
    given = np.arange(40.0).reshape(20, 2)
    path = write_csv(
        tmp_path / "given.csv", "image,board,corner,x,y", rows(given, "stills/0.png", "small")
    )
    right = replace(inputs(two_boards)[1], corners=path)

    (seen,) = observe_boards([BOARD, SMALL], [right], SETTINGS)

    np.testing.assert_allclose(pixels_of(seen.sightings)["0.png", 1], given, atol=1e-12)
    assert ("0.png", 0) not in pixels_of(seen.sightings)


@pytest.mark.slow
@pytest.mark.parametrize("header", ["x,y", "corner,x,y"])
def test_corners_of_the_clip_serve_where_none_are_found(
    recorded: Path, hidden: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, header: str
) -> None:
    marks = np.round(truth_of(0) - 0.5) + 0.5
    lines = rows(marks) if "corner" in header else [f"{x - 0.5},{y - 0.5}" for x, y in marks]
    left = replace(
        inputs(recorded)[0],
        extrinsics=open_source(hidden, "left/clip/0.png"),
        corners=write_csv(tmp_path / "marks.csv", header, lines),
    )

    (seen,) = observe_boards([BOARD], [left], SETTINGS)

    assert "marked by hand" in seen.how
    assert seen.hand_look == 0
    assert any("no board found" in record.message for record in caplog.records)
    found = pixels_of(seen.sightings)["board clip", 0]
    assert np.abs(found - truth_of(0)).max() < 1.0


def test_marks_elsewhere_than_the_board_are_said_and_not_used(
    recorded: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    lines = rows(truth_of(0) * 0.5)
    path = write_csv(tmp_path / "marks.csv", "corner,x,y", lines)
    plain = observe_boards([BOARD], inputs(recorded)[:1], SETTINGS)

    (seen,) = observe_boards([BOARD], inputs(recorded, corners=path)[:1], SETTINGS)

    assert seen.hand_look is None
    assert any("px away from those found" in record.message for record in caplog.records)
    assert told([replace(seen, sources=plain[0].sources)]) == told(plain)


@pytest.mark.parametrize(
    ("header", "lines", "line"),
    [
        ("x,y", ["1,2"] * 5, r"marks\.csv: 5 corners, expected 42"),
        ("image,corner,x,y", ["no.png,0,1,2"], r"image 'no\.png' is the name of no picture"),
        ("frame,corner,x,y", ["5,0,1,2"], r"frame 5; left/clip/\*\.png has 5, from 0"),
        ("frame,corner,x,y", ["-1,0,1,2"], r"line 2: frame '-1'; expected a whole number"),
        ("image,frame,corner,x,y", ["0.png,1,0,1,2"], r"line 2: names an image and a frame"),
        ("corner,x,y", ["0,1,2", "0,3,4"], r"corner 0 is given twice"),
        ("corner,x,y", ["42,1,2"], r"corner 42; 7x6 .* has 0 to 41"),
        ("corner,x,y", ["1,1,2", ",1,2"], r"some corners are numbered and some are not"),
        ("corner,x,y", ["0,1,nan"], r"line 2: x = '1', y = 'nan' is no place"),
        ("corner,x,y", ["0,1"], r"line 2: 2 cells, the header has 3"),
        ("corner,x,y", [], r"no corners found"),
        ("corner,u,v", ["0,1,2"], r"has the columns corner, u, v; expected x and y"),
        ("board,corner,x,y", ["floor,0,1,2"], r"line 2: there is no board 'floor'; one of board"),
        ("image,x,y", ["stills/0.png,1,2"], r"image stills/0\.png: 1 corners, expected 42"),
        ("image,x,y", ["stills/0.png,1,2"] * 42, r"do not form the board's grid"),
    ],
)
def test_a_file_of_corners_that_makes_no_sense_is_named_with_the_line(
    recorded: Path, tmp_path: Path, header: str, lines: list[str], line: str
) -> None:
    path = write_csv(tmp_path / "marks.csv", header, lines)

    with pytest.raises(CalibrationError, match=line) as caught:
        observe_boards([BOARD], inputs(recorded, corners=path)[:1], SETTINGS)

    assert str(path) in str(caught.value)
    assert CALLS == []  # said before anything is searched


def test_corners_of_several_boards_must_say_of_which(two_boards: Path, tmp_path: Path) -> None:
    path = write_csv(tmp_path / "marks.csv", "corner,x,y", ["0,1,2"])

    with pytest.raises(CalibrationError, match=r"which of the boards .* one of board, small"):
        observe_boards([BOARD, SMALL], inputs(two_boards, corners=path), SETTINGS)


# --- Bad input --------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_camera_that_sees_no_board_is_named_with_what_was_tried(
    recorded: Path, hidden: Path
) -> None:
    left = replace(inputs(recorded)[0], extrinsics=open_source(hidden, "left/clip/0.png"))

    with pytest.raises(
        CalibrationError, match=r"'left': no board of 7x6 .* tried classic at .*sector at .*by hand"
    ):
        observe_boards([BOARD], [left, inputs(recorded)[1]], SETTINGS)


@pytest.mark.slow
def test_a_camera_that_never_sees_the_moving_board_is_named(recorded: Path, tmp_path: Path) -> None:
    write_images(tmp_path / "clip", [bare()] * 4)
    left, right = moving_inputs(recorded)
    blind = replace(left, extrinsics=open_source(tmp_path, "clip/*.png"))

    with pytest.raises(CalibrationError, match=r"'left': no board of 7x6 .* any of 4 frames"):
        observe_boards([BOARD], [blind, right], SETTINGS)


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"model": "GOPRO"}, r"'left': unknown camera model 'GOPRO'; one of auto, .*OPENCV"),
        ({"name": "same"}, "'same' is listed 2 times"),
        ({"extrinsics": None}, "'left': no clip"),
    ],
)
def test_inputs_that_cannot_be_used_are_named(
    recorded: Path, changes: dict[str, Any], line: str
) -> None:
    with pytest.raises(CalibrationError, match=line):
        observe_boards([BOARD], inputs(recorded, **changes), SETTINGS)


def test_no_camera_and_no_board_are_refused(recorded: Path) -> None:
    with pytest.raises(CalibrationError, match="no camera"):
        observe_boards([BOARD], [])
    with pytest.raises(CalibrationError, match="no board to look for"):
        observe_boards([], inputs(recorded))


def test_a_lens_may_be_left_open(recorded: Path) -> None:
    (seen,) = observe_boards([BOARD], inputs(recorded, model="auto", intrinsics=None)[:1], SETTINGS)

    assert seen.model == "auto"


def test_stills_of_another_size_are_left_out_and_named(recorded: Path, tmp_path: Path) -> None:
    for path in sorted((recorded / "left" / "stills").iterdir()):
        image = cv2.imread(str(path))
        assert image is not None
        if path.name == "0.png":
            image = cv2.resize(image, None, fx=1.5, fy=1.5)
        cv2.imwrite(str(tmp_path / path.name), image)
    left = replace(inputs(recorded)[0], intrinsics=open_source(tmp_path, "*.png"))

    (seen,) = observe_boards([BOARD], [left], SETTINGS)

    assert seen.missed["0.png"] == "is 540x405 pixels, most are 360x270"
    assert "0.png" not in {sighting.image for sighting in seen.sightings}


def test_stills_at_another_size_are_taken_as_the_clip_would_show_them(
    recorded: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    image = cv2.imread(str(recorded / "left" / "stills" / "0.png"))
    assert image is not None
    for name, size in (("as_it_is", (360, 270)), ("larger", (720, 540)), ("wide", (720, 405))):
        (tmp_path / name).mkdir()
        cv2.imwrite(str(tmp_path / name / "0.png"), cv2.resize(image, size))
    left = inputs(recorded)[0]
    seen = {}
    for name in ("as_it_is", "larger"):
        stills = open_source(tmp_path, f"{name}/0.png")
        (found,) = observe_boards([BOARD], [replace(left, intrinsics=stills)], SETTINGS)
        assert found.size_px == (360, 270)
        (seen[name],) = (one.pixels for one in found.sightings if one.instant is None)

    assert "720x540 pixels are taken for the same picture as the clip's 360x270" in caplog.text
    # Corners of a picture that was blown up are found anew, some hundredths of a pixel beside.
    assert np.nanmax(np.abs(seen["larger"] - seen["as_it_is"])) < 0.1
    wide = replace(left, intrinsics=open_source(tmp_path, "wide/0.png"))
    with pytest.raises(CalibrationError, match=r"'left': intrinsics are 720x405 .* 360x270"):
        observe_boards([BOARD], [wide], SETTINGS)


def test_pictures_of_one_name_are_called_by_their_folders(recorded: Path, tmp_path: Path) -> None:
    for number in (0, 2):
        (tmp_path / str(number)).mkdir()
        shutil.copy(recorded / "left" / "stills" / f"{number}.png", tmp_path / f"{number}/a.png")
    left = replace(inputs(recorded)[0], intrinsics=open_source(tmp_path, "*/a.png"))

    (seen,) = observe_boards([BOARD], [left], SETTINGS)

    stills = [sighting.image for sighting in seen.sightings if sighting.instant is None]
    assert stills == ["0/a.png", "2/a.png"]
