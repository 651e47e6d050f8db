"""Pages from templates: Jinja's environment, in which all text is escaped, and values as text."""

import math
from collections.abc import Iterable, Mapping
from functools import cache
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, Template


class Unknown:
    """What stands for a number that there is not: a word in text, set apart on a page."""

    def __str__(self) -> str:
        return "unknown"

    def __html__(self) -> str:
        return f'<span class="none">{self}</span>'


_UNKNOWN = Unknown()

#: Values that hold others.
_NESTED = (Mapping, list, tuple, set, frozenset)


def page_template(name: str) -> Template:
    """Return a template of ``hull/view/templates``.

    All that is put into it is escaped, and a name that nothing was given for is an error.
    """
    return _environment().get_template(name)


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader(__package__),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {
        "columns": _columns,
        "degrees": math.degrees,
        "fixed": _fixed,
        "in_order": _in_order,
        "mm": _length,
        "number": number,
        "percent": _percent,
        "said": _said,
    }
    environment.tests["nested"] = lambda value: isinstance(value, _NESTED)
    return environment


def number(value: float) -> str | Unknown:
    """Return a number to two digits that count, or to whole ones; no power of ten if sane."""
    if not math.isfinite(value):
        return _UNKNOWN
    if value == 0:
        return "0"
    magnitude = math.floor(math.log10(abs(value)))
    if not -5 <= magnitude < 7:
        return f"{value:.1e}"
    return f"{value:.{max(0, 1 - magnitude)}f}"


def _fixed(value: float, decimals: int) -> str | Unknown:
    return f"{value:.{decimals}f}" if math.isfinite(value) else _UNKNOWN


def _percent(share: float) -> str | Unknown:
    return f"{100 * share:.0f} %" if math.isfinite(share) else _UNKNOWN


def _length(length_m: float) -> str | Unknown:
    return f"{number(1000 * length_m)} mm" if math.isfinite(length_m) else _UNKNOWN


def _said(value: Any) -> str | Unknown:
    """Return a plain value that holds no others in words."""
    if value is None:
        return _UNKNOWN
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}" if math.isfinite(value) else _UNKNOWN
    return str(value)


def _in_order(values: Iterable[Any]) -> list[Any]:
    """Return the entries of a list, or those of a set in an order that is always the same."""
    return sorted(values, key=str) if isinstance(values, set | frozenset) else list(values)


def _columns(rows: Iterable[Mapping[Any, Any]]) -> list[Any]:
    """Return the keys of all rows, each once, in the order in which they first come."""
    return list(dict.fromkeys(key for row in rows for key in row))
