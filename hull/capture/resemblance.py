"""Which room a recording shows: its own camera's empty scene, turned or not, or another one's."""

from itertools import combinations

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.errors import HybridveError
from hybridve.calib.image_io import FrameSource
from hybridve.hull.capture.session import Session

#: Pictures are compared this small, in pixels: what moves in them hardly counts.
_SIZE_PX = (64, 48)

#: What a recording shows is another camera's room, or its own turned, if it resembles that so well
#: (a correlation), and its own as it is by so much less.
_RESEMBLES, _LESS = 0.7, 0.2


#: How a picture may be turned: the axes along which it is flipped.
_TURNS = {"mirrored": (1,), "upside down": (0,), "turned": (0, 1)}


def unlike_rooms(session: Session) -> tuple[tuple[str, tuple[str, ...]], ...]:
    """Return the recordings that do not show their own camera's empty scene, and what they show.

    Cameras without a background, or whose pictures cannot be read, are not asked.

    Returns
    -------
    tuple of (str, tuple of str)
        "exchanged" and the two cameras that show each other's; "mirrored", "upside down" or
        "turned" and the camera whose own is shown so.
    """
    rooms, tasks, names = [], [], []
    for camera in session.cameras:
        if camera.has_masks or camera.background is None or camera.recording is None:
            continue
        try:
            room, task = _small(camera.background), _small(camera.recording)
        except HybridveError:
            continue
        names.append(camera.name)
        rooms.append(room)
        tasks.append(task)
    count = len(names)
    likeness = np.array([[_likeness(task, room) for room in rooms] for task in tasks])
    found: list[tuple[str, tuple[str, ...]]] = []
    for i, j in combinations(range(count), 2):
        crossed = min(likeness[i, j], likeness[j, i])
        less = min(likeness[i, j] - likeness[i, i], likeness[j, i] - likeness[j, j])
        if crossed > _RESEMBLES and less > _LESS:
            found.append(("exchanged", (names[i], names[j])))
    for i in range(count):
        turned = {
            kind: _likeness(np.flip(tasks[i], axes), rooms[i]) for kind, axes in _TURNS.items()
        }
        best = max(turned, key=lambda kind: turned[kind])
        if turned[best] > _RESEMBLES and turned[best] - likeness[i, i] > _LESS:
            found.append((best, (names[i],)))
    return tuple(found)


def _small(source: FrameSource) -> NDArray[np.float64]:
    """Return the first picture, small and grey."""
    image = source.first()
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image
    return np.asarray(cv2.resize(grey, _SIZE_PX, interpolation=cv2.INTER_AREA), np.float64)


def _likeness(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    """Return the correlation of two pictures of one size."""
    first, second = first - first.mean(), second - second.mean()
    size = float(np.linalg.norm(first) * np.linalg.norm(second))
    return float((first * second).sum()) / size if size > 0.0 else 0.0
