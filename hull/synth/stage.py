"""What a generated recording shows: cameras, board, room, real things in motion, CAD parts."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.boards.target import Chessboard
from hybridve.calib.camera import Camera
from hybridve.calib.pose import Pose, compose, rotation_about_axes, transform
from hybridve.hull.synth.meshes import Mesh
from hybridve.hull.synth.shapes import Shape

Color = tuple[float, float, float]  # blue, green, red in grey levels, as OpenCV orders them


@dataclass(frozen=True, slots=True)
class Material:
    """Two colours that alternate in soft stripes.

    Attributes
    ----------
    color, other : Color
        The colours.
    stripe_m : float
        From one stripe to the next of the same colour.
    direction : tuple of 3 float
        Across the stripes, unit vector in the shape's frame.
    """

    color: Color
    other: Color
    stripe_m: float
    direction: tuple[float, float, float] = (0.0, 0.0, 1.0)


@dataclass(frozen=True, slots=True, eq=False)
class RealShape:
    """One convex shape of a real thing.

    Attributes
    ----------
    name : str
        Unique within the stage.
    shape : Shape
        Its form.
    actor_from_shape : (3, 4) float64
        Where it sits on the thing that moves.
    material : Material
        What it looks like.
    """

    name: str
    shape: Shape
    actor_from_shape: Pose
    material: Material


@dataclass(frozen=True, slots=True, eq=False)
class Actor:
    """A real thing that moves as one.

    Attributes
    ----------
    shapes : tuple of RealShape
        What it is made of.
    world_from_actor : callable
        Its pose at a moment from 0, the beginning of the recording, to 1, its end.
    """

    shapes: tuple[RealShape, ...]
    world_from_actor: Callable[[float], Pose]


@dataclass(frozen=True, slots=True, eq=False)
class CadPart:
    """A CAD object: a mesh in millimetres and its place in the world, as a scene.toml says it.

    Attributes
    ----------
    name : str
        Name of the object and of its file.
    mesh : Mesh
        Millimetres, its own frame.
    translate_mm, rotate_deg : tuple of 3 float
        Turned about the world's x, then y, then z axis, then moved.
    required_clearance_mm : float
        How far real things are to stay away.
    recovery_direction : tuple of 3 float, optional
        Where it gives way if it can only in one direction, in the frame of the mesh.
    comment : str
        What scene.toml says of it, a line for each line.
    effect : str
        The keys of the ``[[effect]]`` that moves it, a line for each line; none if empty.
    """

    name: str
    mesh: Mesh
    translate_mm: tuple[float, float, float]
    rotate_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    required_clearance_mm: float = 0.0
    recovery_direction: tuple[float, float, float] | None = None
    comment: str = ""
    effect: str = ""

    @property
    def world_from_mesh(self) -> Pose:
        """Its pose, (3, 4), for a mesh in metres."""
        return pose_at(np.array(self.translate_mm) / 1000.0, self.rotate_deg)

    @property
    def triangles_world(self) -> NDArray[np.float64]:
        """The corners of its triangles, (T, 3, 3) metres."""
        corners_m = self.mesh.triangles_mm.reshape(-1, 3) / 1000.0
        return transform(self.world_from_mesh, corners_m).reshape(-1, 3, 3)


@dataclass(frozen=True, slots=True)
class Spacing:
    """A question to a recording: how far a part must be shifted.

    Attributes
    ----------
    part : str
        Its name.
    along : tuple of 3 float
        Unit vector, world: where it is shifted.
    range_m : tuple of 2 float
        The smallest and the largest shift considered.
    gap_m : float
        How wide the gap is that the shift widens, where the scene has the part.
    """

    part: str
    along: tuple[float, float, float]
    range_m: tuple[float, float]
    gap_m: float


@dataclass(frozen=True, slots=True)
class Lamp:
    """A round lamp that faces down.

    Attributes
    ----------
    position_world : tuple of 3 float
        Its middle, metres.
    radius_m : float
        How wide it is; the wider, the softer the shadows.
    shade : float
        How much of the light on the floor is missing in full shadow, 0 to 1.
    """

    position_world: tuple[float, float, float]
    radius_m: float
    shade: float


@dataclass(frozen=True, slots=True)
class Panel:
    """A rectangle of another colour on a wall: a door, a poster.

    Attributes
    ----------
    wall : int
        0 and 1 at low and high x of the room, 2 and 3 at low and high y.
    low_m, high_m : tuple of 2 float
        Its corners: along the wall from the middle, and above the floor.
    color : Color
        Its colour.
    """

    wall: int
    low_m: tuple[float, float]
    high_m: tuple[float, float]
    color: Color


@dataclass(frozen=True, slots=True)
class Room:
    """A room with a tiled floor at z = 0 and four bare walls, as high as anybody looks.

    Attributes
    ----------
    center_world : tuple of 2 float
        Its middle on the floor, metres.
    half_size_m : tuple of 2 float
        Half its extent along its own x and y.
    yaw_rad : float
        How far it is turned about z against the world.
    floor, wall : Color
        Colours.
    tile_m : float
        Edge of a floor tile.
    panels : tuple of Panel
        What hangs on the walls.
    """

    center_world: tuple[float, float]
    half_size_m: tuple[float, float]
    yaw_rad: float
    floor: Color
    wall: Color
    tile_m: float
    panels: tuple[Panel, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Stage:
    """All that a generated recording shows.

    Attributes
    ----------
    cameras : tuple of Camera
        At least one.
    board : Chessboard
        The calibration target, printed with a black square before its first corner, on a white
        plate (see `plate_of`). The world is its frame when it lies on the floor. One of columns
        and rows is even and the other odd, so that turned by 180 degrees it is another pattern.
    room : Room
        What stands behind everything.
    lamp : Lamp
        What casts the shadows.
    actors : tuple of Actor
        The real things.
    parts : tuple of CadPart
        The CAD objects, which no camera sees.
    spacings : tuple of Spacing
        The questions of room that the recording answers.
    """

    cameras: tuple[Camera, ...]
    board: Chessboard
    room: Room
    lamp: Lamp
    actors: tuple[Actor, ...]
    parts: tuple[CadPart, ...]
    spacings: tuple[Spacing, ...] = ()

    @property
    def shapes(self) -> tuple[RealShape, ...]:
        """The shapes of all real things."""
        return tuple(shape for actor in self.actors for shape in actor.shapes)

    def poses(self, moment: float) -> list[Pose]:
        """Return the pose ``world_from_shape`` of each shape at a moment from 0 to 1."""
        return [
            compose(actor.world_from_actor(moment), shape.actor_from_shape)
            for actor in self.actors
            for shape in actor.shapes
        ]


@dataclass(frozen=True, slots=True)
class PresetOption:
    """A number that a preset can be given.

    Attributes
    ----------
    name : str
        What `make_stage` calls it.
    default, low, high : float
        Its value if it is not given, and the least and the greatest it may have.
    is_whole : bool
        Whether it is a number of things.
    """

    name: str
    default: float
    low: float
    high: float
    is_whole: bool = False


@dataclass(frozen=True, slots=True)
class Preset:
    """A recording that can be generated by name.

    Attributes
    ----------
    description : str
        One sentence.
    n_frames : int
        Frames of the task unless another number is asked for; the motion takes as many as there
        are, from its beginning to its end.
    fps : float
        Frames per second, written into the session.
    make_stage : callable
        Takes a value for each option, by name, and returns the stage.
    options : tuple of PresetOption
        What can be chosen.
    """

    description: str
    n_frames: int
    fps: float
    make_stage: Callable[..., Stage]
    options: tuple[PresetOption, ...] = ()


def plate_of(board: Chessboard) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the lower and upper corner (2,) of the board's plate, metres, board frame.

    It bears the squares and a white border half as wide as one.
    """
    low = np.full(2, -1.5 * board.square_m)
    high = np.array([board.columns + 0.5, board.rows + 0.5]) * board.square_m
    return low, high


def pose_at(
    position: NDArray[np.float64] | tuple[float, float, float],
    rotate_deg: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Pose:
    """Return the pose (3, 4) that turns about x, then y, then z, then moves to `position`."""
    return np.column_stack([rotation_about_axes(rotate_deg), np.asarray(position, np.float64)])
