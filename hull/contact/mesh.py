"""CAD meshes as they come from files: read, checked, never silently repaired."""

import logging
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.errors import SceneError
from hybridve.hull.contact.mesh_cache import find_mesh, keep_mesh, mesh_key

_log = logging.getLogger(__name__)

#: What Open3D reads.
MESH_SUFFIXES = (".stl", ".obj", ".ply", ".off", ".glb", ".gltf", ".fbx")

#: Kinds of files whose mesh is all their own, so that the same content is always the same mesh, and
#: by which word those give themselves away that lean on other files all the same. Materials in a
#: file beside an OBJ change the order of its triangles; a GLB may keep its vertices elsewhere. A
#: glTF does so as a rule, and what an FBX leans on is not known here.
_SELF_CONTAINED = {".stl": None, ".ply": None, ".off": None, ".obj": b"mtllib", ".glb": b'"uri"'}


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

    A mesh that was read before comes from `hybridve.hull.contact.mesh_cache`, the same to the bit.

    Raises
    ------
    SceneError
        If there is no such file, it cannot be read, its kind is unknown, or it holds no triangle or
        a coordinate that is not a finite number.
    """
    if not path.is_file():
        raise SceneError(f"there is no mesh file {path}")
    if path.suffix.lower() not in MESH_SUFFIXES:
        kinds = ", ".join(MESH_SUFFIXES)
        raise SceneError(
            f"{path}: a {path.suffix or 'file without suffix'} cannot be read; {kinds} can"
        )
    key = _cache_key(path)
    kept = None if key is None else find_mesh(key)
    if kept is not None:
        return check_mesh(*kept, str(path))
    vertices, faces = _read_with_open3d(path)
    mesh = check_mesh(vertices, faces, str(path))
    # Asked again: a file that was written to meanwhile must not be kept as what it was before.
    if key is not None and key == _cache_key(path):
        keep_mesh(key, mesh.vertices, mesh.faces)
    return mesh


def _read_with_open3d(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    import open3d  # late: the import alone takes up to a second

    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        loaded = open3d.io.read_triangle_mesh(path)
    vertices = np.array(loaded.vertices, dtype=np.float64).reshape(-1, 3)
    faces = np.array(loaded.triangles, dtype=np.int32).reshape(-1, 3)
    if len(faces) == 0:
        raise SceneError(f"{path}: the mesh is empty: no triangle was found in it; export it again")
    return vertices, faces


def _cache_key(path: Path) -> str | None:
    """Return the name under which a file's mesh is kept; None if it may depend on other files."""
    suffix = path.suffix.lower()
    reader = _open3d_version()
    if suffix not in _SELF_CONTAINED or reader is None:
        return None
    try:
        content = path.read_bytes()
    except OSError as error:
        raise SceneError(f"{path}: the file cannot be read: {error.strerror}") from error
    elsewhere = _SELF_CONTAINED[suffix]
    if elsewhere is not None and elsewhere in content:
        return None
    return mesh_key(content, suffix, reader)


def _open3d_version() -> str | None:
    """Return the version of Open3D, without importing it."""
    for package in ("open3d-cpu", "open3d"):  # the same library under two names
        try:
            return f"{package} {version(package)}"
        except PackageNotFoundError:
            continue
    return None


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
