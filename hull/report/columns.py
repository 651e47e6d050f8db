"""Every column of a report: what it is called, what it holds, in which unit, and of which kind."""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.report.collisions import Runs, StoredMesh

if TYPE_CHECKING:  # whoever only reads a report waits for none of these
    from hybridve.hull.agreement.outlines import Outline
    from hybridve.hull.contact.backtrack import FirstContact
    from hybridve.hull.contact.clearance import Clearance
    from hybridve.hull.contact.detect import Contact
    from hybridve.hull.contact.finding import Finding
    from hybridve.hull.contact.patches import Patch
    from hybridve.hull.contact.recovery import Recovery
    from hybridve.hull.contact.respond import Response
    from hybridve.hull.contact.uncertainty import Doubt
from hybridve.hull.report.schema import STAGES, CameraFrame, Column, FrameResult, Part, Table


def _stage(name: str) -> Column[FrameResult]:
    return Column(
        f"stage_s/{name}",
        "s",
        "estimate",
        f"seconds of work on the stage {name!r}, summed over the cameras",
        np.float64,
        lambda result: result.stage_s.get(name, 0.0),
    )


#: One row a frame.
FRAME_COLUMNS: tuple[Column[FrameResult], ...] = (
    Column(
        "index",
        "1",
        "exact",
        "number of the frame in the session",
        np.uint32,
        lambda result: result.index,
    ),
    Column(
        "time_s",
        "s",
        "exact",
        "time from the session's first frame",
        np.float64,
        lambda result: result.time_s,
    ),
    Column(
        "valid",
        "1",
        "exact",
        "whether the frame was evaluated",
        np.bool_,
        lambda result: result.is_valid,
    ),
    Column(
        "reason",
        "1",
        "exact",
        "why the frame was not evaluated",
        str,
        lambda result: result.reason,
    ),
    Column(
        "state",
        "1",
        "exact",
        "evaluated; unread: pictures or the pose of a camera or an object are missing or damaged; "
        "contradictory: the silhouettes cannot all be right, and nothing is said of the objects",
        str,
        lambda result: result.state,
    ),
    Column(
        "rests_on",
        "1",
        "exact",
        "what it rests on that the frame has no hull: which cameras saw nothing; empty if it has",
        str,
        lambda result: result.rests_on,
    ),
    *(_stage(name) for name in STAGES),
)

_VERDICT: "tuple[Column[Finding], ...]" = (
    Column(
        "verdict",
        "1",
        "exact",
        "clash: a point of the surface is in the hull; inside: the hull is in the closed object; "
        "too near: certainly nearer than required; unknown: the frame was not evaluated; open: "
        "nothing found, nothing proved; not seen: where no point can be in the hull, whatever is "
        "there; kept: proved to keep its distance",
        str,
        lambda finding: finding.verdict,
        absent=lambda _: "unknown",
    ),
    Column(
        "reason",
        "1",
        "exact",
        "why the verdict is what it is, or what it rests on, where that does not go without saying",
        str,
        lambda finding: finding.reason,
        absent=lambda result: result.reason,
    ),
)

#: One row a frame, of each camera.
CAMERA_COLUMNS: tuple[Column[CameraFrame], ...] = (
    Column(
        "object_share",
        "1",
        "exact",
        "share of the undistorted picture that is object; NaN if the frame was not read",
        np.float64,
        lambda camera: camera.object_share,
    ),
    Column(
        "denied_px",
        "px^2",
        "bound",
        "area of the large pieces of its silhouette that other cameras are proved to deny, beyond "
        "the stated errors of outlines, at least; 0 of fewer than three cameras, which cannot tell",
        np.uint32,
        lambda camera: camera.denied_px,
    ),
    Column(
        "supported_share",
        "1",
        "bound",
        "share of the squares of its object pixels that the other cameras are not proved to deny, "
        "at most; NaN without such squares, of fewer than three cameras, and of frames not read",
        np.float64,
        lambda camera: camera.supported_share,
    ),
    Column(
        "denies_share",
        "1",
        "estimate",
        "share of the others' squares that this camera alone denies; NaN likewise",
        np.float64,
        lambda camera: camera.denies_share,
    ),
    Column(
        "is_denier",
        "1",
        "estimate",
        "whether it denies pieces of the silhouettes of two others at least: such a frame is not "
        "believed",
        np.bool_,
        lambda camera: camera.is_denier,
    ),
    Column(
        "alone_px",
        "px",
        "bound",
        "left, top, right and bottom of what this camera sees and all others are proved to deny; "
        "NaN where there is nothing",
        np.float64,
        lambda camera: camera.alone_px,
        shape=(4,),
    ),
    Column(
        "outline/is_inverse",
        "1",
        "exact",
        "whether most of the picture is object, and the outline is that of what is not",
        np.bool_,
        lambda camera: camera.outline.is_inverse,
    ),
)

#: Of each camera, any number of rows a frame.
OUTLINE_COLUMNS: "tuple[Column[Outline], ...]" = (
    Column(
        "outline/corners_px",
        "px",
        "exact",
        "corners of the convex hulls of the silhouette's pieces, piece after piece: centres of "
        "pixels of the undistorted image, the centre of the top-left one being (0.5, 0.5)",
        np.float32,
        lambda outline: outline.corners_px,
        shape=(2,),
    ),
    Column(
        "outline/marks",
        "1",
        "exact",
        "of each corner 1 if it is the first of its piece, and 2 if what the camera saw ends "
        "there, added up",
        np.uint8,
        lambda outline: outline.marks,
    ),
)

_CONTACT: "tuple[Column[Contact], ...]" = (
    Column(
        "collides",
        "1",
        "sampled",
        "whether a sample of its surface is in the hull",
        np.bool_,
        lambda contact: contact.collides,
    ),
    Column(
        "n_points",
        "1",
        "sampled",
        "number of collision points",
        np.uint64,
        lambda contact: contact.n_points,
    ),
    Column(
        "n_triangles",
        "1",
        "sampled",
        "number of triangles with a collision point",
        np.uint32,
        lambda contact: contact.n_triangles,
    ),
    Column(
        "certificate",
        "1",
        "exact",
        "colliding: a witness point is in every silhouette; free: proved, no point of the object "
        "is in the hull; open: no disc of diameter open_at_m on its surface is in the hull; empty: "
        "sampled only, or not evaluated",
        str,
        lambda contact: contact.certificate,
    ),
    Column(
        "witness_m",
        "m",
        "exact",
        "a point of the surface in every silhouette; NaN unless colliding",
        np.float64,
        lambda contact: contact.witness_world,
        shape=(3,),
        is_place=True,
    ),
    Column(
        "open_at_m",
        "m",
        "bound",
        "no disc of this diameter on the surface is in the hull; NaN unless open",
        np.float64,
        lambda contact: contact.open_at_m,
    ),
)

_CLEARANCE: "tuple[Column[Clearance], ...]" = (
    Column(
        "clearance_m",
        "m",
        "bound",
        "lower and upper bound of the distance from the hull to the object; 0, 0 while colliding "
        "or inside; inf above where no hull was found; NaN where unknown",
        np.float64,
        lambda clearance: (clearance.lower_m, clearance.upper_m),
        shape=(2,),
    ),
    Column(
        "clearance_on_object_m",
        "m",
        "bound",
        "point of the object's surface that the upper bound was measured from",
        np.float64,
        lambda clearance: clearance.on_object_world,
        shape=(3,),
        is_place=True,
    ),
    Column(
        "clearance_on_hull_m",
        "m",
        "bound",
        "point of the hull that the upper bound was measured to; of a hull that is in "
        "a closed object its deepest point",
        np.float64,
        lambda clearance: clearance.on_hull_world,
        shape=(3,),
        is_place=True,
    ),
    Column(
        "depth_m",
        "m",
        "bound",
        "lower and upper bound of how far the deepest point of the hull lies beneath the surface "
        "of a closed object, which is no distance that separates them; 0, 0 if none does; NaN if "
        "the object is not closed",
        np.float64,
        lambda clearance: (clearance.depth_lower_m, clearance.depth_upper_m),
        shape=(2,),
    ),
)

_APPROACH: "tuple[Column[Finding], ...]" = (
    Column(
        "approach_m_s",
        "m/s",
        "bound",
        "lower and upper bound of the mean speed at which hull and object came nearer since the "
        "frame before, depth counting as negative distance; negative where they parted; infinite "
        "where nothing bounds it, as in an object that is not closed; NaN in the first frame, "
        "beside one that was not evaluated and one without a hull",
        np.float64,
        lambda finding: finding.approach_m_s,
        shape=(2,),
    ),
)

_INSTANT: "tuple[Column[Finding], ...]" = (
    Column(
        "first_contact_s",
        "s",
        "estimate",
        "when the hull first touched the object, from the session's first frame; in the first "
        "colliding frame after one without, else NaN",
        np.float64,
        lambda finding: finding.first_contact_s,
    ),
    Column(
        "first_contact_uncertainty_s",
        "s",
        "bound",
        "how far off first_contact_s can be",
        np.float64,
        lambda finding: finding.first_contact_uncertainty_s,
    ),
)

_FIRST_CONTACT: "tuple[Column[FirstContact], ...]" = (
    Column(
        "first_contact_m",
        "m",
        "estimate",
        "where the hull first touched the object's surface",
        np.float64,
        lambda first: first.point_world,
        shape=(3,),
        is_place=True,
    ),
    Column(
        "first_contact_status",
        "1",
        "exact",
        "what is wrong with first_contact_s and first_contact_m; empty if nothing is",
        str,
        lambda first: first.status,
    ),
)

_RESPONSE: "tuple[Column[Response], ...]" = (
    Column(
        "cp_obj_m",
        "m",
        "sampled",
        "CP_obj: the collision point farthest from RP_obj, or that of first contact "
        "where it was asked for; NaN where nothing collides",
        np.float64,
        lambda response: response.cp_obj_world,
        shape=(3,),
        is_place=True,
    ),
    Column(
        "v_rec",
        "1",
        "exact",
        "V_rec, unit vector: the way the object is moved out of the hull",
        np.float64,
        lambda response: response.v_rec,
        shape=(3,),
    ),
    Column(
        "cp_hull_m",
        "m",
        "exact",
        "CP_hull: where the ray from CP_obj along V_rec leaves the hull",
        np.float64,
        lambda response: response.cp_hull_world,
        shape=(3,),
        is_place=True,
    ),
    Column(
        "d_rec_m",
        "m",
        "exact",
        "D_rec: from CP_obj to CP_hull; moves CP_obj out, not necessarily the whole object",
        np.float64,
        lambda response: response.d_rec_m,
    ),
    Column(
        "n_hull",
        "1",
        "estimate",
        "N_hull, unit vector out of the hull: of the smoothed outline at CP_hull",
        np.float64,
        lambda response: response.n_hull,
        shape=(3,),
    ),
    Column(
        "response_status",
        "1",
        "exact",
        "what is wrong with the columns before it; empty if nothing is",
        str,
        lambda response: response.status,
    ),
    Column(
        "cp_hull_paper_m",
        "m",
        "sampled",
        "CP_hull as published: the first sample of triangle ABC within the hull",
        np.float64,
        lambda response: response.cp_hull_paper_world,
        shape=(3,),
        is_place=True,
    ),
    Column(
        "d_rec_paper_m",
        "m",
        "sampled",
        "D_rec as published",
        np.float64,
        lambda response: response.d_rec_paper_m,
    ),
    Column(
        "d_rec_difference_m",
        "m",
        "sampled",
        "d_rec_paper_m less d_rec_m",
        np.float64,
        lambda response: response.difference_m,
    ),
    Column(
        "n_hull_paper",
        "1",
        "sampled",
        "N_hull as published: the cross product of IJ and KL",
        np.float64,
        lambda response: response.n_hull_paper,
        shape=(3,),
    ),
    Column(
        "response_status_paper",
        "1",
        "exact",
        "what is wrong with the columns as published; empty if nothing is",
        str,
        lambda response: response.status_paper,
    ),
)

_RECOVERY: "tuple[Column[Recovery], ...]" = (
    Column(
        "recovery_frees",
        "1",
        "exact",
        "whether the whole object, moved along v_rec by d_rec_m and the tolerance of the "
        "clearance, is free of the hull: yes or no, both proved; open: neither; empty where there "
        "is no D_rec",
        str,
        lambda recovery: recovery.frees,
    ),
    Column(
        "free_shift_m",
        "m",
        "bound",
        "shift along v_rec that is not certain to free the whole object, and a larger one that is "
        "proved to; inf where none was found, NaN where nothing was asked",
        np.float64,
        lambda recovery: (recovery.blocked_m, recovery.free_m),
        shape=(2,),
    ),
)

_DOUBT: "tuple[Column[Doubt], ...]" = (
    Column(
        "clearance_std_m",
        "m",
        "estimate",
        "standard deviation of the clearance, from outlines and calibration; of the depth, where "
        "the hull reaches into a closed object",
        np.float64,
        lambda doubt: doubt.std_m,
    ),
    Column(
        "clearance_at_least_m",
        "m",
        "estimate",
        "what the clearance is at least, at 95 %",
        np.float64,
        lambda doubt: doubt.at_least_m,
    ),
    Column(
        "real_clearance_at_most_m",
        "m",
        "bound",
        "the real thing is not farther away than this, given right silhouettes; inf if unknown, "
        "NaN of objects too far away to be looked at closely",
        np.float64,
        lambda doubt: doubt.real_upper_m,
    ),
    Column(
        "m_per_px",
        "m/px",
        "estimate",
        "by how much the clearance falls when a camera's outline moves outward by a pixel",
        np.float64,
        lambda doubt: doubt.m_per_px,
        shape=("C",),
    ),
    Column(
        "n_seeing",
        "1",
        "exact",
        "cameras that see the contact, or the point of the hull that is nearest",
        np.uint32,
        lambda doubt: doubt.n_seeing,
    ),
    Column(
        "survives",
        "1",
        "exact",
        "yes or no: whether the verdict, touched or not, stands with any one camera left out; "
        "empty of objects too far away to be looked at closely",
        str,
        lambda doubt: {True: "yes", False: "no", None: ""}[doubt.survives],
    ),
    Column(
        "hinges_on",
        "1",
        "exact",
        "the cameras without which it does not",
        str,
        lambda doubt: ", ".join(doubt.hinges_on),
    ),
    Column(
        "component",
        "1",
        "estimate",
        "the connected volume of the hull, in cells of some centimetres and with silhouettes grown "
        "by a pixel, that touches or is nearest; real: somewhere it holds something real, given "
        "right silhouettes, which need not be where it touches (a phantom that a thin neck joins "
        "to a person is of one volume with them); unsure: other volumes explain all that it does, "
        "as of a phantom; empty of objects too far away to be looked at closely",
        str,
        lambda doubt: doubt.component,
    ),
)

#: Of each object, one row a frame.
TABLES: tuple[Table[Any], ...] = (
    Table("contact", lambda finding: finding, _VERDICT),
    Table("contact", lambda finding: finding.contact, _CONTACT),
    Table("clearance", lambda finding: finding.clearance, _CLEARANCE),
    Table("clearance", lambda finding: finding, _APPROACH),
    Table("first contact", lambda finding: finding, _INSTANT),
    Table("first contact", lambda finding: finding.first_contact, _FIRST_CONTACT),
    Table("response", lambda finding: finding.response, _RESPONSE),
    Table("recovery", lambda finding: finding.recovery, _RECOVERY),
    Table("doubt", lambda finding: finding.doubt, _DOUBT),
)

#: Of each object, one row a run of collision points.
RUN_COLUMNS: tuple[Column[Runs], ...] = (
    Column(
        "runs/triangle",
        "1",
        "sampled",
        "triangle that a run of consecutive samples in the hull begins in; it goes on through the "
        "triangles that follow in mesh/order",
        np.uint32,
        lambda runs: runs.triangle,
    ),
    Column(
        "runs/first",
        "1",
        "sampled",
        "number of its first sample in the viewport of that triangle",
        np.uint32,
        lambda runs: runs.first,
    ),
    Column(
        "runs/count",
        "1",
        "sampled",
        "how many samples the run has",
        np.uint32,
        lambda runs: runs.count,
    ),
)

#: Of each object, one row a patch: a connected piece of the hull that is in contact with it, or
#: nearer than it requires.
PATCH_COLUMNS: "tuple[Column[Patch], ...]" = (
    Column(
        "patches/cp_obj_m",
        "m",
        "sampled",
        "the patch's collision point farthest from RP_obj; without one, the point of the object "
        "that the upper bound of its clearance was measured from",
        np.float64,
        lambda patch: patch.cp_obj_world,
        shape=(3,),
        is_place=True,
    ),
    Column(
        "patches/on_hull_m",
        "m",
        "bound",
        "point of the patch that the upper bound of its clearance was measured to",
        np.float64,
        lambda patch: patch.on_hull_world,
        shape=(3,),
        is_place=True,
    ),
    Column(
        "patches/clearance_m",
        "m",
        "bound",
        "lower and upper bound of the distance from the patch to the object; 0, 0 where it "
        "touches; inf above where no point of the hull was found in it",
        np.float64,
        lambda patch: patch.clearance_m,
        shape=(2,),
    ),
    Column(
        "patches/lower_m",
        "m",
        "bound",
        "lower corner of the box around the patch",
        np.float64,
        lambda patch: patch.lower_world,
        shape=(3,),
        is_place=True,
    ),
    Column(
        "patches/extent_m",
        "m",
        "bound",
        "edges of the box around the patch",
        np.float64,
        lambda patch: patch.upper_world - patch.lower_world,
        shape=(3,),
    ),
    Column(
        "patches/triangles",
        "1",
        "sampled",
        "number of triangles with a collision point of the patch",
        np.uint32,
        lambda patch: patch.n_triangles,
    ),
    Column(
        "patches/points",
        "1",
        "sampled",
        "number of its collision points",
        np.uint64,
        lambda patch: patch.n_points,
    ),
)

#: Of each object, one row a collision point, where all are spelt out.
POINT_COLUMNS: tuple[Column[Any], ...] = (
    Column(
        "points/xyz_m",
        "m",
        "sampled",
        "collision points CP_i, rounded to single precision",
        np.float32,
        lambda points: points,
        shape=(3,),
        is_place=True,
    ),
    Column(
        "points/triangle",
        "1",
        "sampled",
        "number of the triangle that the collision point lies on",
        np.uint32,
        lambda points: points,
    ),
)


def offset_column(group: str, what: str) -> Column[NDArray[np.uint64]]:
    """Return the column that says which rows of a group belong to which frame."""
    return Column(
        f"{group}/offset",
        "1",
        "exact",
        f"the {what} of row f are {group} offset[f] to offset[f + 1]",
        np.uint64,
        lambda offset: offset,
    )


#: Which runs, patches and points belong to which frame; made from their numbers.
RUN_OFFSET = offset_column("runs", "runs")
PATCH_OFFSET = offset_column("patches", "patches")
OUTLINE_OFFSET = offset_column("outline", "corners of the outline")
POINT_OFFSET = offset_column("points", "collision points")

#: Of each object, its mesh as it was asked about.
MESH_COLUMNS: tuple[Column[StoredMesh], ...] = (
    Column(
        "mesh/vertices_m",
        "m",
        "exact",
        "vertices in the frame of the mesh",
        np.float64,
        lambda mesh: mesh.vertices_m,
        shape=(3,),
    ),
    Column(
        "mesh/faces",
        "1",
        "exact",
        "vertex numbers of each triangle",
        np.int32,
        lambda mesh: mesh.faces,
        shape=(3,),
    ),
    Column(
        "mesh/viewport",
        "1",
        "exact",
        "samples along an edge of each triangle",
        np.uint16,
        lambda mesh: mesh.viewport,
    ),
    Column(
        "mesh/order",
        "1",
        "exact",
        "triangles in the order in which runs go on through them",
        np.uint32,
        lambda mesh: mesh.order,
    ),
    Column(
        "mesh/placement",
        "1",
        "exact",
        "[R | t] with x = R vertex + t, metres about the local origin: as it stood; of an object "
        "that moves, a row a frame, NaN where that is not known",
        np.float64,
        lambda mesh: mesh.placement,
        shape=(3, 4),
    ),
)


def tables_of(parts: frozenset[Part]) -> tuple[Table[Any], ...]:
    """Return the tables of an evaluation that computed `parts` besides the contact."""
    there = {"contact", *parts}
    return tuple(table for table in TABLES if table.part in there)
