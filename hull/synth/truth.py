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
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.camera import Camera
from hybridve.calib.errors import ReportError, SessionError
from hybridve.calib.pose import Pose
from hybridve.hull.stored import DAMAGED, open_stored
from hybridve.hull.synth.shapes import SHAPES, Shape

FORMAT = "hybridve-truth"
VERSION = 2
FILE_NAME = "truth.h5"

#: How far from an object its hull is looked for; farther away its clearance is NaN.
HULL_REACH_M = 0.1


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
        file = open_stored(path)
    except ReportError as error:
        raise SessionError(str(error)) from error
    except DAMAGED as error:
        raise SessionError(f"{path}: not an HDF5 file that can be read: {error}") from error
    kind, version = file.attrs.get("format"), file.attrs.get("version")
    if kind != FORMAT or version != VERSION:
        file.close()
        raise SessionError(
            f"{path}: found format {kind!r} version {version}, expected {FORMAT!r} version "
            f"{VERSION}; generate the recording again"
        )
    return file


#: The attributes of a spacing that are one number.
_SPACING_NUMBERS = (
    "required_clearance_m",
    "gap_cm",
    "needed_m",
    "needed_hull_m",
    "needed_gap_cm",
    "needed_hull_gap_cm",
)
