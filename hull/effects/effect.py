"""What an effect is: settings in the scene, a state, steps beside the hull, numbers for the file.

An effect is a module with an `EffectKind`. Those of `hybridve.hull.effects.kinds` come with
hybridve; another package adds one by an entry point of the group ``hybridve.effects``, named after
the kind, that gives its `EffectKind`. A scene's ``[[effect]]`` tables name kinds; no other is
imported. All that is simulated together is one `Effect`: the entries of one kind, and of all kinds
that give the same `make`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

from hybridve.calib.errors import SceneError
from hybridve.calib.pose import Pose
from hybridve.hull.cad.scene import Scene, SceneObject
from hybridve.hull.query.engine import Engine
from hybridve.hull.query.silhouettes import Hull, Views
from hybridve.hull.toml_io import Name

#: How far a number can be trusted; see `hybridve.hull.report.result_file.Kind`.
Trust = Literal["exact", "bound", "estimate", "sampled"]

#: What the world pulls at everything with, metres per second squared, along -z.
GRAVITY_M_S2 = 9.80665


class EffectTable(BaseModel):
    """The keys that every ``[[effect]]`` has; each kind adds its own.

    Attributes
    ----------
    kind : str
        Which effect.
    name : str or None
        What its results are called; by default after its object, or its kind.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    kind: str
    name: Name | None = None

    @property
    def claimed(self) -> tuple[str, ...]:
        """The objects that it moves, which no other effect may."""
        return ()

    @property
    def default_name(self) -> str:
        """What it is called where it has no name."""
        return self.claimed[0] if self.claimed else self.kind


@dataclass(frozen=True, slots=True)
class Entry:
    """One ``[[effect]]`` of a scene, read.

    Attributes
    ----------
    name : str
        What its results are called; unique within the scene.
    table : EffectTable
        Its settings.
    label : str
        Where they stand, for messages: "scene.toml: effect.2".
    """

    name: str
    table: Any  # the EffectTable of its kind, which knows its own keys
    label: str

    def error(self, text: str, key: str = "") -> SceneError:
        """Return the one line that says what is wrong with it, or with one of its keys."""
        return SceneError(f"{self.label}{f'.{key}' if key else ''}: {text}")


@dataclass(frozen=True, slots=True, eq=False)
class Setting:
    """What effects are made for.

    Attributes
    ----------
    scene : Scene
        The CAD.
    claimed : frozenset of str
        The objects that effects move; all others stand, or go where the scene says.
    views : Views
        The cameras.
    engine : Engine
        What answers the volume query; an effect asks it about `Triangles.moved` vertices.
    step_s : float
        The longest step that is asked for.
    frame_s : float
        From one frame to the next.
    viewport : int
        Samples along an edge of each triangle that is asked.
    seed : int
        Of what is drawn at random.
    """

    scene: Scene
    claimed: frozenset[str]
    views: Views
    engine: Engine
    step_s: float
    frame_s: float
    viewport: int = 10
    seed: int = 0

    def object_of(self, entry: Entry, name: str, key: str = "object") -> SceneObject:
        """Return an object of the scene.

        Raises
        ------
        SceneError
            If there is none of this name.
        """
        for one in self.scene.objects:
            if one.name == name:
                return one
        known = ", ".join(one.name for one in self.scene.objects)
        raise entry.error(f"there is no object {name!r}; the scene has {known}", key)

    @property
    def obstacles(self) -> tuple[SceneObject, ...]:
        """The objects that no effect moves; those that move as a file says at rest."""
        return tuple(one for one in self.scene.objects if one.name not in self.claimed)

    def moves(self, one: SceneObject) -> bool:
        """Tell whether an effect or a file moves an object from where the scene puts it."""
        return one.motion is not None or one.name in self.claimed


class Course(NamedTuple):
    """Where an object that moves as a file says is over one step.

    Each is world_from_rest, (3, 4) metres: at the beginning of the step, in its middle, and at its
    end.
    """

    begin: Pose
    middle: Pose
    end: Pose

    def velocity(self, step_s: float) -> NDArray[np.float64]:
        """Return what a point at rest, metres, is taken to by how fast it moves: (3, 4), metres/s.

        In the mean over the step, so that it is there at its end.
        """
        return np.asarray((self.end - self.begin) / step_s)


@dataclass(frozen=True, slots=True, eq=False)
class Instant:
    """What is real at one instant, and for the steps that lead there.

    Attributes
    ----------
    time_s : float
        When, seconds from frame 0 of the session.
    hull : Hull
        What is real.
    before : Hull or None
        The hull of the instant before; None at the beginning, and after a pause, where the hull
        may be anywhere and nothing is known of its speed.
    elapsed_s : float
        From that instant to this one.
    frame : int
        The number of the frame that the steps lead to.
    recorded : (Hull, Hull) or None
        Where the hull is interpolated, those of the frames before and after: silhouettes move by
        whole pixels, of which the short way from `before` holds few. None where that tells as much.
    recorded_s : float
        From the first of these to the second.
    courses : mapping of str to Course
        Of the objects that move as a file says, by name. Where there are any, each step has an
        instant of its own, of the same hulls.
    """

    time_s: float
    hull: Hull
    before: Hull | None
    elapsed_s: float
    frame: int
    recorded: tuple[Hull, Hull] | None = None
    recorded_s: float = 0.0
    courses: Mapping[str, Course] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """Where an object is in a frame that is not where the scene puts it.

    Attributes
    ----------
    vertices_world : (V, 3) float64
        Metres.
    world_from_rest : (3, 4) float64 or None
        Of one that moved rigidly from where the scene puts it; None of one that bends.
    """

    vertices_world: NDArray[np.float64]
    world_from_rest: Pose | None


@dataclass(frozen=True, slots=True)
class Quantity:
    """One column that an effect tells after each frame.

    Attributes
    ----------
    name : str
        Of its dataset; ends in its unit where it has one.
    unit : str
        "1" where it has none.
    trust : Trust
        How far it can be trusted.
    description : str
        What it says.
    shape : tuple of int
        Of one frame's value.
    dtype : type
        NumPy's.
    is_place : bool
        Whether it is a place in the world: the file holds it about its local origin.
    """

    name: str
    unit: str
    trust: Trust
    description: str
    shape: tuple[int, ...] = ()
    dtype: type = np.float64
    is_place: bool = False


#: What every effect tells of each of its entries, besides its own columns.
COMMON = (
    Quantity("kinetic_j", "J", "exact", "kinetic energy, of the simulated state"),
    Quantity(
        "potential_j",
        "J",
        "exact",
        "potential energy of weight, springs and stretch, less that of the first frame's state",
    ),
    Quantity(
        "hull_work_j",
        "J",
        "estimate",
        "what real things have put into it so far: the work of their contacts, and of moving it "
        "out of them",
    ),
    Quantity(
        "penetration_m",
        "m",
        "sampled",
        "the deepest that any of its samples was in the hull after any step since the frame "
        "before, along its way out",
    ),
    Quantity(
        "n_contacts",
        "1",
        "exact",
        "contacts with real things, all steps since the frame before",
        dtype=np.uint32,
    ),
)


#: What those tell besides that meet CAD.
CAD_WORK = Quantity(
    "cad_work_j",
    "J",
    "estimate",
    "what CAD that moves as a file says has put into it so far: the work of their contacts",
)

#: Where those are told of that tell of an object that moves.
VERTICES = "vertices_m"


@dataclass(frozen=True, slots=True, eq=False)
class Drawn:
    """How an entry is shown: a mesh whose vertices are a column, or points that are one.

    Attributes
    ----------
    column : str
        The column of places, (V, 3) a frame; or of poses (3, 4) world from mesh, of a mesh that
        does not bend; "" for one that stands still.
    vertices : (V, 3) float64 or None
        Of what does not bend, metres, in the frame that the poses place.
    faces : (T, 3) int32 or None
        Of a mesh; None for points.
    cell_columns : tuple of str
        Columns with a number for each triangle.
    """

    column: str
    vertices: NDArray[np.float64] | None = None
    faces: NDArray[np.int32] | None = None
    cell_columns: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Told:
    """What an effect tells of one entry.

    Attributes
    ----------
    columns : tuple of Quantity
        Its own, besides `COMMON`.
    drawn : Drawn or None
        How it is shown.
    constants : dict of str to (Quantity, array)
        What does not change from frame to frame.
    about : dict
        What it was resolved to, as plain JSON values.
    """

    columns: tuple[Quantity, ...]
    drawn: Drawn | None = None
    constants: Mapping[str, tuple[Quantity, NDArray[Any]]] = field(default_factory=dict)
    about: Mapping[str, Any] = field(default_factory=dict)


class UnstableError(Exception):
    """A simulation has blown up; the text says which entry, and what was found."""


class Effect(Protocol):
    """Something simulated, with all its state.

    Attributes
    ----------
    told : dict of str to Told
        Per entry that it simulates, by name, what it will tell.
    """

    told: Mapping[str, Told]

    def advance(self, instant: Instant, step_s: float) -> None:
        """Go on by one step, to be out of the hull of this instant at its end.

        Raises
        ------
        UnstableError
            If the state is not finite any more, or grows without reason.
        """
        ...

    def values(self, hull: Hull | None) -> Mapping[str, Mapping[str, NDArray[Any]]]:
        """Return by entry and column what stands at the end of a frame: `COMMON` and its own.

        What is counted "since the frame before" begins anew.

        Parameters
        ----------
        hull : Hull or None
            Of the frame; None if it has none, so that nothing went on.
        """
        ...

    def state(self) -> Mapping[str, NDArray[Any]]:
        """Return all that decides how it goes on, as arrays."""
        ...

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Go on from what `state` gave, to the same values to the bit."""
        ...


@runtime_checkable
class Onlooker(Protocol):
    """An `Effect` that tells of objects where they are in a frame, whoever moves them."""

    def see_objects(self, placed: Mapping[str, Placed]) -> None:
        """Take note of where objects are in the frame whose `values` are asked next.

        Parameters
        ----------
        placed : mapping of str to Placed
            All objects that files or effects move, by name; in a frame in which a file has no pose
            of one, where it was last. All others are where the scene puts them.
        """
        ...


@dataclass(frozen=True, slots=True)
class EffectKind:
    """A kind of effect.

    Attributes
    ----------
    name : str
        As scenes call it.
    table : type of EffectTable
        Its keys.
    make : callable
        Takes all entries to be simulated together, and the setting; raises `SceneError` with the
        line that says what is wrong.
    software : callable
        Returns the names and versions of the libraries that its numbers depend on.
    """

    name: str
    table: type[EffectTable]
    make: Callable[[Sequence[Entry], Setting], Effect]
    software: Callable[[], dict[str, str]] = dict
