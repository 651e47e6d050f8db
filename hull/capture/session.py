"""What was recorded: session.toml, checked, with its files found.

A session names the cameras, where their pictures of the target, of the empty scene and of the
task lie, and how to cut objects out of them. Reading it opens every file it names once, so that a
mistake is told before any work starts. Frames themselves are read later, one at a time.
"""

import hashlib
import logging
import math
import statistics
from collections.abc import Collection
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import (
    TypeAdapter,
    ValidationError,
)

from hybridve.calib.errors import Faults, SessionError
from hybridve.calib.files import nearly
from hybridve.calib.image_io import FrameSource, in_step, open_source, significant_bits
from hybridve.hull.capture.segment import SegmentSettings
from hybridve.hull.capture.session_tables import (
    TARGETS,
    CameraTable,
    RigUnit,
    SessionTable,
    TargetTable,
    WorldPoint,
)
from hybridve.hull.toml_io import Roots, explain_validation, like, read_toml

_log = logging.getLogger(__name__)

#: A clock that is off a whole number of frames by less than this, in frames, is off by that number:
#: silhouettes between two pictures are known less well than that moves them.
_SAME_INSTANT = 0.02

#: Frames a second where nobody says; and two rates are the same up to this factor.
_NO_RATE, _SAME_RATE = 30.0, 1.01

#: Points whose triangle is flatter than this (sine of its angles) lie on a line.
_FLAT = 1e-3


@dataclass(frozen=True, slots=True)
class RigFile:
    """A calibration made elsewhere, as the session names it.

    Attributes
    ----------
    pattern : str
        A path below the root; ``{camera}`` stands for each camera's name.
    unit : str or None
        Unit of its lengths; None for a rig.json, which knows.
    pixel_centre : float or None
        Where the centre of the top-left pixel lies, 0 or 0.5; None: where its format has it.
    """

    pattern: str
    unit: RigUnit | None
    pixel_centre: float | None


@dataclass(frozen=True, slots=True)
class SessionCamera:
    """One camera of a session, its files found.

    Attributes
    ----------
    name, model : str
        The camera and its COLMAP model, or "auto".
    intrinsics, extrinsics, background : FrameSource or None
        Pictures of the target in this camera alone, of the target seen by all, of the empty scene.
    corners : Path or None
        Corners given by hand.
    recording : FrameSource or None
        The task: frames, or ready silhouettes if `has_masks`.
    has_masks : bool
        Whether `recording` holds silhouettes.
    shift_frames : int
    lag : float
        How many frames after the others this camera's clock started, whole ones and a share from 0
        up to 1: its frame k was recorded at the session's frame k + shift_frames + lag.
    lens : str or None
        Cameras with the same lens have the same intrinsics.
    params : tuple of float, or None
        Intrinsics that are known and stay as they are: COLMAP's order, pixel centre at 0.5. Known
        for one camera of a lens, they are known for all.
    poses, extrinsics_poses : Path or None
        Of a camera that moves, where its tracker was in `recording` and in `extrinsics`.
    """

    name: str
    model: str
    intrinsics: FrameSource | None
    extrinsics: FrameSource | None
    corners: Path | None
    background: FrameSource | None
    recording: FrameSource | None
    has_masks: bool
    shift_frames: int
    lag: float = 0.0
    lens: str | None = None
    params: tuple[float, ...] | None = None
    poses: Path | None = None
    extrinsics_poses: Path | None = None

    @property
    def nearest_shift(self) -> int:
        """The shift that takes a frame of the session to the nearest picture of this camera."""
        return self.shift_frames + (self.lag >= 0.5)


@dataclass(frozen=True, slots=True)
class Session:
    """One recorded session.

    Attributes
    ----------
    path : Path
        The session.toml.
    root : Path
        Where its relative paths start.
    fps : float
        Frames per second.
    unseen, min_cameras
        What a camera that cannot see a point says of it; see `hybridve.hull.query.silhouettes`.
    targets : tuple of TargetTable
        The boards, each with a name of its own.
    world : str
        What the world is: the board, named points, or the floor.
    points : tuple of WorldPoint
        What `world` is found from, unless it is the board.
    sync : str
        Whether the clocks of the board clips are as given, or estimated.
    rig_file : RigFile or None
        A calibration made elsewhere.
    rig_check : str
        Whether a rig that is used is tested against the boards that the cameras saw, and the
        cameras for having moved since: "on", or "off" where it is to be used whatever they say.
    mask_threshold : int or None
        Pixels of ready masks above so many 255ths of the full scale are object pixels; None to
        find it out from the masks.
    mask_channel : str or None
        Whether ready masks are in the grey levels or in the alpha channel; None to find it out.
    segmentation : SegmentSettings
        How objects are told from the background.
    cameras : tuple of SessionCamera
        At least one.
    checksum : str
        SHA-256 of the session.toml, for reports.
    """

    path: Path
    root: Path
    fps: float
    unseen: Literal["carve", "keep"]
    min_cameras: int
    targets: tuple[TargetTable, ...]
    world: Literal["board", "points", "floor"]
    points: tuple[WorldPoint, ...]
    sync: Literal["given", "estimate"]
    rig_file: RigFile | None
    rig_check: Literal["on", "off"]
    mask_threshold: int | None
    mask_channel: Literal["grey", "alpha"] | None
    segmentation: SegmentSettings
    cameras: tuple[SessionCamera, ...]
    checksum: str

    @property
    def target(self) -> TargetTable | None:
        """The first board, if there is one."""
        return self.targets[0] if self.targets else None

    def without(self, names: Collection[str]) -> "Session":
        """Return the session as if it had not these cameras.

        Raises
        ------
        SessionError
            If it has no camera of such a name, or none is left.
        """
        known = [camera.name for camera in self.cameras]
        for name in names:
            if name not in known:
                raise SessionError(
                    f"{self.path}: there is no camera {name!r} to leave out; it has "
                    f"{', '.join(known)}"
                )
        left = tuple(camera for camera in self.cameras if camera.name not in names)
        if not left:
            raise SessionError(f"{self.path}: without {', '.join(names)} no camera is left")
        return replace(self, cameras=left, min_cameras=min(self.min_cameras, len(left)))

    @property
    def folder(self) -> Path:
        """The folder of the session.toml, where rig/ and silhouettes.h5 are kept."""
        return self.path.parent

    @property
    def name(self) -> str:
        """What to call the session in tables."""
        return self.folder.name if self.path.name == "session.toml" else self.path.stem


def load_session(path: Path) -> Session:
    """Return the session that `path`, a session.toml or its folder, describes.

    Raises
    ------
    SessionError
        One line that names the key at fault: no such file, broken TOML, a wrong or missing key, an
        unknown value, a camera named twice; a line for each file that is missing or cannot be read.
    """
    if path.is_dir():
        path = path / "session.toml"
    table, text = read_toml(path, "session", SessionError)
    targets = _parse_targets(table.pop("target", []), path)
    try:
        parsed = SessionTable.model_validate(table)
    except ValidationError as error:
        raise SessionError(explain_validation(error, path, SessionTable)) from None

    names = [camera.name for camera in parsed.camera]
    for number, name in enumerate(names):
        if name in names[:number]:
            raise SessionError(
                f"{path}: camera.{number + 1}.name: {name!r} is the name of camera."
                f"{names.index(name) + 1} too; give each camera its own"
            )
    if parsed.rig_unit == "squares" and (not targets or targets[0].unit_m is None):
        raise SessionError(f"{path}: rig_unit: 'squares' needs a [target] with square_mm")
    shared_params = _check_lenses(parsed.camera, path)
    _check_points(parsed, names, path)
    roots = Roots.of(parsed.root, parsed.roots, path, SessionError)
    _refuse_rig_outside(parsed, roots, path)
    if parsed.min_cameras > len(names):
        raise SessionError(
            f"{path}: min_cameras: {parsed.min_cameras} of {len(names)} cameras cannot see a point"
        )
    faults = Faults()
    found = [
        _find_files(camera, number, shared_params, roots, path, faults)
        for number, camera in enumerate(parsed.camera, start=1)
    ]
    faults.refuse()
    cameras = _in_step(
        tuple(found),
        path,
        # A camera that began later counts from its own beginning.
        have_own_counters=any(camera.offset_s for camera in parsed.camera),
    )
    fps = _rate_of(parsed, cameras, path)
    cameras = tuple(
        _late(camera, table.offset_s * fps, path)
        for camera, table in zip(cameras, parsed.camera, strict=True)
    )
    rig_file = None
    if parsed.rig is not None:
        rig_file = RigFile(parsed.rig, parsed.rig_unit, parsed.rig_pixel_centre)
    return Session(
        path=path,
        root=roots.root,
        fps=fps,
        unseen=parsed.unseen,
        min_cameras=parsed.min_cameras,
        targets=targets,
        world=parsed.world,
        points=tuple(parsed.point),
        sync=parsed.sync,
        rig_file=rig_file,
        rig_check=parsed.rig_check,
        mask_threshold=parsed.mask_threshold,
        mask_channel=parsed.mask_channel,
        segmentation=_segment_settings(parsed.segmentation, path),
        cameras=cameras,
        checksum=hashlib.sha256(text).hexdigest(),
    )


def _refuse_rig_outside(parsed: SessionTable, roots: Roots, path: Path) -> None:
    """Refuse a rig that lies where the session says of no file that it may."""
    if parsed.rig is None:
        return
    files = [
        roots.root / parsed.rig.replace("{camera}", name)
        for name in [camera.name for camera in parsed.camera]
    ]
    files += [one for file in files if file.is_dir() for one in file.iterdir()]
    try:
        roots.refuse_outside(parsed.rig, files, SessionError)
    except SessionError as error:
        raise SessionError(f"{path}: rig: {error}") from error


def load_targets(path: Path) -> tuple[TargetTable, ...]:
    """Return the boards that a session.toml, or the one in a folder, describes; nothing else of it.

    Raises
    ------
    SessionError
        If it describes none, or not well.
    """
    if path.is_dir():
        path = path / "session.toml"
    table, _ = read_toml(path, "session", SessionError)
    targets = _parse_targets(table.get("target", []), path)
    if not targets:
        raise SessionError(
            f"{path}: target: this table is missing; describe the board (kind, columns, rows, ...)"
        )
    return targets


def _parse_targets(found: Any, path: Path) -> tuple[TargetTable, ...]:
    is_one = isinstance(found, dict)
    tables = [found] if is_one else found
    if not isinstance(tables, list) or not all(isinstance(table, dict) for table in tables):
        raise SessionError(f"{path}: target: expected a table, [target], or several, [[target]]")
    targets: list[TargetTable] = []
    for number, table in enumerate(tables, start=1):
        place = "target." if is_one else f"target.{number}."
        if "kind" not in table:
            raise SessionError(f"{path}: {place}kind: this key is missing")
        kind = table["kind"]
        if not isinstance(kind, str) or kind not in TARGETS:
            raise SessionError(f"{path}: {place}kind: one of {', '.join(TARGETS)}, found {kind!r}")
        named = {"name": "board" if number == 1 else f"board{number}", **table}
        try:
            target = TARGETS[kind].model_validate(named)
        except ValidationError as error:
            within = ("target",) if is_one else ("target", number - 1)
            raise SessionError(explain_validation(error, path, TARGETS[kind], within)) from None
        names = [other.name for other in targets]
        if target.name in names:
            raise SessionError(
                f"{path}: {place}name: {target.name!r} is the name of target."
                f"{names.index(target.name) + 1} too; give each board its own"
            )
        targets.append(target)
    return tuple(targets)


def _check_lenses(cameras: list[CameraTable], path: Path) -> dict[str, tuple[float, ...]]:
    """Return the known intrinsics of shared lenses; all cameras of one must agree."""
    known: dict[str, tuple[float, ...]] = {}
    first: dict[str, tuple[int, str]] = {}
    for number, camera in enumerate(cameras, start=1):
        if camera.lens is None:
            continue
        owner, model = first.setdefault(camera.lens, (number, camera.model))
        if camera.model != model:
            raise SessionError(
                f"{path}: camera.{number}.lens: {camera.lens!r} has model {camera.model} here, "
                f"{model} in camera.{owner}; cameras that share a lens share its model"
            )
        if camera.params is not None and known.setdefault(camera.lens, camera.params) != (
            camera.params
        ):
            raise SessionError(
                f"{path}: camera.{number}.params: differ from those that another camera gives for "
                f"the same lens, {camera.lens!r}"
            )
    return known


def _check_points(parsed: SessionTable, cameras: list[str], path: Path) -> None:
    names = [point.name for point in parsed.point]
    for number, point in enumerate(parsed.point, start=1):
        place = f"{path}: point.{number}"
        if point.name in names[: number - 1]:
            raise SessionError(
                f"{place}.name: {point.name!r} is the name of point."
                f"{names.index(point.name) + 1} too; give each point its own"
            )
        for camera in point.pixels:
            if camera not in cameras:
                raise SessionError(
                    f"{place}.pixels: there is no camera {camera!r}; one of {', '.join(cameras)}"
                )
    if parsed.world == "board":
        if parsed.point:
            raise SessionError(
                f"{path}: point: world = 'board' needs no points; say world = 'points' or 'floor'"
            )
        return
    key = "xyz_mm" if parsed.world == "points" else "floor = true"
    serving = [
        (number, point)
        for number, point in enumerate(parsed.point, start=1)
        if (point.xyz_mm is not None if parsed.world == "points" else point.floor)
    ]
    if len(serving) < 3:
        raise SessionError(
            f"{path}: world: {parsed.world!r} needs 3 or more [[point]] with {key}, found "
            f"{len(serving)}"
        )
    for number, point in serving:
        if len(point.pixels) < 2:
            raise SessionError(
                f"{path}: point.{number}.pixels: {point.name!r} is seen by {len(point.pixels)} "
                "camera; mark it in 2 or more"
            )
    if parsed.world == "points":
        xyz_mm = np.array([point.xyz_mm for _, point in serving])
        spread_mm = np.linalg.svd(xyz_mm - xyz_mm.mean(axis=0), compute_uv=False)
        if spread_mm[1] <= _FLAT * spread_mm[0]:
            raise SessionError(
                f"{path}: point: those with xyz_mm lie on a line, about which the world may turn; "
                "add one beside it"
            )


def _segment_settings(table: dict[str, Any], path: Path) -> SegmentSettings:
    known = [field.name for field in fields(SegmentSettings)]
    for key in table:
        if key not in known:
            raise SessionError(
                f"{path}: segmentation.{key}: there is no such key{like(key, known)}"
            )
    try:
        return TypeAdapter(SegmentSettings).validate_python(table)
    except ValidationError as error:
        raise SessionError(explain_validation(error, path, within=("segmentation",))) from None
    except ValueError as error:
        raise SessionError(f"{path}: segmentation: {error}") from None


def _in_step(
    cameras: tuple[SessionCamera, ...], path: Path, *, have_own_counters: bool
) -> tuple[SessionCamera, ...]:
    """Return the cameras with pictures of one instant in one frame, by the numbers in their names.

    What all cameras see at once is their recordings, and as a rule their views of the board.

    Raises
    ------
    SessionError
        If recordings lack pictures, and their numbers do not tell which.
    """

    def placed(
        sources: list[FrameSource | None], *, is_recording: bool
    ) -> list[FrameSource | None]:
        given = [source for source in sources if source is not None]
        groups = [[source] for source in given] if have_own_counters else [given]
        try:
            found = iter([one for group in groups for one in in_step(group)])
        except SessionError as error:
            if not is_recording:  # a camera that moves may have views of its own
                return sources
            raise SessionError(f"{path}: {error}") from error
        return [None if source is None else next(found) for source in sources]

    recordings = placed([camera.recording for camera in cameras], is_recording=True)
    views = placed([camera.extrinsics for camera in cameras], is_recording=False)
    return tuple(
        replace(camera, recording=recording, extrinsics=view)
        for camera, recording, view in zip(cameras, recordings, views, strict=True)
    )


def _rate_of(parsed: SessionTable, cameras: tuple[SessionCamera, ...], path: Path) -> float:
    """Return the frames a second of the recordings: as the session says, or their files.

    Raises
    ------
    SessionError
        If the files say that cameras differ: frames of one number are not of one instant then.
    """
    rates = {
        camera.name: rate
        for camera in cameras
        if camera.recording is not None and (rate := camera.recording.rate()) is not None
    }
    if rates:
        slowest, quickest = (pick(rates, key=lambda name: rates[name]) for pick in (min, max))
        if rates[quickest] > _SAME_RATE * rates[slowest]:
            raise SessionError(
                f"{path}: camera {slowest!r} recorded {rates[slowest]:g} frames a second, camera "
                f"{quickest!r} {rates[quickest]:g}, so that frames of one number are not of one "
                "instant; bring them to one rate first (ffmpeg -i IN -r RATE OUT)"
            )
    found = statistics.median(rates.values()) if rates else None
    if parsed.fps is None:
        if found is None and any(camera.recording is not None for camera in cameras):
            _log.warning(
                "%s: fps: this key is missing, and pictures do not say; times are told as if there "
                "were %g frames a second",
                path,
                _NO_RATE,
            )
        return found or _NO_RATE
    if found is not None and not parsed.fps / _SAME_RATE <= found <= _SAME_RATE * parsed.fps:
        _log.warning(
            "%s: fps: the session says %g, the videos %g; taken as the session says",
            path,
            parsed.fps,
            found,
        )
    return parsed.fps


def _as_stored(source: FrameSource | None) -> FrameSource | None:
    """Return masks as what their files hold; what that means is found from them."""
    return None if source is None else replace(source, is_raw=True)


def _late(camera: SessionCamera, by_frames: float, path: Path) -> SessionCamera:
    """Return a camera whose clock started so many frames after the others'."""
    nearest = round(by_frames)
    if abs(by_frames - nearest) < _SAME_INSTANT:
        return replace(camera, shift_frames=nearest)
    if camera.poses is not None:
        # What it saw between two frames it saw from a place between two.
        _log.warning(
            "%s: camera %r moves, and its offset_s is %.2f frames, not a whole number: taken as %d",
            path,
            camera.name,
            by_frames,
            nearest,
        )
        return replace(camera, shift_frames=nearest)
    whole = math.floor(by_frames)
    return replace(camera, shift_frames=whole, lag=by_frames - whole)


def _find_files(
    table: CameraTable,
    number: int,
    shared_params: dict[str, tuple[float, ...]],
    roots: Roots,
    path: Path,
    faults: Faults,
) -> SessionCamera:
    """Return a camera with its files; those that are missing are None, and told to `faults`."""
    root = roots.root

    def opened(key: str, name: str) -> FrameSource:
        try:
            roots.refuse_outside(name, [root / name], SessionError)
            source = open_source(root, name)
            roots.refuse_outside(name, source.paths, SessionError)
            return source
        except SessionError as error:
            raise SessionError(f"{path}: camera.{number}.{key}: {error}") from error

    def file_of(key: str, name: str) -> Path:
        file: Path = root / name
        try:
            roots.refuse_outside(name, [file], SessionError)
        except SessionError as error:
            raise SessionError(f"{path}: camera.{number}.{key}: {error}") from error
        if not file.is_file():
            raise SessionError(
                f"{path}: camera.{number}.{key}: there is no file {name!r} in {root}{nearly(file)}"
            )
        return file

    def find(key: str) -> FrameSource | None:
        name = getattr(table, key)
        return None if name is None else faults.of(lambda: opened(key, name))

    def find_file(key: str) -> Path | None:
        name = getattr(table, key)
        return None if name is None else faults.of(lambda: file_of(key, name))

    pictures = {key: find(key) for key in ("intrinsics", "extrinsics", "background", "video")}
    bits = significant_bits(source for source in pictures.values() if source is not None)
    intrinsics, extrinsics, background, video = (
        None if source is None else replace(source, bits=bits) for source in pictures.values()
    )
    return SessionCamera(
        name=table.name,
        model=table.model,
        intrinsics=intrinsics,
        extrinsics=extrinsics,
        corners=find_file("corners"),
        background=background,
        recording=video if table.masks is None else _as_stored(find("masks")),
        has_masks=table.masks is not None,
        shift_frames=0,  # until the rate is known
        lens=table.lens,
        params=table.params if table.lens is None else shared_params.get(table.lens),
        poses=find_file("poses"),
        extrinsics_poses=find_file("extrinsics_poses"),
    )
