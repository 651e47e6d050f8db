"""What a simulation's file holds."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from hybridve.hull.agreement.outlines import FrameOutlines
from hybridve.hull.agreement.record import SessionAgreement
from hybridve.hull.report.machine import Run
from hybridve.hull.report.result_file import Described

VERSION = 1

#: The stages whose seconds are kept, besides those of each effect.
STAGES = ("decode", "segment", "between")


@dataclass(frozen=True, slots=True)
class Variable(Described):
    """A dataset with a value a frame, or one for all.

    Attributes
    ----------
    shape : tuple of int
        Of one value.
    dtype : type
        NumPy's.
    is_place : bool
        Whether it is a place in the world: the file holds it about its local origin. Of a pose
        (3, 4) the last column is.
    """

    shape: tuple[int, ...] = ()
    dtype: type = np.float64
    is_place: bool = False

    def describe(self, dataset: h5py.Dataset) -> None:
        """Write to a dataset what it says of itself."""
        Described.describe(self, dataset)
        dataset.attrs["is_place"] = self.is_place

    def about(self, values: NDArray[Any], origin_m: NDArray[np.float64]) -> NDArray[Any]:
        """Return values in the world about an origin, as the file holds them."""
        if not self.is_place:
            return values.astype(self.dtype, copy=False)
        moved = np.array(values, np.float64)
        if self.shape[-2:] == (3, 4):
            moved[..., 3] -= origin_m
        else:
            moved -= origin_m
        return moved.astype(self.dtype, copy=False)


@dataclass(frozen=True, slots=True, eq=False)
class Shown:
    """How a group is shown.

    Attributes
    ----------
    column : str
        The variable of places (V, 3), or of poses (3, 4) that place `vertices`; "" for a mesh that
        stands still.
    vertices : (V, 3) float64 or None
        Metres, in the frame that is placed; of a mesh that stands still, the world's.
    faces : (T, 3) int32 or None
        None for points.
    cell_columns : tuple of str
        Variables with a number for each triangle.
    """

    column: str
    vertices: NDArray[np.float64] | None
    faces: NDArray[np.int32] | None
    cell_columns: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Group:
    """One effect of the file.

    Attributes
    ----------
    name, kind : str
        What it is called, and which effect it is.
    about : dict
        Its settings, as plain JSON values.
    variables : tuple of Variable
        With a value a frame.
    constants : tuple of (Variable, array)
        What is the same for all frames.
    shown : Shown or None
        How it is shown.
    """

    name: str
    kind: str
    about: Mapping[str, Any]
    variables: tuple[Variable, ...]
    constants: tuple[tuple[Variable, NDArray[Any]], ...] = ()
    shown: Shown | None = None


@dataclass(frozen=True, slots=True, eq=False)
class SimulationHeader:
    """What a simulation's file says of itself as a whole.

    Attributes
    ----------
    run : Run
        Which run made it.
    settings : dict
        All that decides the result, as plain JSON values; ``solvers`` names the libraries that the
        numbers depend on, with their versions.
    rig : dict
        The rig as in rig.json.
    engine, renderer : str
        What answered the volume query.
    groups : tuple of Group
        The effects, in the order in which they are simulated.
    local_origin_m : tuple of 3 floats
        Places in the file are metres about this point of the world.
    standing : tuple of (name, vertices (V, 3), faces (T, 3))
        The CAD that nothing moves, metres in the world.
    moving : tuple of (name, vertices (V, 3), faces (T, 3))
        The CAD that moves as files say, metres in the frame of its mesh.
    """

    run: Run
    settings: dict[str, Any]
    rig: dict[str, Any]
    engine: str
    renderer: str
    groups: tuple[Group, ...]
    local_origin_m: tuple[float, float, float]
    standing: tuple[tuple[str, NDArray[np.float64], NDArray[np.int32]], ...] = ()
    moving: tuple[tuple[str, NDArray[np.float64], NDArray[np.int32]], ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedFrame:
    """What became of one frame.

    Attributes
    ----------
    index : int
        Number of the frame in the session.
    time_s : float
        When it was recorded, seconds from the session's first frame.
    reason : str
        Why it has no hull, so that the simulation paused; else empty.
    n_steps, n_hulls : int
        Steps since the frame before, and hulls on the way.
    stage_s : dict
        Seconds by stage.
    values : dict of dict of arrays
        By group and variable, places in the world.
    outlines : FrameOutlines
        What the frame says of the cameras.
    blew_up : str
        Of the last frame of a simulation that was stopped, why; else empty.
    poses : dict of (3, 4) float64
        Where the CAD was that moves as files say, by name: world from the frame of its mesh. What
        has no pose in the frame is left out.
    """

    index: int
    time_s: float
    reason: str
    n_steps: int
    n_hulls: int
    stage_s: Mapping[str, float]
    values: Mapping[str, Mapping[str, NDArray[Any]]]
    outlines: FrameOutlines
    blew_up: str = ""
    poses: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class StoredGroup:
    """One effect, read.

    Attributes
    ----------
    kind : str
        Which effect.
    about : dict
        Its settings.
    values : dict of (F, ...) arrays
        By variable; places are in the world.
    constants : dict of arrays
        What is the same for all frames.
    units : dict of str
        The unit of each.
    shown : Shown or None
        How it is shown.
    """

    kind: str
    about: dict[str, Any]
    values: dict[str, NDArray[Any]]
    constants: dict[str, NDArray[Any]]
    units: dict[str, str]
    shown: Shown | None


@dataclass(frozen=True, slots=True, eq=False)
class StoredSimulation:
    """A simulation, read.

    Attributes
    ----------
    path : Path
        The file.
    run : Run
        Which run made it.
    settings : dict
        All that decides the result.
    index, time_s, reason, n_steps, n_hulls : (F,) arrays
        As in `SimulatedFrame`.
    stage_s : dict of (F,) float64
        Seconds by stage.
    groups : dict of StoredGroup
        By name, in the order of the file.
    stopped : str
        Why it was stopped before the recording's end; empty if it was not.
    agreement : SessionAgreement
        What the cameras say about each other.
    standing : tuple of (name, vertices, faces)
        The CAD that nothing moves, in the world.
    moving : tuple of (name, vertices, faces, poses (F, 3, 4))
        The CAD that moves as files say, in the frame of its mesh, and where that was, NaN where it
        is not known.
    """

    path: Path
    run: Run
    settings: dict[str, Any]
    index: NDArray[np.int64]
    time_s: NDArray[np.float64]
    reason: NDArray[np.str_]
    n_steps: NDArray[np.int64]
    n_hulls: NDArray[np.int64]
    stage_s: dict[str, NDArray[np.float64]]
    groups: dict[str, StoredGroup] = field(default_factory=dict)
    stopped: str = ""
    agreement: SessionAgreement = field(default_factory=SessionAgreement)
    standing: tuple[tuple[str, NDArray[np.float64], NDArray[np.int32]], ...] = ()
    moving: tuple[tuple[str, NDArray[np.float64], NDArray[np.int32], NDArray[np.float64]], ...] = ()
