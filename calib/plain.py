"""Plain values: dataclasses and arrays as JSON has them, and dataclasses back from it.

Reading is so strict that nothing is passed over in silence. A dataclass becomes an object with its
fields as keys. A field whose default is None is left out where it is None; all others must be
there, of their type, and nothing else may be.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any, ClassVar, TypeVar

import numpy as np

from hybridve.calib.errors import CalibrationError

_T = TypeVar("_T")


class Told:
    """Values that are written as JSON, and read so strictly that no key is passed over."""

    __slots__ = ()
    __pydantic_config__: ClassVar[dict[str, Any]] = {
        "extra": "forbid",
        "strict": True,
        "alias_generator": lambda name: name.removesuffix("_"),  # `is` is a word of Python
    }


def to_plain(value: Any) -> Any:
    """Return dataclasses, mappings, sequences and arrays as dicts, lists and Python's values."""
    if is_dataclass(value):
        return {
            one.name.removesuffix("_"): to_plain(getattr(value, one.name))
            for one in fields(value)
            if one.default is not None or getattr(value, one.name) is not None
        }
    if isinstance(value, Mapping):
        return {key: to_plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [to_plain(entry) for entry in value]
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value


def to_json(value: Any) -> Any:
    """Return what `to_plain` returns, with None for numbers that are not finite.

    Examples
    --------
    >>> to_json({"range_m": np.array([0.5, np.inf])})
    {'range_m': [0.5, None]}
    """
    return _finite(to_plain(value))


def _finite(plain: Any) -> Any:
    if isinstance(plain, dict):
        return {key: _finite(entry) for key, entry in plain.items()}
    if isinstance(plain, list):
        return [_finite(entry) for entry in plain]
    return None if isinstance(plain, float) and not math.isfinite(plain) else plain


def read_strictly(kind: type[_T], told: Mapping[str, Any], where: str) -> _T:
    """Return a dataclass of `Told` from its JSON values.

    Raises
    ------
    CalibrationError
        Naming the first key that is missing, unknown, or of another type.
    """
    # Late: most commands read nothing, and need not wait for pydantic.
    from pydantic import TypeAdapter, ValidationError

    try:
        found = TypeAdapter(kind).validate_json(json.dumps(told))
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in (where, *first["loc"]))
        what = {"missing": "is missing", "extra_forbidden": "is not known"}.get(
            first["type"], first["msg"].removeprefix("Value error, ")
        )
        raise CalibrationError(f"{key}: {what}") from error
    return found
