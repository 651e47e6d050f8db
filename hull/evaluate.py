"""One recording through the whole chain: frames in, results out, written as they come.

::

    session -> silhouettes -+
    rig --------------------+-> Hull (one frame) -> contacts -> FrameResult -> report
    scene -> bodies --------+
"""

import time
from collections.abc import Callable, Generator, Iterator
from contextlib import closing, contextmanager, nullcontext
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.errors import SceneError, SessionError
from hybridve.calib.formats.rigs import rig_to_dict
from hybridve.calib.lens import Undistortion, undistortion
from hybridve.calib.lens_bound import lens_shift_px
from hybridve.calib.rig import Rig
from hybridve.hull.agreement.common_view import common_view
from hybridve.hull.agreement.frame import (
    DEFAULT_ERROR_PX,
    Agreement,
    disputes,
    judge_frame,
    stated_error_px,
)
from hybridve.hull.agreement.search import Pencils, make_pencils
from hybridve.hull.agreement.sight import sight_of
from hybridve.hull.cad.scene import Scene
from hybridve.hull.capture.recording import (
    FrameRange,
    FrameSilhouettes,
    check_lengths,
    check_recording,
    claimed_length,
    silhouettes_of,
    stored_silhouettes,
)
from hybridve.hull.capture.rig import load_rig, rig_digest
from hybridve.hull.capture.session import Session
from hybridve.hull.capture.silhouette_io import SilhouetteReader
from hybridve.hull.capture.tracks import Tracks, read_tracks
from hybridve.hull.contact.backtrack import approach_speed, first_contact
from hybridve.hull.contact.clearance import Clearance, ClearanceMeter
from hybridve.hull.contact.detect import (
    Body,
    Contact,
    certify_contacts,
    detect_contacts,
    make_body,
)
from hybridve.hull.contact.finding import Finding, agreed, judged, signed_clearance, widened
from hybridve.hull.contact.patches import contact_patches
from hybridve.hull.contact.recovery import recover
from hybridve.hull.contact.respond import Response, ResponseSettings, respond
from hybridve.hull.query.certify import Certifier
from hybridve.hull.query.engine import Engine
from hybridve.hull.query.silhouettes import (
    Hull,
    Seen,
    Views,
    make_hull,
    make_seen,
    make_views,
)
from hybridve.hull.report.collisions import StoredMesh
from hybridve.hull.report.schema import CameraFrame, FrameResult, Part, State

if TYPE_CHECKING:
    from hybridve.hull.contact.uncertainty import Doubter, DoubtSettings


@dataclass(frozen=True, slots=True)
class EvaluateSettings:
    """How a recording is evaluated; by default for contacts alone.

    Attributes
    ----------
    frames : FrameRange
        Which frames.
    viewport : int or None
        Samples along every triangle's edge.
    accuracy_m : float or None
        Or, instead, the largest spacing of samples along an edge: each triangle takes the smallest
        viewport that keeps it.
    open_at_m : float or None
        Verdicts are certified down to discs of this diameter; None leaves them as sampled.
    clearance_m : float or None
        How far apart the bounds of the clearance may be; None leaves it unmeasured.
    response : ResponseSettings or None
        How the way out of the hull is searched; None leaves it alone.
    backtrack : bool
        Whether that search begins at the point of first contact in the frame of first contact.
    doubt : DoubtSettings or None
        What is assumed of outlines; None, or no clearance, leaves everything undoubted.
    """

    frames: FrameRange = field(default_factory=FrameRange)
    viewport: int | None = 10
    accuracy_m: float | None = None
    open_at_m: float | None = 1e-4
    clearance_m: float | None = None
    response: ResponseSettings | None = None
    backtrack: bool = False
    doubt: "DoubtSettings | None" = None


@dataclass(frozen=True, slots=True, eq=False)
class Chain:
    """A session, its rig and a scene, made ready.

    Attributes
    ----------
    session, rig, scene
        What is evaluated.
    settings : EvaluateSettings
        How.
    undistortions : list of Undistortion
        Per camera of the session.
    views : Views
        The cameras' pinhole images; moving cameras where they are first tracked (see `views_at`).
    bodies : list of Body
        The scene's objects, laid into viewports.
    silhouettes : Path or None
        Where stored silhouettes stand that are those of this session; None to segment now.
    tracks : Tracks
        Where moving cameras were.
    """

    session: Session
    rig: Rig
    scene: Scene
    settings: EvaluateSettings
    undistortions: list[Undistortion]
    views: Views
    bodies: list[Body]
    silhouettes: Path | None
    tracks: Tracks = field(default_factory=Tracks)


def rig_views(session: Session, rig: Rig) -> tuple[Views, list[Undistortion]]:
    """Return the session's cameras as pinhole views, and how their images become so."""
    lenses = [undistortion(rig[camera.name]) for camera in session.cameras]
    seen = None
    if session.unseen == "keep":  # where a lens leaves a gap in the pinhole image, nobody looked
        names = tuple(camera.name for camera in session.cameras)
        seen = make_seen(names, _sizes_px(lenses), [lens.seen for lens in lenses])
    return _lens_views(session, rig, lenses, seen=seen), lenses


def moved_views(
    session: Session, rig: Rig, tracks: Tracks, index: int, first: Views, lenses: list[Undistortion]
) -> Views:
    """Return the views of one frame, about the origin of the first.

    Parameters
    ----------
    session, rig
        Whose cameras.
    tracks : Tracks
        Where the moving ones were; in this frame none is missing.
    index : int
        Number of the frame.
    first, lenses
        What `rig_views` gave. Where no camera moves, `first` is returned.
    """
    if not tracks:
        return first
    return _lens_views(session, rig.at(tracks.at(index)), lenses, first.origin_world, first.seen)


def _lens_views(
    session: Session,
    rig: Rig,
    lenses: list[Undistortion],
    origin_world: NDArray[np.float64] | None = None,
    seen: Seen | None = None,
) -> Views:
    cameras = [rig[camera.name] for camera in session.cameras]
    return make_views(
        tuple(camera.name for camera in cameras),
        _sizes_px(lenses),
        np.array(
            [
                lens.img_from_cam @ camera.cam_from_world
                for lens, camera in zip(lenses, cameras, strict=True)
            ]
        ),
        session.unseen,
        session.min_cameras,
        origin_world,
        seen,
    )


def _sizes_px(lenses: list[Undistortion]) -> NDArray[np.int64]:
    """Return the sizes (C, 2) of the cameras' pinhole images: width, height."""
    return np.array([(lens.width_px, lens.height_px) for lens in lenses], np.int64)


def make_chain(
    session: Session,
    scene: Scene,
    settings: EvaluateSettings,
    progress: Callable[[str, int, int], None] | None = None,
) -> Chain:
    """Return everything that is the same for all frames.

    `progress` is told ``(what, done, total)`` while a rig that was not tested yet is tested.

    Raises
    ------
    HybridveError
        If recordings, rig and scene do not fit together.
    """
    rig = load_rig(session, progress)
    tracks = read_tracks(session, rig)
    silhouettes = stored_silhouettes(session, rig_digest(rig))
    if silhouettes is None:
        check_recording(session)
        check_lengths(session, settings.frames)
    views, undistortions = rig_views(session, first_rig(rig, tracks))
    if not tracks and (seen := common_view(views)).kind == "none":
        raise SessionError(f"{session.path}: nothing can be in the hull: {seen.reason}")
    bodies = []
    for scene_object in scene.objects:
        try:
            bodies.append(
                make_body(scene_object, viewport=settings.viewport, accuracy_m=settings.accuracy_m)
            )
        except ValueError as error:
            raise SceneError(
                f"{scene.path}: object {scene_object.name!r}: {error}; ask for less accuracy, or "
                "refine the mesh"
            ) from error
    return Chain(session, rig, scene, settings, undistortions, views, bodies, silhouettes, tracks)


def first_rig(rig: Rig, tracks: Tracks) -> Rig:
    """Return the rig with moving cameras where they are first tracked all together."""
    return rig if tracks.first is None else rig.at(tracks.at(tracks.first))


def views_at(chain: Chain, index: int) -> Views:
    """Return the views of a frame in which no tracked pose is missing.

    They keep the local origin of all others. Where no camera moves, they are the same object.
    """
    return moved_views(
        chain.session, chain.rig, chain.tracks, index, chain.views, chain.undistortions
    )


def evaluate(
    chain: Chain,
    engine: Engine,
    *,
    skip: int = 0,
    write_s: Callable[[], float] = lambda: 0.0,
    progress: Callable[[str, int, int], None] | None = None,
) -> Generator[FrameResult]:
    """Yield the result of every frame; to be closed where it is left before its end.

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

    Raises
    ------
    SessionError
        If the recording has none of the frames asked for.
    """
    row = first = max(skip - 1, 0)
    before: _Seen | None = None
    with (
        _Tools.of(chain, engine) as tools,
        closing(_silhouettes(chain, first, progress)) as frames,
    ):
        for silhouettes in frames:
            watch = _Stopwatch(decode=silhouettes.decode_s, segment=silhouettes.segment_s)
            seen = _look(chain, tools, silhouettes, watch)
            state: State = "unread" if seen is None else "evaluated"
            reason = silhouettes.reason
            if seen is not None and seen.agreement.is_contradictory:
                state, reason = "contradictory", seen.agreement.reason
            if row >= skip:
                findings: tuple[Finding, ...] = ()
                if seen is not None and state == "evaluated":
                    findings = _findings(chain, tools, before, seen, watch)
                watch.stage_s["write"] = write_s()
                yield FrameResult(
                    index=silhouettes.index,
                    time_s=silhouettes.index / chain.session.fps,
                    reason=reason,
                    findings=findings,
                    stage_s=watch.stage_s,
                    state=state,
                    rests_on=seen.agreement.reason if seen and state == "evaluated" else "",
                    cameras=() if seen is None else seen.cameras,
                )
            is_known = seen is not None and seen.agreement.is_believed
            before = seen if is_known else None
            row += 1
    if row == 0:
        raise SessionError(
            f"{chain.session.path}: the recording has none of the frames "
            f"{chain.settings.frames}; it may be empty or shorter"
        )


class _Stopwatch:
    """Seconds by stage."""

    def __init__(self, **stage_s: float) -> None:
        self.stage_s = stage_s
        self._last = time.perf_counter()

    def lap(self, stage: str) -> None:
        """Count the time since the last lap to a stage."""
        now = time.perf_counter()
        self.stage_s[stage] = self.stage_s.get(stage, 0.0) + now - self._last
        self._last = now


@dataclass(frozen=True, slots=True, eq=False)
class _Tools:
    """What is kept from frame to frame. No result depends on what was asked of it before."""

    engine: Engine
    certifier: Certifier | None
    meters: list[ClearanceMeter]
    doubter: "Doubter | None"
    error_px: NDArray[np.int64]
    pencils: Pencils | None
    share_seen: list[float]

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
        error_px = np.full(len(chain.views), DEFAULT_ERROR_PX)
        if doubter is not None:
            error_px = stated_error_px(doubter.errors.sigma_px)
        is_still = not chain.tracks
        pencils = make_pencils(chain.views) if is_still else None
        shares = _shares_seen(chain, chain.views) if is_still else []
        with Certifier(settings.open_at_m) if settings.open_at_m else nullcontext() as certifier:
            yield cls(engine, certifier, meters, doubter, error_px, pencils, shares)


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """One frame by itself."""

    index: int
    time_s: float
    hull: Hull
    agreement: Agreement
    cameras: tuple[CameraFrame, ...]
    contacts: list[Contact]
    clearances: list[Clearance]


def _shares_seen(chain: Chain, views: Views) -> list[float]:
    """Return the share of each object's surface that enough cameras see; 0 if that is proved."""
    shares = []
    for part in chain.scene.objects:
        sight = sight_of(views, part.vertices_world, part.faces)
        least = 0.0 if sight.is_not_seen else float(np.finfo(np.float64).tiny)
        shares.append(1.0 if sight.is_seen else max(sight.share, least))
    return shares


def _look(
    chain: Chain, tools: _Tools, silhouettes: FrameSilhouettes, watch: _Stopwatch
) -> _Seen | None:
    """Return what one frame says by itself, without those before; None if it cannot be read."""
    if silhouettes.masks is None:
        return None
    hull = make_hull(views_at(chain, silhouettes.index), silhouettes.masks)
    time_s = silhouettes.index / chain.session.fps
    pencils = make_pencils(hull.views) if tools.pencils is None else tools.pencils
    agreement = judge_frame(hull, tools.error_px, pencils)
    denied_px = {one.camera: one.area_px for one in disputes(hull, tools.error_px, pencils)}
    cameras = tuple(
        CameraFrame(share, denied_px.get(name, 0))
        for name, share in zip(hull.views.names, hull.object_shares().tolist(), strict=True)
    )
    watch.lap("agree")
    if agreement.is_contradictory:
        return _Seen(silhouettes.index, time_s, hull, agreement, cameras, [], [])
    contacts = detect_contacts(hull, chain.bodies, tools.engine)
    watch.lap("query")
    if tools.certifier is not None:
        contacts = certify_contacts(hull, chain.bodies, contacts, tools.certifier)
    watch.lap("certify")
    clearances = [meter.measure(hull) for meter in tools.meters]
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
    return _Seen(silhouettes.index, time_s, hull, agreement, cameras, contacts, clearances)


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
            finding = replace(finding, response=_response(chain, number, seen.hull, finding))
        findings.append(finding)
    watch.lap("respond")
    shares = tools.share_seen or _shares_seen(chain, seen.hull.views)
    findings = [
        _completed(chain, tools, seen, number, finding, share)
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
            for finding, meter, part in zip(
                findings, tools.meters, chain.scene.objects, strict=True
            )
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
        chain.bodies[number],
        finding.contact,
        tools.certifier,
        tools.engine,
    )
    return replace(
        finding,
        first_contact=first,
        first_contact_s=before.time_s + first.fraction * seconds,
        first_contact_uncertainty_s=first.fraction_uncertainty * seconds,
    )


def _completed(
    chain: Chain, tools: _Tools, seen: _Seen, number: int, finding: Finding, share_seen: float
) -> Finding:
    """Return a finding with its verdict, its patches, and what moving the whole object does."""
    part, hull = chain.scene.objects[number], seen.hull
    required_m = part.required_clearance_m
    finding = judged(
        finding,
        is_closed=part.is_closed,
        required_m=required_m,
        share_seen=share_seen,
        rests_on=seen.agreement.reason,
        is_sound=seen.agreement.is_believed,
    )
    if finding.clearance is None:
        return finding
    meter = tools.meters[number]
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


def _response(chain: Chain, number: int, hull: Hull, finding: Finding) -> Response:
    part = chain.scene.objects[number]
    begins_at = None
    if chain.settings.backtrack and finding.first_contact is not None:
        begins_at = finding.first_contact.point_world
    return respond(
        hull,
        finding.contact,
        reference_point_world=part.reference_point_world,
        recovery_direction=part.recovery_direction,
        settings=chain.settings.response,
        cp_obj_world=begins_at,
    )


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


def count_frames(chain: Chain) -> int:
    """Return how many frames there are to evaluate; where videos tell it only roughly, roughly."""
    frames = chain.settings.frames
    if chain.silhouettes is not None:
        with SilhouetteReader(chain.silhouettes) as reader:
            length = reader.n_frames
    else:
        length = claimed_length(chain.session)
    stop = length if frames.stop is None else min(length, frames.stop)
    return len(range(frames.start, max(stop, frames.start), frames.step))


def resolved_settings(chain: Chain) -> dict[str, Any]:
    """Return all that decides the result of an evaluation, as plain JSON values."""
    session = chain.session
    return {
        "session": str(session.path),
        "session_sha256": session.checksum,
        "scene": str(chain.scene.path),
        "scene_sha256": chain.scene.checksum,
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
        "rig_check": session.rig_check,
        "segmentation": asdict(session.segmentation),
        "silhouettes": None if chain.silhouettes is None else str(chain.silhouettes),
        "local_origin_m": list(local_origin_m(chain)),
        "query_origin_m": chain.views.origin_world.tolist(),
        **({"poses_sha256": dict(chain.tracks.sha256)} if chain.tracks else {}),
    }


def about_rig(chain: Chain) -> dict[str, Any]:
    """Return the rig as in rig.json, and how far undistorting can shift each silhouette.

    ``mask_shift_px`` is the bound of `hybridve.calib.lens_bound` in recorded pixels; None for a
    camera that the session does not use, or of which no bound is known.
    """
    shift_px = _mask_shift_px(chain)
    about = rig_to_dict(chain.rig)
    for entry in about["cameras"]:
        entry["mask_shift_px"] = shift_px.get(entry["name"])
    return about


def make_doubter(chain: Chain) -> "Doubter | None":
    """Return what doubts the clearances of a recording; None where nothing is to be doubted."""
    if chain.settings.doubt is None:
        return None
    # Late: it brings scipy's optimisers, for which a picture or a sweep need not wait.
    from hybridve.hull.contact.uncertainty import Doubter, outline_errors

    names, shift_px = chain.views.names, _mask_shift_px(chain)
    errors = outline_errors(
        names,
        chain.rig,
        [shift_px[name] for name in names],
        chain.settings.doubt,
    )
    return Doubter(errors, chain.settings.doubt)


def _mask_shift_px(chain: Chain) -> dict[str, float | None]:
    shift_px = {
        camera.name: lens_shift_px(chain.rig[camera.name], lens)
        for camera, lens in zip(chain.session.cameras, chain.undistortions, strict=True)
    }
    return {name: shift if np.isfinite(shift) else None for name, shift in shift_px.items()}


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
    """Return the objects' meshes as the report holds them."""
    meshes = []
    for part, body in zip(chain.scene.objects, chain.bodies, strict=True):
        placement = part.world_from_mesh.copy()
        placement[:, 3] -= local_origin_m(chain)
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


def _silhouettes(
    chain: Chain, skip: int, progress: Callable[[str, int, int], None] | None
) -> Generator[FrameSilhouettes]:
    frames = chain.settings.frames
    start = frames.start + skip * frames.step
    if frames.stop is not None and start >= frames.stop:
        return
    rest = FrameRange(start, frames.stop, frames.step)
    yield from silhouettes_of(
        chain.session,
        chain.silhouettes,
        rest,
        tracks=chain.tracks,
        undistortions=chain.undistortions,
        progress=progress,
    )
