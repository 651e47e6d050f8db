"""Small sessions on disk whose truth is known: ready silhouettes of a ball, seen from a ring."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

SIZE_PX = (160, 120)
FOCAL_PX = 150.0
BALL_RADIUS_M = 0.2

SESSION_HEAD = 'format = "hybridve-session"\nversion = 1\nfps = 25\n'
SCENE_HEAD = 'format = "hybridve-scene"\nversion = 1\n'

CUBE = (
    "v -100 -100 -100\nv 100 -100 -100\nv 100 100 -100\nv -100 100 -100\n"
    "v -100 -100 100\nv 100 -100 100\nv 100 100 100\nv -100 100 100\n"
    "f 1 3 2\nf 1 4 3\nf 5 6 7\nf 5 7 8\nf 1 2 6\nf 1 6 5\n"
    "f 2 3 7\nf 2 7 6\nf 3 4 8\nf 3 8 7\nf 4 1 5\nf 4 5 8\n"
)


def ring_matrix(camera: int, n_cameras: int) -> NDArray[np.float64]:
    """Return img_from_world (3, 4) of one camera of a ring of 2 m that looks at the origin."""
    angle = 2 * np.pi * camera / n_cameras + 0.3
    center = 2.0 * np.array([np.cos(angle), np.sin(angle), 0.6])
    forward = -center / np.linalg.norm(center)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.array([right, np.cross(forward, right), forward])
    pinhole = np.array([[FOCAL_PX, 0, SIZE_PX[0] / 2], [0, FOCAL_PX, SIZE_PX[1] / 2], [0, 0, 1.0]])
    return np.asarray(pinhole @ np.column_stack([rotation, -rotation @ center]))


def ball_mask(matrix: NDArray[np.float64], center: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Return 255 where the ray through a pixel's centre meets the ball: its tangent cone."""
    columns, rows = np.meshgrid(np.arange(SIZE_PX[0]) + 0.5, np.arange(SIZE_PX[1]) + 0.5)
    pixels = np.stack([columns, rows, np.ones_like(columns)], axis=-1)
    rays = pixels @ np.linalg.inv(matrix[:, :3]).T
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    eye = -np.linalg.solve(matrix[:, :3], matrix[:, 3])
    along = rays @ (center - eye)
    distance_squared = np.sum((center - eye) ** 2) - along**2
    return np.where(distance_squared < BALL_RADIUS_M**2, 255, 0).astype(np.uint8)


def write_ball_session(
    folder: Path, centers: NDArray[np.float64], *, n_cameras: int = 4, extra: str = ""
) -> Path:
    """Write a session of ready masks in which a ball stands at `centers` (F, 3), frame by frame."""
    folder.mkdir(parents=True, exist_ok=True)
    rows, cameras = [], []
    for camera in range(n_cameras):
        name = f"cam{camera}"
        (folder / name).mkdir(exist_ok=True)
        matrix = ring_matrix(camera, n_cameras)
        rows.append(",".join([name, *(repr(float(value)) for value in matrix.ravel())]))
        for frame, center in enumerate(centers):
            cv2.imwrite(str(folder / name / f"{frame}.png"), ball_mask(matrix, center))
        cameras.append(f'[[camera]]\nname = "{name}"\nmasks = "{name}/*.png"\n')
    (folder / "rig.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    path = folder / "session.toml"
    path.write_text(
        f'{SESSION_HEAD}rig = "rig.csv"\nrig_unit = "m"\n{extra}\n' + "\n".join(cameras),
        encoding="utf-8",
    )
    return path


def write_cube_scene(folder: Path, centers_mm: dict[str, tuple[float, float, float]]) -> Path:
    """Write a scene of cubes with 0.2 m edges at the places given by name."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "cube.obj").write_text(CUBE, encoding="utf-8")
    objects = [
        f'[[object]]\nname = "{name}"\nmesh = "cube.obj"\nunit = "mm"\n'
        f"translate_mm = [{x}, {y}, {z}]\n"
        for name, (x, y, z) in centers_mm.items()
    ]
    path = folder / "scene.toml"
    path.write_text(SCENE_HEAD + "\n".join(objects), encoding="utf-8")
    return path
