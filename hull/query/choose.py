"""Opens the engine that serves a query."""

import logging

from hybridve.calib.errors import DeviceError
from hybridve.hull.query.engine import Engine, EngineName

_logger = logging.getLogger(__name__)


def open_engine(name: EngineName = "auto") -> Engine:
    """Return the engine called `name`; its owner closes it, or uses it in a ``with`` statement.

    Parameters
    ----------
    name : str
        ``auto`` takes ``compute`` where OpenGL runs on hardware, and ``native`` elsewhere; the
        attributes ``name`` and ``renderer`` of the engine say which it took.

    Raises
    ------
    DeviceError
        If ``compute`` or ``stencil`` is asked for and there is no OpenGL 4.3 device.
    ValueError
        If there is no engine of that name.
    """
    # Each room brings a library that takes its time to load: only the one that serves is imported.
    if name == "reference":
        from hybridve.hull.query.reference import Reference

        return Reference()
    if name == "compute":
        from hybridve.hull.query.compute import Compute

        return Compute()
    if name == "stencil":
        from hybridve.hull.query.stencil import Stencil

        return Stencil()
    if name == "auto" and (hardware := _open_on_hardware()) is not None:
        return hardware
    if name in ("auto", "native"):
        from hybridve.hull.query.native import Native

        return Native()
    raise ValueError(f"engine {name!r}, expected auto, compute, native, stencil or reference")


def _open_on_hardware() -> Engine | None:
    """Return the compute engine, or None where OpenGL is missing, software, or too old."""
    try:
        from hybridve.hull.query.compute import Compute
        from hybridve.hull.query.device import is_software_renderer

        engine = Compute()
    except (DeviceError, ImportError):  # ImportError: moderngl without the system's libraries
        return None
    try:
        if not is_software_renderer(engine.renderer):
            engine.programs_for(1)
            return engine
    except DeviceError as error:
        _logger.warning("%s", error)
    engine.close()
    return None
