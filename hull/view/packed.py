"""Numbers and pictures as text within a page: deflated, in base64, as browsers read them back."""

import base64
import zlib

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.hull.view.surface import Surface

#: Of deflation: 9 takes four times as long for 2 per cent.
_LEVEL = 6

#: Places of a hull's surface are kept to this, metres.
STEP_M = 0.002


def packed(*arrays: NDArray[np.generic]) -> str:
    """Return arrays one after another, as they lie in little-endian memory, deflated, in base64."""
    whole = b"".join(
        np.ascontiguousarray(array, array.dtype.newbyteorder("<")).tobytes() for array in arrays
    )
    return base64.b64encode(zlib.compress(whole, _LEVEL)).decode("ascii")


def unpacked(text: str) -> bytes:
    """Return the bytes that were packed."""
    return zlib.decompress(base64.b64decode(text))


def packed_lists(values: NDArray[np.integer], offset: NDArray[np.integer]) -> str:
    """Return lists of ascending numbers: how long each is, then how far each is from that before.

    The first of a list is as far as it is from 0.

    Parameters
    ----------
    values : (K,) integers
        List after list.
    offset : (F + 1,) integers
        Those of list f are ``offset[f]`` to ``offset[f + 1]``.
    """
    steps = np.diff(values.astype(np.int64), prepend=0)
    begins = offset[:-1][np.diff(offset.astype(np.int64)) > 0].astype(np.int64)
    steps[begins] = values[begins]
    return packed(np.diff(offset).astype(np.uint32), steps.astype(np.uint32))


def packed_surface(surface: Surface, origin_m: NDArray[np.float64]) -> str:
    """Return a surface about an origin (3,): V, T and its corner; vertices and faces as steps.

    Places are whole steps of `STEP_M` from the corner, each stated from the one before it (int16,
    axis after axis), numbers of vertices (int32) likewise.
    """
    vertices_m = surface.vertices_world - origin_m
    corner_m = vertices_m.min(axis=0) if len(vertices_m) else np.zeros(3)
    places = np.rint((vertices_m - corner_m) / STEP_M).astype(np.int32)
    vertex_steps = np.diff(places, axis=0, prepend=0)
    face_steps = np.diff(surface.faces.ravel(), prepend=0)
    counts = np.array([len(vertices_m), len(surface.faces)], np.int32)
    return packed(
        counts,
        corner_m.astype(np.float32),
        vertex_steps.T.astype(np.int16),
        face_steps.astype(np.int32),
    )


def webp(image: NDArray[np.uint8], quality: int) -> str:
    """Return a picture (H, W, 3) BGR in base64, as WebP."""
    good, encoded = cv2.imencode(".webp", image, [cv2.IMWRITE_WEBP_QUALITY, quality])
    if not good:
        raise ValueError(f"a picture of {image.shape} cannot be encoded")
    return base64.b64encode(encoded.tobytes()).decode("ascii")
