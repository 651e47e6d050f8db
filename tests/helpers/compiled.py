"""What compiled code was compiled of."""

from collections.abc import Callable
from typing import Any


def source_of(compiled: Callable[..., Any]) -> Callable[..., Any]:
    """Return the Python function behind a compiled one: it can be listened to."""
    dispatcher: Any = compiled
    source: Callable[..., Any] = dispatcher.py_func
    return source
