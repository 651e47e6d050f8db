"""Reports of patches that are where a test wants them, on one box of a metre."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from helpers.contacts import FREE, contact_at, free_contact
from hybridve.hull.agreement.outlines import Outline
from hybridve.hull.agreement.record import SessionAgreement
from hybridve.hull.contact.clearance import Clearance
from hybridve.hull.contact.finding import Finding, judged
from hybridve.hull.contact.patches import Patch
from hybridve.hull.contact.uncertainty import Doubt
from hybridve.hull.report import machine
from hybridve.hull.report.collisions import StoredMesh
from hybridve.hull.report.schema import CameraFrame, FrameResult, ReportHeader
from hybridve.hull.report.write import ReportWriter

#: Frames of a report are so far apart, seconds.
STEP_S = 0.1

CAMERAS = ("cam1", "cam2")

#: Where a part stands whose frame is the world's.
AT_REST = np.eye(3, 4)

#: What nobody doubts: outlines move the clearance by a tenth of a millimetre.
SURE = Doubt(1e-4, np.nan, 0.0, np.array([0.003, 0.0]), False, 2, True, (), "real")


@dataclass(frozen=True)
class Spot:
    """Where the hull is at the part, as cubes of `size_m` about a place (3,), metres.

    It is `depth_m` deep in it; below 0 it is so far away.
    """

    at_m: tuple[float, float, float]
    depth_m: float = 0.01
    size_m: float = 0.02
    doubt: Doubt = SURE

    @property
    def clearance_m(self) -> tuple[float, float]:
        return (0.0, 0.0) if self.depth_m > 0 else (-self.depth_m, -self.depth_m + 1e-4)

    def patch(self, at: "NDArray[np.float64]") -> Patch:
        touches = self.depth_m > 0
        return Patch(
            at,
            at if touches else at - np.array([0.0, 0.0, self.depth_m]),
            self.clearance_m,
            at - self.size_m / 2,
            at + self.size_m / 2,
            int(touches),
            int(touches),
        )


def stored_box(world_from_mesh: ArrayLike = AT_REST) -> StoredMesh:
    """Return a cube of a metre about the origin of its frame, as a report holds it."""
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    faces = np.array([[0, 1, 3], [4, 7, 5], [0, 4, 5], [2, 3, 7], [0, 2, 6], [1, 5, 7]], np.int32)
    numbers = np.arange(len(faces), dtype=np.uint32)
    placement = np.asarray(world_from_mesh, np.float64)[None]
    return StoredMesh(corners, faces, np.full(len(faces), 2, np.uint16), numbers, placement)


def _finding(spots: Sequence[Spot], required_m: float, world_from_mesh: Any) -> Finding:
    """Return what a frame with these spots says of the box."""
    if not spots:
        clearance = Clearance(0.5, 0.5001, np.ones(3), np.zeros(3), 0.0, 0.0)
        finding = Finding(FREE, clearance, doubt=replace(SURE, at_least_m=0.4))
    else:
        deepest = max(spots, key=lambda one: one.depth_m)
        places = [np.asarray(world_from_mesh) @ [*one.at_m, 1.0] for one in spots]
        at = places[spots.index(deepest)]
        touching = [place for one, place in zip(spots, places, strict=True) if one.depth_m > 0]
        contact = (
            contact_at(touching, "colliding", witness_world=at) if touching else free_contact()
        )
        depth_m = max(deepest.depth_m, 0.0)
        lower_m, upper_m = deepest.clearance_m
        clearance = Clearance(
            lower_m, upper_m, at, at, depth_m, depth_m + (1e-4 if depth_m else 0.0)
        )
        at_least_m = max(0.0, lower_m - 1.645 * deepest.doubt.std_m)
        finding = Finding(
            contact,
            clearance,
            doubt=replace(deepest.doubt, at_least_m=at_least_m),
            patches=tuple(one.patch(at) for one, at in zip(spots, places, strict=True)),
        )
    return judged(finding, is_closed=True, required_m=required_m, share_seen=1.0, rests_on="")


def write_clash_report(
    path: Path,
    frames: Sequence[Sequence[Spot] | None],
    *,
    required_m: float = 0.0,
    world_from_mesh: ArrayLike = AT_REST,
    name: str = "box",
    made: str = "2026-01-01T00:00:00+00:00",
    seen: str = "one",
    first: int = 0,
    step: int = 1,
    agreement: SessionAgreement | None = None,
    settings: Mapping[str, Any] | None = None,
    poses: Sequence[ArrayLike] = (),
) -> Path:
    """Write a report of one part, frame by frame with spots; None for a frame that is torn.

    Parameters
    ----------
    poses : sequence of (3, 4)
        Where a part that moves stood in each frame, instead of `world_from_mesh`.
    seen : str
        What the silhouettes were: two reports of one word saw the same.
    made : str
        When it was made, as it says.
    """
    header = ReportHeader(
        run=machine.Run("hybridve detect", "", {}, ""),
        objects=({"name": name, "required_clearance_m": required_m, "closed": True},),
        settings={"session_sha256": "one", **(settings or {})},
        rig={"cameras": []},
        engine="native",
        renderer="",
        parts=frozenset({"clearance", "doubt"}),
        cameras=CAMERAS,
        meshes=(stored_box(world_from_mesh),),
        placements=(
            {first + step * row: np.asarray(pose) for row, pose in enumerate(poses)} or None,
        ),
    )
    share = sum(seen.encode()) / 1e5
    camera = CameraFrame(share, 0, 1.0, 0.0, False, np.full(4, np.nan), Outline.empty())
    with ReportWriter(path, header, overwrite=True) as writer:
        for row, spots in enumerate(frames):
            index = first + step * row
            reason = "torn" if spots is None else ""
            pose = poses[row] if poses else world_from_mesh
            findings = () if spots is None else (_finding(spots, required_m, pose),)
            writer.append(
                FrameResult(
                    index,
                    STEP_S * index,
                    reason,
                    findings,
                    {},
                    "unread" if reason else "evaluated",
                    cameras=(camera,) * len(CAMERAS),
                )
            )
        writer.finish(agreement)
    import h5py

    with h5py.File(path, "r+") as file:
        file.attrs["created_utc"] = made
    return path
