"""The tables of a session.toml, each key with what it may be."""

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    field_validator,
    model_validator,
)

from hybridve.calib.boards.markers import DICTIONARIES
from hybridve.calib.camera import N_PARAMS
from hybridve.hull.toml_io import Name

#: What lengths of a rig calibrated elsewhere may be in; squares are those of the target.
RigUnit = Literal["m", "cm", "mm", "in", "ft", "squares"]

#: How many degrees of freedom a lens has is found out from the pictures.
AUTO_MODEL = "auto"


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
    name: Name
    body: Name | None = None
    columns: Annotated[int, Field(ge=1)]
    rows: Annotated[int, Field(ge=1)]

    @property
    def unit_m(self) -> float | None:
        """The side of a square along x in metres, the unit of lengths "in squares"; or None."""
        return None

    def table(self) -> dict[str, Any]:
        """Return what `hybridve.calib.boards.named.make_board` makes the board from."""
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
        """Return what the board is made from; the gap is in millimetres."""
        said = super().table()
        spacing = said.pop("tag_spacing", None)
        if spacing is not None:
            said["gap_mm"] = self.tag_mm * spacing
        return said


TARGETS: dict[str, type[ChessboardTable | CharucoTable | AprilGridTable]] = {
    "chessboard": ChessboardTable,
    "charuco": CharucoTable,
    "aprilgrid": AprilGridTable,
}


def _check_dictionary(name: str) -> str:
    if name not in DICTIONARIES:
        raise ValueError(f"unknown dictionary {name!r}; one of {', '.join(DICTIONARIES)}")
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


class CameraTable(_Table):
    """A [[camera]] of a session."""

    name: Name
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
    def _lens_is_known(self) -> "CameraTable":
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
    def _moves_with_masks(self) -> "CameraTable":
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
    def _one_recording(self) -> "CameraTable":
        if self.video is not None and self.masks is not None:
            raise ValueError("has both video and masks; name the one to be used")
        if self.video is not None and self.background is None:
            raise ValueError("has a video but no background; name a recording of the empty scene")
        return self


class SessionTable(_Table):
    """A session.toml as a whole."""

    format: Literal["hybridve-session"]
    version: Literal[1]
    root: str = "."
    roots: list[str] = []
    fps: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = None
    world: Literal["board", "points", "floor"] = "board"
    sync: Literal["given", "estimate"] = "given"
    unseen: Literal["carve", "keep"] = "carve"
    min_cameras: Annotated[int, Field(ge=1)] = 1
    rig: str | None = None
    rig_unit: RigUnit | None = None
    rig_pixel_centre: float | None = None
    rig_check: Literal["on", "off"] = "on"
    point: list[WorldPoint] = []
    mask_threshold: Annotated[int, Field(ge=0, le=254)] | None = None
    mask_channel: Literal["grey", "alpha"] | None = None
    segmentation: dict[str, Any] = {}
    camera: Annotated[list[CameraTable], Field(min_length=1)]

    @field_validator("rig_pixel_centre")
    @classmethod
    def _is_a_convention(cls, centre: float | None) -> float | None:
        if centre not in (None, 0.0, 0.5):
            raise ValueError(f"found {centre}; expected 0.5 (COLMAP) or 0 (OpenCV)")
        return centre

    @model_validator(mode="after")
    def _rig_has_unit(self) -> "SessionTable":
        if self.rig is not None and self.rig_unit is None and not self.rig.endswith("rig.json"):
            raise ValueError("rig needs rig_unit (m, cm, mm, in, ft or squares): never guessed")
        return self
