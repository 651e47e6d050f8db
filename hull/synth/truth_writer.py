"""The truth of a generated recording, written frame by frame."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import h5py
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.files import Sink
from hybridve.calib.pose import Pose, invert, transform
from hybridve.hull.synth.closest import TOLERANCE_M, Closest, closest_on_surface
from hybridve.hull.synth.cones import RESOLUTION_M, HullDistance, Surface, TrueHull
from hybridve.hull.synth.entries import CONTACT_TOLERANCE_M, Entry
from hybridve.hull.synth.shapes import SHAPES, Shape
from hybridve.hull.synth.spacing import Needed
from hybridve.hull.synth.stage import Spacing, Stage
from hybridve.hull.synth.truth import FORMAT, HULL_REACH_M, VERSION

#: So far within a shape a point is taken that surely belongs to it.
_WITHIN_M = 1e-9


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
        self._sink = Sink(path, holds_errors=True)
        self._file = h5py.File(self._sink, "w", track_order=True)
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
        self._sink.close()
        if kind is None and self._sink.error is not None:
            raise self._sink.error


#: How every dataset is stored.
_STORED: dict[str, Any] = {
    "compression": "gzip",
    "shuffle": True,
    "fletcher32": True,
    "track_times": False,
}


def _keep(group: Any, name: str, data: Any, unit: str, description: str) -> None:
    chunks = tuple(max(1, length) for length in data.shape)  # no entry at all is an answer, too
    maximum = data.shape if data.size else tuple(max(1, length) for length in data.shape)
    dataset = group.create_dataset(name, data=data, chunks=chunks, maxshape=maximum, **_STORED)
    dataset.attrs["unit"] = unit
    dataset.attrs["description"] = description
