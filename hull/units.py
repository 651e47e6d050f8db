"""A night's work: BATCH.toml, sessions by layouts by settings, as command lines.

::

    format = "hybridve-batch"
    version = 1
    sessions = ["recordings/p*", "extra/session.toml"]     # patterns, from the file's folder
    scenes = ["layouts/*.toml"]
    output = "reports"                                      # the folder of the results

    [options]                     # of `hybridve detect`, for all
    viewport = 10

    [[setting]]                   # several of them: each session and layout is run with each
    name = "fine"
    options = { accuracy-mm = 1 }

    [[exception]]                 # where names match, with * and ?; the last one has the last word
    session = "p07*"
    options = { drop-camera = ["cam2"] }   # or: skip = true
"""

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from hybridve.calib.errors import SessionError
from hybridve.hull.report.compare import distinct_names, report_name
from hybridve.hull.toml_io import Name, explain_validation, like, read_toml

#: What an option may be: a number, a text, a flag (false: its ``no-`` form), or several of one.
Value = bool | int | float | str | list[str | int | float]
Options = dict[str, Value]


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)


class _SettingTable(_Table):
    name: Name
    options: Options = {}


class _ExceptionTable(_Table):
    session: str = "*"
    scene: str = "*"
    setting: str = "*"
    skip: bool = False
    options: Options = {}


class _BatchTable(_Table):
    format: Literal["hybridve-batch"]
    version: Literal[1]
    sessions: Annotated[list[str], Field(min_length=1)]
    scenes: Annotated[list[str], Field(min_length=1)]
    output: str
    options: Options = {}
    setting: list[_SettingTable] = []
    exception: list[_ExceptionTable] = []


@dataclass(frozen=True, slots=True)
class Unit:
    """One piece of work, which is one command line.

    Attributes
    ----------
    name : str
        Unique in the batch; that of its result without ``.h5``.
    session, layout, setting : str
        Names of what it is made of; ``setting`` is empty where there is one only.
    session_path, scene_path : Path
        Their files.
    output : Path
        The report.
    words : tuple of str
        The command line, from ``detect`` on.
    """

    name: str
    session: str
    layout: str
    setting: str
    session_path: Path
    scene_path: Path
    output: Path
    words: tuple[str, ...]

    @property
    def line(self) -> str:
        """The command line, as a shell takes it."""
        return command_line(self.words)


def command_line(words: Sequence[str]) -> str:
    """Return what a shell takes for ``hybridve`` with arguments."""
    return shlex.join(["hybridve", *words])


@dataclass(frozen=True, slots=True)
class Batch:
    """All units of a batch, in the order in which they begin.

    Attributes
    ----------
    path : Path
        Its file; None of several sessions on one command line.
    output : Path
        The folder of its results.
    units : tuple of Unit
        At least one.
    """

    path: Path | None
    output: Path
    units: tuple[Unit, ...]


def load_batch(path: Path) -> Batch:
    """Return the units that a BATCH.toml asks for.

    Raises
    ------
    SessionError
        One line that names the key at fault; a pattern that nothing matches is a fault.
    """
    table, _ = read_toml(path, "batch", SessionError)
    try:
        parsed = _BatchTable.model_validate(table)
    except ValidationError as error:
        raise SessionError(explain_validation(error, path, _BatchTable)) from None
    folder = path.parent
    sessions = _found(folder, parsed.sessions, "sessions", "session.toml", path)
    scenes = _found(folder, parsed.scenes, "scenes", "scene.toml", path)
    settings = {one.name: one.options for one in parsed.setting} or {"": {}}
    if len(settings) < len(parsed.setting):
        raise SessionError(f"{path}: setting: two have one name; give each its own")
    names = {
        "session": [*sessions],
        "scene": [*scenes],
        "setting": [*settings],
    }
    for number, exception in enumerate(parsed.exception, start=1):
        for key, known in names.items():
            pattern = getattr(exception, key)
            if pattern != "*" and not any(fnmatchcase(name, pattern) for name in known):
                raise SessionError(
                    f"{path}: exception.{number}.{key}: nothing is called {pattern!r}"
                    f"{like(pattern, known)}"
                )
    output = folder / parsed.output
    units = []
    for setting, its_options in settings.items():
        for session, session_path in sessions.items():
            for layout, scene_path in scenes.items():
                options = parsed.options | its_options
                skip = False
                for one in parsed.exception:
                    pairs = (
                        (session, one.session),
                        (layout, one.scene),
                        (setting, one.setting),
                    )
                    if all(fnmatchcase(name, pattern) for name, pattern in pairs):
                        options |= one.options
                        skip = one.skip or (skip and not one.options)
                if skip:
                    continue
                units.append(
                    make_unit((session, layout, setting), session_path, scene_path, output, options)
                )
    if not units:
        raise SessionError(f"{path}: exception: all is skipped; nothing is left to do")
    return Batch(path, output, tuple(units))


def make_unit(
    names: tuple[str, str, str],
    session_path: Path,
    scene_path: Path,
    output: Path,
    options: Mapping[str, Value],
) -> Unit:
    """Return the unit of a session, a layout and a setting."""
    session, layout, setting = names
    name = report_name(session, layout).removesuffix(".h5")
    if setting:
        name = f"{name}__{setting}"
    report = output / f"{name}.h5"
    words = ["detect", str(session_path), "--scene", str(scene_path), "-o", str(report)]
    return Unit(name, *names, session_path, scene_path, report, (*words, *_words(options)))


def _words(options: Mapping[str, Value]) -> list[str]:
    """Return options as they stand on a command line."""
    words = []
    for key, value in options.items():
        if isinstance(value, bool):
            words.append(f"--{key}" if value else f"--no-{key.removeprefix('no-')}")
        else:
            for one in value if isinstance(value, list) else [value]:
                words += [f"--{key}", str(one)]
    return words


def _found(
    folder: Path, patterns: Sequence[str], key: str, default: str, path: Path
) -> dict[str, Path]:
    """Return the files that patterns stand for, by a short name for each."""
    files: list[Path] = []
    for pattern in patterns:
        try:
            if any(mark in pattern for mark in "*?["):
                anchor = Path(pattern).anchor
                base = Path(anchor) if anchor else folder
                matching = sorted(base.glob(pattern.removeprefix(anchor)))
            else:
                matching = [folder / pattern]
        except (ValueError, NotImplementedError) as error:
            raise SessionError(f"{path}: {key}: {pattern!r} is no pattern: {error}") from None
        found = [one / default if one.is_dir() else one for one in matching]
        if any(mark in pattern for mark in "*?["):
            found = [one for one in found if one.is_file() and one.suffix == ".toml"]
            if not found:
                raise SessionError(f"{path}: {key}: no {default} matches {pattern!r} in {folder}")
        files += [one for one in found if one not in files]
    try:
        return dict(zip(distinct_names(files, default), files, strict=True))
    except ValueError as error:
        raise SessionError(f"{path}: {key}: {error}") from None
