"""The process that reads HDF5 files of strangers from end to end; see `hybridve.hull.stored`.

It takes names from its input, one a line, and answers each with what is wrong with the file, or an
empty text. It loads nothing but h5py, and may take so much memory and no more.
"""

import errno
import json
import math
import os
import sys
from contextlib import suppress
from typing import Any

import h5py

#: Bytes of memory that it may take.
_MEMORY_B = 3 << 30

#: Bytes of a chunk, and of a dataset that is read as a whole though little of it is stored.
_CHUNK_B, _UNSTORED_B = 256 << 20, 256 << 20

#: How many times as much as is stored a dataset may hold: more, no compression makes of anything.
_MOST_TIMES = 1100

#: What ParaView reads, and hybridve does not.
_FOR_PARAVIEW = "/VTKHDF/"

#: Groups inside each other, and things in a file at most.
_DEEPEST, _MOST_THINGS = 32, 1_000_000

#: Bytes that are read at once.
_BLOCK_B = 32 << 20


class RefusedError(Exception):
    """What a file holds, and ours do not."""


def look_through(path: bytes) -> str:
    """Return what is wrong with a file; empty if nothing is."""
    try:
        with h5py.File(path, "r") as file:
            _walk(file)
    except RefusedError as error:
        return str(error)
    except Exception as error:  # whatever HDF5 makes of it
        number = getattr(error, "errno", None)
        if number in (errno.EAGAIN, errno.EWOULDBLOCK) or "unable to lock" in str(error):
            return "in use"
        return (str(error).splitlines() or [type(error).__name__])[0]
    return ""


def _walk(file: h5py.File) -> None:
    seen: set[Any] = set()
    rest = [(file["/"], "/", 0)]
    while rest:
        group, name, depth = rest.pop()
        if depth > _DEEPEST:
            raise RefusedError(f"holds groups nested more than {_DEEPEST} deep")
        _read_attributes(group)
        for key in group:
            label = f"{name}{key}"
            kind = group.id.links.get_info(key.encode("utf-8", "surrogateescape")).type
            if kind == h5py.h5l.TYPE_SOFT and name.startswith(_FOR_PARAVIEW):
                continue  # ours has some there, and nobody here reads them
            if kind != h5py.h5l.TYPE_HARD:
                which = "a link to another file" if kind == h5py.h5l.TYPE_EXTERNAL else "a link"
                raise RefusedError(f"holds {which}, {label[:80]!r}, which no file of ours does")
            one = group[key]
            token = _token(one)
            if token in seen:
                continue
            seen.add(token)
            if len(seen) > _MOST_THINGS:
                raise RefusedError(f"holds more than {_MOST_THINGS} things")
            if isinstance(one, h5py.Group):
                rest.append((one, f"{label}/", depth + 1))
            elif isinstance(one, h5py.Dataset):
                _read_attributes(one)
                _read(one, label)


def _token(one: Any) -> Any:
    about = h5py.h5o.get_info(one.id)
    return about.fileno, about.addr


def _read_attributes(one: Any) -> None:
    for name in one.attrs:
        one.attrs[name]


def _read(data: h5py.Dataset, label: str) -> None:
    how = data.id.get_create_plist()
    if how.get_external_count():
        raise RefusedError(f"keeps {label[:80]!r} in another file, which no file of ours does")
    if data.is_virtual:
        raise RefusedError(f"gathers {label[:80]!r} from elsewhere, which no file of ours does")
    if data.shape is None:
        return
    each_b = max(data.dtype.itemsize, 1)
    whole_b = math.prod(data.shape) * each_b
    chunk_b = math.prod(data.chunks) * each_b if data.chunks else 0
    if chunk_b > _CHUNK_B:
        raise RefusedError(f"{label[:80]!r} has chunks of {chunk_b:.3g} bytes")
    is_by_row = bool(data.chunks) and data.chunks[0] == 1 and data.ndim > 1
    stored_b = data.id.get_storage_size()
    if (
        whole_b > _UNSTORED_B
        and whole_b > _MOST_TIMES * stored_b
        and not (is_by_row and data.shape[0] <= _MOST_THINGS)
    ):
        raise RefusedError(
            f"{label[:80]!r} says that it holds {whole_b:.3g} bytes, of which {stored_b} are there"
        )
    if not data.shape:
        data[()]
        return
    rows = max(1, int(_BLOCK_B // max(1, whole_b // max(data.shape[0], 1))))
    for start in range(0, data.shape[0], rows):
        with suppress(OSError):  # a checksum that is wrong is told when somebody needs these rows
            data[start : start + rows]


def _main() -> None:
    with suppress(ImportError, ValueError, OSError):
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (_MEMORY_B, _MEMORY_B))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    out = os.dup(sys.stdout.fileno())
    for line in sys.stdin.buffer:
        answer = look_through(bytes.fromhex(json.loads(line)))
        os.write(out, json.dumps(answer).encode() + b"\n")


if __name__ == "__main__":
    _main()
