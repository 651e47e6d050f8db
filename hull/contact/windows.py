"""The parts of images that an object projects into."""

import itertools

import numpy as np

from hybridve.hull.capture.pixel_boxes import Box
from hybridve.hull.contact.detect import Body
from hybridve.hull.query.silhouettes import Views


def windows_of(views: Views, body: Body) -> list[Box]:
    """Return for each camera a box that the object projects into, with some pixels to spare."""
    ends_world = np.stack([body.lower_world, body.upper_world])
    corners_world = np.array(list(itertools.product(*ends_world.T)))  # (8, 3)
    windows = []
    for camera, (width, height) in enumerate(views.sizes_px.tolist()):
        whole = (0, height, 0, width)
        projected = views.project(corners_world, camera)  # (8, 3)
        if projected[:, 2].min() <= 1e-6:
            windows.append(whole)  # part of it is behind the camera
            continue
        pixels = projected[:, :2] / projected[:, 2:]
        left, top = np.clip(np.floor(pixels.min(axis=0)) - 2, 0, (width, height)).tolist()
        right, bottom = np.clip(np.ceil(pixels.max(axis=0)) + 2, 0, (width, height)).tolist()
        windows.append((int(top), int(bottom), int(left), int(right)))
    return windows
