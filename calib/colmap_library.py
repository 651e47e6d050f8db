"""pycolmap, loaded so that it leaves signals to the program.

Loading it makes SIGTERM print a stack of C++ functions and kill the program, in place of what the
program does about it.
"""

import signal
from contextlib import suppress

_on_terminate = signal.getsignal(signal.SIGTERM)

import pycolmap  # noqa: E402  # what stands before it is what it changes

if _on_terminate is not None:
    with suppress(ValueError):  # in another thread than the first signals are not set
        signal.signal(signal.SIGTERM, _on_terminate)

__all__ = ["pycolmap"]
