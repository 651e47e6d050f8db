"""Balls below a plate, seen by a ring of cameras and one from above."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from helpers.hulls import ball_masks, look_at, projection, ring_views
from hybridve.hull.cad.scene import SceneObject
from hybridve.hull.contact.clearance import ClearanceMeter
from hybridve.hull.contact.detect import Contact, detect_contacts, make_body
from hybridve.hull.query.reference import Reference
from hybridve.hull.query.silhouettes import Hull, Views, make_hull, make_views
from hybridve.hull.synth.meshes import box_mesh


def looking_down(n_cameras: int = 6) -> Views:
    """A ring of cameras and one above: two things beside each other leave no phantom."""
    ring = ring_views(n_cameras)
    above = projection(look_at(np.array([0.01, 0.0, 2.5]), np.zeros(3)), 700.0, 720, 720)
    width, height = ring.sizes_px[0]
    matrices = ring.img_from_local.copy()
    matrices[:, :, 3] -= matrices[:, :, :3] @ ring.origin_world
    return make_views(
        (*ring.names, "above"),
        np.array([*([(width, height)] * n_cameras), (720, 720)]),
        np.array([*matrices, above]),
    )


def balls(views: Views, radii_m: Sequence[float], centers: NDArray[np.float64]) -> Hull:
    """Return the hull of balls."""
    masks = [
        ball_masks(views, center, radius) for center, radius in zip(centers, radii_m, strict=True)
    ]
    return make_hull(views, [np.maximum(*both) for both in zip(*masks, strict=True)])


def plate(bottom_m: float) -> SceneObject:
    """A plate of 1.2 x 0.4 x 0.02 m whose underside is at this height."""
    mesh = box_mesh((1200.0, 400.0, 20.0), 40.0)
    vertices = mesh.vertices_mm / 1000 + np.array([0.0, 0.0, bottom_m + 0.01])
    return SceneObject(
        "plate",
        None,  # type: ignore[arg-type]
        vertices,
        mesh.faces.astype(np.int32),
        0.0,
        np.array([0.0, 0.0, bottom_m + 0.01]),
        None,
        True,
    )


def found_in(hull: Hull, part: SceneObject) -> tuple[ClearanceMeter, Contact]:
    """Return what measures a plate's clearance, and its contact."""
    meter = ClearanceMeter(part.vertices_world, part.faces, is_closed=True)
    with Reference() as engine:
        (contact,) = detect_contacts(hull, [make_body(part, viewport=20)], engine)
    return meter, contact
