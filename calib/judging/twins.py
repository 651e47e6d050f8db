"""Cameras of a rig that see the same from the same place: one of them tells all that both do."""

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.camera import Camera
from hybridve.calib.lens import cam_from_img, img_from_cam
from hybridve.calib.pose import invert, transform
from hybridve.calib.rig import Rig

#: Two views are one if all that one camera sees lies where the other sees it, to this: outlines
#: are found no better than to a pixel, and what differs by less carves nothing more.
_SAME_PX = 1.0

#: That is asked at so many places across and down the image, at these distances, as shares of how
#: far the rig's cameras stand from their middle.
_PLACES = 5
_DISTANCES = (0.5, 1.0, 2.0)


def find_twins(rig: Rig) -> tuple[tuple[str, ...], ...]:
    """Return the groups of cameras that stand in one place and have one view.

    Cameras that move with trackers are left out. A camera that sees the same in more pixels is a
    twin, too.

    Parameters
    ----------
    rig : Rig
        The cameras.

    Returns
    -------
    tuple of tuple of str
        Names in the rig's order, two or more a group; none where every camera tells something.
    """
    fixed = [camera for camera in rig.cameras if camera.name not in rig.mounts]
    if len(fixed) < 2:
        return ()
    centers = np.array([camera.center_world for camera in fixed])
    size_m = float(np.median(np.linalg.norm(centers - np.median(centers, axis=0), axis=1)))
    size_m = size_m if size_m > 0 else 1.0  # all in one place: any distance tells the same
    group = list(range(len(fixed)))
    for i, j in combinations(range(len(fixed)), 2):
        if group[i] != group[j] and _see_the_same(fixed[i], fixed[j], size_m):
            group = [group[i] if value == group[j] else value for value in group]
    groups = [
        tuple(camera.name for camera, value in zip(fixed, group, strict=True) if value == number)
        for number in dict.fromkeys(group)
    ]
    return tuple(names for names in groups if len(names) > 1)


def twins_text(groups: Sequence[Sequence[str]]) -> str:
    """Return what to say of cameras that see the same; nothing where there are none."""
    parts = []
    for names in groups:
        who = " and ".join([", ".join(map(repr, names[:-1])), repr(names[-1])])
        parts.append(
            f"cameras {who} stand in one place and have one view: together they tell no more than "
            "one of them"
        )
    told = "; ".join(parts)
    return f"{told}; was one clip, or one line of the rig, given twice?" if told else ""


def _see_the_same(first: Camera, second: Camera, size_m: float) -> bool:
    # The middle of the first image tells most cameras apart, without a lens being asked much.
    return _is_same(first, second, _grid(first, 1), size_m) and _is_same(
        first, second, _grid(first, _PLACES), size_m
    )


def _grid(camera: Camera, places: int) -> NDArray[np.float64]:
    """Return places evenly over an image: (K, 2) pixels."""
    x = (np.arange(places) + 0.5) / places * camera.width_px
    y = (np.arange(places) + 0.5) / places * camera.height_px
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def _is_same(first: Camera, second: Camera, pixels: NDArray[np.float64], size_m: float) -> bool:
    """Tell whether a second camera sees what a first sees at `pixels` (K, 2) in the same places."""
    rays = cam_from_img(first, pixels)
    known = np.isfinite(rays).all(axis=1)
    if not known.any():
        return False
    world_from_first = invert(first.cam_from_world)
    per_pixel = np.array(
        [second.width_px / first.width_px, second.height_px / first.height_px], np.float64
    )
    directions = np.column_stack([rays[known], np.ones(int(known.sum()))])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for distance in _DISTANCES:
        points_world = transform(world_from_first, distance * size_m * directions)
        points_cam = transform(second.cam_from_world, points_world)
        if not (points_cam[:, 2] > 0).all():
            return False
        missed = (img_from_cam(second, points_cam) - pixels[known] * per_pixel) / per_pixel
        if not (np.linalg.norm(missed, axis=1) < _SAME_PX).all():
            return False
    return True
