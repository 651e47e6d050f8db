"""Objects that move, as a scene names them: files of poses and angles, and scenes at rest."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hybridve.calib.pose import Pose


def poses_csv(poses: Mapping[int, Pose]) -> str:
    """Return the text of a file of poses, with quaternions."""
    rows = ["frame,x,y,z,qw,qx,qy,qz"]
    for frame, pose in poses.items():
        x, y, z, w = Rotation.from_matrix(pose[:, :3]).as_quat().tolist()
        rows.append(",".join([str(frame), *map(repr, (*pose[:, 3].tolist(), w, x, y, z))]))
    return "\n".join(rows) + "\n"


def angles_csv(angles_deg: Mapping[int, float]) -> str:
    """Return the text of a file of a hinge's angles."""
    rows = [f"{frame},{angle_deg!r}" for frame, angle_deg in angles_deg.items()]
    return "\n".join(["frame,angle_deg", *rows]) + "\n"


def with_keys(scene: Path, lines: str, name: str = "scene.toml") -> Path:
    """Write a scene beside another, with lines more in its last table; return its path."""
    path = scene.with_name(name)
    path.write_text(scene.read_text(encoding="utf-8") + lines + "\n", encoding="utf-8")
    return path


def pose_of(rotation: NDArray[np.float64], translation_m: tuple[float, ...]) -> Pose:
    """Return a pose (3, 4)."""
    return np.column_stack([rotation, translation_m])
