"""One recording through the whole chain: frames in, results out, written as they come.

::

    session -> silhouettes -+
    rig --------------------+-> Hull (one frame) -> contacts -> FrameResult -> report
    scene -> bodies --------+
"""

import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import closing, contextmanager, nullcontext
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.errors import SessionError
from hybridve.calib.pose import compose, invert, transform
from hybridve.hull.agreement.frame import Agreement, Coherence, judge_frame
from hybridve.hull.agreement.sight import sight_of
from hybridve.hull.cad.scene import SceneObject
from hybridve.hull.contact.backtrack import FirstContact, approach_speed, first_contact
from hybridve.hull.contact.clearance import Clearance, ClearanceMeter
from hybridve.hull.contact.detect import (
    Body,
    Contact,
    certify_contacts,
    detect_contacts,
)
from hybridve.hull.contact.finding import Finding, agreed, judged, signed_clearance, widened
from hybridve.hull.contact.patches import contact_patches
from hybridve.hull.contact.recovery import recover
from hybridve.hull.contact.respond import Response, respond
from hybridve.hull.query.certify import Certifier
from hybridve.hull.query.engine import Engine
from hybridve.hull.query.silhouettes import (
    Hull,
    Views,
)
from hybridve.hull.query.threads import usable_cpus
from hybridve.hull.report.schema import CameraFrame, FrameResult, State

if TYPE_CHECKING:
    from hybridve.hull.contact.uncertainty import Doubter


from hybridve.hull.about import computed_parts
from hybridve.hull.chain import (
    Chain,
    FrameHull,
    Standing,
    body_at,
    hulls,
    make_doubter,
    standing_at,
)
from hybridve.hull.trust import Witness

#: Frames are evaluated side by side, as many as there are processors, but no more than this: each
#: holds its images.
_MOST_AT_ONCE = 8


def evaluate(
    chain: Chain,
    engine: Engine,
    *,
    skip: int = 0,
    write_s: Callable[[], float] = lambda: 0.0,
    progress: Callable[[str, int, int], None] | None = None,
    n_at_once: int | None = None,
) -> Generator[FrameResult]:
    """Yield the result of every frame; to be closed where it is left before its end.

    Frames are evaluated side by side and yielded in their order. No result depends on how many are
    evaluated at once, nor on what was evaluated before, but for the frame before.

    Parameters
    ----------
    chain : Chain
        What to evaluate.
    engine : Engine
        What answers the volume query.
    skip : int
        How many frames at the start are done already. The last of them is looked at again, since
        the next one is compared with it.
    write_s : callable
        Tells how long was spent on writing since it was last asked; kept with the next frame.
    progress : callable, optional
        Told ``(what, done, total)`` while the backgrounds are learnt.
    n_at_once : int, optional
        How many frames are evaluated at once; by default as many as there are processors, some at
        most, but one where the engine answers one thread only.

    Raises
    ------
    SessionError
        If the recording has none of the frames asked for.
    """
    if n_at_once is None:
        n_at_once = min(usable_cpus(), _MOST_AT_ONCE) if engine.any_thread else 1
    first = max(skip - 1, 0)
    n_frames = 0
    with (
        _Tools.of(chain, engine) as tools,
        closing(hulls(chain, skip=first, progress=progress)) as frames,
        closing(_side_by_side(chain, tools, frames, n_at_once)) as results,
    ):
        for n_frames, result in enumerate(results, first + 1):
            if n_frames > skip:
                result.stage_s["write"] = write_s()
                yield result
    if n_frames == 0 and first == 0:
        raise SessionError(
            f"{chain.session.path}: the recording has none of the frames "
            f"{chain.settings.frames}; it may be empty or shorter"
        )


def _side_by_side(
    chain: Chain, tools: "_Tools", frames: Iterable[FrameHull], n_at_once: int
) -> Generator[FrameResult]:
    """Yield the results of frames in their order; so many are evaluated at once.

    A frame is compared with the one before as soon as that was looked at: the earlier one has
    begun by then, so no frame waits for one that waits itself.
    """
    looked: Future[_Seen | None] | None = None
    waiting: deque[Future[FrameResult]] = deque()
    with ThreadPoolExecutor(n_at_once, "frame") as threads:
        try:
            for frame in frames:
                before, looked = looked, Future()
                if n_at_once == 1:  # some engines answer the thread that opened them, and no other
                    yield _evaluated(chain, tools, frame, before, looked)
                    continue
                while len(busy := [call for call in waiting if not call.done()]) >= n_at_once:
                    wait(busy, return_when=FIRST_COMPLETED)
                waiting.append(threads.submit(_evaluated, chain, tools, frame, before, looked))
                while waiting and waiting[0].done():
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for call in waiting:
                call.cancel()


def _evaluated(
    chain: Chain,
    tools: "_Tools",
    frame: FrameHull,
    before: "Future[_Seen | None] | None",
    looked: "Future[_Seen | None]",
) -> FrameResult:
    """Return the result of one frame; `looked` is given what is seen in it by itself."""
    watch = _Stopwatch(decode=frame.decode_s, segment=frame.segment_s, agree=frame.hull_s)
    seen: _Seen | None = None
    try:
        if frame.hull is not None:
            seen = _look(chain, tools, frame, frame.hull, watch)
    except BaseException as error:
        looked.set_exception(error)
        raise
    looked.set_result(seen)
    state: State = "unread" if seen is None else "evaluated"
    reason = frame.reason
    if seen is not None and seen.agreement.is_contradictory:
        state, reason = "contradictory", seen.agreement.reason
    findings: tuple[Finding, ...] = ()
    if seen is not None and state == "evaluated":
        earlier = None if before is None else before.result()
        is_known = earlier is not None and earlier.is_believed
        findings = _findings(chain, tools, earlier if is_known else None, seen, watch)
    if seen is not None:
        seen.standing.let_go()
    return FrameResult(
        index=frame.index,
        time_s=frame.time_s,
        reason=reason,
        findings=findings,
        stage_s=watch.stage_s,
        state=state,
        rests_on=seen.rests_on if seen and state == "evaluated" else "",
        cameras=() if seen is None else seen.cameras,
    )


class _Stopwatch:
    """Seconds of work of this thread by stage; it does not count waiting for other frames."""

    def __init__(self, **stage_s: float) -> None:
        self.stage_s = stage_s
        self._last = time.thread_time()

    def lap(self, stage: str) -> None:
        """Count the time since the last lap to a stage."""
        now = time.thread_time()
        self.stage_s[stage] = self.stage_s.get(stage, 0.0) + now - self._last
        self._last = now


@dataclass(frozen=True, slots=True, eq=False)
class _Tools:
    """What is kept from frame to frame. No result depends on what was asked of it before."""

    engine: Engine
    certifier: Certifier | None
    meters: list[ClearanceMeter]
    doubter: "Doubter | None"
    witness: Witness
    share_seen: list[float | None]

    def meters_at(self, standing: Standing) -> list[ClearanceMeter]:
        """Return the meters of objects where they stand."""
        if not self.meters:
            return []
        return [
            meter if pose is None else meter.at(pose)
            for meter, pose in zip(self.meters, standing.world_from_rest, strict=True)
        ]

    def shares_seen_at(self, standing: Standing, views: Views) -> list[float]:
        """Return the share of each object's surface that enough cameras see."""
        return [
            _share_seen(one, views) if known is None else known
            for one, known in zip(standing.objects, self.share_seen, strict=True)
        ]

    @classmethod
    @contextmanager
    def of(cls, chain: Chain, engine: Engine) -> Iterator[Self]:
        settings = chain.settings
        meters = []
        if settings.clearance_m is not None:
            meters = [
                ClearanceMeter(
                    part.vertices_world,
                    part.faces,
                    is_closed=part.is_closed,
                    solid_faces=part.solid_faces,
                    tolerance_m=settings.clearance_m,
                )
                for part in chain.scene.objects
            ]
        doubter = make_doubter(chain) if "doubt" in computed_parts(settings) else None
        is_still = not chain.tracks
        witness = Witness.of(
            chain.views,
            chain.undistortions,
            None if doubter is None else doubter.errors.sigma_px,
            is_still=is_still,
        )
        shares = [
            _share_seen(one, chain.views) if is_still and one.motion is None else None
            for one in chain.scene.objects
        ]
        with Certifier(settings.open_at_m) if settings.open_at_m else nullcontext() as certifier:
            yield cls(engine, certifier, meters, doubter, witness, shares)


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """One frame by itself."""

    index: int
    time_s: float
    hull: Hull
    agreement: Agreement
    coherence: Coherence
    cameras: tuple[CameraFrame, ...]
    standing: Standing
    meters: list[ClearanceMeter]
    contacts: list[Contact]
    clearances: list[Clearance]

    @property
    def is_believed(self) -> bool:
        """Whether the hull may be taken for what was there."""
        return self.agreement.is_believed and not self.coherence.deniers

    @property
    def rests_on(self) -> str:
        """Why it may not, or what its emptiness rests on, in words; else empty."""
        return "; ".join(filter(None, [self.agreement.reason, self.coherence.reason]))


def _share_seen(part: SceneObject, views: Views) -> float:
    """Return the share of an object's surface that enough cameras see; 0 if that is proved."""
    sight = sight_of(views, part.vertices_world, part.faces)
    least = 0.0 if sight.is_not_seen else float(np.finfo(np.float64).tiny)
    return 1.0 if sight.is_seen else max(sight.share, least)


def _look(chain: Chain, tools: _Tools, frame: FrameHull, hull: Hull, watch: _Stopwatch) -> _Seen:
    """Return what one frame says by itself, without those before."""
    agreement = judge_frame(hull, tools.witness.error_px, tools.witness.pencils)
    found, kept = tools.witness.look(frame.index, hull)
    denied_px = {one.camera: one.area_px for one in found.disputes}
    cameras = tuple(
        CameraFrame(
            share,
            denied_px.get(name, 0),
            float(found.supported_share[camera]),
            float(found.denies_share[camera]),
            bool(kept.deniers[camera]),
            kept.alone_px[camera],
            kept.outlines[camera],
        )
        for camera, (name, share) in enumerate(
            zip(hull.views.names, hull.object_shares().tolist(), strict=True)
        )
    )
    watch.lap("agree")
    standing = standing_at(chain, frame.index)
    meters = tools.meters_at(standing)
    alone = (frame.index, frame.time_s, hull, agreement, found, cameras, standing, meters)
    if agreement.is_contradictory:
        return _Seen(*alone, [], [])
    contacts = detect_contacts(hull, standing.bodies, tools.engine)
    watch.lap("query")
    if tools.certifier is not None:
        contacts = certify_contacts(hull, standing.bodies, contacts, tools.certifier)
    watch.lap("certify")
    clearances = [meter.measure(hull) for meter in meters]
    if clearances:
        pairs = [
            agreed(contact, clearance)
            for contact, clearance in zip(contacts, clearances, strict=True)
        ]
        contacts = [contact for contact, _ in pairs]
        clearances = [
            widened(clearance, part.tessellation_error_m)
            for (_, clearance), part in zip(pairs, chain.scene.objects, strict=True)
        ]
    watch.lap("clearance")
    return _Seen(*alone, contacts, clearances)


def _findings(
    chain: Chain, tools: _Tools, before: _Seen | None, seen: _Seen, watch: _Stopwatch
) -> tuple[Finding, ...]:
    """Return all about one frame, compared with the one before where that could be read."""
    findings = []
    for number, contact in enumerate(seen.contacts):
        finding = Finding(contact, seen.clearances[number] if seen.clearances else None)
        if before is not None:
            finding = _compared(chain, tools, number, before, seen, finding)
        if finding.touches and chain.settings.response is not None:
            finding = replace(finding, response=_response(chain, number, before, seen, finding))
        findings.append(finding)
    watch.lap("respond")
    shares = tools.shares_seen_at(seen.standing, seen.hull.views)
    findings = [
        _completed(chain, seen, number, finding, share)
        for number, (finding, share) in enumerate(zip(findings, shares, strict=True))
    ]
    watch.lap("patches")
    if tools.doubter is not None:
        doubts = tools.doubter.frame(seen.hull, chain.tracks.at(seen.index))
        findings = [
            replace(
                finding,
                doubt=doubts.doubt(
                    meter, finding.contact, finding.clearance, part.required_clearance_m
                ),
            )
            for finding, meter, part in zip(findings, seen.meters, chain.scene.objects, strict=True)
            if finding.clearance is not None
        ]
    watch.lap("doubt")
    return tuple(findings)


def _compared(
    chain: Chain, tools: _Tools, number: int, before: _Seen, seen: _Seen, finding: Finding
) -> Finding:
    """Return a finding with what the frame before adds to it."""
    seconds = seen.time_s - before.time_s
    if finding.clearance is not None:
        was, became = before.clearances[number], finding.clearance
        # A hull that comes from nowhere, as after a camera that saw nothing, has not approached.
        if np.isfinite(was.upper_m) and np.isfinite(became.upper_m):
            speed_m_s = approach_speed(signed_clearance(was), signed_clearance(became), seconds)
            finding = replace(finding, approach_m_s=speed_m_s)
    earlier = Finding(
        before.contacts[number], before.clearances[number] if before.clearances else None
    )
    if not finding.touches or earlier.clashes:
        return finding
    first = first_contact(
        before.hull,
        seen.hull,
        seen.standing.bodies[number],
        finding.contact,
        tools.certifier,
        tools.engine,
        _body_between(chain, number, before, seen),
    )
    return replace(
        finding,
        first_contact=first,
        first_contact_s=before.time_s + first.fraction * seconds,
        first_contact_uncertainty_s=first.fraction_uncertainty * seconds,
    )


def _body_between(
    chain: Chain, number: int, before: _Seen, seen: _Seen
) -> Callable[[float], Body] | None:
    """Return where an object is at a fraction of the way between two frames; None if it rests."""
    motion = chain.scene.objects[number].motion
    if motion is None or np.array_equal(motion.poses[before.index], motion.poses[seen.index]):
        return None
    return lambda fraction: body_at(
        chain, number, motion.between(before.index, seen.index, fraction)
    )


def _completed(
    chain: Chain, seen: _Seen, number: int, finding: Finding, share_seen: float
) -> Finding:
    """Return a finding with its verdict, its patches, and what moving the whole object does."""
    part, hull = seen.standing.objects[number], seen.hull
    required_m = part.required_clearance_m
    finding = judged(
        finding,
        is_closed=part.is_closed,
        required_m=required_m,
        share_seen=share_seen,
        rests_on=seen.rests_on,
        is_sound=seen.is_believed,
    )
    if finding.clearance is None:
        return finding
    meter = seen.meters[number]
    if finding.verdict in ("clash", "inside", "too near"):
        patches = contact_patches(
            hull,
            meter,
            finding.contact,
            required_m=required_m,
            reference_point_world=part.reference_point_world,
        )
        finding = replace(finding, patches=patches)
    if finding.response is not None and chain.settings.response is not None:
        response = finding.response
        reach_m = chain.settings.response.reach_m
        recovery = recover(hull, meter, response.v_rec, response.d_rec_m, reach_m)
        finding = replace(finding, recovery=recovery)
    return finding


def _response(
    chain: Chain, number: int, before: _Seen | None, seen: _Seen, finding: Finding
) -> Response:
    part = seen.standing.objects[number]
    begins_at = None
    if chain.settings.backtrack and finding.first_contact is not None and before is not None:
        begins_at = _carried(chain, number, before, seen, finding.first_contact)
    return respond(
        seen.hull,
        finding.contact,
        reference_point_world=part.reference_point_world,
        recovery_direction=part.recovery_direction,
        settings=chain.settings.response,
        cp_obj_world=begins_at,
    )


def _carried(
    chain: Chain, number: int, before: _Seen, seen: _Seen, first: FirstContact
) -> NDArray[np.float64]:
    """Return the point of the object that was touched first, (3,), where it is in the frame."""
    motion = chain.scene.objects[number].motion
    # Where the outline is lost, the point is one of this frame already.
    if motion is None or first.status == "outline lost":
        return first.point_world
    touched, now = (motion.between(before.index, seen.index, at) for at in (first.fraction, 1.0))
    return np.asarray(transform(compose(now, invert(touched)), first.point_world[None])[0])
