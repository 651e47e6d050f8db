"""Compilation of numerical loops, typed.

numba ships no types, so its decorator is wrapped once here. Functions release the GIL, so that
plain Python threads run them side by side, and are kept on disk, so that nothing compiles after
the first time (see `hybridve.hull.prepare`). Division by zero gives infinity, as in NumPy.

numba notices when the file of a function changes, but not when a function that it calls does, in
another file. So what is kept lies in a folder named after all sources that are compiled and where
they are, in ``compiled`` of the cache (see `hybridve.calib.cache`), or in ``NUMBA_CACHE_DIR`` where
that is set. To load this module reads the sources, and makes nothing; the folder is opened for the
first function that is called.

numba's own files break what reads them where one is damaged, and where the disk is full. Here each
function, for each types, is one file under a name made of both, with a checksum: one that is
damaged is compiled anew, and where nothing can be written, nothing is kept.
"""

import hashlib
import logging
import os
import pickle
import shutil
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

import llvmlite.binding
import numba
import numpy as np
from numba.core import types
from numba.core.caching import CompileResultCacheImpl
from numba.core.serialize import dumps
from numba.extending import intrinsic

from hybridve.calib.cache import cache_folder
from hybridve.calib.files import appearing

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


class _Code(CompileResultCacheImpl):  # type: ignore[misc]  # numba has no types
    """Turns compiled code into what can be kept, and back."""

    def __init__(self) -> None:
        """Look for no folder, as numba's own does."""


_CODE = _Code()


class _KeptCode:
    """What is kept of one function's compiled code; no folder is touched before it is asked for.

    numba asks it as it would ask its own `numba.core.caching.FunctionCache`.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function

    @property
    def cache_path(self) -> str | None:
        """The folder."""
        return None if folder() is None else str(folder())

    def enable(self) -> None:
        """Nothing turns it off."""

    disable = flush = enable

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the code for arguments of some types, or None."""
        target_context.refresh()
        key = self._key(sig, target_context.codegen())
        path = self._path(key)
        if path is None:
            return None
        try:
            content = path.read_bytes()
        except FileNotFoundError:
            return None
        except OSError as error:
            _logger.info("%s: compiled anew: %s", path, error.strerror)
            return None
        digest, data = content[:_DIGEST_BYTES], content[_DIGEST_BYTES:]
        if hashlib.sha256(data).digest() != digest:
            _logger.info("%s: is damaged, compiled anew", path)
            return None
        try:
            stored, payload = pickle.loads(data)
            return _CODE.rebuild(target_context, payload) if stored == key else None
        except Exception as error:  # of another library's version, and that has many names
            _logger.info("%s: cannot be used, compiled anew: %s", path, error)
            return None

    def save_overload(self, sig: Any, code: Any) -> None:
        """Keep the code for arguments of some types, where there is a folder and room."""
        key = self._key(sig, code.codegen)
        path = self._path(key)
        if path is None:
            return
        data = dumps((key, _CODE.reduce(code)))
        try:
            with appearing(path, is_contended=True) as partial:
                partial.write_bytes(hashlib.sha256(data).digest() + data)
        except OSError as error:
            _logger.warning("compiled code is not kept for the next start: %s", error)

    def _key(self, sig: Any, codegen: Any) -> tuple[Any, ...]:
        """Return what the code depends on besides the sources, which name the folder."""
        name = f"{self._function.__module__}.{self._function.__qualname__}"
        return name, str(sig), codegen.magic_tuple(), sys.implementation.cache_tag

    def _path(self, key: tuple[Any, ...]) -> Path | None:
        kept = folder()
        if kept is None:
            return None
        module = self._function.__module__.rpartition(".")[2]
        digits = hashlib.sha256(repr(key).encode()).hexdigest()[:_DIGITS]
        return kept / f"{module}.{self._function.__name__}.{digits}.nbc"


#: Bytes of the checksum that a file of compiled code begins with.
_DIGEST_BYTES = 32


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


def _fused(_typing: Any, _a: Any, _b: Any, _c: Any) -> Any:
    def generate(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return builder.fma(*arguments)

    return types.float64(types.float64, types.float64, types.float64), generate


#: The product of two numbers and the sum with a third, rounded once; for compiled functions.
fused = cast("Callable[[float, float, float], float]", intrinsic(_fused))
