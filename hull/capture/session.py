"""What was recorded: session.toml, checked, with its files found.

A session names the cameras, where their pictures of the target, of the empty scene and of the
task lie, and how to cut objects out of them. Reading it opens every file it names once, so that a
mistake is told before any work starts. Frames themselves are read later, one at a time.
"""

import hashlib
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    TypeAdapter,
    ValidationError,
    field_validator,
    model_validator,
)

from hybridve.calib.camera import N_PARAMS
from hybridve.calib.errors import SessionError
from hybridve.calib.image_io import FrameSource, open_source
from hybridve.hull.capture.segment import SegmentSettings
from hybridve.hull.toml_io import expand_root, explain_validation, read_toml

#: What lengths of a rig calibrated elsewhere may be in; squares are those of the target.
RigUnit = Literal["m", "cm", "mm", "in", "ft", "squares"]

_NAME = r"^[^/\s\"']+$"


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class TargetTable(_Table):
    """The board, as ``[target]`` describes it."""

    kind: Literal["chessboard"]
    columns: Annotated[int, Field(ge=2)]
    rows: Annotated[int, Field(ge=2)]
    square_mm: Annotated[float, Field(gt=0)]


class _CameraTable(_Table):
    name: Annotated[str, Field(pattern=_NAME)]
    model: str = "OPENCV"
    intrinsics: str | None = None
    extrinsics: str | None = None
    corners: str | None = None
    background: str | None = None
    video: str | None = None
    masks: str | None = None
    offset_s: float = 0.0

    @model_validator(mode="after")
    def _one_recording(self) -> "_CameraTable":
        if self.model not in N_PARAMS:
            raise ValueError(f"unknown camera model {self.model!r}; one of {', '.join(N_PARAMS)}")
        if self.video is not None and self.masks is not None:
            raise ValueError("has both video and masks; name the one to be used")
        if self.video is not None and self.background is None:
            raise ValueError("has a video but no background; name a recording of the empty scene")
        return self


class _SessionTable(_Table):
    format: Literal["hybridve-session"]
    version: Literal[1]
    root: str = "."
    fps: Annotated[float, Field(gt=0)] = 30.0
    world: Literal["board"] = "board"
    unseen: Literal["carve", "keep"] = "carve"
    min_cameras: Annotated[int, Field(ge=1)] = 1
    rig: str | None = None
    rig_unit: RigUnit | None = None
    rig_pixel_centre: float = 0.5
    target: TargetTable | None = None
    mask_threshold: Annotated[int, Field(ge=0, le=254)] = 127
    segmentation: dict[str, Any] = {}
    camera: Annotated[list[_CameraTable], Field(min_length=1)]

    @field_validator("rig_pixel_centre")
    @classmethod
    def _is_a_convention(cls, centre: float) -> float:
        if centre not in (0.0, 0.5):
            raise ValueError(f"found {centre}; expected 0.5 (COLMAP) or 0 (OpenCV)")
        return centre

    @model_validator(mode="after")
    def _rig_has_unit(self) -> "_SessionTable":
        if self.rig is not None and self.rig_unit is None and not self.rig.endswith("rig.json"):
            raise ValueError("rig needs rig_unit (m, cm, mm, in, ft or squares): never guessed")
        if self.rig_unit == "squares" and self.target is None:
            raise ValueError("rig_unit = 'squares' needs a [target] with square_mm")
        return self


@dataclass(frozen=True, slots=True)
class RigFile:
    """A calibration made elsewhere, as the session names it.

    Attributes
    ----------
    pattern : str
        A path below the root; ``{camera}`` stands for each camera's name.
    unit : str or None
        Unit of its lengths; None for a rig.json, which knows.
    pixel_centre : float
        Where the centre of the top-left pixel lies, 0 or 0.5.
    """

    pattern: str
    unit: RigUnit | None
    pixel_centre: float


@dataclass(frozen=True, slots=True)
class SessionCamera:
    """One camera of a session, its files found.

    Attributes
    ----------
    name, model : str
        The camera and its COLMAP model.
    intrinsics, extrinsics, background : FrameSource or None
        Pictures of the target in this camera alone, of the target seen by all, of the empty scene.
    corners : Path or None
        Corners given by hand for `extrinsics`.
    recording : FrameSource or None
        The task: frames, or ready silhouettes if `has_masks`.
    has_masks : bool
        Whether `recording` holds silhouettes.
    shift_frames : int
        How many frames after the others this camera's clock started: its frame k was recorded at
        the session's frame k + shift_frames.
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
    target : TargetTable or None
        The board.
    rig_file : RigFile or None
        A calibration made elsewhere.
    mask_threshold : int
        Pixels of ready masks above it are object pixels.
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
    target: TargetTable | None
    rig_file: RigFile | None
    mask_threshold: int
    segmentation: SegmentSettings
    cameras: tuple[SessionCamera, ...]
    checksum: str

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
        unknown value, a camera named twice, a file that is missing or cannot be read.
    """
    if path.is_dir():
        path = path / "session.toml"
    table, text = read_toml(path, "session", SessionError)
    parsed = _parse(_SessionTable, table, path)

    names = [camera.name for camera in parsed.camera]
    for number, name in enumerate(names):
        if name in names[:number]:
            raise SessionError(
                f"{path}: camera.{number + 1}.name: {name!r} is the name of camera."
                f"{names.index(name) + 1} too; give each camera its own"
            )
    root = expand_root(parsed.root, path, SessionError)
    if parsed.min_cameras > len(names):
        raise SessionError(
            f"{path}: min_cameras: {parsed.min_cameras} of {len(names)} cameras cannot see a point"
        )
    rig_file = None
    if parsed.rig is not None:
        rig_file = RigFile(parsed.rig, parsed.rig_unit, parsed.rig_pixel_centre)
    return Session(
        path=path,
        root=root,
        fps=parsed.fps,
        unseen=parsed.unseen,
        min_cameras=parsed.min_cameras,
        target=parsed.target,
        rig_file=rig_file,
        mask_threshold=parsed.mask_threshold,
        segmentation=_segment_settings(parsed.segmentation, path),
        cameras=tuple(
            _find_files(camera, number, root, parsed.fps, path)
            for number, camera in enumerate(parsed.camera, start=1)
        ),
        checksum=hashlib.sha256(text).hexdigest(),
    )


def _parse(model: type[_SessionTable], table: dict[str, Any], path: Path) -> _SessionTable:
    for number, camera in enumerate(table.get("camera", []), start=1):
        if isinstance(camera, dict) and "poses" in camera:
            raise SessionError(
                f"{path}: camera.{number}.poses: moving, tracked cameras are not supported by this "
                "version; leave the camera out"
            )
    try:
        return model.model_validate(table)
    except ValidationError as error:
        raise SessionError(explain_validation(error, path)) from None


def _segment_settings(table: dict[str, Any], path: Path) -> SegmentSettings:
    known = [field.name for field in fields(SegmentSettings)]
    for key in table:
        if key not in known:
            raise SessionError(
                f"{path}: segmentation.{key}: there is no such key; one of {', '.join(known)}"
            )
    try:
        return TypeAdapter(SegmentSettings).validate_python(table)
    except ValidationError as error:
        raise SessionError(
            explain_validation(error, path).replace(f"{path}: ", f"{path}: segmentation.", 1)
        ) from None
    except ValueError as error:
        raise SessionError(f"{path}: segmentation: {error}") from None


def _find_files(
    table: _CameraTable, number: int, root: Path, fps: float, path: Path
) -> SessionCamera:
    def find(key: str) -> FrameSource | None:
        name = getattr(table, key)
        if name is None:
            return None
        try:
            return open_source(root, name)
        except SessionError as error:
            raise SessionError(f"{path}: camera.{number}.{key}: {error}") from error

    corners = None
    if table.corners is not None:
        corners = root / table.corners
        if not corners.is_file():
            raise SessionError(
                f"{path}: camera.{number}.corners: there is no file {table.corners!r} in {root}"
            )
    return SessionCamera(
        name=table.name,
        model=table.model,
        intrinsics=find("intrinsics"),
        extrinsics=find("extrinsics"),
        corners=corners,
        background=find("background"),
        recording=find("masks") if table.masks is not None else find("video"),
        has_masks=table.masks is not None,
        shift_frames=round(table.offset_s * fps),
    )
