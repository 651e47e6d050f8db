"""An effect of somebody else's, as a package of its own that pip installs."""

import subprocess
import sys
from pathlib import Path

_PYPROJECT = """\
[build-system]
requires = ["setuptools"]
build-backend = "setuptools.build_meta"
[project]
name = "toy-effects"
version = "1.0"
[project.entry-points."hybridve.effects"]
dwell = "toy_effects:KIND"
[tool.setuptools]
py-modules = ["toy_effects"]
"""

#: How long the hull was in an object's surface, in steps; it can be told to fail at a frame.
_MODULE = """\
import os

import numpy as np

from hybridve.hull.effects.effect import (
    EffectKind, EffectTable, Quantity, Told, Drawn, UnstableError,
)
from hybridve.hull.query.engine import Triangles


class DwellTable(EffectTable):
    object: str
    drift_m_s: float = 0.0


class Dwell:
    def __init__(self, entries, setting):
        (entry,) = entries
        self._name, self._engine = entry.name, setting.engine
        part = setting.object_of(entry, entry.table.object)
        viewports = np.full(len(part.faces), setting.viewport, np.int32)
        self._mesh = Triangles(part.vertices_world, part.faces, viewports)
        self._drift_m_s = entry.table.drift_m_s
        self._dwell_s = self._time_s = 0.0
        self._n_contacts = 0
        columns = (
            Quantity("dwell_s", "s", "sampled", "time in the hull"),
            Quantity("simulated_s", "s", "exact", "time gone by"),
            Quantity(
                "vertices_m", "m", "exact", "vertices", shape=part.vertices_world.shape,
                is_place=True,
            ),
        )
        self.told = {self._name: Told(columns, Drawn("vertices_m", faces=part.faces))}

    def _vertices(self):
        return self._mesh.vertices_world + [self._drift_m_s * self._time_s, 0.0, 0.0]

    def advance(self, instant, step_s):
        fails = os.environ.get("TOY_FAILS", "")
        if fails == f"interrupt {instant.frame}":
            raise KeyboardInterrupt
        if fails == f"unstable {instant.frame}":
            raise UnstableError("the toy was told to break")
        self._time_s += step_s
        (hits,) = self._engine.query(instant.hull, [self._mesh.moved(self._vertices())])
        if len(hits.start):
            self._dwell_s += step_s
            self._n_contacts += 1

    def values(self, hull):
        n_contacts, self._n_contacts = self._n_contacts, 0
        return {self._name: {
            "kinetic_j": 0.0, "potential_j": 0.0, "hull_work_j": 0.0, "penetration_m": 0.0,
            "n_contacts": n_contacts, "dwell_s": self._dwell_s, "simulated_s": self._time_s,
            "vertices_m": self._vertices(),
        }}

    def state(self):
        return {"times_s": np.array([self._dwell_s, self._time_s])}

    def restore(self, state):
        self._dwell_s, self._time_s = state["times_s"].tolist()


KIND = EffectKind("dwell", DwellTable, Dwell, lambda: {"toy": os.environ.get("TOY", "1.0")})
"""


def install(folder: Path) -> Path:
    """Build the package and install it into a folder; return the folder, to be searched."""
    source, target = folder / "source", folder / "installed"
    source.mkdir()
    (source / "pyproject.toml").write_text(_PYPROJECT, encoding="utf-8")
    (source / "toy_effects.py").write_text(_MODULE, encoding="utf-8")
    subprocess.run(
        [
            *(sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index"),
            *("--no-build-isolation", "--disable-pip-version-check", "--target", target, source),
        ],
        check=True,
    )
    return target
