"""A simulation's file: complete or absent, taken up where a run was cut off.

Frames are gathered in finished parts beside the file (``SIM.h5.parts/``), each with the state that
goes on from its last frame; they become the file once the last frame is done.

::

    /hybridve/settings/   configuration (JSON), rig (JSON), agreement (JSON), local_origin_m
    /hybridve/frames/     index, time_s, valid, reason, n_steps, n_hulls, stage_s/...
    /hybridve/effects/E/  a dataset for each variable, a row a frame; constants below constants/
    /hybridve/standing/O/ vertices_m, faces: the CAD that nothing moves
    /hybridve/moving/O/   vertices_m, faces, world_from_mesh: the CAD that moves as files say
    /VTKHDF               the same as ParaView and VTK read it
"""

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import h5py
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.errors import ReportError
from hybridve.calib.files import sink
from hybridve.calib.plain import read_strictly, to_plain
from hybridve.calib.pose import placed
from hybridve.hull.agreement.outlines import FrameOutlines, pack_frames, unpack_frames
from hybridve.hull.agreement.record import SessionAgreement
from hybridve.hull.report.machine import utc_now
from hybridve.hull.report.result_file import (
    STORED,
    Described,
    begin_parts,
    parts_of,
    read_run,
    read_stamp,
    reading,
    refuse_parts,
    remove_parts,
    sound_parts,
    store,
    store_text,
    write_run,
    writing,
)
from hybridve.hull.report.simulation_data import (
    STAGES,
    VERSION,
    Group,
    Shown,
    SimulatedFrame,
    SimulationHeader,
    StoredGroup,
    StoredSimulation,
    Variable,
)
from hybridve.hull.report.vtk_blocks import (
    FramePoints,
    add_points,
    add_surface,
    labels_of,
    make_collection,
)

#: A part is finished after this many frames, or once its numbers take so much room.
_PART_FRAMES, _PART_BYTES = 64, 64 << 20

#: Points of a group that ``/VTKHDF`` shows in a frame at most.
_MOST_SHOWN = 20_000

_FRAME_VARIABLES = (
    Variable("index", "1", "exact", "number of the frame in the session", dtype=np.int64),
    Variable("time_s", "s", "exact", "when it was recorded, from the session's first frame"),
    Variable(
        "valid",
        "1",
        "exact",
        "whether the frame has a hull; where it has none, nothing went on",
        dtype=np.bool_,
    ),
    Variable(
        "n_steps", "1", "exact", "steps of the simulation since the frame before", dtype=np.int64
    ),
    Variable(
        "n_hulls",
        "1",
        "exact",
        "hulls on the way from the frame before; the last is the frame's own, all others are "
        "estimates of what was between",
        dtype=np.int64,
    ),
    *(Variable(f"stage_s/{stage}", "s", "exact", f"seconds of work: {stage}") for stage in STAGES),
)
_REASON = "reason"


class SimulationWriter:
    """Gathers simulated frames and leaves a complete file, or none.

    Parameters
    ----------
    path : Path
        The file; that it may be written was seen to.
    header : SimulationHeader
        What it says of itself.
    resume : bool
        Take up the parts of a run that was cut off.
    overwrite : bool
        Replace a file, or the parts of one, that stand there already.

    Attributes
    ----------
    n_done : int
        How many frames stand in finished parts.

    Raises
    ------
    ReportError
        If parts stand there that neither allows to be used, or they are of other settings, or of
        another version of a solver.
    """

    def __init__(
        self, path: Path, header: SimulationHeader, *, resume: bool = False, overwrite: bool = False
    ) -> None:
        self._path = path
        self._header = header
        self._parts = parts_of(path)
        refuse_parts(self._parts, resume=resume, overwrite=overwrite)
        self._pending: list[SimulatedFrame] = []
        self._pending_bytes = 0
        self.n_done = 0
        told = {key: value for key, value in header.settings.items() if key != "solvers"}
        effects = [group.about for group in header.groups]
        stamp = {
            "solvers": header.settings["solvers"],
            "settings": told | {"rig": header.rig, "engine": header.engine, "effects": effects},
        }
        if self._parts.is_dir() and not overwrite:
            self._take_up(json.loads(json.dumps(stamp)))
        else:
            begin_parts(path, self._parts, json.dumps(stamp))

    def _take_up(self, stamp: Mapping[str, Any]) -> None:
        told = read_stamp(self._parts)
        found = json.loads(told) if told else {}
        for name, version in stamp["solvers"].items():
            before = found.get("solvers", {}).get(name)
            if before is not None and before != version:
                raise ReportError(
                    f"{self._parts}: the run that was cut off had {name} {before}, this is {name} "
                    f"{version}, which need not give the same; install {name} {before}, or start "
                    "anew with --overwrite"
                )
        if found != stamp:
            raise ReportError(
                f"{self._parts}: the run that was cut off had other settings; give the same again, "
                "or start anew with --overwrite"
            )
        sound_parts(self._parts, "frame/index")
        self.n_done = sum(len(part["frame/index"]) for part in self._loaded(_is_index))

    def append(
        self, frame: SimulatedFrame, state: Callable[[], Mapping[str, NDArray[Any]]]
    ) -> None:
        """Take in one frame; `state` tells, if it is asked, what goes on from there."""
        self._pending.append(frame)
        self._pending_bytes += sum(
            np.asarray(value).nbytes for of in frame.values.values() for value in of.values()
        )
        is_full = len(self._pending) >= _PART_FRAMES or self._pending_bytes >= _PART_BYTES
        if is_full or frame.blew_up:
            self._flush(state())

    def _flush(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Finish the part that is being gathered."""
        if not self._pending:
            return
        frames = self._pending
        columns: dict[str, NDArray[Any]] = {f"state/{key}": value for key, value in state.items()}
        for name in ("index", "time_s", "n_steps", "n_hulls"):
            columns[f"frame/{name}"] = np.array([getattr(frame, name) for frame in frames])
        columns["frame/valid"] = np.array([not frame.reason for frame in frames])
        columns["frame/reason"] = np.array([frame.reason for frame in frames], np.str_)
        columns["frame/blew_up"] = np.array([frame.blew_up for frame in frames], np.str_)
        for stage in STAGES:
            columns[f"frame/stage_s/{stage}"] = np.array(
                [frame.stage_s.get(stage, 0.0) for frame in frames]
            )
        for key, value in pack_frames([frame.outlines for frame in frames]).items():
            columns[f"outline/{key}"] = value
        origin_m = np.array(self._header.local_origin_m)
        for group in self._header.groups:
            for variable in group.variables:
                values = np.stack(
                    [np.asarray(frame.values[group.name][variable.name]) for frame in frames]
                )
                if values.shape[1:] != variable.shape:
                    raise ValueError(
                        f"{group.name}: {variable.name} has shape {values.shape[1:]}, declared "
                        f"{variable.shape}"
                    )
                columns[_key(group, variable)] = variable.about(values, origin_m)
        nowhere = np.full((3, 4), np.nan)
        for name, _, _ in self._header.moving:
            poses = np.stack([frame.poses.get(name, nowhere) for frame in frames])
            columns[f"moving/{name}"] = _PLACE.about(poses, origin_m)
        part = self._parts / f"{self.n_done:09d}.npz"
        with sink(part) as file:
            np.savez(file, **columns)  # type: ignore[arg-type]  # the stub takes names for options
        self.n_done += len(frames)
        self._pending, self._pending_bytes = [], 0

    def state(self) -> dict[str, NDArray[Any]]:
        """Return the state after the last frame that is done; empty where none is."""
        found: dict[str, NDArray[Any]] = {}
        for path in sorted(self._parts.glob("*.npz"))[-1:]:
            with np.load(path) as part:
                found = {
                    key.removeprefix("state/"): part[key]
                    for key in part.files
                    if key.startswith("state/")
                }
        return found

    @property
    def stopped(self) -> str:
        """Why the simulation was stopped; empty if it was not."""
        found = [part["frame/blew_up"] for part in self._loaded(lambda key: key == _BLEW_UP)]
        return str(found[-1][-1]) if found else ""

    def _loaded(self, is_wanted: Callable[[str], bool]) -> Iterator[dict[str, NDArray[Any]]]:
        """Yield of each part the columns that are wanted; no others load."""
        for path in sorted(self._parts.glob("*.npz")):
            with np.load(path) as part:
                yield {key: part[key] for key in part.files if is_wanted(key)}

    def outlines(self, state: Callable[[], Mapping[str, NDArray[Any]]]) -> list[FrameOutlines]:
        """Return what all frames say of the cameras, in this run or one before."""
        self._flush(state())
        return [
            frame
            for part in self._loaded(lambda key: key.startswith("outline/"))
            for frame in unpack_frames(
                {key.removeprefix("outline/"): value for key, value in part.items()}
            )
        ]

    def finish(self, agreement: SessionAgreement) -> None:
        """Make the parts the file, with what the cameras say about each other."""
        with writing(self._path) as file:
            self._write(file, agreement)
        remove_parts(self._parts)

    def _write(self, file: h5py.File, agreement: SessionAgreement) -> None:
        header = self._header
        write_run(file, "simulation", VERSION, replace(header.run, created_utc=utc_now()))
        file.attrs["engine"] = header.engine
        file.attrs["renderer"] = header.renderer
        file.attrs["stopped"] = self.stopped
        for name, value, description in (
            ("configuration", header.settings, "all that decides the result, JSON"),
            ("rig", header.rig, "the rig as in rig.json, each camera with mask_shift_px, JSON"),
            ("agreement", to_plain(agreement), "what the cameras say about each other, JSON"),
        ):
            store_text(file, f"hybridve/settings/{name}", json.dumps(value), description)
        origin_m = np.array(header.local_origin_m)
        store(file["hybridve/settings"], _ORIGIN, origin_m)
        frames = list(self._loaded(lambda key: key.startswith("frame/")))
        if not frames:
            raise ReportError(f"{self._path}: no frame was simulated; there is nothing to tell")
        of_frames = file.create_group("hybridve/frames")
        for variable in _FRAME_VARIABLES:
            of_parts = [part[f"frame/{variable.name}"] for part in frames]
            store(of_frames, variable, np.concatenate(of_parts))
        reasons = [str(text) for one in frames for text in one["frame/reason"]]
        store_text(of_frames, _REASON, reasons, "why the frame has no hull; empty if it has one")
        effects = file.create_group("hybridve/effects", track_order=True)
        for group in header.groups:
            self._write_group(effects.create_group(group.name), group, origin_m)
        for name, vertices_world, faces in header.standing:
            standing = file.create_group(f"hybridve/standing/{name}")
            store(standing, _VERTICES, vertices_world - origin_m)
            store(standing, _FACES, faces)
        for name, vertices_mesh, faces in header.moving:
            moving = file.create_group(f"hybridve/moving/{name}")
            store(moving, _VERTICES, vertices_mesh)
            store(moving, _FACES, faces)
            self._store_rows(moving, _PLACE, f"moving/{name}")
        self._add_vtkhdf(file)

    def _write_group(self, stored: h5py.Group, group: Group, origin_m: NDArray[np.float64]) -> None:
        stored.attrs["kind"] = group.kind
        stored.attrs["about"] = json.dumps(group.about)
        for variable in group.variables:
            self._store_rows(stored, variable, _key(group, variable))
        for variable, value in group.constants:
            where = stored.require_group("constants")
            store(where, variable, variable.about(np.asarray(value), origin_m))
        if group.shown is not None:
            shown = stored.create_group("shown")
            shown.attrs["column"] = group.shown.column
            shown.attrs["cell_columns"] = json.dumps(group.shown.cell_columns)
            if group.shown.vertices is not None:
                places = group.shown.vertices
                store(shown, _VERTICES, places if group.shown.column else places - origin_m)
            if group.shown.faces is not None:
                store(shown, _FACES, group.shown.faces)

    def _store_rows(self, stored: h5py.Group, variable: Variable, key: str) -> None:
        """Store a variable part by part: all frames of many points would fill the memory."""
        dataset = stored.create_dataset(
            variable.name,
            (self.n_done, *variable.shape),
            variable.dtype,
            chunks=True,
            **STORED,
        )
        variable.describe(dataset)
        start = 0
        for part in self._loaded(lambda name: name == key):
            dataset[start : start + len(part[key])] = part[key]
            start += len(part[key])

    def _add_vtkhdf(self, file: h5py.File) -> None:
        collection = make_collection(file)
        n_frames = len(file["hybridve/frames/index"])
        groups = [group for group in self._header.groups if group.shown is not None]
        standing = list(file.get("hybridve/standing", {}).items())
        moving = list(file.get("hybridve/moving", {}).items())
        beside = [*standing, *moving]
        labels = labels_of([group.name for group in groups] + [name for name, _ in beside])
        for label, group in zip(labels, groups, strict=False):
            stored = file[f"hybridve/effects/{group.name}"]
            if group.shown is None:
                continue
            block = collection.block(label, group.name)
            vertices_at = _places(stored, group.shown)
            if group.shown.faces is None:
                add_points(block, (_shown_points(vertices_at(row)) for row in range(n_frames)))
            else:
                add_surface(
                    block,
                    group.shown.faces,
                    vertices_at,
                    np.arange(n_frames) * bool(group.shown.column),
                )
        for label, (name, mesh) in zip(labels[len(groups) :], beside, strict=True):
            vertices_at, shown = _places_of_cad(mesh, n_frames)
            add_surface(collection.block(label, name), mesh[_FACES.name][:], vertices_at, shown)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Leave finished parts where they are: the next run takes them up."""
        if self._parts.is_dir() and not any(self._parts.glob("*.npz")):
            with suppress(OSError):  # what went wrong may be that nothing can be written
                remove_parts(self._parts)


_ORIGIN = Described(
    "local_origin_m",
    "m",
    "exact",
    "places in this file are metres about this point of the world: world = place + local_origin_m",
)
_VERTICES = Described("vertices_m", "m", "exact", "vertices of the mesh")
_FACES = Described("faces", "1", "exact", "vertex numbers of each triangle")
_PLACE = Variable(
    "world_from_mesh",
    "m",
    "exact",
    "rotation and place of the mesh, as its file says; NaN where that has no pose",
    (3, 4),
    is_place=True,
)
_BLEW_UP = "frame/blew_up"


def _is_index(key: str) -> bool:
    return key == "frame/index"


def _key(group: Group, variable: Variable) -> str:
    return f"effect/{group.name}/{variable.name}"


def _places(stored: h5py.Group, shown: Shown) -> Callable[[int], NDArray[np.floating]]:
    """Return what gives the places (V, 3) of a group in a frame, metres about the local origin."""
    if not shown.column:
        vertices_m = stored["shown/vertices_m"][:]
        return lambda _: vertices_m
    values = stored[shown.column]
    if shown.vertices is None:
        return lambda row: values[row]
    vertices = shown.vertices
    return lambda row: placed(vertices, values[row])


def _places_of_cad(
    mesh: h5py.Group, n_frames: int
) -> tuple[Callable[[int], NDArray[np.floating]], NDArray[np.int64]]:
    """Return what gives the vertices of CAD in a frame, and as which frame (F,) each shows it.

    Metres about the local origin; -1 for a frame in which it has no place.
    """
    vertices_m = mesh[_VERTICES.name][:]
    if _PLACE.name not in mesh:
        return lambda _: vertices_m, np.zeros(n_frames, np.int64)
    poses = mesh[_PLACE.name][:]
    is_known = np.isfinite(poses).all(axis=(1, 2))
    return lambda row: placed(vertices_m, poses[row]), np.where(is_known, np.arange(n_frames), -1)


def _shown_points(places_m: NDArray[np.floating]) -> FramePoints:
    """Return points as they are shown: those that are anywhere, at most so many."""
    there = places_m[np.isfinite(places_m).all(axis=1)]
    step = max(1, -(-len(there) // _MOST_SHOWN))
    shown = there[::step].astype(np.float32)
    return FramePoints(np.array([len(shown)]), shown, np.zeros(len(shown), np.uint32))


def read_settings(path: Path) -> tuple[Any, Any]:
    """Return what a simulation was made with: its settings and its rig, as JSON has them.

    Raises
    ------
    ReportError
        As of `read_simulation`.
    """
    with reading(path, "simulation", VERSION) as file:
        stored = file["hybridve/settings"]
        return json.loads(stored["configuration"].asstr()[()]), json.loads(
            stored["rig"].asstr()[()]
        )


def read_simulation(path: Path) -> StoredSimulation:
    """Return a simulation.

    Raises
    ------
    ReportError
        If there is no such file, it is of another format, of an unknown version, or damaged.
    """
    with reading(path, "simulation", VERSION) as file:
        origin_m = file["hybridve/settings/local_origin_m"][:]
        frames = file["hybridve/frames"]
        agreement = json.loads(file["hybridve/settings/agreement"].asstr()[()])
        return StoredSimulation(
            path=path,
            run=read_run(file),
            settings=json.loads(file["hybridve/settings/configuration"].asstr()[()]),
            index=frames["index"][:],
            time_s=frames["time_s"][:],
            reason=np.array(frames[_REASON].asstr()[:], np.str_),
            n_steps=frames["n_steps"][:],
            n_hulls=frames["n_hulls"][:],
            stage_s={stage: frames[f"stage_s/{stage}"][:] for stage in STAGES},
            groups={
                name: _read_group(group, origin_m)
                for name, group in file["hybridve/effects"].items()
            },
            stopped=str(file.attrs["stopped"]),
            agreement=read_strictly(SessionAgreement, agreement, f"{path}: agreement"),
            standing=tuple(
                (name, mesh["vertices_m"][:] + origin_m, mesh["faces"][:])
                for name, mesh in file.get("hybridve/standing", {}).items()
            ),
            moving=tuple(
                (
                    name,
                    mesh["vertices_m"][:],
                    mesh["faces"][:],
                    _in_world(mesh[_PLACE.name], origin_m),
                )
                for name, mesh in file.get("hybridve/moving", {}).items()
            ),
        )


def _read_group(group: h5py.Group, origin_m: NDArray[np.float64]) -> StoredGroup:
    values: dict[str, NDArray[Any]] = {}
    constants: dict[str, NDArray[Any]] = {}
    units: dict[str, str] = {}
    for target, where in ((values, group), (constants, group.get("constants", {}))):
        for name, dataset in where.items():
            if not isinstance(dataset, h5py.Dataset):
                continue
            target[name] = _in_world(dataset, origin_m)
            units[name] = str(dataset.attrs["unit"])
    shown = None
    if "shown" in group:
        about = group["shown"]
        column = str(about.attrs["column"])
        vertices = about["vertices_m"][:] if "vertices_m" in about else None
        if vertices is not None and not column:
            vertices = vertices + origin_m
        shown = Shown(
            column,
            vertices,
            about["faces"][:] if "faces" in about else None,
            tuple(json.loads(about.attrs["cell_columns"])),
        )
    return StoredGroup(
        kind=str(group.attrs["kind"]),
        about=json.loads(group.attrs["about"]),
        values=values,
        constants=constants,
        units=units,
        shown=shown,
    )


def _in_world(dataset: h5py.Dataset, origin_m: NDArray[np.float64]) -> NDArray[Any]:
    values: NDArray[Any] = dataset[()]
    if not dataset.attrs.get("is_place", False):
        return values
    if values.shape[-2:] == (3, 4):
        values = values.copy()
        values[..., 3] += origin_m
        return values
    moved: NDArray[Any] = values + origin_m.astype(values.dtype)
    return moved
