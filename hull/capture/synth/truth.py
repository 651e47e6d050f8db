"""What is true of a generated recording: truth.h5, written beside it and read by tests.

The truth is that of the real shapes themselves, not of their visual hull, which is larger: where a
true shape touches a CAD surface, the hull touches it too; the reverse need not hold.

Layout, lengths in metres, F frames::

    /                    attrs: format, version, preset, seed, fps, tolerance_m
    /cameras/NAME/       params (P,), cam_from_world (3, 4), cam_from_board (N, 3, 4) of the stills
    /silhouettes/NAME    (F, H, ceil(W / 8)) uint8, packed bits, lens distortion left in
    /shapes/NAME/        world_from_shape (F, 3, 4); attrs: kind, sizes_m
    /objects/NAME/       collides, penetration_m, clearance_m (F,), nearest_on_object_m (F, 3),
                         nearest_shape (F,) bytes; world_from_mesh (3, 4)
"""

from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import h5py
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.camera import Camera
from hybridve.calib.errors import SessionError
from hybridve.calib.pose import Pose
from hybridve.hull.capture.synth.closest import TOLERANCE_M, Closest
from hybridve.hull.capture.synth.shapes import SHAPES, Shape
from hybridve.hull.capture.synth.stage import Stage

FORMAT = "hybridve-truth"
VERSION = 1
FILE_NAME = "truth.h5"


@dataclass(frozen=True, slots=True, eq=False)
class ObjectTruth:
    """What really happened to one CAD object, F frames.

    Attributes
    ----------
    collides : (F,) bool
        Whether a point of its surface lies inside a real shape.
    penetration_m : (F,) float64
        How deep the deepest point of its surface lies in any one real shape; 0 where none does.
    clearance_m : (F,) float64
        The distance between its surface and the nearest real shape; 0 while colliding. At most
        `Truth.tolerance_m` above the exact value.
    nearest_on_object_m : (F, 3) float64
        The point of its surface that is nearest to, or deepest in, a real shape; world.
    nearest_shape : tuple of F str
        The name of that shape.
    world_from_mesh : (3, 4) float64
        Its pose, metres.
    """

    collides: NDArray[np.bool_]
    penetration_m: NDArray[np.float64]
    clearance_m: NDArray[np.float64]
    nearest_on_object_m: NDArray[np.float64]
    nearest_shape: tuple[str, ...]
    world_from_mesh: Pose


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """What is true of a generated recording, F frames.

    Attributes
    ----------
    preset : str
        Which recording.
    seed : int
        Which noise.
    fps : float
        Frames per second.
    tolerance_m : float
        How far clearances may lie above, and penetrations below, their exact values.
    cameras : tuple of Camera
        The rig, in the world of the board on the floor.
    cam_from_board : dict of (N, 3, 4) float64
        For each camera where the board was in each of its stills.
    shapes : dict of Shape
        The real shapes by name.
    world_from_shape : dict of (F, 3, 4) float64
        Where each was.
    objects : dict of ObjectTruth
        The CAD objects by name.
    """

    preset: str
    seed: int
    fps: float
    tolerance_m: float
    cameras: tuple[Camera, ...]
    cam_from_board: dict[str, NDArray[np.float64]]
    shapes: dict[str, Shape]
    world_from_shape: dict[str, NDArray[np.float64]]
    objects: dict[str, ObjectTruth]


def read_truth(folder: Path) -> Truth:
    """Return the truth of the recording in `folder`.

    Raises
    ------
    SessionError
        If there is none, or it is of another version.
    """
    with _open(folder) as file:
        cameras = []
        for name, group in file["cameras"].items():
            cameras.append(
                Camera(
                    name,
                    str(group.attrs["model"]),
                    int(group.attrs["width_px"]),
                    int(group.attrs["height_px"]),
                    group["params"][()],
                    group["cam_from_world"][()],
                )
            )
        objects = {
            name: ObjectTruth(
                collides=group["collides"][()],
                penetration_m=group["penetration_m"][()],
                clearance_m=group["clearance_m"][()],
                nearest_on_object_m=group["nearest_on_object_m"][()],
                nearest_shape=tuple(name.decode() for name in group["nearest_shape"][()]),
                world_from_mesh=group["world_from_mesh"][()],
            )
            for name, group in file["objects"].items()
        }
        shapes = {
            name: SHAPES[str(group.attrs["kind"])](
                *(float(size) for size in group.attrs["sizes_m"])
            )
            for name, group in file["shapes"].items()
        }
        return Truth(
            preset=str(file.attrs["preset"]),
            seed=int(file.attrs["seed"]),
            fps=float(file.attrs["fps"]),
            tolerance_m=float(file.attrs["tolerance_m"]),
            cameras=tuple(cameras),
            cam_from_board={
                name: group["cam_from_board"][()] for name, group in file["cameras"].items()
            },
            shapes=shapes,
            world_from_shape={
                name: group["world_from_shape"][()] for name, group in file["shapes"].items()
            },
            objects=objects,
        )


def true_masks(folder: Path, frame: int) -> dict[str, NDArray[np.uint8]]:
    """Return the exact silhouettes of the real shapes in one frame, by camera.

    An object pixel, 1, is one whose centre sees a real shape through the lens; the others are 0.
    The images (H, W) are those of the recording, lens distortion left in.

    Raises
    ------
    SessionError
        If there is no such recording or frame.
    """
    masks = {}
    with _open(folder) as file:
        for name, packed in file["silhouettes"].items():
            if not 0 <= frame < len(packed):
                raise SessionError(
                    f"{folder / FILE_NAME}: there is no frame {frame}; it has {len(packed)}"
                )
            width_px = int(file["cameras"][name].attrs["width_px"])
            masks[name] = np.unpackbits(packed[frame], axis=1, count=width_px)
    return masks


def is_generated(folder: Path) -> bool:
    """Return whether `folder` holds a recording that was generated."""
    try:
        _open(folder).close()
    except SessionError:
        return False
    return True


def _open(folder: Path) -> Any:
    path = folder / FILE_NAME
    if not path.is_file():
        raise SessionError(f"{path}: there is no such file; {folder} was not generated")
    try:
        file = h5py.File(path, "r")
    except OSError as error:
        raise SessionError(f"{path}: not an HDF5 file that can be read: {error}") from error
    kind, version = file.attrs.get("format"), file.attrs.get("version")
    if kind != FORMAT or version != VERSION:
        file.close()
        raise SessionError(
            f"{path}: found format {kind!r} version {version}, expected {FORMAT!r} version "
            f"{VERSION}; generate the recording again"
        )
    return file


class TruthWriter:
    """Writes truth.h5 as the recording is made, a frame at a time and in order.

    Use it as a context manager; what is small is written when it ends well.
    """

    def __init__(
        self, path: Path, stage: Stage, *, preset: str, seed: int, fps: float, n_frames: int
    ) -> None:
        self._stage = stage
        self._poses: list[list[Pose]] = []
        self._closest: list[list[Closest]] = []
        self._file = h5py.File(path, "w", track_order=True)
        self._file.attrs.update(
            format=FORMAT,
            version=VERSION,
            preset=preset,
            seed=seed,
            fps=fps,
            tolerance_m=TOLERANCE_M,
        )
        for camera in stage.cameras:
            group = self._file.require_group(f"cameras/{camera.name}")
            group.attrs.update(
                model=camera.model, width_px=camera.width_px, height_px=camera.height_px
            )
            _keep(group, "params", camera.params, "px", "lens parameters in COLMAP's order")
            _keep(group, "cam_from_world", camera.cam_from_world, "m", "pose [R | t]")
            shape = (n_frames, camera.height_px, -(-camera.width_px // 8))
            silhouettes = self._file.require_group("silhouettes").create_dataset(
                camera.name, shape, np.uint8, chunks=(1, *shape[1:]), **_STORED
            )
            silhouettes.attrs["unit"] = ""
            silhouettes.attrs["description"] = (
                "bit 1 where the centre of the pixel sees a real shape; the first bit is the "
                "leftmost pixel of its eight; lens distortion left in"
            )

    def write_stills(self, camera: str, cam_from_board: list[Pose]) -> None:
        """Write where the board was in each still of a camera."""
        poses = np.array(cam_from_board).reshape(-1, 3, 4)
        group = self._file["cameras"][camera]
        _keep(group, "cam_from_board", poses, "m", "pose [R | t] of the board in each still")

    def write_frame(
        self,
        world_from_shape: list[Pose],
        silhouettes: dict[str, NDArray[np.bool_]],
        closest: list[Closest],
    ) -> None:
        """Write what is true of the next frame; `closest` is in the order of the CAD parts."""
        for name, mask in silhouettes.items():
            self._file["silhouettes"][name][len(self._poses)] = np.packbits(mask, axis=1)
        self._poses.append(world_from_shape)
        self._closest.append(closest)

    def _finish(self) -> None:
        stage = self._stage
        for number, real in enumerate(stage.shapes):
            group = self._file.require_group(f"shapes/{real.name}")
            kind = next(name for name, kind in SHAPES.items() if kind is type(real.shape))
            group.attrs.update(kind=kind, sizes_m=real.shape.sizes_m)
            poses = np.array([frame[number] for frame in self._poses])
            _keep(group, "world_from_shape", poses, "m", "pose [R | t] of the real shape")
        names = np.array([real.name for real in stage.shapes], dtype=np.bytes_)
        for number, part in enumerate(stage.parts):
            group = self._file.require_group(f"objects/{part.name}")
            found = [frame[number] for frame in self._closest]
            distance_m = np.array([closest.distance_m for closest in found])
            for name, data, unit, description in (
                ("world_from_mesh", part.world_from_mesh, "m", "pose [R | t] of the mesh"),
                (
                    "collides",
                    distance_m < 0,
                    "",
                    "whether a point of its surface lies in a real shape",
                ),
                (
                    "penetration_m",
                    np.maximum(-distance_m, 0.0),
                    "m",
                    "depth of the deepest point of its surface in any one real shape; else 0",
                ),
                (
                    "clearance_m",
                    np.maximum(distance_m, 0.0),
                    "m",
                    "distance from its surface to the nearest real shape; 0 while colliding",
                ),
                (
                    "nearest_on_object_m",
                    np.array([closest.point_world for closest in found]),
                    "m",
                    "point of its surface nearest to, or deepest in, a real shape; world",
                ),
                (
                    "nearest_shape",
                    names[[closest.shape for closest in found]],
                    "",
                    "name of that shape",
                ),
            ):
                _keep(group, name, data, unit, description)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is None:
            self._finish()
        self._file.close()


#: How every dataset is stored.
_STORED: dict[str, Any] = {
    "compression": "gzip",
    "shuffle": True,
    "fletcher32": True,
    "track_times": False,
}


def _keep(group: Any, name: str, data: Any, unit: str, description: str) -> None:
    dataset = group.create_dataset(name, data=data, **_STORED)
    dataset.attrs["unit"] = unit
    dataset.attrs["description"] = description
