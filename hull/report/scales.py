"""What the axes of a report's datasets are: dimension scales, as xarray and HDFView have them.

Each group of rows has its own: readers of netCDF look for those of a dataset in its group, or in
those above it.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from hybridve.hull.report.result_file import STORED, Described
from hybridve.hull.report.schema import Column

#: Of an axis of so many numbers a row what it is called, and what each is.
_PARTS: Mapping[int, tuple[str, tuple[str, ...]]] = {
    2: ("bound", ("lower", "upper")),
    3: ("axis", ("x", "y", "z")),
    4: ("side", ("left", "top", "right", "bottom")),
}

_ABOUT = {
    "bound": "which of two bounds",
    "axis": "which axis of the world, or of the report's local frame",
    "side": "which side of a rectangle in a picture",
    "camera": "which camera",
}

#: What HDF5's own library writes of scales.
_LISTS = h5py.vlen_dtype(h5py.ref_dtype)
_REFERENCE = np.dtype([("dataset", h5py.ref_dtype), ("dimension", np.int32)])

_TIME = Described("time_s", "s", "exact", "time from the session's first frame")


def label_axes(
    group: h5py.Group,
    columns: Iterable[Column[Any]],
    time_s: NDArray[np.float64],
    cameras: Sequence[str],
) -> None:
    """Say of a group's columns, of which each has a row a frame, what their axes are.

    Parameters
    ----------
    group : h5py.Group
        Has those of the columns that were computed.
    columns : iterable of Column
        What may be in it.
    time_s : (F,) float64
        When the frames were recorded.
    cameras : sequence of C str
        What an axis of "C" goes over.
    """
    there = [column for column in columns if column.name in group]
    if not there:
        return
    along: dict[str, h5py.Dataset] = {}
    refers: dict[str, list[tuple[h5py.Reference, int]]] = {}
    time = _time_scale(group, time_s)
    for column in there:
        dataset = group[column.name]
        if dataset == time:
            continue
        scales = [time]
        for size in column.shape:
            name, parts = ("camera", tuple(cameras)) if size == "C" else _PARTS[int(size)]
            scales.append(_named_scale(group, name, parts))
        _attach(dataset, scales)
        for axis, scale in enumerate(scales):
            along[scale.name] = scale
            refers.setdefault(scale.name, []).append((dataset.ref, axis))
    for name, each in refers.items():
        _add_references(along[name], each)


def _attach(dataset: h5py.Dataset, scales: Sequence[h5py.Dataset]) -> None:
    """Say which scale goes along each axis; as `dims[..].attach_scale` does, at once.

    That writes what the scales refer to anew for each dataset, and leaves the old in the file.
    """
    lists = np.zeros(len(scales), _LISTS)
    for axis, scale in enumerate(scales):
        lists[axis] = np.array([scale.ref], h5py.ref_dtype)
    dataset.attrs.create("DIMENSION_LIST", lists, dtype=_LISTS)


def _add_references(scale: h5py.Dataset, refers: Sequence[tuple[h5py.Reference, int]]) -> None:
    """Say which axes of which datasets a scale goes along."""
    before = list(scale.attrs["REFERENCE_LIST"]) if "REFERENCE_LIST" in scale.attrs else []
    every = np.zeros(len(before) + len(refers), _REFERENCE)
    for row, (dataset, axis) in enumerate([*before, *refers]):
        every[row] = (dataset, axis)
    scale.attrs["REFERENCE_LIST"] = every


def _time_scale(group: h5py.Group, time_s: NDArray[np.float64]) -> h5py.Dataset:
    if _TIME.name not in group:
        scale = group.create_dataset(_TIME.name, data=time_s, chunks=True, **STORED)
        _TIME.describe(scale)
    scale = group[_TIME.name]
    if not scale.is_scale:
        scale.make_scale(_TIME.name)
    return scale


def _named_scale(group: h5py.Group, name: str, parts: tuple[str, ...]) -> h5py.Dataset:
    if name not in group:
        kind = h5py.string_dtype("utf-8", max(1, *(len(part.encode()) for part in parts)))
        values = np.array([part.encode() for part in parts], kind)
        scale = group.create_dataset(name, data=values, dtype=kind, chunks=True, **STORED)
        Described(name, "1", "exact", _ABOUT[name]).describe(scale)
        scale.make_scale(name)
    return group[name]
