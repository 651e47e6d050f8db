"""CAD meshes as they come from files: read, checked, never silently repaired."""

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.errors import SceneError

_log = logging.getLogger(__name__)

#: What Open3D reads.
MESH_SUFFIXES = (".stl", ".obj", ".ply", ".off", ".glb", ".gltf", ".fbx")


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """A triangle mesh in the frame and unit of its file.

    Attributes
    ----------
    vertices : (V, 3) float64
        In the unit of the file.
    faces : (T, 3) int32
        Vertex numbers.
    n_zero_area : int
        How many triangles have no area. They are kept: their edges are still sampled.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]
    n_zero_area: int


def read_mesh(path: Path) -> Mesh:
    """Return the mesh in a file.

    Raises
    ------
    SceneError
        If there is no such file, its kind is unknown, or it holds no triangle or a coordinate that
        is not a finite number.
    """
    if not path.is_file():
        raise SceneError(f"there is no mesh file {path}")
    if path.suffix.lower() not in MESH_SUFFIXES:
        kinds = ", ".join(MESH_SUFFIXES)
        raise SceneError(
            f"{path}: a {path.suffix or 'file without suffix'} cannot be read; {kinds} can"
        )
    import open3d  # late: the import alone takes a second

    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        loaded = open3d.io.read_triangle_mesh(path)
    vertices = np.array(loaded.vertices, dtype=np.float64).reshape(-1, 3)
    faces = np.array(loaded.triangles, dtype=np.int32).reshape(-1, 3)
    if len(faces) == 0:
        raise SceneError(f"{path}: the mesh is empty: no triangle was found in it; export it again")
    return check_mesh(vertices, faces, str(path))


def check_mesh(vertices: NDArray[np.float64], faces: NDArray[np.int32], label: str) -> Mesh:
    """Return a mesh after a look at its numbers.

    Raises
    ------
    SceneError
        If a coordinate is not finite or a face names a vertex that is not there.
    """
    finite = np.isfinite(vertices).all(axis=1)
    if not finite.all():
        worst = int(np.argmin(finite))
        raise SceneError(
            f"{label}: vertex {worst} is {vertices[worst].tolist()}: "
            f"{int((~finite).sum())} of {len(vertices)} vertices are not finite numbers; "
            "export it again"
        )
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise SceneError(f"{label}: a face names a vertex that is not there; export it again")
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    doubled_areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    n_zero_area = int((doubled_areas == 0).sum())
    if n_zero_area:
        _log.info("%s: %d of %d triangles have no area", label, n_zero_area, len(faces))
    return Mesh(vertices, faces, n_zero_area)
