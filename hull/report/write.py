"""A report that is complete or absent.

Results are gathered in finished parts beside the report (``REPORT.h5.parts/``), each of which
appears by a rename, and become ``REPORT.h5`` by another once the last frame is done. A run that is
cut off loses at most the part it was gathering; the next run takes up
what stands, and the result is the same as that of a run that was never cut off.
"""

import json
import operator
import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import h5py
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.errors import ReportError
from hybridve.calib.files import sink
from hybridve.calib.plain import to_plain
from hybridve.hull.agreement.outlines import FrameOutlines, Outline
from hybridve.hull.agreement.record import SessionAgreement
from hybridve.hull.contact.finding import Finding
from hybridve.hull.report.collisions import Runs, StoredMesh
from hybridve.hull.report.columns import (
    CAMERA_COLUMNS,
    FRAME_COLUMNS,
    MESH_COLUMNS,
    OUTLINE_COLUMNS,
    OUTLINE_OFFSET,
    PATCH_COLUMNS,
    PATCH_OFFSET,
    POINT_COLUMNS,
    POINT_OFFSET,
    RUN_COLUMNS,
    RUN_OFFSET,
    tables_of,
)
from hybridve.hull.report.machine import utc_now
from hybridve.hull.report.result_file import (
    STORED,
    begin_parts,
    parts_of,
    read_stamp,
    refuse_parts,
    remove_parts,
    sound_parts,
    store,
    store_text,
    write_run,
    writing,
)
from hybridve.hull.report.scales import label_axes
from hybridve.hull.report.schema import VERSION, Column, FrameResult, ReportHeader
from hybridve.hull.report.vtk import MOST_SHOWN, add_vtkhdf
from hybridve.hull.report.vtk_blocks import FramePoints
from hybridve.hull.report.withdraw import doubted, withdrawn

#: A part is finished after this many frames, runs of collision points, or vertices of objects that
#: move, which each frame has anew; whichever comes first.
_PART_FRAMES = 64
_PART_RUNS = 250_000
_PART_VERTICES = 4_000_000

#: Rows in one chunk of the file, of those that have many.
_CHUNK_ROWS = 16_384


class ReportWriter:
    """Gathers frame results and leaves a complete report, or none.

    Parameters
    ----------
    path : Path
        The report.
    header : ReportHeader
        What it says of itself.
    resume : bool
        Take up the parts of a run that was cut off.
    overwrite : bool
        Replace a report, or the parts of one, that stand there already.

    Attributes
    ----------
    n_done : int
        How many frames stand in finished parts: where a resumed run goes on.

    Raises
    ------
    ReportError
        If the report exists, its folder cannot be written to, or parts stand there that `resume`
        or `overwrite` do not allow to be used.
    """

    def __init__(
        self, path: Path, header: ReportHeader, *, resume: bool = False, overwrite: bool = False
    ) -> None:
        self._path = path
        self._header = header
        self._parts = parts_of(path)
        self._pending: list[FrameResult] = []
        self._n_pending_runs = self._n_pending_vertices = 0
        self.n_done = 0
        self._write_s = 0.0
        refuse_existing(path, overwrite=overwrite)
        refuse_parts(self._parts, resume=resume, overwrite=overwrite)
        stamp = json.dumps(
            {"settings": header.settings, "rig": header.rig, "engine": header.engine},
            sort_keys=True,
        )
        if self._parts.is_dir() and not overwrite:
            self._take_up(stamp)
        else:
            begin_parts(path, self._parts, stamp)

    def _take_up(self, stamp: str) -> None:
        if read_stamp(self._parts) != stamp:
            raise ReportError(
                f"{self._parts}: the run that was cut off had other settings; give the same again, "
                "or start anew with --overwrite"
            )
        for part in sound_parts(self._parts, _frame_key("index")):
            with np.load(part) as columns:
                self.n_done += len(columns[_frame_key("index")])

    def append(self, result: FrameResult) -> None:
        """Take in one frame's result."""
        self._pending.append(result)
        self._n_pending_runs += sum(len(finding.contact.hits.start) for finding in result.findings)
        self._n_pending_vertices += sum(
            len(finding.contact.body.triangles.vertices_world)
            for finding, moves in zip(result.findings, self._header.placements, strict=False)
            if moves is not None
        )
        if (
            len(self._pending) >= _PART_FRAMES
            or self._n_pending_runs >= _PART_RUNS
            or self._n_pending_vertices >= _PART_VERTICES
        ):
            self._flush()

    def _flush(self) -> None:
        """Finish the part that is being gathered."""
        if not self._pending:
            return
        started = time.perf_counter()
        columns = _columns(self._pending, self._header)
        part = self._parts / f"{self.n_done:09d}.npz"
        with sink(part) as file:
            np.savez(file, **columns)  # type: ignore[arg-type]  # the stub takes the names for options
        self.n_done += len(self._pending)
        self._pending, self._n_pending_runs, self._n_pending_vertices = [], 0, 0
        self._write_s += time.perf_counter() - started

    def take_write_s(self) -> float:
        """Return the seconds spent on writing since this was last asked."""
        write_s, self._write_s = self._write_s, 0.0
        return write_s

    def _part_paths(self) -> list[Path]:
        return sorted(self._parts.glob("*.npz"))

    def _part_columns(self, is_wanted: Callable[[str], bool]) -> Iterator[dict[str, NDArray[Any]]]:
        """Yield of each part the columns that are wanted; no others load."""
        for part in self._part_paths():
            with np.load(part) as columns:
                yield {key: columns[key] for key in columns.files if is_wanted(key)}

    def outlines(self) -> list[FrameOutlines]:
        """Return the outlines of all frames that were taken in, in this run or one before."""
        self._flush()
        frames: list[FrameOutlines] = []
        cameras = range(len(self._header.cameras))
        for part in self._part_columns(lambda key: key.startswith(("camera/", "frame/"))):
            each = [_outlines(part, number) for number in cameras]
            deniers, supported, alone_px, object_share = (
                np.array([part[_camera_key(number, name)] for number in cameras])
                for name in ("is_denier", "supported_share", "alone_px", "object_share")
            )
            for row, index in enumerate(part[_frame_key("index")].tolist()):
                state = part[_frame_key("state")][row]
                outlines = tuple(of_camera[row] for of_camera in each) if state != "unread" else ()
                frames.append(
                    FrameOutlines(
                        index,
                        outlines,
                        deniers[:, row],
                        supported[:, row],
                        alone_px[:, row],
                        object_share[:, row],
                        is_contradictory=state == "contradictory",
                    )
                )
        return frames

    def finish(self, agreement: SessionAgreement | None = None) -> None:
        """Make the parts the report.

        What the cameras of the whole session say about each other, if they were asked, takes back
        what single frames have said too surely.
        """
        self._flush()
        with writing(self._path) as file:
            self._write(file, agreement or SessionAgreement())
        remove_parts(self._parts)

    def _write(self, file: h5py.File, agreement: SessionAgreement) -> None:
        header = self._header
        write_run(file, "report", VERSION, replace(header.run, created_utc=utc_now()))
        file.attrs["engine"] = header.engine
        file.attrs["renderer"] = header.renderer
        for name, value, description in (
            ("configuration", header.settings, "the resolved configuration, JSON"),
            ("rig", header.rig, "the rig as in rig.json, each camera with mask_shift_px, JSON"),
            (
                "agreement",
                to_plain(agreement),
                "what the cameras say about each other in all frames together, JSON",
            ),
        ):
            store_text(file, f"hybridve/settings/{name}", json.dumps(value), description)
        self._store(file["hybridve/settings"], _ORIGIN, np.array(header.local_origin_m))
        file["hybridve/settings"].attrs[_ORIGIN.name] = header.local_origin_m

        rows = list(self._part_columns(lambda key: not key.endswith(_MANY)))
        if not rows:
            raise ReportError(f"{self._path}: no frame was evaluated; there is nothing to report")
        whole = {key: np.concatenate([row[key] for row in rows]) for key in rows[0]}
        self._take_back(whole, agreement)
        meshes = self._meshes(whole[_frame_key("index")])
        frames = file.create_group("hybridve/frames")
        for column in FRAME_COLUMNS:
            self._store(frames, column, whole[_frame_key(column.name)])
        time_s = whole[_frame_key("time_s")]
        label_axes(frames, FRAME_COLUMNS, time_s, header.cameras)
        cameras = file.create_group("hybridve/cameras", track_order=True)  # the session's order
        for number, name in enumerate(header.cameras):
            group = cameras.create_group(name)
            for camera_column in CAMERA_COLUMNS:
                self._store(group, camera_column, whole[_camera_key(number, camera_column.name)])
            label_axes(group, CAMERA_COLUMNS, time_s, header.cameras)
            self._store_many(
                group,
                partial(_camera_key, number),
                OUTLINE_OFFSET,
                OUTLINE_COLUMNS,
                whole[_camera_key(number, "n_corners")],
            )
        objects = file.create_group("hybridve/objects", track_order=True)  # the scene's order
        for number, about in enumerate(header.objects):
            group = objects.create_group(about["name"])
            for name, value in about.items():
                if name != "name" and value is not None:  # HDF5 has no word for nothing
                    group.attrs[name] = json.dumps(value) if isinstance(value, dict) else value
            for table in tables_of(header.parts):
                for column in table.columns:
                    self._store(group, column, whole[_object_key(number, column.name)])
            every = [column for table in tables_of(header.parts) for column in table.columns]
            label_axes(group, every, time_s, header.cameras)
            for offset, columns, count in (
                (RUN_OFFSET, RUN_COLUMNS, "n_runs"),
                (PATCH_OFFSET, PATCH_COLUMNS, "n_patches"),
            ):
                key = partial(_object_key, number)
                self._store_many(group, key, offset, columns, whole[key(count)])
            self._store_mesh(file, group, meshes[number])
            if header.points == "all":
                n_points = whole[_object_key(number, "n_points")]
                self._store_points(group, number, meshes[number], n_points)
        add_vtkhdf(
            file,
            [about["name"] for about in header.objects],
            meshes,
            [self._points(number, mesh) for number, mesh in enumerate(meshes)],
            is_sample=header.points == "sample",
        )

    def _meshes(self, index: NDArray[np.uint32]) -> tuple[StoredMesh, ...]:
        """Return the meshes as they stood in frames (F,); NaN where that is not known."""
        header = self._header
        if not header.placements:
            return header.meshes
        nowhere = np.full((3, 4), np.nan)
        return tuple(
            mesh
            if poses is None
            else replace(
                mesh, placement=np.array([poses.get(frame, nowhere) for frame in index.tolist()])
            )
            for mesh, poses in zip(header.meshes, header.placements, strict=True)
        )

    def _take_back(self, whole: dict[str, NDArray[Any]], agreement: SessionAgreement) -> None:
        """Replace what frames have said more surely than all of them together allow."""
        index = whole[_frame_key("index")].astype(np.int64)
        excess_px = agreement.excess_px(self._header.cameras, index)
        wrong = [agreement.distrust or reason for reason in agreement.wrong(index)]
        for number in range(len(self._header.objects)):
            key = partial(_object_key, number)
            verdict, reason, certificate = map(key, ("verdict", "reason", "certificate"))
            whole[verdict], whole[reason], whole[certificate] = withdrawn(
                whole[verdict], whole[reason], whole[certificate], wrong
            )
            at_least = key("clearance_at_least_m")
            if at_least in whole:
                whole[at_least] = doubted(whole[at_least], whole[key("m_per_px")], excess_px)

    def _store(self, group: h5py.Group, column: Column[Any], values: NDArray[Any]) -> None:
        if column.dtype is str:
            encoded = [str(text).encode() for text in values]
            kind = h5py.string_dtype("utf-8", max(1, *(len(text) for text in encoded)))
            values = np.array(encoded, kind)
        self._name_cameras(store(group, column, values), column)

    def _name_cameras(self, dataset: h5py.Dataset, column: Column[Any]) -> None:
        if "C" in column.shape:
            dataset.attrs["cameras"] = list(self._header.cameras)

    def _store_many(
        self,
        group: h5py.Group,
        key_of: Callable[[str], str],
        offset: Column[Any],
        columns: Sequence[Column[Any]],
        counts: NDArray[np.int64],
    ) -> None:
        """Store what a frame has any number of, part by part."""
        ends = np.concatenate([[0], np.cumsum(counts, dtype=np.uint64)]).astype(np.uint64)
        self._store(group, offset, ends)
        for column in columns:
            key = key_of(column.name)
            parts = (part[key] for part in self._part_columns(partial(operator.eq, key)))
            self._store_parts(group, column, int(ends[-1]), parts)

    def _store_points(
        self, group: h5py.Group, number: int, mesh: StoredMesh, n_points: NDArray[np.uint64]
    ) -> None:
        ends = np.concatenate([[0], np.cumsum(n_points, dtype=np.uint64)]).astype(np.uint64)
        self._store(group, POINT_OFFSET, ends)
        xyz_m, triangle = POINT_COLUMNS
        total = int(ends[-1])
        self._store_parts(group, xyz_m, total, (part.xyz_m for part in self._points(number, mesh)))
        self._store_parts(
            group, triangle, total, (part.triangle for part in self._points(number, mesh))
        )

    def _store_parts(
        self, group: h5py.Group, column: Column[Any], total: int, parts: Iterator[NDArray[Any]]
    ) -> None:
        # Growing shapes only because HDF5 allows chunks larger than the data in no others.
        chunk = _CHUNK_ROWS if total > _CHUNK_ROWS else max(total, 1)
        dataset = group.create_dataset(
            column.name,
            (total, *column.shape),
            column.dtype,
            chunks=(chunk, *column.shape),
            maxshape=(None, *column.shape),
            **STORED,
        )
        column.describe(dataset)
        self._name_cameras(dataset, column)
        start = 0
        for values in parts:
            stop = start + len(values)
            if stop > start:
                dataset[start:stop] = values
            start = stop

    def _store_mesh(self, file: h5py.File, group: h5py.Group, mesh: StoredMesh) -> None:
        """Store a mesh; vertices and faces of objects that share them stand in the file once."""
        digest = mesh.sha256
        shared = file.require_group(f"hybridve/meshes/{digest}")
        for column in MESH_COLUMNS:
            name = column.name.removeprefix("mesh/")
            if name in ("vertices_m", "faces"):
                if name not in shared:
                    self._store(shared, replace(column, name=name), column.take(mesh))
                group[column.name] = shared[name]  # a hard link
            else:
                self._store(group, column, column.take(mesh))
        group["mesh"].attrs["sha256"] = digest

    def _points(self, number: int, mesh: StoredMesh) -> Iterator[FramePoints]:
        """Yield of each part the collision points of an object, all or a sample of them."""
        row = 0
        most = MOST_SHOWN if self._header.points == "sample" else None
        names = ("n_runs", *(column.name for column in RUN_COLUMNS))
        keys = [_object_key(number, name) for name in names]
        for columns in self._part_columns(keys.__contains__):
            counts, triangle, first, count = (columns[key] for key in keys)
            runs, start = Runs(triangle, first, count), 0
            xyz_m = [np.zeros((0, 3), np.float32)]
            triangles = [np.zeros(0, np.uint32)]
            for n_runs in counts.tolist():
                if n_runs:
                    points_m, on = mesh.points(runs.part(start, start + n_runs), row, most)
                    xyz_m.append(points_m.astype(np.float32))
                    triangles.append(on)
                else:
                    xyz_m.append(xyz_m[0])
                    triangles.append(triangles[0])
                start += n_runs
                row += 1
            n_points = np.array([len(one) for one in triangles[1:]], np.int64)
            yield FramePoints(n_points, np.concatenate(xyz_m), np.concatenate(triangles))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Keep what is done if the run was cut off; it can be taken up again."""
        if kind is None:
            return
        with suppress(OSError):  # what went wrong may be that nothing can be written
            self._flush()
        if self.n_done == 0:
            with suppress(OSError):
                remove_parts(self._parts)


def refuse_existing(path: Path, *, overwrite: bool) -> None:
    """Refuse to write over a file, or where no file can be written.

    Raises
    ------
    ReportError
        If `path` exists and `overwrite` is not set, or is a folder, or its folder is missing or
        may not be written to.
    """
    if path.is_dir():
        raise ReportError(f"{path}: is a folder; name a file")
    if path.exists() and not overwrite:
        raise ReportError(f"{path}: exists already; choose another name or give --overwrite")
    folder = path.parent
    if not folder.is_dir():
        raise ReportError(f"{path}: cannot be written: there is no folder {folder}; make it first")
    if not os.access(folder, os.W_OK):
        raise ReportError(f"{path}: cannot be written: no permission to write to {folder}")


def refuse_existing_in(folder: Path, name: str, *, overwrite: bool) -> None:
    """Refuse a folder that is to be made if it is not there, and in which a file is to stand.

    Raises
    ------
    ReportError
        If it holds a file of that name and `overwrite` is not set, or cannot be made.
    """
    if folder.is_dir():
        refuse_existing(folder / name, overwrite=overwrite)
        return
    there = next(one for one in (folder, *folder.absolute().parents) if one.exists())
    if not there.is_dir():
        raise ReportError(f"{folder}: cannot be made: {there} is a file; name a folder")
    if not os.access(there, os.W_OK):
        raise ReportError(f"{folder}: cannot be made: no permission to write to {there}")


def refuse_result(path: Path, *, resume: bool, overwrite: bool) -> None:
    """Refuse to begin a result that is gathered in parts beside it, where that may not be.

    One that stands there already may be taken up: it is finished.

    Raises
    ------
    ReportError
        As of `refuse_existing`; or if the parts of a run that was cut off stand there, and are to
        be neither taken up nor replaced.
    """
    refuse_existing(path, overwrite=overwrite or resume)
    refuse_parts(parts_of(path), resume=resume, overwrite=overwrite)


#: Where the places of the file begin.
_ORIGIN: Column[Any] = Column(
    "local_origin_m",
    "m",
    "exact",
    "places in this file are metres about this point of the world: world = place + local_origin_m",
    np.float64,
    lambda origin: origin,
)

#: Ends of the keys under which a part keeps what a frame has any number of.
_MANY = tuple(
    column.name for columns in (RUN_COLUMNS, PATCH_COLUMNS, OUTLINE_COLUMNS) for column in columns
)


def _frame_key(name: str) -> str:
    return f"frame/{name}"


def _camera_key(number: int, name: str) -> str:
    return f"camera/{number}/{name}"


def _object_key(number: int, name: str) -> str:
    return f"{number}/{name}"


def _columns(results: list[FrameResult], header: ReportHeader) -> dict[str, NDArray[Any]]:
    """Return the arrays of one part."""

    def values(column: Column[Any], rows: Sequence[Any]) -> NDArray[Any]:
        return _values(column, rows, results, header)

    columns = {_frame_key(column.name): values(column, results) for column in FRAME_COLUMNS}
    for number in range(len(header.cameras)):
        cameras = [result.cameras[number] if result.cameras else None for result in results]
        for camera_column in CAMERA_COLUMNS:
            columns[_camera_key(number, camera_column.name)] = values(camera_column, cameras)
        outlines = [Outline.empty() if one is None else one.outline for one in cameras]
        columns[_camera_key(number, "n_corners")] = np.array(
            [len(one.marks) for one in outlines], np.int64
        )
        for outline_column in OUTLINE_COLUMNS:
            columns[_camera_key(number, outline_column.name)] = np.concatenate(
                [outline_column.take(one) for one in outlines]
            )
    for number in range(len(header.objects)):
        findings = [result.findings[number] if result.is_valid else None for result in results]
        for table in tables_of(header.parts):
            rows = [None if finding is None else table.of(finding) for finding in findings]
            for column in table.columns:
                columns[_object_key(number, column.name)] = values(column, rows)
        runs = [_runs(finding) for finding in findings]
        columns[_object_key(number, "n_runs")] = np.array([len(one) for one in runs], np.int64)
        for run_column in RUN_COLUMNS:
            columns[_object_key(number, run_column.name)] = np.concatenate(
                [run_column.take(one) for one in runs]
            )
        patches = [() if finding is None else finding.patches for finding in findings]
        columns[_object_key(number, "n_patches")] = np.array(
            [len(one) for one in patches], np.int64
        )
        every = [patch for of_frame in patches for patch in of_frame]
        for patch_column in PATCH_COLUMNS:
            columns[_object_key(number, patch_column.name)] = values(patch_column, every)
    return columns


def _outlines(part: dict[str, NDArray[Any]], number: int) -> list[Outline]:
    """Return the outlines of one camera in the frames of a part."""
    ends = part[_camera_key(number, "n_corners")].cumsum()
    corners, marks, is_inverse = (
        part[_camera_key(number, f"outline/{name}")]
        for name in ("corners_px", "marks", "is_inverse")
    )
    return [
        Outline(corners[start:stop], marks[start:stop], bool(inverse))
        for start, stop, inverse in zip([0, *ends[:-1].tolist()], ends, is_inverse, strict=True)
    ]


_NO_RUNS = Runs(np.zeros(0, np.uint32), np.zeros(0, np.uint32), np.zeros(0, np.uint32))


def _runs(finding: Finding | None) -> Runs:
    if finding is None or not finding.contact.collides:
        return _NO_RUNS
    hits = finding.contact.hits
    numbers = finding.contact.body.numbers
    return Runs.of(hits.start, hits.stop, hits.topology.samples_before, numbers)


def _values(
    column: Column[Any], rows: Sequence[Any], results: list[FrameResult], header: ReportHeader
) -> NDArray[Any]:
    """Return one value a row, (F, *shape); rows that are None are those of their frame's result."""

    def missing(number: int) -> Any:
        return column.fill if column.absent is None else column.absent(results[number])

    if column.dtype is str:  # as wide as the longest text
        texts = [
            missing(number) if row is None else column.take(row) for number, row in enumerate(rows)
        ]
        return np.array(texts, np.str_)
    values: NDArray[Any] = np.full(
        (len(rows), *column.shape_of(len(header.cameras))), column.fill, column.dtype
    )
    for number, row in enumerate(rows):
        if row is not None:
            values[number] = column.take(row)
    return values - np.array(header.local_origin_m) if column.is_place else values
