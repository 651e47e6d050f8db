"""Compilation of numerical loops, typed.

numba ships no types, so its decorator is wrapped once here. Functions release the GIL, so that
plain Python threads run them side by side, and are kept on disk, so that nothing compiles after
the first time (see `hybridve.hull.prepare`). Division by zero gives infinity, as in NumPy.

numba notices when the file of a function changes, but not when a function that it calls does, in
another file. So what is kept lies in a folder named after all sources that are compiled and where
they are, in ``compiled`` of the cache (see `hybridve.calib.cache`), or in ``NUMBA_CACHE_DIR`` where
that is set. To load this module reads the sources, and makes nothing; the folder is opened for the
first function that is called.
"""

import hashlib
import logging
import os
import shutil
import time
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

import llvmlite.binding
import numba
import numpy as np
from numba.core.caching import FunctionCache, NullCache

from hybridve.calib.cache import cache_folder

_logger = logging.getLogger(__name__)
_Function = TypeVar("_Function", bound=Callable[..., Any])

#: Code that no start has used for so long is removed, in seconds: its sources have changed.
_FORGOTTEN_AFTER_S = 30 * 24 * 3600.0

_DIGITS = 16


def open_folder(name: str | None = None) -> Path | None:
    """Return the folder of compiled code for these sources on this machine; None for none.

    It is made where there is none. Folders of other sources that are not used any more go then.
    Its name is that of the sources as they stand, unless another is given.
    """
    users = numba.config.CACHE_DIR
    base = Path(users) if users else cache_folder("compiled")
    if base is None:
        return None
    folder = base / (name or _digest())
    try:
        if not folder.is_dir():
            folder.mkdir(parents=True, exist_ok=True)
            if not users:
                _drop_forgotten(base)
        os.utime(folder)  # the time of last use
    except OSError as error:
        _logger.warning("compiled code is not kept for the next start: %s", error)
        return None
    if not os.access(folder, os.W_OK | os.X_OK):
        # numba would turn to __pycache__, where it does not notice changes of other files.
        _logger.warning("compiled code is not kept for the next start: %s is read-only", folder)
        return None
    return folder


def _digest() -> str:
    here = Path(__file__).resolve().parent
    digest = hashlib.sha256(os.fsencode(here))  # numba keeps the code of each place apart, too
    for source in sorted(here.rglob("*.py")):
        text = source.read_bytes()
        if b"hull.jit import" in text:
            digest.update(text)
    digest.update(f"{numba.__version__} {llvmlite.binding.get_host_cpu_name()}".encode())
    return digest.hexdigest()[:_DIGITS]


def _drop_forgotten(base: Path) -> None:
    """Remove folders of compiled code that were not used for long."""
    for folder in base.glob("[0-9a-f]" * _DIGITS):
        with suppress(OSError):  # another process was faster
            if time.time() - folder.stat().st_mtime > _FORGOTTEN_AFTER_S:
                shutil.rmtree(folder, ignore_errors=True)


#: The sources as they are loaded: what is compiled later is of these, whatever stands there then.
_LOADED = _digest()


@cache
def folder() -> Path | None:
    """Return where this program keeps compiled code, or None; the folder is there from now on."""
    opened = open_folder(_LOADED)
    if opened is not None:
        numba.config.CACHE_DIR = str(opened)
    return opened


class _KeptCode:
    """What is kept of one function's compiled code; no folder is touched before it is asked for."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function
        self._code: Any = None

    def __getattr__(self, name: str) -> Any:
        if self._code is None:
            self._code = NullCache() if folder() is None else FunctionCache(self._function)
        return getattr(self._code, name)


#: A zero to begin counts with. For one written out, numba compiles what takes it a second time.
ZERO = cast(int, np.int64(0))


def compiled(function: _Function) -> _Function:
    """Return `function` compiled to machine code when it is first called."""
    return _compile(function)


def inlined(function: _Function) -> _Function:
    """Return `function` compiled into its callers: for small ones in the innermost loops."""
    return _compile(function, forceinline=True)


def _compile(function: _Function, **options: bool) -> _Function:
    dispatcher = numba.njit(nogil=True, no_cfunc_wrapper=True, error_model="numpy", **options)(
        function
    )
    # numba's own would make the folder here, whether or not anything is ever compiled.
    dispatcher._cache = _KeptCode(function)
    return cast("_Function", dispatcher)
