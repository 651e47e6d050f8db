"""An engine in a thread of its own."""

from collections.abc import Callable
from concurrent.futures import CancelledError, ThreadPoolExecutor
from threading import Event
from types import TracebackType
from typing import ParamSpec, Self, TypeVar

from hybridve.hull.query.engine import Engine

Result = TypeVar("Result")
Arguments = ParamSpec("Arguments")


class EngineRoom:
    """Opens an engine in a thread of its own, where all its work is done.

    A thread has one OpenGL context that is current: two engines that draw, used in turn from one
    thread, would draw into each other's.

    Parameters
    ----------
    open_engine : callable
        Opens the engine.

    Attributes
    ----------
    engine : Engine
        To be asked through `call` alone.
    """

    def __init__(self, open_engine: Callable[[], Engine]) -> None:
        self._thread = ThreadPoolExecutor(max_workers=1)
        self._is_left = Event()
        try:
            self.engine = self.call(open_engine)
        except BaseException:
            self._thread.shutdown()
            raise

    def call(
        self,
        function: Callable[Arguments, Result],
        *args: Arguments.args,
        **kwargs: Arguments.kwargs,
    ) -> Result:
        """Return what a function returns that is called in the engine's thread."""
        return self._thread.submit(function, *args, **kwargs).result()

    def raise_if_left(self) -> None:
        """End long work in the engine's thread when whoever asked for it was interrupted."""
        if self._is_left.is_set():
            raise CancelledError

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Close the engine, where it was opened."""
        self._is_left.set()
        self.call(self.engine.close)
        self._thread.shutdown()
