"""When boards were seen, and what a pose is of: the keys by which views are put together."""

from dataclasses import dataclass

from hybridve.calib.boards.board import Board


@dataclass(frozen=True, slots=True, order=True)
class Moment:
    """An instant of the clip, which all cameras share, or one still of one camera.

    In order, stills come before the clip, camera by camera.

    Attributes
    ----------
    is_clip : bool
        Which of the two it is.
    instant : int
        Of the clip; 0 for a still.
    camera : int
        Whose still it is; 0 for an instant of the clip.
    image : str
        The still's name; empty for an instant of the clip.
    """

    is_clip: bool
    instant: int
    camera: int
    image: str

    @staticmethod
    def of_clip(instant: int) -> "Moment":
        """Return an instant of the clip."""
        return Moment(True, instant, 0, "")

    @staticmethod
    def of_still(camera: int, image: str) -> "Moment":
        """Return a still of a camera."""
        return Moment(False, 0, camera, image)


@dataclass(frozen=True, slots=True, order=True)
class Body:
    """Boards that move together.

    Attributes
    ----------
    is_named : bool
        Whether a session names it; else it is one board that moves alone.
    name : str
        Its name, or that of the board.
    """

    is_named: bool
    name: str


def body_of(board: Board) -> Body:
    """Return the body that a board sits on."""
    return Body(False, board.name) if board.body is None else Body(True, board.body)


@dataclass(frozen=True, slots=True, order=True)
class PoseKey:
    """What a pose is of: a body at a moment.

    Attributes
    ----------
    moment : Moment
        When it was there.
    body : Body
        What was there.
    """

    moment: Moment
    body: Body
