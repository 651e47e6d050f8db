"""What a report says of the session, the rig and the objects it was made from."""

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from hybridve.calib.formats.rig_json import rig_to_dict
from hybridve.calib.plain import to_plain
from hybridve.calib.pose import Pose, compose
from hybridve.hull.report.collisions import StoredMesh
from hybridve.hull.report.schema import Part

if TYPE_CHECKING:
    pass


from hybridve.hull.chain import Chain, EvaluateSettings, mask_shift_px


def resolved_settings(chain: Chain) -> dict[str, Any]:
    """Return all that decides the result of an evaluation, as plain JSON values."""
    session = chain.session
    return {
        "session": str(session.path),
        "session_sha256": session.checksum,
        "scene": str(chain.scene.path),
        "scene_sha256": chain.scene.checksum,
        "cameras": [camera.name for camera in session.cameras],
        "frames": str(chain.settings.frames),
        "viewport": chain.settings.viewport,
        "accuracy_m": chain.settings.accuracy_m,
        "open_at_m": chain.settings.open_at_m,
        "clearance_m": chain.settings.clearance_m,
        "response": None if chain.settings.response is None else asdict(chain.settings.response),
        "backtrack": chain.settings.backtrack,
        "doubt": None if chain.settings.doubt is None else asdict(chain.settings.doubt),
        "unseen": session.unseen,
        "min_cameras": session.min_cameras,
        "mask_threshold": session.mask_threshold,
        "mask_channel": session.mask_channel,
        "rig_check": session.rig_check,
        "segmentation": asdict(session.segmentation),
        "silhouettes": None if chain.silhouettes is None else str(chain.silhouettes),
        "local_origin_m": list(local_origin_m(chain)),
        "query_origin_m": chain.views.origin_world.tolist(),
        **({"poses_sha256": dict(chain.tracks.sha256)} if chain.tracks else {}),
        **({"rules": [to_plain(rule) for rule in chain.scene.rules]} if chain.scene.rules else {}),
    }


def about_rig(chain: Chain) -> dict[str, Any]:
    """Return the rig as in rig.json, and how far undistorting can shift each silhouette.

    ``mask_shift_px`` is the bound of `hybridve.calib.lens_bound` in recorded pixels; None for a
    camera that the session does not use, or of which no bound is known.
    """
    shift_px = mask_shift_px(chain)
    about = rig_to_dict(chain.rig)
    for entry in about["cameras"]:
        entry["mask_shift_px"] = shift_px.get(entry["name"])
    return about


def about_objects(chain: Chain) -> tuple[dict[str, Any], ...]:
    """Return what the report says of each object, as plain JSON values."""
    return tuple(
        {
            **scene_object.about,
            "name": body.name,
            "mesh": str(scene_object.mesh_path),
            "triangles": len(body.triangles),
            "largest_viewport": int(body.triangles.viewports.max()),
            "smallest_viewport": int(body.triangles.viewports.min()),
            "samples": int(body.triangles.topology.samples_before[-1]),
            "sample_spacing_m": body.spacing_m,
            "required_clearance_m": scene_object.required_clearance_m,
        }
        for scene_object, body in zip(chain.scene.objects, chain.bodies, strict=True)
    )


def local_origin_m(chain: Chain) -> tuple[float, float, float]:
    """Return where the places of a report begin, (3,) metres in the world.

    In whole hundreds of metres: a room about the world's origin keeps its coordinates, and one far
    from it has places in single precision to 4 micrometres.
    """
    x, y, z = (float(round(at / 100.0) * 100.0) for at in chain.views.origin_world)
    return x, y, z


def stored_meshes(chain: Chain) -> tuple[StoredMesh, ...]:
    """Return the objects' meshes as the report holds them; those that move at rest."""
    meshes = []
    for part, body in zip(chain.scene.objects, chain.bodies, strict=True):
        placement = _about_origin(chain, part.world_from_mesh)
        viewport = np.zeros(len(body.numbers), np.uint16)
        viewport[body.numbers] = body.triangles.viewports
        meshes.append(
            StoredMesh(
                part.vertices_world if part.vertices_mesh is None else part.vertices_mesh,
                part.faces,
                viewport,
                body.numbers,
                placement[None],
            )
        )
    return tuple(meshes)


def placements(chain: Chain) -> tuple[dict[int, Pose] | None, ...]:
    """Return by frame of the session where the report has each object's mesh; None if it rests."""
    return tuple(
        None
        if part.motion is None
        else {
            frame: _about_origin(chain, compose(pose, part.world_from_mesh))
            for frame, pose in part.motion.poses.items()
        }
        for part in chain.scene.objects
    )


def _about_origin(chain: Chain, world_from_mesh: Pose) -> Pose:
    """Return a placement (3, 4) in the world as one about the report's local origin, metres."""
    placement = world_from_mesh.copy()
    placement[:, 3] -= local_origin_m(chain)
    return placement


def computed_parts(settings: EvaluateSettings) -> frozenset[Part]:
    """Return what an evaluation computes of each object besides its contact."""
    has_clearance = settings.clearance_m is not None
    parts: dict[Part, bool] = {
        "clearance": has_clearance,
        "first contact": True,
        "response": settings.response is not None,
        "recovery": has_clearance and settings.response is not None,
        "doubt": has_clearance and settings.doubt is not None,
    }
    return frozenset(part for part, is_computed in parts.items() if is_computed)
