"""What is true of a generated recording: truth.h5, written beside it and read by tests.

Two truths stand side by side. That of the real shapes themselves; and that of their hull as perfect
silhouettes carve it, without pixels (see `cones.py`), which is larger: where a true shape touches a
CAD surface before all cameras, the hull touches it too; the reverse need not hold. Where a result
departs from the hull's truth the method errs; where the hull's departs from the shapes', the hull.

Layout, lengths in metres, times in seconds from the first frame, F frames::

    /                    attrs: format, version, preset, options, seed, fps, tolerance_m,
                         hull_resolution_m, hull_reach_m, contact_tolerance_m
    /cameras/NAME/       params (P,), cam_from_world (3, 4), cam_from_board (N, 3, 4) of the stills
    /silhouettes/NAME    (F, H, ceil(W / 8)) uint8, packed bits, lens distortion left in
    /shapes/NAME/        world_from_shape (F, 3, 4); attrs: kind, sizes_m
    /objects/NAME/       collides, penetration_m, clearance_m (F,), nearest_on_object_m (F, 3),
                         nearest_shape (F,) bytes; world_from_mesh (3, 4)
                         contact_times_s (K,), contact_points_m (K, 3): each entry into collision
                         hull_collides, hull_clearance_m (F,)
    /spacing/NAME/       the smallest shift at which all keeps its distance from object NAME:
                         needed_by_frame_m, needed_hull_by_frame_m (F,); attrs: along (3,),
                         range_m (2,), required_clearance_m, gap_cm, and for the recording
                         needed_m, needed_gap_cm, binding_frame of the shapes; needed_hull_m,
                         needed_hull_gap_cm, binding_frame_hull of their hull
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import h5py
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.camera import Camera
from hybridve.calib.errors import SessionError
from hybridve.calib.pose import Pose, invert, transform
from hybridve.hull.synth.closest import TOLERANCE_M, Closest, closest_on_surface
from hybridve.hull.synth.cones import RESOLUTION_M, HullDistance, Surface, TrueHull
from hybridve.hull.synth.entries import CONTACT_TOLERANCE_M, Entry
from hybridve.hull.synth.shapes import SHAPES, Shape
from hybridve.hull.synth.spacing import Needed
from hybridve.hull.synth.stage import Spacing, Stage

FORMAT = "hybridve-truth"
VERSION = 2
FILE_NAME = "truth.h5"

#: How far from an object its hull is looked for; farther away its clearance is NaN.
HULL_REACH_M = 0.1

#: So far within a shape a point is taken that surely belongs to it.
_WITHIN_M = 1e-9


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
    contact_times_s : (K,) float64
        When its surface begins to lie in a real shape, seconds from the first frame: each instant
        at which that becomes true, whether or not a frame shows it. What touches it from the
        beginning has none.
    contact_points_m : (K, 3) float64
        The point of its surface that is touched first; world.
    hull_collides : (F,) bool
        Whether a point of its surface was found in the hull of the real shapes.
    hull_clearance_m : (F,) float64
        The distance between its surface and that hull, at most `Truth.hull_resolution_m` above the
        exact value; 0 while colliding, NaN beyond `Truth.hull_reach_m`.
    """

    collides: NDArray[np.bool_]
    penetration_m: NDArray[np.float64]
    clearance_m: NDArray[np.float64]
    nearest_on_object_m: NDArray[np.float64]
    nearest_shape: tuple[str, ...]
    world_from_mesh: Pose
    contact_times_s: NDArray[np.float64]
    contact_points_m: NDArray[np.float64]
    hull_collides: NDArray[np.bool_]
    hull_clearance_m: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class SpacingTruth:
    """How far an object must be shifted for all to keep its distance from it, F frames.

    Attributes
    ----------
    along : (3,) float64
        Unit vector, world: where it is shifted.
    range_m : tuple of 2 float
        The smallest and the largest shift considered.
    required_clearance_m : float
        The distance to keep from its surface.
    gap_cm : float
        How wide the gap is that the shift widens, where the scene has the object.
    needed_m, needed_hull_m : float
        The smallest shift in the range that serves in every frame, for the real shapes and, at
        most `Truth.hull_resolution_m` too small, for their hull; inf where none does.
    needed_gap_cm, needed_hull_gap_cm : float
        The gap that results.
    binding_frame, binding_frame_hull : int
        The frame that asks for it.
    needed_by_frame_m, needed_hull_by_frame_m : (F,) float64
        The smallest shift that serves in each frame alone.
    """

    along: NDArray[np.float64]
    range_m: tuple[float, float]
    required_clearance_m: float
    gap_cm: float
    needed_m: float
    needed_hull_m: float
    needed_gap_cm: float
    needed_hull_gap_cm: float
    binding_frame: int
    binding_frame_hull: int
    needed_by_frame_m: NDArray[np.float64]
    needed_hull_by_frame_m: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """What is true of a generated recording, F frames.

    Attributes
    ----------
    preset : str
        Which recording.
    options : dict of float
        What was chosen of it.
    seed : int
        Which noise.
    fps : float
        Frames per second.
    tolerance_m : float
        How far clearances may lie above, and penetrations below, their exact values.
    hull_resolution_m, hull_reach_m : float
        How far distances to the hull may lie above their exact values, and how far they go.
    contact_tolerance_m : float
        How far from touching the shapes are at the instant of contact.
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
    spacing : dict of SpacingTruth
        The room needed by each object that the recording asks about, by name.
    """

    preset: str
    options: dict[str, float]
    seed: int
    fps: float
    tolerance_m: float
    hull_resolution_m: float
    hull_reach_m: float
    contact_tolerance_m: float
    cameras: tuple[Camera, ...]
    cam_from_board: dict[str, NDArray[np.float64]]
    shapes: dict[str, Shape]
    world_from_shape: dict[str, NDArray[np.float64]]
    objects: dict[str, ObjectTruth]
    spacing: dict[str, SpacingTruth]


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
                contact_times_s=group["contact_times_s"][()],
                contact_points_m=group["contact_points_m"][()],
                hull_collides=group["hull_collides"][()],
                hull_clearance_m=group["hull_clearance_m"][()],
            )
            for name, group in file["objects"].items()
        }
        spacing = {}
        for name, group in file["spacing"].items():
            numbers = {key: float(group.attrs[key]) for key in _SPACING_NUMBERS}
            low_m, high_m = (float(value) for value in group.attrs["range_m"])
            spacing[name] = SpacingTruth(
                along=group.attrs["along"],
                range_m=(low_m, high_m),
                binding_frame=int(group.attrs["binding_frame"]),
                binding_frame_hull=int(group.attrs["binding_frame_hull"]),
                needed_by_frame_m=group["needed_by_frame_m"][()],
                needed_hull_by_frame_m=group["needed_hull_by_frame_m"][()],
                **numbers,
            )
        shapes = {
            name: SHAPES[str(group.attrs["kind"])](
                *(float(size) for size in group.attrs["sizes_m"])
            )
            for name, group in file["shapes"].items()
        }
        return Truth(
            preset=str(file.attrs["preset"]),
            options=json.loads(file.attrs["options"]),
            seed=int(file.attrs["seed"]),
            fps=float(file.attrs["fps"]),
            tolerance_m=float(file.attrs["tolerance_m"]),
            hull_resolution_m=float(file.attrs["hull_resolution_m"]),
            hull_reach_m=float(file.attrs["hull_reach_m"]),
            contact_tolerance_m=float(file.attrs["contact_tolerance_m"]),
            cameras=tuple(cameras),
            cam_from_board={
                name: group["cam_from_board"][()] for name, group in file["cameras"].items()
            },
            shapes=shapes,
            world_from_shape={
                name: group["world_from_shape"][()] for name, group in file["shapes"].items()
            },
            objects=objects,
            spacing=spacing,
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


@dataclass(frozen=True, slots=True, eq=False)
class PartInFrame:
    """What is true of one CAD part in one frame.

    Attributes
    ----------
    closest : Closest
        Where a real shape is nearest to it.
    hull : HullDistance
        How near the hull of the shapes is.
    """

    closest: Closest
    hull: HullDistance


def look_at(
    surface: Surface, hull: TrueHull, shapes: Sequence[Shape], world_from_shape: Sequence[Pose]
) -> PartInFrame:
    """Return what is true of a surface among shapes and their hull."""
    closest = closest_on_surface(surface.triangles_world, shapes, world_from_shape)
    shape, pose = shapes[closest.shape], world_from_shape[closest.shape]
    # Where the shape is nearest, the hull is no farther.
    local = transform(invert(pose), closest.point_world[None])
    distance, slope = shape.signed_distance(local)
    inside = local - (np.maximum(distance, 0.0) + _WITHIN_M)[:, None] * slope
    near = hull.distance(surface, within_m=HULL_REACH_M, witnesses_world=transform(pose, inside))
    return PartInFrame(closest, near)


class TruthWriter:
    """Writes truth.h5 as the recording is made, a frame at a time and in order.

    Use it as a context manager; what is small is written when it ends well.
    """

    def __init__(
        self,
        path: Path,
        stage: Stage,
        *,
        preset: str,
        options: dict[str, float],
        seed: int,
        fps: float,
        n_frames: int,
    ) -> None:
        self._stage = stage
        self._length_s = (n_frames - 1) / fps
        self._poses: list[list[Pose]] = []
        self._found: list[list[PartInFrame]] = []
        self._file = h5py.File(path, "w", track_order=True)
        self._file.attrs.update(
            format=FORMAT,
            version=VERSION,
            preset=preset,
            options=json.dumps(options),
            seed=seed,
            fps=fps,
            tolerance_m=TOLERANCE_M,
            hull_resolution_m=RESOLUTION_M,
            hull_reach_m=HULL_REACH_M,
            contact_tolerance_m=CONTACT_TOLERANCE_M,
        )
        self._file.require_group("spacing")
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
        found: list[PartInFrame],
    ) -> None:
        """Write what is true of the next frame; `found` is in the order of the CAD parts."""
        for name, mask in silhouettes.items():
            self._file["silhouettes"][name][len(self._poses)] = np.packbits(mask, axis=1)
        self._poses.append(world_from_shape)
        self._found.append(found)

    def write_entries(self, part: str, entries: list[Entry]) -> None:
        """Write when contacts with a CAD part begin."""
        group = self._file.require_group(f"objects/{part}")
        times_s = np.array([self._length_s * entry.moment for entry in entries])
        points = np.array([entry.point_world for entry in entries]).reshape(-1, 3)
        for name, data, unit, description in (
            (
                "contact_times_s",
                times_s,
                "s",
                "instants from the first frame at which its surface begins to lie in a real shape",
            ),
            ("contact_points_m", points, "m", "point of its surface touched first; world"),
        ):
            _keep(group, name, data, unit, description)

    def write_spacing(self, spacing: Spacing, shapes: Needed, hull: Needed) -> None:
        """Write how far a CAD part must be shifted, for the real shapes and for their hull."""
        group = self._file.require_group(f"spacing/{spacing.part}")
        part = next(part for part in self._stage.parts if part.name == spacing.part)
        group.attrs.update(
            along=np.array(spacing.along),
            range_m=np.array(spacing.range_m),
            required_clearance_m=part.required_clearance_mm / 1000.0,
            gap_cm=100.0 * spacing.gap_m,
            needed_m=shapes.shift_m,
            needed_gap_cm=100.0 * (spacing.gap_m + shapes.shift_m),
            binding_frame=shapes.frame,
            needed_hull_m=hull.shift_m,
            needed_hull_gap_cm=100.0 * (spacing.gap_m + hull.shift_m),
            binding_frame_hull=hull.frame,
        )
        for name, needed, whose in (
            ("needed_by_frame_m", shapes, "the real shapes"),
            ("needed_hull_by_frame_m", hull, "their hull"),
        ):
            what = f"smallest shift at which {whose} keep the required clearance in the frame"
            _keep(group, name, needed.by_frame_m, "m", what)

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
            hulls = [frame[number].hull for frame in self._found]
            hull_m = np.array([hull.distance_m for hull in hulls])
            found = [frame[number].closest for frame in self._found]
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
                (
                    "hull_collides",
                    np.array([hull.collides for hull in hulls]),
                    "",
                    "whether a point of its surface lies in the hull of the real shapes",
                ),
                (
                    "hull_clearance_m",
                    np.where(np.isfinite(hull_m), hull_m, np.nan),
                    "m",
                    "distance from its surface to the hull of the real shapes; 0 while colliding, "
                    "NaN beyond hull_reach_m; at most hull_resolution_m above the exact value",
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


#: The attributes of a spacing that are one number.
_SPACING_NUMBERS = (
    "required_clearance_m",
    "gap_cm",
    "needed_m",
    "needed_hull_m",
    "needed_gap_cm",
    "needed_hull_gap_cm",
)


def _keep(group: Any, name: str, data: Any, unit: str, description: str) -> None:
    chunks = tuple(max(1, length) for length in data.shape)  # no entry at all is an answer, too
    maximum = data.shape if data.size else tuple(max(1, length) for length in data.shape)
    dataset = group.create_dataset(name, data=data, chunks=chunks, maxshape=maximum, **_STORED)
    dataset.attrs["unit"] = unit
    dataset.attrs["description"] = description
