"""TOML files that users write: read, checked, and what is wrong told in one line."""

import codecs
import difflib
import os
import re
import tomllib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, get_args

from pydantic import AfterValidator, BaseModel, ValidationError

from hybridve.calib.bounded import (
    DEEPEST,
    has_control,
    is_too_deep,
    printable,
    read_bounded,
    texts_in,
)
from hybridve.calib.errors import HybridveError


def _is_name(name: str) -> str:
    """Refuse what cannot be the name of a thing: it becomes that of a folder and of a group."""
    if not re.fullmatch(r"[^/\\\"'\s]([^/\\\"'\x00-\x1f]*[^/\\\"'\s])?", name) or name[0] == ".":
        raise ValueError(
            f"found {name!r}; expected a name without / \\ and quotes, that begins with no dot and "
            "neither begins nor ends with a space"
        )
    return name


#: What a thing may be called.
Name = Annotated[str, AfterValidator(_is_name)]


#: Where each kind of file comes from, for a person who has none.
_BEGUN_BY = {
    "session": "hybridve init",
    "scene": "hybridve init",
    "plan": "hybridve plan --example",
    "batch": "hybridve batch --help",
}


def read_toml(
    path: Path, kind: str, error_class: type[HybridveError]
) -> tuple[dict[str, Any], bytes]:
    """Return a TOML file's table and its bytes.

    Parameters
    ----------
    path : Path
        The file.
    kind : str
        What its key ``format`` says behind "hybridve-", if it says anything.
    error_class : type
        Of the errors.

    Raises
    ------
    HybridveError
        Of class `error_class`: there is no such file, or it is not TOML (with line and column).
    """
    try:
        text = read_bounded(path)
    except FileNotFoundError:
        begin = f", or begin one with `{_BEGUN_BY[kind]}`" if kind in _BEGUN_BY else ""
        raise error_class(f"{path}: there is no such {kind}; name a {kind}.toml{begin}") from None
    except OSError as error:
        raise error_class(f"{path}: cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise error_class(f"{path}: {error}") from error
    # A key in parts takes the parser the square of their number.
    if any(line.partition(b"=")[0].count(b".") > DEEPEST for line in text.splitlines()):
        raise error_class(
            f"{path}: a key has more than {DEEPEST} parts, so deep are no tables; look at what "
            "was written"
        )
    try:
        table = tomllib.loads(_decoded(text))
    except UnicodeDecodeError as error:
        raise error_class(
            f"{path}: is not UTF-8 at byte {error.start}; save it as UTF-8"
        ) from error
    except tomllib.TOMLDecodeError as error:
        hint = ""
        if re.search(r"escape|hex value|'\\\\'", str(error)):
            hint = "; write folders with /, or the path in 'single quotes'"
        raise error_class(f"{path}: not valid TOML: {error}{hint}") from error
    if is_too_deep(table):
        raise error_class(f"{path}: holds tables nested too deeply; look at what was written")
    for one in texts_in(table):
        if has_control(one):
            raise error_class(
                f"{path}: holds a control character, in {printable(one)[:60]!r}; names and paths "
                "have none"
            )
    found = table.get("format")
    if isinstance(found, str) and found.startswith("hybridve-") and found != f"hybridve-{kind}":
        raise error_class(
            f"{path}: is a {found.removeprefix('hybridve-')} (format = {found!r}), expected a "
            f"{kind}; were two files exchanged?"
        )
    return table, text


def _decoded(text: bytes) -> str:
    """Return a file's text: UTF-8, or what else its first bytes say, as Windows writes it."""
    for mark, encoding in ((codecs.BOM_UTF16_LE, "utf-16"), (codecs.BOM_UTF16_BE, "utf-16")):
        if text.startswith(mark):
            return text.decode(encoding)
    return text.decode("utf-8-sig")


def explain_validation(
    error: ValidationError,
    path: Path,
    model: type[BaseModel] | None = None,
    within: tuple[str | int, ...] = (),
) -> str:
    """Return one line for what is wrong: file, key, what was found and expected.

    A key that does not exist names the one that it is most like.

    Parameters
    ----------
    error : ValidationError
        What pydantic says.
    path : Path
        The file.
    model : type of BaseModel, optional
        What was validated, for the keys that there are.
    within : tuple
        Leads to the table that was checked, in a file that holds more.
    """
    problems = []
    for one in error.errors():
        loc = one["loc"]
        key = ".".join(str(part + 1) if isinstance(part, int) else part for part in (*within, *loc))
        message = one["msg"].removeprefix("Value error, ")
        if one["type"] == "extra_forbidden":
            message = f"there is no such key{like(str(loc[-1]), _keys_at(model, loc))}"
        elif one["type"] == "missing":
            message = "this key is missing"
        elif one["type"] != "value_error":
            found = repr(one["input"])
            message = f"{message}, found {found if len(found) <= 60 else found[:57] + '...'}"
        # A table's own complaint begins with the key that it is about.
        about_key = one["type"] == "value_error" and re.match(r"\w+: ", message)
        between = "." if key and about_key else ": " if key else ""
        problems.append(f"{key}{between}{message}")
    more = len(problems) - _MOST_PROBLEMS
    tail = f" (and {more} more)" if more > 0 else ""
    return f"{path}: {'; '.join(problems[:_MOST_PROBLEMS])}{tail}"


#: Problems that one line tells.
_MOST_PROBLEMS = 4


def like(key: str, known: Sequence[str]) -> str:
    """Return, for a message, the key that another is most like, or those that there are."""
    close = difflib.get_close_matches(key, known, n=1, cutoff=0.65)
    if close:
        return f"; did you mean {close[0]}?"
    return f"; there are {', '.join(known)}" if known else "; look for a spelling mistake"


def _keys_at(model: type[BaseModel] | None, loc: tuple[str | int, ...]) -> list[str]:
    """Return the keys of the table in which a key stands, by the model of the whole."""
    for part in loc[:-1]:
        if model is None or isinstance(part, int):
            continue
        field = model.model_fields.get(part)
        model = None if field is None else _model_in(field.annotation)
    return [] if model is None else list(model.model_fields)


def _model_in(annotation: Any) -> type[BaseModel] | None:
    """Return the one model that an annotation holds, as `list[Camera]`; None for another."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    found = [model for one in get_args(annotation) if (model := _model_in(one)) is not None]
    return found[0] if len(found) == 1 else None


def expand_root(root: str, path: Path, error_class: type[HybridveError]) -> Path:
    """Return the root folder; ``${NAME}`` and ``${NAME:-default}`` stand for the environment.

    Raises
    ------
    HybridveError
        Of class `error_class`: a variable is not set, or there is no such folder.
    """

    def value(match: re.Match[str]) -> str:
        name, default = match["name"], match["default"]
        found = os.environ.get(name) or default
        if found is None:
            raise error_class(f"{path}: root: the environment variable {name} is not set")
        return found

    expanded = re.sub(r"\$\{(?P<name>\w+)(?::-(?P<default>[^}]*))?\}", value, root)
    folder = (path.parent / expanded).resolve()
    if not folder.is_dir():
        raise error_class(f"{path}: root: there is no folder {folder}")
    return folder


@dataclass(frozen=True, slots=True)
class Roots:
    """Where the files that a session or a scene names may lie: nowhere else is anything read.

    Attributes
    ----------
    root : Path
        Where its paths start.
    allowed : tuple of Path
        That, its own folder, and those that its key ``roots`` adds; all resolved.
    """

    root: Path
    allowed: tuple[Path, ...]

    @classmethod
    def of(
        cls, root: str, others: Sequence[str], path: Path, error_class: type[HybridveError]
    ) -> "Roots":
        """Return the folders that a file declares.

        Raises
        ------
        HybridveError
            Of class `error_class`: there is no such folder.
        """
        begin = expand_root(root, path, error_class)
        more = (expand_root(one, path, error_class) for one in others)
        return cls(begin, (begin, path.parent.resolve(), *more))

    def refuse_outside(
        self, name: str, files: Iterable[Path], error_class: type[HybridveError]
    ) -> None:
        """Refuse a name that leads out of the folders, by ``..``, as an absolute path or by links.

        Raises
        ------
        HybridveError
            Of class `error_class`: where it leads, and what would allow it.
        """
        folders: dict[Path, bool] = {}
        for file in files:
            if file.parent not in folders or file.is_symlink() or file.name == "..":
                real = Path(os.path.realpath(file))
                is_inside = any(real.is_relative_to(one) for one in self.allowed)
                if not file.is_symlink():
                    folders[file.parent] = is_inside
            else:
                is_inside = folders[file.parent]
            if not is_inside:
                real = Path(os.path.realpath(file))
                raise error_class(
                    f"{name!r} leads out of {self.root}, to {real}; what lies elsewhere is read "
                    f'only where the file says so: roots = ["{real.parent}"]'
                )
