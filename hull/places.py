"""Where the inputs of a command lie, and which files are results that may be replaced.

``--overwrite`` replaces results. It must not replace what a command reads, nor anything else that
lies among recordings and is no result of ours: a slip of the hand would cost a recording.
"""

import os
import re
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hybridve.calib.bounded import texts_in
from hybridve.calib.errors import HybridveError, ReportError
from hybridve.hull.toml_io import expand_root, read_toml

#: What pictures and pages of ours say of themselves.
MARK = "made by hybridve"

#: What stands at the beginning of each of our results, or at the end of a film.
MARKS = re.compile(
    rb"hybridve-(report|simulation|simulation-sweep|sweep|spacing|silhouettes|rig)\b|"
    + MARK.encode()
)

#: Bytes at the beginning of a file, and at its end, in which a mark is looked for.
_HEAD, _TAIL = 65_536, 256

#: What the cameras' folders of a session, and patterns of files, begin with.
_WILD = re.compile(r"[*?\[{]")


@dataclass(frozen=True, slots=True)
class Inputs:
    """What a command reads.

    Attributes
    ----------
    files : frozenset of Path
        Files that it reads, resolved.
    folders : frozenset of Path
        Folders in which they lie, resolved.
    listed : frozenset of Path
        Those of them of which patterns take the files, resolved.
    """

    files: frozenset[Path]
    folders: frozenset[Path]
    listed: frozenset[Path]

    @classmethod
    def of(cls, paths: Iterable[Path]) -> "Inputs":
        """Return what is read where sessions, scenes, rigs, reports or folders are given."""
        files: set[Path] = set()
        folders: set[Path] = set()
        listed: set[Path] = set()
        for path in paths:
            _gather(path, files, folders, listed)
        return cls(frozenset(files), frozenset(folders | listed), frozenset(listed))

    def refuse(self, output: Path, *, is_kept_here: bool = False) -> None:
        """Refuse to write an output that is an input, or in the place of a stranger's file.

        Parameters
        ----------
        output : Path
            The file that is to be written.
        is_kept_here : bool
            Whether the session keeps this very result among its files, as its rig.

        Raises
        ------
        ReportError
            Saying what stands there.
        """
        found = _resolved(output)
        if found in self.files and not (is_kept_here and is_result(found)):
            raise ReportError(
                f"{output}: is an input of this very command, and is not replaced; choose another "
                "name for the output"
            )
        if found.is_file() and not is_result(found):
            for folder in self.folders:
                if found.is_relative_to(folder):
                    raise ReportError(
                        f"{output}: lies among the inputs, in {folder}, and is no result of "
                        "hybridve; it is not replaced, choose another name for the output"
                    )


def is_result(path: Path) -> bool:
    """Tell whether a file is one that this program made as a result."""
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD)
            file.seek(0, os.SEEK_END)
            file.seek(max(0, file.tell() - _TAIL))
            return MARKS.search(head) is not None or MARKS.search(file.read()) is not None
    except OSError:
        return False


def _resolved(path: Path) -> Path:
    try:
        return path.resolve()
    except (OSError, RuntimeError):  # links in a circle
        return path.absolute()


def _gather(path: Path, files: set[Path], folders: set[Path], listed: set[Path]) -> None:
    """Add what is read where `path` is given."""
    if "{camera}" in str(path):
        pattern = str(path.relative_to(path.anchor)).replace("{camera}", "*")
        with suppress(OSError, ValueError):
            files.update(map(_resolved, Path(path.anchor).glob(pattern)))
        return
    if path.is_dir():
        if not (path / "session.toml").is_file():
            with suppress(OSError):
                files.update(_resolved(one) for one in path.iterdir() if one.is_file())
            return
        path = path / "session.toml"
    files.add(_resolved(path))
    if path.suffix != ".toml":
        if path.suffix == ".h5":
            folders.add(_resolved(path.parent))
        return
    try:
        table, _ = read_toml(path, "session", HybridveError)
    except HybridveError:
        with suppress(HybridveError):
            table, _ = read_toml(path, "scene", HybridveError)
            _gather_named(table, path, files, folders, listed)
        return  # what is wrong is told by who reads it
    _gather_named(table, path, files, folders, listed)
    kept = (path.parent / "silhouettes.h5", path.parent / "rig" / "rig.json")
    files.update(_resolved(one) for one in kept if one.is_file())


def _gather_named(
    table: dict[str, Any], path: Path, files: set[Path], folders: set[Path], listed: set[Path]
) -> None:
    root = path.parent
    if isinstance(told := table.get("root"), str):
        with suppress(HybridveError):
            root = expand_root(told, path, HybridveError)
    folders.update((_resolved(path.parent), _resolved(root)))
    for other in table.get("roots", []) if isinstance(table.get("roots"), list) else ():
        with suppress(HybridveError, TypeError):
            folders.add(expand_root(other, path, HybridveError))
    for text in texts_in(table):
        with suppress(OSError, ValueError):
            wild = _WILD.search(text)
            named = root / (text if wild is None else text[: wild.start()].rpartition("/")[0])
            if wild is None and named.is_file():
                files.add(_resolved(named))
            elif wild is not None and named.is_dir():
                listed.add(_resolved(named))
