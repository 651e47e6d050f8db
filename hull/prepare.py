"""Compiles all that ``detect`` needs, before it is needed: at set-up, or by ``doctor --prepare``.

Half of the code is compiled by one process and half by another, side by side, because numba
compiles in one thread at a time. They run it on the tiniest input and keep what they compiled
where every later start looks (see `hybridve.hull.jit`). Both use `rectangles.survivors`; the
second comes to it late, when the first may have kept it. A ``detect`` that finds nothing compiled
does it by itself: it needs only a part, 9 s of processor time where the two processes take 15.

``python -m hybridve.hull.prepare query`` compiles one half in this process.
"""

import gc
import subprocess
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.contact.detect import Body, detect_contacts, make_body
from hybridve.hull.contact.scene import SceneObject
from hybridve.hull.jit import FOLDER
from hybridve.hull.query.silhouettes import Views, make_hull, make_views

#: Side in pixels of the images that are compiled with.
_SIDE_PX = 64

#: Quads along an edge of the sheet that is compiled with: enough triangles for clusters.
_QUADS = 48


def is_prepared() -> bool:
    """Tell whether all is compiled and kept."""
    return FOLDER is not None and all(_sign(FOLDER, part).exists() for part in _PARTS)


def prepare_kernels() -> bool:
    """Compile all that ``detect`` needs and keep it; tell whether it is kept."""
    if FOLDER is not None and not is_prepared():
        processes = [
            subprocess.Popen(
                [sys.executable, "-m", "hybridve.hull.prepare", part],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
            )
            for part in _PARTS
        ]
        for process in processes:
            process.wait()
    return is_prepared()


def _sign(folder: Path, part: str) -> Path:
    """Return the file that says that a part is compiled."""
    return folder / f"{part}.done"


def _views() -> Views:
    matrix = np.array([[50.0, 0, 32, 32], [0, 50, 32, 32], [0, 0, 1, 1]])
    size = np.full((1, 2), _SIDE_PX, np.int64)
    return make_views(("camera",), size, matrix[None], "carve", 1)


def _mask() -> NDArray[np.uint8]:
    """Return a square in the middle."""
    mask = np.zeros((_SIDE_PX, _SIDE_PX), np.uint8)
    mask[16:48, 16:48] = 1
    return mask


def _sheet() -> Body:
    """Return a square that is larger than what the camera sees."""
    x, y = np.meshgrid(*[np.linspace(-1.0, 1.0, _QUADS + 1)] * 2)
    corner = (np.arange(_QUADS) + (_QUADS + 1) * np.arange(_QUADS)[:, None]).ravel()
    below = corner + _QUADS + 1
    faces = np.concatenate(
        [np.stack([corner, corner + 1, below], 1), np.stack([below, corner + 1, below + 1], 1)]
    )
    vertices = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    sheet = SceneObject("sheet", Path(), vertices, faces.astype(np.int32), 0.0, np.zeros(3), None)
    return make_body(sheet, viewport=10)


def _compile_query() -> None:
    from hybridve.hull.query.native import Native

    views, sheet = _views(), _sheet()
    with Native(1) as engine:
        for _ in range(2):  # clusters are made for the second frame
            detect_contacts(make_hull(views, [_mask()]), [sheet], engine)


def _compile_rest() -> None:
    from hybridve.hull.capture.background import learn_background
    from hybridve.hull.capture.segment import Segmenter, SegmentSettings
    from hybridve.hull.query.certify import Certifier

    empty = np.full((_SIDE_PX, _SIDE_PX, 3), 100, np.uint8)
    Segmenter(learn_background([empty]), SegmentSettings()).segment(
        np.where(_mask()[..., None] == 1, np.uint8(200), empty)
    )
    with Certifier(0.1, 1) as certifier:
        certifier.certify_mesh(make_hull(_views(), [_mask()]), _sheet().triangles)


_PARTS = {"query": _compile_query, "rest": _compile_rest}


if __name__ == "__main__":
    gc.disable()  # a tenth of the time, in a process that ends at once
    _PARTS[sys.argv[1]]()
    if FOLDER is not None:
        _sign(FOLDER, sys.argv[1]).touch()
