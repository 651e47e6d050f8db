"""What was recorded: session.toml, checked, with its files found.

A session names the cameras, where their pictures of the target, of the empty scene and of the
task lie, and how to cut objects out of them. Reading it opens every file it names once, so that a
mistake is told before any work starts. Frames themselves are read later, one at a time.
"""

import hashlib
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import numpy as np
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

#: How many degrees of freedom a lens has is found out from the pictures.
AUTO_MODEL = "auto"

_NAME = r"^[^/\s\"']+$"

#: Points whose triangle is flatter than this (sine of its angles) lie on a line.
_FLAT = 1e-3

_Millimetres = Annotated[float, Field(gt=0, allow_inf_nan=False)]
_Number = Annotated[float, Field(allow_inf_nan=False)]


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class TargetTable(_Table):
    """A board, as ``[target]`` describes it; what holds for every kind.

    Attributes
    ----------
    kind, columns, rows
        What is printed, and how often; what is counted depends on the kind.
    name : str
        Unique within the session.
    body : str or None
        Boards of one body keep their places on it; None for a board by itself.
    """

    kind: str
    name: Annotated[str, Field(pattern=_NAME)]
    body: Annotated[str, Field(pattern=_NAME)] | None = None
    columns: Annotated[int, Field(ge=1)]
    rows: Annotated[int, Field(ge=1)]

    @property
    def unit_m(self) -> float | None:
        """The side of a square along x in metres, the unit of lengths "in squares"; or None."""
        return None

    def table(self) -> dict[str, Any]:
        """Return what was said of the board, for `hybridve.calib.boards.named.make_board`."""
        return self.model_dump(exclude_none=True)


class _SquaresTable(TargetTable):
    columns: Annotated[int, Field(ge=2)]
    rows: Annotated[int, Field(ge=2)]
    square_mm: _Millimetres | tuple[_Millimetres, _Millimetres]

    @field_validator("square_mm", mode="before")
    @classmethod
    def _one_or_two_sides(cls, square: Any) -> Any:
        # Said here, because a union's own complaint names each of its members.
        sides = square if isinstance(square, list | tuple) else (square,)
        is_length = [type(side) in (int, float) and 0 < side < np.inf for side in sides]
        if len(sides) != (1 if sides is not square else 2) or not all(is_length):
            raise ValueError(
                f"found {square!r}; expected a length above 0, or two: [along x, along y]"
            )
        return square

    @property
    def sides_mm(self) -> tuple[float, float]:
        """The sides of a square along x and y."""
        square = self.square_mm
        return square if isinstance(square, tuple) else (square, square)

    @property
    def unit_m(self) -> float | None:
        """The side of a square along x in metres."""
        return self.sides_mm[0] / 1000.0


class ChessboardTable(_SquaresTable):
    """A chessboard, counted by its inner corners."""

    kind: Literal["chessboard"]


class CharucoTable(_SquaresTable):
    """A chessboard with markers in its white squares, counted by its squares."""

    kind: Literal["charuco"]
    marker_mm: _Millimetres
    dictionary: str = "DICT_4X4_1000"
    legacy: bool | None = None
    first_id: Annotated[int, Field(ge=0)] = 0

    @field_validator("dictionary")
    @classmethod
    def _is_a_dictionary(cls, name: str) -> str:
        return _check_dictionary(name)

    @model_validator(mode="after")
    def _marker_fits(self) -> "CharucoTable":
        if self.marker_mm >= min(self.sides_mm):
            raise ValueError(
                f"marker_mm: {self.marker_mm:g} mm is not less than the square, "
                f"{min(self.sides_mm):g} mm"
            )
        return self


class AprilGridTable(TargetTable):
    """A grid of AprilTags, counted by its tags."""

    kind: Literal["aprilgrid"]
    tag_mm: _Millimetres
    gap_mm: _Millimetres | None = None
    tag_spacing: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = None
    dictionary: str = "DICT_APRILTAG_36h11"
    first_id: Annotated[int, Field(ge=0)] = 0

    @field_validator("dictionary")
    @classmethod
    def _is_a_dictionary(cls, name: str) -> str:
        return _check_dictionary(name)

    @model_validator(mode="after")
    def _one_gap(self) -> "AprilGridTable":
        if (self.gap_mm is None) == (self.tag_spacing is None):
            raise ValueError(
                "gap_mm: give the gap between tags, either as gap_mm or as tag_spacing (gap / tag)"
            )
        return self

    def table(self) -> dict[str, Any]:
        """Return what was said of the board, the gap in millimetres."""
        said = super().table()
        spacing = said.pop("tag_spacing", None)
        if spacing is not None:
            said["gap_mm"] = self.tag_mm * spacing
        return said


_TARGETS: dict[str, type[ChessboardTable | CharucoTable | AprilGridTable]] = {
    "chessboard": ChessboardTable,
    "charuco": CharucoTable,
    "aprilgrid": AprilGridTable,
}


def _check_dictionary(name: str) -> str:
    known = sorted(key for key in dir(cv2.aruco) if key.startswith("DICT_"))
    if name not in known:
        raise ValueError(f"unknown dictionary {name!r}; one of {', '.join(known)}")
    return name


class WorldPoint(_Table):
    """A point that says where the world is, as ``[[point]]`` describes it.

    Attributes
    ----------
    name : str
        Unique within the session.
    xyz_mm : (x, y, z) or None
        Where it is in the world, in millimetres.
    floor : bool
        Whether it lies on the floor.
    pixels : dict of str to (x, y)
        By camera where it is seen, pixel centre at 0.5.
    """

    name: Annotated[str, Field(min_length=1)]
    xyz_mm: tuple[_Number, _Number, _Number] | None = None
    floor: bool = False
    pixels: Annotated[dict[str, tuple[_Number, _Number]], Field(min_length=1)]


class _CameraTable(_Table):
    name: Annotated[str, Field(pattern=_NAME)]
    model: str = "OPENCV"
    intrinsics: str | None = None
    extrinsics: str | None = None
    corners: str | None = None
    background: str | None = None
    video: str | None = None
    masks: str | None = None
    poses: str | None = None
    extrinsics_poses: str | None = None
    lens: Annotated[str, Field(min_length=1)] | None = None
    params: tuple[_Number, ...] | None = None
    offset_s: float = 0.0

    @model_validator(mode="after")
    def _lens_is_known(self) -> "_CameraTable":
        if self.model != AUTO_MODEL and self.model not in N_PARAMS:
            raise ValueError(
                f"unknown camera model {self.model!r}; one of {AUTO_MODEL}, {', '.join(N_PARAMS)}"
            )
        if self.params is not None:
            if self.model == AUTO_MODEL:
                raise ValueError("params: are those of which model? name it (model)")
            expected = N_PARAMS[self.model]
            if len(self.params) != expected:
                raise ValueError(
                    f"params: {len(self.params)} numbers, expected {expected} for {self.model}"
                )
            if self.params[0] <= 0:
                raise ValueError(
                    f"params: a focal length of {self.params[0]:g} px; expected more than 0"
                )
        return self

    @model_validator(mode="after")
    def _moves_with_masks(self) -> "_CameraTable":
        if self.extrinsics_poses is not None and self.extrinsics is None:
            raise ValueError("extrinsics_poses: there are no extrinsics of which these are poses")
        if (self.poses or self.extrinsics_poses) and self.video is not None:
            raise ValueError(
                "video: a camera that moves has no background to cut objects from; give masks"
            )
        if self.poses is not None and self.masks is None:
            raise ValueError("poses: there are no masks of which these are poses")
        if self.extrinsics_poses is not None and self.masks is not None and self.poses is None:
            raise ValueError(
                "extrinsics_poses: the camera moves in the board clip; give the poses of its "
                "masks too (poses)"
            )
        return self

    @model_validator(mode="after")
    def _one_recording(self) -> "_CameraTable":
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
    world: Literal["board", "points", "floor"] = "board"
    sync: Literal["given", "estimate"] = "given"
    unseen: Literal["carve", "keep"] = "carve"
    min_cameras: Annotated[int, Field(ge=1)] = 1
    rig: str | None = None
    rig_unit: RigUnit | None = None
    rig_pixel_centre: float = 0.5
    rig_check: Literal["on", "off"] = "on"
    point: list[WorldPoint] = []
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
        How many frames after the others this camera's clock started: its frame k was recorded at
        the session's frame k + shift_frames.
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
    lens: str | None = None
    params: tuple[float, ...] | None = None
    poses: Path | None = None
    extrinsics_poses: Path | None = None


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
        Whether a rig that is used is tested against the boards that the cameras saw: "on", or
        "off" where it is to be used whatever they say.
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
    targets: tuple[TargetTable, ...]
    world: Literal["board", "points", "floor"]
    points: tuple[WorldPoint, ...]
    sync: Literal["given", "estimate"]
    rig_file: RigFile | None
    rig_check: Literal["on", "off"]
    mask_threshold: int
    segmentation: SegmentSettings
    cameras: tuple[SessionCamera, ...]
    checksum: str

    @property
    def target(self) -> TargetTable | None:
        """The first board, if there is one."""
        return self.targets[0] if self.targets else None

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
    targets = _parse_targets(table.pop("target", []), path)
    try:
        parsed = _SessionTable.model_validate(table)
    except ValidationError as error:
        raise SessionError(explain_validation(error, path)) from None

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
        targets=targets,
        world=parsed.world,
        points=tuple(parsed.point),
        sync=parsed.sync,
        rig_file=rig_file,
        rig_check=parsed.rig_check,
        mask_threshold=parsed.mask_threshold,
        segmentation=_segment_settings(parsed.segmentation, path),
        cameras=tuple(
            _find_files(camera, number, shared_params, root, parsed.fps, path)
            for number, camera in enumerate(parsed.camera, start=1)
        ),
        checksum=hashlib.sha256(text).hexdigest(),
    )


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
        if not isinstance(kind, str) or kind not in _TARGETS:
            raise SessionError(f"{path}: {place}kind: one of {', '.join(_TARGETS)}, found {kind!r}")
        named = {"name": "board" if number == 1 else f"board{number}", **table}
        try:
            target = _TARGETS[kind].model_validate(named)
        except ValidationError as error:
            message = explain_validation(error, path)
            raise SessionError(message.replace(f"{path}: ", f"{path}: {place}", 1)) from None
        names = [other.name for other in targets]
        if target.name in names:
            raise SessionError(
                f"{path}: {place}name: {target.name!r} is the name of target."
                f"{names.index(target.name) + 1} too; give each board its own"
            )
        targets.append(target)
    return tuple(targets)


def _check_lenses(cameras: list[_CameraTable], path: Path) -> dict[str, tuple[float, ...]]:
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


def _check_points(parsed: _SessionTable, cameras: list[str], path: Path) -> None:
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
    table: _CameraTable,
    number: int,
    shared_params: dict[str, tuple[float, ...]],
    root: Path,
    fps: float,
    path: Path,
) -> SessionCamera:
    def find(key: str) -> FrameSource | None:
        name = getattr(table, key)
        if name is None:
            return None
        try:
            return open_source(root, name)
        except SessionError as error:
            raise SessionError(f"{path}: camera.{number}.{key}: {error}") from error

    def find_file(key: str) -> Path | None:
        name = getattr(table, key)
        if name is None:
            return None
        file: Path = root / name
        if not file.is_file():
            raise SessionError(
                f"{path}: camera.{number}.{key}: there is no file {name!r} in {root}"
            )
        return file

    return SessionCamera(
        name=table.name,
        model=table.model,
        intrinsics=find("intrinsics"),
        extrinsics=find("extrinsics"),
        corners=find_file("corners"),
        background=find("background"),
        recording=find("masks") if table.masks is not None else find("video"),
        has_masks=table.masks is not None,
        shift_frames=round(table.offset_s * fps),
        lens=table.lens,
        params=table.params if table.lens is None else shared_params.get(table.lens),
        poses=find_file("poses"),
        extrinsics_poses=find_file("extrinsics_poses"),
    )
