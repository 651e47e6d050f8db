"""The errors a user can fix.

Each message is complete on its own: which thing, what was found, what was expected, what to do.
Only ``cli/main.py`` turns them into text. Programming mistakes stay `ValueError` and `TypeError`.
"""


class HybridveError(Exception):
    """Root of all errors raised on purpose by hybridve."""


class SessionError(HybridveError):
    """A session.toml, or a file it names, cannot be used."""


class SceneError(HybridveError):
    """A scene.toml, or a mesh it names, cannot be used."""


class CalibrationError(HybridveError):
    """A rig cannot be found, read, solved or trusted."""


class DeviceError(HybridveError):
    """No OpenGL device that serves."""


class ReportError(HybridveError):
    """A report or silhouette file cannot be read or written."""
