"""A report that is complete or absent.

Results are gathered in finished parts beside the report (``REPORT.h5.parts/``), each of which
appears by a rename, and become ``REPORT.h5`` by another once the last frame is done. A run that is
cut off loses at most the part it was gathering; the next run takes up
what stands, and the result is the same as that of a run that was never cut off.
"""

import json
import os
import shutil
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import h5py
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.errors import ReportError
from hybridve.hull.report.schema import FORMAT, STAGES, VERSION, FrameResult, ReportHeader
from hybridve.hull.report.vtk import add_vtkhdf, by_frame

#: A part is finished after this many frames or collision points, whichever comes first.
_PART_FRAMES = 64
_PART_POINTS = 1_000_000

#: Collision points in one chunk of the file.
_CHUNK_POINTS = 16_384

_STORED = {
    "compression": "gzip",
    "compression_opts": 1,  # twice as quick as the default, files a few per cent larger
    "shuffle": True,
    "fletcher32": True,
    "track_times": False,
}


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
        self._parts = path.with_name(path.name + ".parts")
        self._pending: list[FrameResult] = []
        self.n_done = 0
        self._write_s = 0.0
        refuse_existing(path, overwrite=overwrite)
        stamp = json.dumps(
            {"settings": header.settings, "rig": header.rig, "engine": header.engine},
            sort_keys=True,
        )
        if self._parts.is_dir() and not overwrite:
            self._take_up(stamp, resume=resume)
        else:
            self._start(stamp)

    def _start(self, stamp: str) -> None:
        try:
            if self._parts.is_dir():
                shutil.rmtree(self._parts)
            self._parts.mkdir(parents=True)
            (self._parts / "settings.json").write_text(stamp, encoding="utf-8")
        except OSError as error:
            raise ReportError(
                f"{self._path}: cannot be written: {error.strerror} ({error.filename})"
            ) from error

    def _take_up(self, stamp: str, *, resume: bool) -> None:
        if not resume:
            raise ReportError(
                f"{self._parts}: a run that was cut off stands there; take it up with --resume, "
                "or start anew with --overwrite"
            )
        settings = self._parts / "settings.json"
        if not settings.is_file() or settings.read_text(encoding="utf-8") != stamp:
            raise ReportError(
                f"{self._parts}: the run that was cut off had other settings; give the same again, "
                "or start anew with --overwrite"
            )
        for part in self._part_paths():
            with np.load(part) as columns:
                self.n_done += len(columns["index"])

    def append(self, result: FrameResult) -> None:
        """Take in one frame's result."""
        self._pending.append(result)
        n_points = sum(len(c.triangle) for r in self._pending for c in r.contacts)
        if len(self._pending) >= _PART_FRAMES or n_points >= _PART_POINTS:
            self._flush()

    def _flush(self) -> None:
        """Finish the part that is being gathered."""
        if not self._pending:
            return
        started = time.perf_counter()
        columns = _columns(self._pending, len(self._header.objects))
        part = self._parts / f"{self.n_done:09d}.npz"
        partial = part.with_suffix(".partial")
        with partial.open("wb") as file:
            np.savez(file, **columns)  # type: ignore[arg-type]  # the stub takes the names for options
        partial.replace(part)
        self.n_done += len(self._pending)
        self._pending = []
        self._write_s += time.perf_counter() - started

    def take_write_s(self) -> float:
        """Return the seconds spent on writing since this was last asked."""
        write_s, self._write_s = self._write_s, 0.0
        return write_s

    def _part_paths(self) -> list[Path]:
        return sorted(self._parts.glob("*.npz"))

    def _part_columns(self, *starts: str) -> Iterator[dict[str, NDArray[Any]]]:
        """Yield of each part the columns whose names begin with one of `starts`; no others load."""
        for part in self._part_paths():
            with np.load(part) as columns:
                yield {name: columns[name] for name in columns.files if name.startswith(starts)}

    def finish(self) -> None:
        """Make the parts the report."""
        self._flush()
        partial = self._path.with_name(self._path.name + ".partial")
        try:
            with h5py.File(partial, "w") as file:
                self._write(file)
            partial.replace(self._path)
        except OSError as error:
            partial.unlink(missing_ok=True)
            raise ReportError(f"{self._path}: cannot be written: {error}") from error
        shutil.rmtree(self._parts)

    def _write(self, file: h5py.File) -> None:
        header = self._header
        file.attrs["format"] = FORMAT
        file.attrs["version"] = VERSION
        file.attrs["created_utc"] = datetime.now(UTC).isoformat(timespec="seconds")
        file.attrs["command"] = header.command
        file.attrs["machine"] = header.machine
        file.attrs["engine"] = header.engine
        file.attrs["renderer"] = header.renderer
        file.attrs["versions"] = json.dumps(header.versions)
        for name, value, description in (
            ("configuration", header.settings, "the resolved configuration, JSON"),
            ("rig", header.rig, "the rig as in rig.json, each camera with mask_shift_px, JSON"),
        ):
            text = file.create_dataset(f"hybridve/settings/{name}", data=json.dumps(value))
            text.attrs["unit"] = "1"
            text.attrs["description"] = description

        rows = list(
            self._part_columns(
                "index",
                "time_s",
                "reason",
                "stage_",
                "n_points_",
                "n_triangles_",
                "certificate_",
                "witness_",
                "open_at_",
            )
        )
        if not rows:
            raise ReportError(f"{self._path}: no frame was evaluated; there is nothing to report")
        frame = {name: np.concatenate([row[name] for row in rows]) for name in rows[0]}
        frames = file.create_group("hybridve/frames")
        _store(frames, "index", frame["index"], "1", "number of the frame in the session")
        _store(frames, "time_s", frame["time_s"], "s", "time from the session's first frame")
        _store(frames, "valid", frame["reason"] == "", "1", "whether the frame was evaluated")
        _store_text(frames, "reason", frame["reason"], "why the frame was not evaluated")
        for stage in STAGES:
            _store(
                frames,
                f"stage_s/{stage}",
                frame[f"stage_{stage}"],
                "s",
                f"seconds of work on the stage {stage!r}, summed over the cameras",
            )
        objects = file.create_group("hybridve/objects", track_order=True)  # the scene's order
        for number, about in enumerate(header.objects):
            group = objects.create_group(about["name"])
            for name, value in about.items():
                if name != "name":
                    group.attrs[name] = value
            self._write_object(group, number, frame)
        numbers = range(len(header.objects))
        add_vtkhdf(
            file,
            (
                by_frame(
                    [columns[f"n_points_{number}"] for number in numbers],
                    [columns[f"xyz_{number}"] for number in numbers],
                    [columns[f"triangle_{number}"] for number in numbers],
                )
                for columns in self._part_columns("n_points_", "xyz_", "triangle_")
            ),
        )

    def _write_object(self, group: h5py.Group, number: int, frame: dict[str, NDArray[Any]]) -> None:
        n_points = frame[f"n_points_{number}"]
        _store(
            group, "collides", n_points > 0, "1", "whether a sample of its surface is in the hull"
        )
        _store(group, "n_points", n_points, "1", "number of collision points")
        _store(
            group,
            "n_triangles",
            frame[f"n_triangles_{number}"],
            "1",
            "number of triangles with a collision point",
        )
        _store_text(
            group,
            "certificate",
            frame[f"certificate_{number}"],
            "colliding: a witness point is in every silhouette; free: proved, no point of the "
            "object is in the hull; open: no disc of diameter open_at_m on its surface is in the "
            "hull; empty: sampled only, or not evaluated",
        )
        _store(
            group,
            "witness_m",
            frame[f"witness_{number}"],
            "m",
            "a point of the surface in every silhouette, world frame; NaN unless colliding",
        )
        _store(
            group,
            "open_at_m",
            frame[f"open_at_{number}"],
            "m",
            "no disc of this diameter on the surface is in the hull; NaN unless open",
        )
        offset = np.concatenate([[0], np.cumsum(n_points, dtype=np.uint64)]).astype(np.uint64)
        _store(
            group,
            "points/offset",
            offset,
            "1",
            "the collision points of row f are points offset[f] to offset[f + 1]",
        )
        total = int(offset[-1])
        # Growing shapes only because HDF5 allows chunks larger than the data in no others.
        chunk = _CHUNK_POINTS if total > _CHUNK_POINTS else max(total, 1)
        xyz = group.create_dataset(
            "points/xyz_m", (total, 3), "f4", chunks=(chunk, 3), maxshape=(None, 3), **_STORED
        )
        xyz.attrs["unit"] = "m"
        xyz.attrs["description"] = "collision points CP_i, world frame"
        triangle = group.create_dataset(
            "points/triangle", (total,), "u4", chunks=(chunk,), maxshape=(None,), **_STORED
        )
        triangle.attrs["unit"] = "1"
        triangle.attrs["description"] = "number of the triangle that the collision point lies on"
        start = 0
        for columns in self._part_columns(f"xyz_{number}", f"triangle_{number}"):
            stop = start + len(columns[f"triangle_{number}"])
            if stop > start:
                xyz[start:stop] = columns[f"xyz_{number}"]
                triangle[start:stop] = columns[f"triangle_{number}"]
            start = stop

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Keep what is done if the run was cut off; it can be taken up again."""
        if kind is not None:
            self._flush()
            if self.n_done == 0:
                shutil.rmtree(self._parts, ignore_errors=True)


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


def _columns(results: list[FrameResult], n_objects: int) -> dict[str, NDArray[Any]]:
    """Return the arrays of one part."""
    columns: dict[str, NDArray[Any]] = {
        "index": np.array([result.index for result in results], np.uint32),
        "time_s": np.array([result.time_s for result in results], np.float64),
        "reason": np.array([result.reason for result in results], np.str_),
    }
    for stage in STAGES:
        columns[f"stage_{stage}"] = np.array(
            [result.stage_s.get(stage, 0.0) for result in results], np.float64
        )
    for number in range(n_objects):
        contacts = [r.contacts[number] if r.is_valid else None for r in results]
        there = [contact for contact in contacts if contact is not None]
        columns[f"n_points_{number}"] = np.array(
            [len(c.triangle) if c is not None else 0 for c in contacts], np.uint32
        )
        columns[f"n_triangles_{number}"] = np.array(
            [c.n_triangles if c is not None else 0 for c in contacts], np.uint32
        )
        columns[f"certificate_{number}"] = np.array(
            [c.certificate if c is not None else "" for c in contacts], np.str_
        )
        columns[f"witness_{number}"] = np.array(
            [c.witness_world if c is not None else np.full(3, np.nan) for c in contacts]
        )
        columns[f"open_at_{number}"] = np.array(
            [c.open_at_m if c is not None else np.nan for c in contacts], np.float64
        )
        columns[f"xyz_{number}"] = np.concatenate(
            [c.points_world for c in there] or [np.zeros((0, 3), np.float32)]
        )
        columns[f"triangle_{number}"] = np.concatenate(
            [c.triangle for c in there] or [np.zeros(0, np.uint32)]
        )
    return columns


def _store(group: h5py.Group, name: str, data: NDArray[Any], unit: str, description: str) -> None:
    dataset = group.create_dataset(name, data=data, chunks=True, **_STORED)
    dataset.attrs["unit"] = unit
    dataset.attrs["description"] = description


def _store_text(group: h5py.Group, name: str, data: NDArray[np.str_], description: str) -> None:
    encoded = [str(text).encode() for text in data]
    kind = h5py.string_dtype("utf-8", max(1, *(len(text) for text in encoded)))
    _store(group, name, np.array(encoded, kind), "1", description)
