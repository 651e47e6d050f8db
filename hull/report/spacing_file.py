"""``SPACING.h5``: how much room a task needs, written complete or not at all, read back by version.

::

    /                            attrs: format, version, created_utc, command, machine, versions
    /settings                    the resolved configuration, JSON
    /sessions/NAME/              attrs: the answer; settings: what was recorded, JSON
    /sessions/NAME/curve/        how many frames violate at each shift
    /sessions/NAME/frames/       per frame: which shifts violate, which are undecided
    /sessions/NAME/free          stretches of shifts at which no frame violates
    /sessions/NAME/at_95/        the same with errors of outlines and cameras; not where undoubted
    /sessions/NAME/standing/     per object that was not moved: how many frames violate it anyway

Stretches of shifts of all frames stand one below the other; those of frame k are the rows
``offset[k]`` to ``offset[k + 1]``. Every dataset, and every group that holds an answer, says of
which `kind` it is: exact, a bound given the silhouettes, or an estimate.
"""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.plain import read_strictly, to_json, to_plain
from hybridve.hull.agreement.record import SessionAgreement
from hybridve.hull.report.machine import Run
from hybridve.hull.report.result_file import (
    Described,
    Kind,
    read_run,
    reading,
    store,
    store_fields,
    store_text,
    write_run,
    writing,
)

VERSION = 1


@dataclass(frozen=True, slots=True, eq=False)
class Stretches:
    """Stretches of shifts, some for each of F frames.

    Attributes
    ----------
    offset : (F + 1,) int64
        Where those of each frame begin.
    shift_m : (K, 2) float64
        Begin and end, metres.
    """

    offset: NDArray[np.int64]
    shift_m: NDArray[np.float64]

    def of(self, frame: int) -> NDArray[np.float64]:
        """Return those of one frame, (N, 2) metres."""
        return self.shift_m[self.offset[frame] : self.offset[frame + 1]]


def make_stretches(of_frames: list[NDArray[np.float64]]) -> Stretches:
    """Return the stretches (N, 2) of each frame as one."""
    offset = np.cumsum([0, *(len(one) for one in of_frames)]).astype(np.int64)
    return Stretches(offset, np.concatenate([np.zeros((0, 2)), *of_frames]))


@dataclass(frozen=True, slots=True, eq=False)
class SpacingFrames:
    """The F frames of a recording.

    Attributes
    ----------
    index : (F,) uint32
        Their numbers in the session.
    time_s : (F,) float64
        When they were recorded.
    reason : tuple of str
        Why a frame could not be evaluated; else empty.
    violated, undecided : Stretches
        Shifts that certainly violate a clearance, and those of which nothing is known.
    n_measured : (F,) uint32
        Measurements of an object in a place.
    measure_s : (F,) float64
        Seconds they took.
    """

    index: NDArray[np.uint32]
    time_s: NDArray[np.float64]
    reason: tuple[str, ...]
    violated: Stretches
    undecided: Stretches
    n_measured: NDArray[np.uint32]
    measure_s: NDArray[np.float64]

    @property
    def n_valid(self) -> int:
        """How many frames were evaluated."""
        return sum(not reason for reason in self.reason)


@dataclass(frozen=True, slots=True, eq=False)
class SpacingCurve:
    """How many frames violate at each of S shifts.

    Attributes
    ----------
    shift_m : (S,) float64
        Ascending, metres.
    violated, undecided : (S,) uint32
        Frames that certainly violate, and those of which that is not known.
    """

    shift_m: NDArray[np.float64]
    violated: NDArray[np.uint32]
    undecided: NDArray[np.uint32]


@dataclass(frozen=True, slots=True, eq=False)
class Binding:
    """The frame that decides how far objects must be moved, and where.

    Attributes
    ----------
    frame : int
        Its number in the session.
    time_s : float
        When it was recorded.
    object_name : str
        The moved object that it comes nearest to.
    shift_m : float
        The shift at which the rest was measured.
    on_hull_world, on_object_world : (3,) float64
        The point of the hull and that of the moved object, metres, between which the upper bound
        was measured.
    clearance_m : (2,) float64
        Bounds of the clearance there, less the depth where the hull is in the object, metres.
    required_m : float
        The clearance that the object requires.
    """

    frame: int
    time_s: float
    object_name: str
    shift_m: float
    on_hull_world: NDArray[np.float64]
    on_object_world: NDArray[np.float64]
    clearance_m: NDArray[np.float64]
    required_m: float


@dataclass(frozen=True, slots=True, eq=False)
class SpacingDoubt:
    """What errors of outlines and cameras do to the answer, an estimate; F frames.

    Attributes
    ----------
    shift_m : float
        The shift that suffices at 95 %; NaN if none in the range does.
    frame : int or None
        The number of the frame that decides it; None where the begin of the range suffices.
    std_m : float
        Standard deviation of the clearance in that frame; NaN where there is none.
    unsure : Stretches
        Shifts at which each frame is not sure, at 95 %, to keep every clearance.
    std_by_frame_m : (F,) float64
        Standard deviation of the clearance that these were found for; NaN where nothing is near.
    """

    shift_m: float
    frame: int | None
    std_m: float
    unsure: Stretches
    std_by_frame_m: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class SessionSpacing:
    """How much room the task of one recording needs.

    Attributes
    ----------
    name : str
        The session, unique within the file.
    settings : dict
        What was recorded, as plain JSON values.
    shift_m : float
        The smallest shift that is proved to keep every clearance in every frame, as do those up to
        the tolerance above it; NaN if none in the range does.
    at_least_m : float
        The smallest shift that truly does is not below this; NaN if none in the range does.
    binding : Binding or None
        What keeps it from being smaller; if none is free, what is worst at the end of the range.
        None where the begin of the range is free.
    free_m : (N, 2) float64
        Stretches of the range that are proved to keep every clearance, metres; narrower ones than
        the tolerance are left out, but for one at the end of the range.
    curve : SpacingCurve
        How many frames violate.
    at_zero : (2,) int64, or None
        Frames that violate at shift 0, and those undecided there; None if it is not in the range.
    frames : SpacingFrames
        What each frame says.
    standing : dict of str to (int, int)
        Per object that was not moved how many frames violate its clearance, and how many may.
    doubt : SpacingDoubt or None
        What errors do to all this; None where nothing was doubted.
    agreement : SessionAgreement
        What the cameras say about each other; where they contradict each other, nothing of all this
        is to be trusted.
    """

    name: str
    settings: dict[str, Any]
    shift_m: float
    at_least_m: float
    binding: Binding | None
    free_m: NDArray[np.float64]
    curve: SpacingCurve
    at_zero: tuple[int, int] | None
    frames: SpacingFrames
    standing: dict[str, tuple[int, int]]
    doubt: SpacingDoubt | None = None
    agreement: SessionAgreement = field(default_factory=SessionAgreement)


@dataclass(frozen=True, slots=True, eq=False)
class Spacing:
    """How much room a task needs, as several recordings of it say.

    Attributes
    ----------
    run : Run
        Which run made it.
    settings : dict
        As in a report; they say what was moved, whereto and how far.
    sessions : tuple of SessionSpacing
        At least one.
    """

    run: Run
    settings: dict[str, Any]
    sessions: tuple[SessionSpacing, ...]


_FREE = Described("free", "m", "bound", "shifts proved to keep every clearance")
_CURVE_COLUMNS = (
    Described("shift_m", "m", "exact", "how far the objects are moved"),
    Described("violated", "1", "bound", "frames that surely violate a clearance"),
    Described("undecided", "1", "bound", "frames of which that is not known"),
)
_FRAME_COLUMNS = (
    Described("index", "1", "exact", "number of the frame in the session"),
    Described("time_s", "s", "exact", "time since the recording began"),
    Described("n_measured", "1", "exact", "measurements of an object in a place"),
    Described("measure_s", "s", "exact", "how long they took"),
)
_OFFSET = Described("offset", "1", "exact", "where the rows of each frame begin")
_STD_BY_FRAME = Described(
    "std_by_frame_m",
    "m",
    "estimate",
    "standard deviation of the clearance, the largest of the objects moved",
)


def write_spacing(path: Path, spacing: Spacing) -> None:
    """Write a spacing; the file appears only when it is complete.

    Raises
    ------
    ReportError
        If it cannot be written.
    """
    with writing(path) as file:
        _write(file, spacing)


def read_spacing(path: Path) -> Spacing:
    """Return what a spacing file holds.

    Raises
    ------
    ReportError
        If there is no such file, it is not a spacing, of an unknown version, or damaged.
    """
    with reading(path, "spacing", VERSION) as file:
        return _read(file)


def _write(file: h5py.File, spacing: Spacing) -> None:
    write_run(file, "spacing", VERSION, spacing.run)
    store_text(file, "settings", json.dumps(spacing.settings), "the resolved configuration, JSON")
    sessions = file.create_group("sessions", track_order=True)
    for one in spacing.sessions:
        _write_session(sessions.create_group(one.name), one)


def _write_session(group: h5py.Group, one: SessionSpacing) -> None:
    group.attrs["kind"] = "bound"
    group.attrs["shift_m"] = one.shift_m
    group.attrs["at_least_m"] = one.at_least_m
    if one.at_zero is not None:
        group.attrs["at_zero"] = one.at_zero
    if one.binding is not None:
        binding = group.create_group("binding")
        for name in _BINDING:
            binding.attrs[name] = getattr(one.binding, name)
    store_text(group, "settings", json.dumps(one.settings), "what was recorded, JSON")
    agreement = json.dumps(to_plain(one.agreement))
    store_text(group, "agreement", agreement, "what the cameras say about each other, JSON")
    store(group, _FREE, one.free_m)
    store_fields(group.create_group("curve"), one.curve, _CURVE_COLUMNS)
    frames = group.create_group("frames")
    store_fields(frames, one.frames, _FRAME_COLUMNS)
    store_text(frames, "reason", list(one.frames.reason), "why a frame could not be evaluated")
    for name, what in (("violated", "certainly violate"), ("undecided", "may violate")):
        _store_stretches(frames, name, getattr(one.frames, name), "bound", f"shifts that {what}")
    standing = group.create_group("standing", track_order=True)
    for name, counts in one.standing.items():
        standing.attrs[name] = counts
    if one.doubt is not None:
        _write_doubt(group.create_group("at_95"), one.doubt)


def _write_doubt(group: h5py.Group, doubt: SpacingDoubt) -> None:
    group.attrs["kind"] = "estimate"
    group.attrs["shift_m"] = doubt.shift_m
    group.attrs["std_m"] = doubt.std_m
    if doubt.frame is not None:
        group.attrs["frame"] = doubt.frame
    _store_stretches(
        group,
        "unsure",
        doubt.unsure,
        "estimate",
        "shifts at which a clearance is not sure to be kept, at 95 %",
    )
    store(group, _STD_BY_FRAME, doubt.std_by_frame_m)


#: What is kept of a binding frame, each as an attribute.
_BINDING = (
    "frame",
    "time_s",
    "object_name",
    "shift_m",
    "on_hull_world",
    "on_object_world",
    "clearance_m",
    "required_m",
)


def _read(file: h5py.File) -> Spacing:
    return Spacing(
        run=read_run(file),
        settings=json.loads(file["settings"].asstr()[()]),
        sessions=tuple(_read_session(name, group) for name, group in file["sessions"].items()),
    )


def _read_session(name: str, group: h5py.Group) -> SessionSpacing:
    frames, curve = group["frames"], group["curve"]
    binding = None
    if "binding" in group:
        found = {key: group["binding"].attrs[key] for key in _BINDING}
        binding = Binding(
            **{
                key: value.item() if value.ndim == 0 else value
                for key, value in found.items()
                if key != "object_name"
            },
            object_name=found["object_name"],
        )
    agreement = SessionAgreement()
    if "agreement" in group:
        told = json.loads(group["agreement"].asstr()[()])
        agreement = read_strictly(SessionAgreement, told, f"sessions/{name}: agreement")
    return SessionSpacing(
        name=name,
        settings=json.loads(group["settings"].asstr()[()]),
        shift_m=float(group.attrs["shift_m"]),
        at_least_m=float(group.attrs["at_least_m"]),
        binding=binding,
        free_m=group["free"][()],
        curve=SpacingCurve(curve["shift_m"][()], curve["violated"][()], curve["undecided"][()]),
        at_zero=_pair(group.attrs["at_zero"]) if "at_zero" in group.attrs else None,
        frames=SpacingFrames(
            index=frames["index"][()],
            time_s=frames["time_s"][()],
            reason=tuple(frames["reason"].asstr()[()].tolist()),
            violated=_read_stretches(frames["violated"]),
            undecided=_read_stretches(frames["undecided"]),
            n_measured=frames["n_measured"][()],
            measure_s=frames["measure_s"][()],
        ),
        standing={key: _pair(counts) for key, counts in group["standing"].attrs.items()},
        doubt=_read_doubt(group["at_95"]) if "at_95" in group else None,
        agreement=agreement,
    )


def _read_doubt(group: h5py.Group) -> SpacingDoubt:
    return SpacingDoubt(
        shift_m=float(group.attrs["shift_m"]),
        frame=int(group.attrs["frame"]) if "frame" in group.attrs else None,
        std_m=float(group.attrs["std_m"]),
        unsure=_read_stretches(group["unsure"]),
        std_by_frame_m=group["std_by_frame_m"][()],
    )


def _read_stretches(group: h5py.Group) -> Stretches:
    return Stretches(group["offset"][()], group["shift_m"][()])


def _pair(counts: NDArray[np.int64]) -> tuple[int, int]:
    first, second = counts.tolist()
    return first, second


def _store_stretches(
    group: h5py.Group, name: str, stretches: Stretches, kind: Kind, what: str
) -> None:
    below = group.create_group(name)
    store(below, _OFFSET, stretches.offset)
    store(below, Described("shift_m", "m", kind, f"begin and end of {what}"), stretches.shift_m)


def spacing_as_dict(spacing: Spacing) -> dict[str, Any]:
    """Return what a spacing found, as plain JSON values; numbers that are not there are None."""
    return {
        "command": spacing.run.command,
        "machine": spacing.run.machine,
        "created_utc": spacing.run.created_utc,
        "settings": spacing.settings,
        "sessions": [_session_as_dict(one) for one in spacing.sessions],
    }


def _session_as_dict(one: SessionSpacing) -> dict[str, Any]:
    frames, curve, binding, doubt = one.frames, one.curve, one.binding, one.doubt
    return {
        "name": one.name,
        "settings": one.settings,
        "trusted": one.agreement.is_trusted,
        "causes": to_json(one.agreement.causes),
        "rests_on": one.agreement.rests_on,
        "shift_m": to_json(one.shift_m),
        "at_least_m": to_json(one.at_least_m),
        "at_95": None
        if doubt is None
        else {
            "kind": "estimate",
            "shift_m": to_json(doubt.shift_m),
            "frame": doubt.frame,
            "std_m": to_json(doubt.std_m),
        },
        "binding": None
        if binding is None
        else {
            "frame": binding.frame,
            "time_s": binding.time_s,
            "object": binding.object_name,
            "shift_m": binding.shift_m,
            "on_hull_m": to_json(binding.on_hull_world),
            "on_object_m": to_json(binding.on_object_world),
            "clearance_m": to_json(binding.clearance_m),
            "required_clearance_m": binding.required_m,
        },
        "free_m": one.free_m.tolist(),
        "frames": len(frames.index),
        "frames_evaluated": frames.n_valid,
        "violated_at_start": int(curve.violated[0]),
        "violated_at_zero": None if one.at_zero is None else one.at_zero[0],
        "undecided_at_zero": None if one.at_zero is None else one.at_zero[1],
        "curve": {
            "shift_m": curve.shift_m.tolist(),
            "violated": curve.violated.tolist(),
            "undecided": curve.undecided.tolist(),
        },
        "standing": {
            name: {"violated": violated, "undecided": undecided}
            for name, (violated, undecided) in one.standing.items()
        },
        "measurements": int(frames.n_measured.sum()),
        "measure_s": float(frames.measure_s.sum()),
        "by_frame": [
            {
                "index": int(frames.index[row]),
                "time_s": float(frames.time_s[row]),
                "reason": frames.reason[row],
                "violated_m": frames.violated.of(row).tolist(),
                "undecided_m": frames.undecided.of(row).tolist(),
                "unsure_95_m": None if doubt is None else doubt.unsure.of(row).tolist(),
                "std_m": None if doubt is None else to_json(float(doubt.std_by_frame_m[row])),
                "measurements": int(frames.n_measured[row]),
            }
            for row in range(len(frames.index))
        ],
    }
