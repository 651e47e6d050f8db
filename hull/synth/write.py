"""A preset becomes a folder: session.toml, scene.toml, images, videos, meshes and truth.h5."""

import errno
import os
import shutil
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.avi_index import avi_frames
from hybridve.calib.boards.target import Chessboard
from hybridve.calib.camera import Camera
from hybridve.calib.errors import SessionError
from hybridve.calib.image_io import Image
from hybridve.calib.lens import cam_from_img, img_from_cam
from hybridve.calib.pose import Pose, rotation_about_axes, transform
from hybridve.hull.synth import render
from hybridve.hull.synth.cones import Surface, TrueHull
from hybridve.hull.synth.entries import Motion
from hybridve.hull.synth.meshes import write_stl
from hybridve.hull.synth.presets import PRESETS
from hybridve.hull.synth.render import Picture, View
from hybridve.hull.synth.spacing import needed_for_hulls, needed_for_shapes
from hybridve.hull.synth.stage import Preset, Stage, plate_of
from hybridve.hull.synth.truth import is_generated
from hybridve.hull.synth.truth_writer import PartInFrame, TruthWriter, look_at

Progress = Callable[[str, int, int], None]

#: Stills of the board in each camera, frames of the board on the floor, and of the empty room.
N_STILLS, N_BOARD_FRAMES, N_BACKGROUND_FRAMES = 14, 10, 20

#: JPEG quality. Videos lose about as much to it as to the sensor's noise; corners move by less
#: than 0.02 px.
_STILL_QUALITY = 92
_VIDEO_QUALITY = 50

#: Lamps flicker by about one percent, never by more than three.
_FLICKER = 0.01
_LARGEST_FLICKER = 0.03

#: How near to the border of an image the board is held, in pixels.
_STILL_MARGIN_PX = 6.0

#: What the random numbers of a picture depend on, besides the seed and the camera.
_ROOM, _STILLS, _BOARD, _BACKGROUND, _VIDEO, _LIGHT = range(6)


def write_session(
    preset: str,
    folder: Path,
    *,
    seed: int = 0,
    n_frames: int | None = None,
    options: Mapping[str, float] | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> None:
    """Write a generated recording with known truth.

    The folder appears when it is complete: session.toml, scene.toml, meshes/, a folder for each
    camera, and truth.h5 (see `hybridve.hull.synth.truth`). The same preset, seed and
    number of frames give the same recording. The seed changes noise, textures and how the board
    is held; what moves where, and so the truth, is the preset's.

    Parameters
    ----------
    preset : str
        A key of `PRESETS`.
    folder : Path
        Where to write; made with its parents if it is not there.
    seed : int
        Not negative.
    n_frames : int, optional
        Frames of the task; the preset's own number if left out. The whole motion is shown in as
        many frames as there are.
    options : mapping of float, optional
        Values of the preset's own options; the others keep their defaults.
    overwrite : bool
        Whether a generated recording that stands in `folder` is replaced. A folder that holds
        anything else is never touched.
    progress : callable, optional
        Called with what is being made, how many of it are done, and how many there are.

    Raises
    ------
    SessionError
        If there is no such preset or option, a number is out of range, or the folder is taken or
        cannot be written.
    """
    if preset not in PRESETS:
        raise SessionError(f"there is no preset {preset!r}; one of {', '.join(PRESETS)}")
    chosen = PRESETS[preset]
    count = chosen.n_frames if n_frames is None else n_frames
    if count < 1:
        raise SessionError(f"preset {preset!r}: {count} frames asked for, expected at least 1")
    if seed < 0:
        raise SessionError(f"preset {preset!r}: the seed is {seed}, expected 0 or more")
    values = _values_of(preset, chosen, options or {})
    stage = chosen.make_stage(**values)
    job = _Job(preset, chosen, values, stage, seed, count, progress or _silent)
    with _appearing(folder, overwrite) as partial:
        _write_toml(partial, job)
        _record(partial, job)


def _values_of(name: str, preset: Preset, given: Mapping[str, float]) -> dict[str, float]:
    """Return a value for each option of a preset, or say which of those given cannot be."""
    options = {option.name: option for option in preset.options}
    for key, value in given.items():
        if key not in options:
            known = ", ".join(options) or "none"
            raise SessionError(f"preset {name!r} has no option {key}; its options: {known}")
        option = options[key]
        if not option.low <= value <= option.high or (option.is_whole and value != int(value)):
            raise SessionError(
                f"preset {name!r}: {key} is {value:g}, expected {option.low:g} to {option.high:g}"
            )
    values = {key: given.get(key, option.default) for key, option in options.items()}
    return {key: int(v) if options[key].is_whole else float(v) for key, v in values.items()}


@dataclass(frozen=True, slots=True, eq=False)
class _Job:
    name: str
    preset: Preset
    options: dict[str, float]
    stage: Stage
    seed: int
    n_frames: int
    progress: Progress

    def rng(self, what: int, camera: int = 0, frame: int = 0) -> np.random.Generator:
        """Return random numbers of their own for each picture, whatever order they are made in."""
        return np.random.default_rng([self.seed, what, camera, frame])

    def gain(self, what: int, frame: int) -> float:
        """Return the brightness of the lamps in one frame of a clip, the same for all cameras."""
        flicker = self.rng(_LIGHT, what, frame).normal(0.0, _FLICKER)
        return 1.0 + float(np.clip(flicker, -_LARGEST_FLICKER, _LARGEST_FLICKER))


@dataclass(frozen=True, slots=True, eq=False)
class _Place:
    """One camera of the job: its rays, and what of its pictures never changes."""

    number: int
    view: View
    empty: Picture
    floor: tuple[Picture, Picture]
    folder: Path


def _silent(what: str, done: int, total: int) -> None:
    """Report nothing."""


@contextmanager
def _appearing(folder: Path, overwrite: bool) -> Iterator[Path]:
    """Yield a folder to write into that becomes `folder` if all goes well."""
    folder = folder.resolve()
    taken = folder.exists() and (not folder.is_dir() or any(folder.iterdir()))
    if taken and not (folder.is_dir() and is_generated(folder)):
        raise SessionError(
            f"{folder} exists and holds no generated recording; choose another folder or empty it"
        )
    if taken and not overwrite:
        raise SessionError(
            f"{folder} holds a generated recording already; choose another folder or overwrite it"
        )
    _refuse_strange(folder)
    partial = folder.with_name(folder.name + ".partial")
    before = folder.with_name(folder.name + ".before")
    try:
        if before.is_dir() and is_generated(before):  # of a run that was killed in between
            if folder.exists():
                shutil.rmtree(before)
            else:
                before.rename(folder)
        shutil.rmtree(partial, ignore_errors=True)  # left by a run that was killed
        partial.mkdir(parents=True)
    except OSError as error:
        raise SessionError(f"{partial}: cannot be written: {error.strerror}") from error
    try:
        yield partial
        if folder.exists():
            folder.rename(before)
        try:
            partial.rename(folder)
        except OSError:
            if before.exists():
                before.rename(folder)
            raise
        shutil.rmtree(before, ignore_errors=True)
    except OSError as error:
        raise SessionError(f"{folder}: cannot be written: {error.strerror or error}") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)


#: What a generated recording holds, and what is made of it in its folder by other commands.
_KNOWN = frozenset(("session.toml", "scene.toml", "truth.h5", "meshes", "rig", "silhouettes.h5"))


def _refuse_strange(folder: Path) -> None:
    """Refuse to replace a folder in which somebody has put something."""
    if not folder.is_dir():
        return
    for one in sorted(folder.iterdir()):
        is_camera = (one / "video.avi").is_file()
        if one.name not in _KNOWN and not is_camera:
            raise SessionError(
                f"{folder}: holds {one.name!r}, which is not of the generated recording; move it "
                "elsewhere, or choose another folder"
            )


def _record(folder: Path, job: _Job) -> None:
    stage = job.stage
    texture = render.make_texture(job.rng(_ROOM))
    places = []
    for number, camera in enumerate(stage.cameras):
        job.progress("empty room", number, len(stage.cameras))
        view = render.make_view(camera)
        places.append(
            _Place(
                number,
                view,
                render.render_room(view, stage.room, stage.lamp, texture),
                render.shadow_lookup(view, stage.room),
                folder / camera.name,
            )
        )
    job.progress("empty room", len(stage.cameras), len(stage.cameras))
    with (
        ThreadPoolExecutor(max_workers=2) as pool,
        TruthWriter(
            folder / "truth.h5",
            stage,
            preset=job.name,
            seed=job.seed,
            fps=job.preset.fps,
            n_frames=job.n_frames,
            options=job.options,
        ) as truth,
    ):
        for done, (place, poses) in enumerate(
            zip(places, pool.map(lambda place: _write_stills(place, job), places), strict=True), 1
        ):
            truth.write_stills(place.view.camera.name, poses)
            job.progress("board in hand", done, len(places))
        for done, _ in enumerate(pool.map(lambda place: _write_still_clips(place, job), places), 1):
            job.progress("board and background clips", done, len(places))
        _write_task(places, job, truth, pool)


def _write_stills(place: _Place, job: _Job) -> list[Pose]:
    """Write the stills of the board held before one camera; return ``cam_from_board`` of each."""
    rng = job.rng(_STILLS, place.number)
    poses = hold_board(job.stage.board, place.view.camera, N_STILLS, rng)
    folder = place.folder / "intrinsics"
    folder.mkdir(parents=True)
    for frame, pose in enumerate(poses):
        picture = render.add_board(place.view, place.empty, job.stage.board, pose)
        image = render.expose(picture, 1.0, rng)
        path = folder / f"{frame + 1:03d}.jpg"
        path.write_bytes(_encode(image, _STILL_QUALITY))
    return poses


def _write_still_clips(place: _Place, job: _Job) -> None:
    """Write the clips in which nothing moves: the board on the floor, and the empty room."""
    camera = place.view.camera
    floor = render.add_board(place.view, place.empty, job.stage.board, camera.cam_from_world)
    for what, name, picture, count in (
        (_BOARD, "board.avi", floor, N_BOARD_FRAMES),
        (_BACKGROUND, "background.avi", place.empty, N_BACKGROUND_FRAMES),
    ):
        with _video(place.folder / name, camera, job.preset.fps, count) as video:
            for frame in range(count):
                rng = job.rng(what, place.number, frame)
                video.write(render.expose(picture, job.gain(what, frame), rng))


def _write_task(
    places: list[_Place], job: _Job, truth: TruthWriter, pool: ThreadPoolExecutor
) -> None:
    stage = job.stage
    shapes = [real.shape for real in stage.shapes]
    surfaces = [Surface(part.triangles_world) for part in stage.parts]
    frames: list[list[Pose]] = []
    found: list[list[PartInFrame]] = []
    videos = [
        _open_video(place.folder / "video.avi", place.view.camera, job.preset.fps)
        for place in places
    ]
    try:
        for frame in range(job.n_frames):
            job.progress("frames", frame, job.n_frames)
            poses = stage.poses(frame / max(1, job.n_frames - 1))
            shadow = stage.lamp.shade * render.shadow_map(stage.lamp, stage.room, shapes, poses)

            def take(
                place: _Place,
                frame: int = frame,
                poses: list[Pose] = poses,
                shadow: Picture = shadow,
            ) -> NDArray[np.bool_]:
                view = place.view
                seen = render.true_silhouette(view, shapes, poses)
                picture = render.add_shadow(place.empty, place.floor, shadow)
                picture = render.add_shapes(view, picture, stage.lamp, stage.shapes, poses, seen)
                rng = job.rng(_VIDEO, place.number, frame)
                videos[place.number].write(render.expose(picture, job.gain(_VIDEO, frame), rng))
                return seen > 0

            masks = list(pool.map(take, places))
            hull = TrueHull(stage.cameras, shapes, poses)
            frames.append(poses)
            found.append([look_at(surface, hull, shapes, poses) for surface in surfaces])
            truth.write_frame(
                poses,
                {place.view.camera.name: mask for place, mask in zip(places, masks, strict=True)},
                found[-1],
            )
    finally:
        for video in videos:
            video.release()
    for place in places:
        _see_whole(place.folder / "video.avi", job.n_frames)
    job.progress("frames", job.n_frames, job.n_frames)
    _write_motion(job, truth, frames, found)


def _write_motion(
    job: _Job, truth: TruthWriter, frames: list[list[Pose]], found: list[list[PartInFrame]]
) -> None:
    """Write what is true of the motion as a whole: when contacts begin, and the room it needs."""
    stage = job.stage
    total = len(stage.parts) + len(stage.spacings)
    motion = Motion(stage, job.n_frames)
    for number, part in enumerate(stage.parts):
        job.progress("motion", number, total)
        at_frames = [parts[number].closest for parts in found]
        truth.write_entries(part.name, motion.entries(part.triangles_world, at_frames))
    shapes = [real.shape for real in stage.shapes]
    for number, spacing in enumerate(stage.spacings, start=len(stage.parts)):
        job.progress("motion", number, total)
        part = next(part for part in stage.parts if part.name == spacing.part)
        asked = (
            part.triangles_world,
            np.array(spacing.along),
            spacing.range_m,
            part.required_clearance_mm / 1000.0,
        )
        by_shapes = needed_for_shapes(*asked, shapes, frames)
        hulls = [TrueHull(stage.cameras, shapes, poses) for poses in frames]
        truth.write_spacing(spacing, by_shapes, needed_for_hulls(*asked, hulls, by_shapes))
    job.progress("motion", total, total)


def hold_board(
    board: Chessboard, camera: Camera, count: int, rng: np.random.Generator
) -> list[Pose]:
    """Return poses ``cam_from_board`` as a person holds a board before a camera.

    Tilted by up to 40 degrees about any axis, near and far, in the middle and pushed into the
    corners of the image, always wholly in sight.
    """
    size = np.array([camera.width_px, camera.height_px], np.float64)
    low, high = plate_of(board)
    outline = _outline(low, high) - np.append((low + high) / 2, 0.0)  # about the plate's middle
    places = [(x, y) for y in (-1.0, 0.0, 1.0) for x in (-1.0, 0.0, 1.0)]
    poses = []
    for index in range(count):
        toward = np.array(places[(index * 4) % len(places)])  # 4 and 9 share no factor: all visited
        tilt_deg = rng.uniform(12.0, 40.0)
        about = rng.uniform(0.0, 2.0 * np.pi)
        roll_deg = rng.uniform(-12.0, 12.0) + (90.0 if index % 7 == 5 else 0.0)
        # Far away it fits into a corner; near, it fills the image.
        distance_m = rng.uniform(1.1, 1.6) + 0.3 * np.abs(toward).sum()
        lean = (
            rotation_about_axes((0.0, 0.0, np.rad2deg(about)))
            @ rotation_about_axes((tilt_deg, 0.0, 0.0))
            @ rotation_about_axes((0.0, 0.0, -np.rad2deg(about)))
        )
        # Turned by 180 degrees about x, the printed side looks at the camera.
        rotation = lean @ rotation_about_axes((0.0, 0.0, roll_deg))
        rotation = rotation @ rotation_about_axes((180.0, 0.0, 0.0))
        while True:
            pose = _push_outwards(camera, rotation, outline, distance_m, toward, size)
            if pose is not None:
                break
            distance_m *= 1.1
        # From the plate's middle to the board's origin.
        middle = np.append((low + high) / 2, 0.0)
        poses.append(np.column_stack([pose[:, :3], pose[:, 3] - pose[:, :3] @ middle]))
    return poses


def _push_outwards(
    camera: Camera,
    rotation: NDArray[np.float64],
    outline: NDArray[np.float64],
    distance_m: float,
    toward: NDArray[np.float64],
    size: NDArray[np.float64],
) -> Pose | None:
    """Return the pose farthest `toward` the borders at which all of the outline is in sight."""

    def pose_in_sight(pixel: NDArray[np.float64]) -> Pose | None:
        ray = cam_from_img(camera, pixel[None])[0]
        pose = np.column_stack([rotation, distance_m * np.append(ray, 1.0)])
        points = transform(pose, outline)
        if (points[:, 2] <= 0.1).any():
            return None
        pixels = img_from_cam(camera, points)
        low, high = _STILL_MARGIN_PX, size - _STILL_MARGIN_PX
        return pose if ((pixels > low) & (pixels < high)).all() else None

    pixel = size / 2
    best = pose_in_sight(pixel)
    steps = [step for step in np.diag(toward * size / 50) if step.any()]
    moved = best is not None
    while moved:  # a step along each axis in turn, until neither finds room
        moved = False
        for step in steps:
            pose = pose_in_sight(pixel + step)
            if pose is not None:
                pixel, best, moved = pixel + step, pose, True
    return best


def _outline(low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return points (N, 3) along the border of a rectangle in the plane z = 0."""
    way = np.linspace(0.0, 1.0, 9)
    corners = np.array([low, [high[0], low[1]], high, [low[0], high[1]], low])
    sides = [start + way[:, None] * (stop - start) for start, stop in pairwise(corners)]
    points = np.concatenate(sides)
    return np.column_stack([points, np.zeros(len(points))])


# ---------------------------------------------------------------------------- files


def _encode(image: Image, quality: int) -> bytes:
    good, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not good:
        raise SessionError("OpenCV cannot encode JPEG images; reinstall opencv-python-headless")
    return data.tobytes()


def _open_video(path: Path, camera: Camera, fps: float) -> cv2.VideoWriter:
    """Open a motion JPEG for writing: OpenCV's own encoder and container, in every build."""
    video = cv2.VideoWriter(
        str(path),
        cv2.CAP_OPENCV_MJPEG,
        cv2.VideoWriter.fourcc(*"MJPG"),
        fps,
        (camera.width_px, camera.height_px),
    )
    if not video.isOpened():
        raise SessionError(f"{path}: OpenCV cannot write this video; is the disk full?")
    video.set(cv2.VIDEOWRITER_PROP_QUALITY, _VIDEO_QUALITY)
    return video


@contextmanager
def _video(path: Path, camera: Camera, fps: float, count: int) -> Iterator[cv2.VideoWriter]:
    video = _open_video(path, camera, fps)
    try:
        yield video
    finally:
        video.release()
    _see_whole(path, count)


def _see_whole(path: Path, count: int) -> None:
    """Raise an OSError where a video has not all its frames: OpenCV does not notice a full disk."""
    found = avi_frames(path)
    if found is None or found.n_frames != count or found.damaged or found.unreachable:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))


def _write_toml(folder: Path, job: _Job) -> None:
    stage, preset = job.stage, job.preset
    board = stage.board
    chosen = "".join(f", {name} {value:g}" for name, value in job.options.items())
    lines = [
        f"# Generated: preset {job.name}{chosen}, seed {job.seed}. "
        "What is true of it stands in truth.h5.",
        'format = "hybridve-session"',
        "version = 1",
        f"fps = {preset.fps:g}",
        'world = "board"',
        "",
        "[target]",
        'kind = "chessboard"',
        f"columns = {board.columns}  # inner corners; one of the two numbers is even and the other",
        f"rows = {board.rows}     # odd, so that the board upside down is another pattern",
        f"square_mm = {1000 * board.square_m:g}",
    ]
    for camera in stage.cameras:
        lines += [
            "",
            "[[camera]]",
            f'name = "{camera.name}"',
            f'model = "{camera.model}"',
            f'intrinsics = "{camera.name}/intrinsics/*.jpg"',
            f'extrinsics = "{camera.name}/board.avi"',
            f'background = "{camera.name}/background.avi"',
            f'video = "{camera.name}/video.avi"',
        ]
    (folder / "session.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")

    lines = ['format = "hybridve-scene"', "version = 1"]
    (folder / "meshes").mkdir()
    for part in stage.parts:
        write_stl(folder / "meshes" / f"{part.name}.stl", part.mesh, f"{part.name}, millimetres")
        lines += [
            "",
            *(f"# {line}" for line in part.comment.splitlines()),
            "[[object]]",
            f'name = "{part.name}"',
            f'mesh = "meshes/{part.name}.stl"',
            'unit = "mm"',
            f"translate_mm = [{', '.join(f'{value:g}' for value in part.translate_mm)}]",
            f"rotate_deg = [{', '.join(f'{value:g}' for value in part.rotate_deg)}]",
        ]
        if part.required_clearance_mm:
            lines.append(f"required_clearance_mm = {part.required_clearance_mm:g}")
        if part.recovery_direction is not None:
            direction = ", ".join(f"{value:g}" for value in part.recovery_direction)
            lines.append(f"recovery_direction = [{direction}]")
        if part.effect:
            lines += ["", "[[effect]]", *part.effect.splitlines()]
    (folder / "scene.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
