"""What `hybridve doctor` tries, in a process of its own: what ends that process ends nothing else.

``python -m hybridve.cli.trials NAME ...`` tries one after the other and writes a line of JSON each,
``[name, what was found, what went wrong]``. A name that is none of those here is a module to load.
"""

import importlib
import json
import os
import sys
from collections.abc import Callable


def _opengl() -> str:
    from hybridve.hull.query.device import open_device, renderer_name

    with open_device() as device:
        return f"{renderer_name(device)}, {device.info['GL_VERSION']}"


def _engine() -> str:
    from hybridve.hull.query.choose import open_engine

    with open_engine("auto") as engine:
        return engine.name


def _compiled() -> str:
    from hybridve.hull.prepare import is_prepared

    return "yes" if is_prepared() else ""


def _cascadio() -> str:
    sys.modules["trimesh"] = None  # type: ignore[assignment]  # as where STEP files are read
    importlib.import_module("cascadio")
    return "loaded"


_TRIALS: dict[str, Callable[[], str]] = {
    "opengl": _opengl,
    "engine": _engine,
    "compiled": _compiled,
    "cascadio": _cascadio,
}


def _tried(name: str) -> tuple[str, str]:
    """Return what was found, and what went wrong; one of them is empty."""
    try:
        if name in _TRIALS:
            return _TRIALS[name](), ""
        importlib.import_module(name)
    except BaseException as error:  # a library may raise what it likes, or leave
        text = str(error).splitlines()
        return "", f"{type(error).__name__}: {text[0]}" if text else type(error).__name__
    return "loaded", ""


if __name__ == "__main__":
    # What libraries print goes to stderr.
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    for trial in sys.argv[1:]:
        answers.write(json.dumps([trial, *_tried(trial)]) + "\n")
        answers.flush()
