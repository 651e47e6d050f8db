"""Compilation of numerical loops, typed.

numba ships no types, so its decorator is wrapped once here. Functions release the GIL, so that
plain Python threads run them side by side, and are kept on disk, so that only the first start
after an install compiles. Division by zero gives infinity, as in NumPy.

numba notices when the file of a function changes, but not when a function that it calls does, in
another file. So what is kept lies in a folder named after all sources that are compiled.
"""

import hashlib
import logging
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
import numpy as np

_logger = logging.getLogger(__name__)
_Function = TypeVar("_Function", bound=Callable[..., Any])


def _kept_under() -> Path:
    """Return the folder of compiled code that belongs to the sources as they are."""
    digest = hashlib.sha256()
    for source in sorted(Path(__file__).parent.rglob("*.py")):
        text = source.read_bytes()
        if b"hull.jit import" in text:
            digest.update(text)
    base = numba.config.CACHE_DIR
    if not base:
        users = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
        base = Path(users).expanduser() / "hybridve" / "compiled"
    return Path(base) / digest.hexdigest()[:16]


numba.config.CACHE_DIR = str(_kept_under())

#: A zero to begin counts with. For one written out, numba compiles what takes it a second time.
ZERO = cast(int, np.int64(0))


def compiled(function: _Function) -> _Function:
    """Return `function` compiled to machine code when it is first called."""
    return _compile(function)


def inlined(function: _Function) -> _Function:
    """Return `function` compiled into its callers: for small ones in the innermost loops."""
    return _compile(function, forceinline=True)


def _compile(function: _Function, **options: bool) -> _Function:
    try:
        dispatcher = numba.njit(cache=True, nogil=True, error_model="numpy", **options)(function)
    except RuntimeError as error:  # the folder cannot be written to
        _logger.warning("compiled code is not kept for the next start: %s", error)
        dispatcher = numba.njit(nogil=True, error_model="numpy", **options)(function)
    return cast("_Function", dispatcher)
