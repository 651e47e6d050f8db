"""JSON and TOML of strangers: as deep as a description is, and no deeper; free of control marks."""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

#: Tables and lists inside each other at most.
DEEPEST = 64

#: Control characters, and those that turn the direction of text: none belongs in a name.
_CONTROL = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")

#: Marks that a terminal would obey, and half characters of names that are not UTF-8.
_UNPRINTABLE = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")


#: Columns of indentation at most, and bytes of a whole file.
_MOST_INDENTED, _MOST_B = 400, 256_000_000


def read_bounded(path: Path) -> bytes:
    """Return a structured text, TOML, JSON, YAML or XML, that no parser can come to grief over.

    Raises
    ------
    ValueError
        If it is nested more than `DEEPEST` deep, or larger than descriptions are.
    OSError
        If it cannot be read.
    """
    if path.stat().st_size > _MOST_B:
        raise ValueError(f"is larger than {_MOST_B // 1_000_000} MB; that is no description")
    content = path.read_bytes()
    if _depth(content) > DEEPEST:
        raise ValueError(_too_deep())
    return content


def _depth(content: bytes) -> int:
    """Return how deeply a structured text is nested, or more."""
    if content.lstrip()[:1] == b"<":
        marks = re.finditer(rb"<([/!?]?)[^<>]*?(/?)>", content)
        steps = (
            0 if mark[1] in (b"!", b"?") or mark[2] else -1 if mark[1] else 1 for mark in marks
        )
    else:
        indented = re.findall(rb"^[ \t-]+", content, re.MULTILINE)
        if indented and max(map(len, indented)) > _MOST_INDENTED:
            return DEEPEST + 1
        steps = (1 if mark[0] in b"[{" else -1 for mark in re.finditer(rb"[\[{\]}]", content))
    depth = deepest = 0
    for step in steps:
        depth = max(0, depth + step)
        deepest = max(deepest, depth)
    return deepest


def parse_json(text: str | bytes) -> Any:
    """Return what a JSON text holds.

    Raises
    ------
    ValueError
        If it is not JSON, or nested more than `DEEPEST` deep.
    """
    try:
        found = json.loads(text)
    except RecursionError:
        raise ValueError(_too_deep()) from None
    if is_too_deep(found):
        raise ValueError(_too_deep())
    return found


def _too_deep() -> str:
    return f"holds tables or lists nested more than {DEEPEST} deep; that is no description"


def is_too_deep(value: Any) -> bool:
    """Tell whether tables and lists stand inside each other more than `DEEPEST` deep."""
    level = [value]
    for _ in range(DEEPEST + 1):
        level = [inner for one in level for inner in _inner(one)]
        if not level:
            return False
    return True


def _inner(value: Any) -> list[Any]:
    found = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return [one for one in found if isinstance(one, dict | list)]


def texts_in(value: Any) -> Iterator[str]:
    """Yield all keys and texts in tables and lists, however deep."""
    rest = [value]
    while rest:
        one = rest.pop()
        if isinstance(one, str):
            yield one
        elif isinstance(one, dict):
            rest.extend(one)
            rest.extend(one.values())
        elif isinstance(one, list):
            rest.extend(one)


def has_control(text: str) -> bool:
    """Tell whether a text holds a control character other than a tab and the ends of lines."""
    return _CONTROL.search(text) is not None


def printable(text: str) -> str:
    r"""Return a text with what a terminal would obey spelt out.

    Examples
    --------
    >>> printable("a\x1b[2Jb")
    'a\\x1b[2Jb'
    """
    return _UNPRINTABLE.sub(lambda mark: mark[0].encode("unicode_escape").decode(), text)
