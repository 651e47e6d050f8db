"""TOML files that users write: read, checked, and what is wrong told in one line."""

import codecs
import os
import re
import tomllib
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from hybridve.calib.errors import HybridveError


def read_toml(
    path: Path, what: str, error_class: type[HybridveError]
) -> tuple[dict[str, Any], bytes]:
    """Return a TOML file's table and its bytes.

    Raises
    ------
    HybridveError
        Of class `error_class`: there is no such file, or it is not TOML (with line and column).
    """
    try:
        text = path.read_bytes()
    except FileNotFoundError:
        raise error_class(f"{path}: there is no such {what}") from None
    except OSError as error:
        raise error_class(f"{path}: cannot be read: {error.strerror}") from error
    try:
        return tomllib.loads(_decoded(text)), text
    except UnicodeDecodeError as error:
        raise error_class(
            f"{path}: is not UTF-8 at byte {error.start}; save it as UTF-8"
        ) from error
    except tomllib.TOMLDecodeError as error:
        hint = ""
        if re.search(r"escape|'\\\\'", str(error)):
            hint = "; write folders with /, or the path in 'single quotes'"
        raise error_class(f"{path}: not valid TOML: {error}{hint}") from error


def _decoded(text: bytes) -> str:
    """Return a file's text: UTF-8, or what else its first bytes say, as Windows writes it."""
    for mark, encoding in ((codecs.BOM_UTF16_LE, "utf-16"), (codecs.BOM_UTF16_BE, "utf-16")):
        if text.startswith(mark):
            return text.decode(encoding)
    return text.decode("utf-8-sig")


def explain_validation(
    error: ValidationError, path: Path, within: tuple[str | int, ...] = ()
) -> str:
    """Return one line for the first thing that is wrong: file, key, what was found and expected.

    `within` leads to the table that was checked, in a file that holds more.
    """
    first = error.errors()[0]
    place = [str(part + 1) if isinstance(part, int) else part for part in (*within, *first["loc"])]
    key = ".".join(place)
    message = first["msg"].removeprefix("Value error, ")
    if first["type"] == "extra_forbidden":
        message = "there is no such key; look for a spelling mistake"
    elif first["type"] == "missing":
        message = "this key is missing"
    elif first["type"] != "value_error":
        found = repr(first["input"])
        message = f"{message}, found {found if len(found) <= 60 else found[:57] + '...'}"
    more = error.error_count() - 1
    tail = f" (and {more} more)" if more else ""
    return f"{path}: {key + ': ' if key else ''}{message}{tail}"


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
