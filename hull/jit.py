"""Compilation of numerical loops, typed.

numba ships no types, so its decorator is wrapped once here. Functions release the GIL, so that
plain Python threads run them side by side, and are kept on disk, so that only the first start
after an install compiles. Division by zero gives infinity, as in NumPy.
"""

import logging
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

_logger = logging.getLogger(__name__)
_Function = TypeVar("_Function", bound=Callable[..., Any])


def compiled(function: _Function) -> _Function:
    """Return `function` compiled to machine code when it is first called."""
    try:
        dispatcher = numba.njit(cache=True, nogil=True, error_model="numpy")(function)
    except RuntimeError as error:  # neither the package's folder nor the user's can be written to
        _logger.warning("compiled code is not kept for the next start: %s", error)
        dispatcher = numba.njit(nogil=True, error_model="numpy")(function)
    return cast("_Function", dispatcher)
