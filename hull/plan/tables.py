"""The tables of a plan.toml, each key with what it may be."""

import re
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    model_validator,
)

from hybridve.calib.errors import SessionError
from hybridve.hull.capture.session_tables import TARGETS, TargetTable
from hybridve.hull.toml_io import Name, explain_validation, read_toml


def _is_size(text: str) -> str:
    """Refuse what is no size of a picture."""
    if not re.fullmatch(r"[1-9]\d{0,4}x[1-9]\d{0,4}", text):
        raise ValueError(f"found {text!r}; expected width x height in pixels, as '1920x1080'")
    return text


_Length = Annotated[float, Field(gt=0, le=1000, allow_inf_nan=False)]
_Metres = Annotated[float, Field(ge=-1000, le=1000, allow_inf_nan=False)]
_Place = tuple[_Metres, _Metres, _Metres]
_Pixels = Annotated[float, Field(gt=0, le=100, allow_inf_nan=False)]
_Angle = Annotated[float, Field(ge=5, le=140, allow_inf_nan=False)]
_Milliseconds = Annotated[float, Field(ge=0, le=1000, allow_inf_nan=False)]


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class VolumeTable(_Table):
    """Where hands will work: a box in the room, metres, Z up from the floor."""

    low_m: _Place
    high_m: _Place

    @model_validator(mode="after")
    def _is_a_box(self) -> "VolumeTable":
        for axis, low, high in zip("xyz", self.low_m, self.high_m, strict=True):
            if not low < high:
                raise ValueError(f"high_m: {high:g} along {axis}; expected more than {low:g}")
        return self


class LensTable(_Table):
    """The cameras' lens and picture; no distortion is drawn, but is estimated as if there were."""

    size_px: Annotated[str, AfterValidator(_is_size)] = "1920x1080"
    across_deg: _Angle = 70.0


class RingTable(_Table):
    """Cameras on a circle, evenly spread, all looking at one point."""

    cameras: Annotated[int, Field(ge=2, le=64)]
    radius_m: _Length
    height_m: _Metres
    other_height_m: _Metres | None = None
    looks_at_m: _Place
    first_deg: Annotated[float, Field(ge=-360, le=360)] = 45.0
    over_deg: Annotated[float, Field(gt=0, le=360)] = 360.0


class CameraTable(_Table):
    """One camera by itself."""

    name: Name
    at_m: _Place
    looks_at_m: _Place
    roll_deg: Annotated[float, Field(ge=-360, le=360)] = 0.0
    size_px: Annotated[str, AfterValidator(_is_size)] | None = None
    across_deg: _Angle | None = None


class CalibrationTable(_Table):
    """What the calibration will see of the board."""

    stills: Annotated[int, Field(ge=3, le=500)] = 30
    moved: Annotated[int, Field(ge=0, le=500)] = 0
    lies_at_m: _Place = (0.0, 0.0, 0.0)
    corner_px: _Pixels = 0.2


class SilhouettesTable(_Table):
    """How far outlines will be off."""

    outline_px: _Pixels = 1.5


class BallTable(_Table):
    """What stands for a real thing: 8 mm are a finger, 45 mm a fist."""

    radius_mm: Annotated[float, Field(ge=1, le=1000)] = 45.0


class TimingTable(_Table):
    """How fast hands move, and what cameras make of it."""

    speed_m_s: Annotated[float, Field(ge=0, le=100)] = 1.0
    exposure_ms: _Milliseconds = 4.0
    out_of_step_ms: _Milliseconds = 0.0
    fps: Annotated[float, Field(gt=0, le=10000)] = 50.0


class PlanTable(_Table):
    """A plan.toml as a whole, but for its target."""

    format: Literal["hybridve-plan"]
    version: Literal[1]
    volume: VolumeTable
    lens: LensTable = LensTable()
    ring: RingTable | None = None
    camera: list[CameraTable] = []
    calibration: CalibrationTable = CalibrationTable()
    silhouettes: SilhouettesTable = SilhouettesTable()
    ball: BallTable = BallTable()
    timing: TimingTable = TimingTable()

    @model_validator(mode="after")
    def _has_cameras(self) -> "PlanTable":
        if self.ring is None and len(self.camera) < 2:
            raise ValueError("camera: give a [ring], or two [[camera]] at least")
        names = [one.name for one in self.camera]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"camera: {name!r} is the name of {names.count(name)} cameras")
        return self


#: The tables of a plan whose keys a person chooses, by name.
PLAN_TABLES: dict[str, type[BaseModel]] = {
    "volume": VolumeTable,
    "ring": RingTable,
    "camera": CameraTable,
    "lens": LensTable,
    "calibration": CalibrationTable,
    "silhouettes": SilhouettesTable,
    "ball": BallTable,
    "timing": TimingTable,
}


def read_plan(path: Path, changes: dict[str, str] | None = None) -> tuple[PlanTable, TargetTable]:
    """Return what a plan.toml says, and its board.

    Parameters
    ----------
    path : Path
        The file.
    changes : dict of str to str, optional
        Values that stand in place of the file's, by key: ``{"ring.cameras": "6"}``.

    Raises
    ------
    SessionError
        In one line: the file, the key, what was found, what was expected.
    """
    table, _ = read_toml(path, "plan", SessionError)
    for key, text in (changes or {}).items():
        _put(table, key, text, path)
    board = table.pop("target", None)
    try:
        plan = PlanTable.model_validate(table)
    except ValidationError as error:
        raise SessionError(explain_validation(error, path, PlanTable)) from None
    if not isinstance(board, dict) or board.get("kind") not in TARGETS:
        found = board.get("kind") if isinstance(board, dict) else board
        raise SessionError(
            f"{path}: target: the board, as a session's [target], with kind one of "
            f"{', '.join(TARGETS)}; found {found!r}"
        )
    model = TARGETS[board["kind"]]
    try:
        target = model.model_validate({"name": "board", **board})
    except ValidationError as error:
        raise SessionError(explain_validation(error, path, model, ("target",))) from None
    return plan, target


def _put(table: dict[str, Any], key: str, text: str, path: Path) -> None:
    """Put a value under a dotted key, as a number where it is one.

    Raises
    ------
    SessionError
        If the key leads through something that is no table.
    """
    *above, last = key.split(".")
    for part in above:
        table = table.setdefault(part, {})
        if not isinstance(table, dict):
            raise SessionError(f"{path}: {key}: {part} is no table")
    table[last] = _value(text)


def _value(text: str) -> int | float | str:
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text
