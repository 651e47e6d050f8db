"""The frames of a sweep: few, spread over the recording, their hulls made once and kept."""

import logging
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.errors import SessionError
from hybridve.calib.pose import Pose, placed
from hybridve.hull.capture.recording import FrameRange
from hybridve.hull.chain import Chain, hulls, standing_at
from hybridve.hull.contact.detect import Body
from hybridve.hull.query.bounds import boxes_are_free
from hybridve.hull.query.engine import Triangles
from hybridve.hull.query.silhouettes import Hull, make_hull

_log = logging.getLogger(__name__)

#: Frames that a sweep takes if it is not told which.
MOST_FRAMES = 20

#: Bytes that the hulls of a sweep may take: they stay in memory, to be asked again and again.
_MOST_BYTES = 2 << 30


@dataclass(frozen=True, slots=True, eq=False)
class HullFrame:
    """One frame, ready to be asked.

    Attributes
    ----------
    index : int
        Its number in the session.
    hull : Hull
        What is real in it.
    near : (B,) bool
        Which bodies' boxes are not proved free.
    decode_s, segment_s, hull_s, boxes_s : float
        What that took.
    world_from_rest : tuple of (3, 4) float64 or None
        Where each body is, seen from where the scene places it; None of one that does not move, as
        they all do not if this is empty.
    """

    index: int
    hull: Hull
    near: NDArray[np.bool_]
    decode_s: float
    segment_s: float
    hull_s: float
    boxes_s: float
    world_from_rest: tuple[Pose | None, ...] = ()

    def mesh(self, number: int, mesh: Triangles) -> Triangles:
        """Return the mesh of a body, by number, where that is in this frame."""
        pose = self.world_from_rest[number] if self.world_from_rest else None
        return mesh if pose is None else mesh.moved(placed(mesh.vertices_world, pose))

    def body(self, number: int, body: Body) -> Body:
        """Return a body, by number, with its mesh where it is in this frame."""
        mesh = self.mesh(number, body.triangles)
        return body if mesh is body.triangles else replace(body, triangles=mesh)


def spread_frames(n_frames: int, most: int = MOST_FRAMES) -> FrameRange:
    """Return frames spread over a recording, at most so many.

    Examples
    --------
    >>> str(spread_frames(426))
    '0::22'
    """
    return FrameRange(0, None, max(1, -(-n_frames // most)))


def read_hulls(
    chain: Chain,
    progress: Callable[[str, int, int], None] | None = None,
    advance: Callable[[], object] = lambda: None,
) -> list[HullFrame]:
    """Return the chosen frames of a chain; those that cannot be read are left out, with a warning.

    Parameters
    ----------
    chain : Chain
        The recording and the scene.
    progress : callable, optional
        Told ``(what, done, total)`` while the backgrounds are learnt.
    advance : callable
        Told after each frame.

    Raises
    ------
    SessionError
        If no frame can be used, or the hulls of so many do not fit into memory.
    """
    frames: list[HullFrame] = []
    n_bytes = 0
    with closing(hulls(chain, progress=progress)) as found:
        for frame in found:
            advance()
            hull = frame.hull
            if hull is None:
                _log.warning("frame %d is left out: %s", frame.index, frame.reason)
                continue
            n_bytes += hull.masks_flat.nbytes + hull.integrals_flat.nbytes
            if n_bytes > _MOST_BYTES:
                raise SessionError(
                    f"{chain.session.path}: the hulls of {len(frames)} frames fill "
                    f"{_MOST_BYTES >> 30} GiB of memory; take fewer with --frames START:STOP:STEP"
                )
            standing = standing_at(chain, frame.index)
            frames.append(
                HullFrame(
                    frame.index,
                    hull,
                    near_bodies(hull, standing.bodies),
                    frame.decode_s,
                    frame.segment_s,
                    0.0,
                    0.0,
                    standing.world_from_rest,
                )
            )
    if not frames:
        raise SessionError(
            f"{chain.session.path}: none of the frames {chain.settings.frames} can be evaluated; "
            "choose others with --frames"
        )
    return [_timed(frame, chain) for frame in frames]


def _timed(frame: HullFrame, chain: Chain) -> HullFrame:
    """Return a frame with the seconds of its hull and boxes, now that nothing else runs."""
    views = frame.hull.views
    masks = [frame.hull.mask(camera) for camera in range(len(views))]
    bodies = standing_at(chain, frame.index).bodies
    started = time.perf_counter()
    hull = make_hull(views, masks)
    made = time.perf_counter()
    near_bodies(hull, bodies)
    return replace(frame, hull_s=made - started, boxes_s=time.perf_counter() - made)


def near_bodies(hull: Hull, bodies: list[Body]) -> NDArray[np.bool_]:
    """Tell which bodies' boxes are not proved free of the hull, (B,)."""
    return ~boxes_are_free(
        hull,
        np.array([body.lower_world for body in bodies]),
        np.array([body.upper_world for body in bodies]),
    )
