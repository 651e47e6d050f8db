"""What a calibration target is, and what a camera saw of it.

A board is flat and lies in the plane z = 0 of its own frame; z points at whoever looks at its
printed side. Its points (corners of squares, or of tags) have a fixed order, and an array of pixels
always has one row for each of them: NaN where the point was not seen.
"""

from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.pose import Pose

#: How much trouble a search takes: one quick look, the usual ways, or all of them.
Effort = Literal["quick", "usual", "thorough"]


@dataclass(frozen=True, slots=True, eq=False)
class Detection:
    """What the search for a board in one image gave.

    Attributes
    ----------
    corners : (N, 2) float64, or None
        Its points in pixels, pixel centre at 0.5, in the order of `Board.points_board`, NaN where
        one was not seen; None if the board was not found.
    how : str
        The way in which they were found, or all ways that were tried in vain.
    notes : tuple of str
        What is unusual about this board in this image: "mirrored: seen from the back", "inverted".
    beyond : (columns, rows)
        How many columns and rows of corners go on beyond those of a chessboard: it is larger than
        described.
    """

    corners: NDArray[np.float64] | None
    how: str
    notes: tuple[str, ...] = ()
    beyond: tuple[int, int] = (0, 0)


class Board(Protocol):
    """A flat calibration target."""

    @property
    def name(self) -> str:
        """Its name, unique among the boards of a session."""
        ...

    @property
    def body(self) -> str | None:
        """The rigid body that it is mounted on, maybe with others; None: it moves alone."""
        ...

    @property
    def points_board(self) -> NDArray[np.float64]:
        """Its points: (N, 3) metres, z = 0."""
        ...

    @property
    def center_board(self) -> NDArray[np.float64]:
        """Its middle: (3,) metres."""
        ...

    @property
    def square_m(self) -> float:
        """The length of its squares, for tolerances and messages."""
        ...

    @property
    def looks(self) -> NDArray[np.intp]:
        """The listings of the points that no image can tell apart: (L, N) indices.

        ``pixels[looks[k]]`` is as good a listing as ``pixels``; it belongs to a board turned by
        ``k / L`` of a full turn about its middle. The first is the identity.
        """
        ...

    def board_from_turned(self, look: int) -> Pose:
        """Return the motion (3, 4) of ``points_board`` onto ``points_board[looks[look]]``."""
        ...

    def detect(self, image: NDArray[Any], effort: Effort = "thorough") -> Detection:
        """Find the board in an image (H, W) or (H, W, 3), grey or BGR, 0 to 255."""
        ...

    def __str__(self) -> str:
        """Say what board it is, for messages."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """One board in one image of one camera.

    Attributes
    ----------
    image : str
        The image, for messages; unique within the camera.
    instant : int or None
        Which frame of the clip that all cameras recorded at once; None: a still of this camera
        alone.
    board : int
        Which of the session's boards.
    pixels : (N, 2) float64
        The board's points in pixels, pixel centre at 0.5; NaN where one was not seen.
    beyond : (columns, rows)
        As `Detection.beyond`.
    """

    image: str
    instant: int | None
    board: int
    pixels: NDArray[np.float64]
    beyond: tuple[int, int] = (0, 0)


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """All that one camera saw of the boards; what a rig is solved from.

    Attributes
    ----------
    name, model : str
        The camera, and a COLMAP camera model or "auto".
    size_px : (width, height)
        Of its images.
    sightings : tuple of Sighting
        Stills in their own order, then the clip's frames in theirs.
    is_still : bool
        Whether the boards lie still in the clip: it was averaged, and has one instant, 0.
    missed : dict of str to str
        Images of the stills that do not count, and why.
    picture : (H, W) float32, or None
        The average of a still clip, in grey levels.
    how : str
        How the clip's points were found.
    spread_px : float or None
        How far the worst point of a still clip strays from frame to frame (median over frames).
    hand_look : int or None
        Which look of the board was listed by hand, if one was.
    notes : tuple of str
        What is unusual: "board clip, frame 3: mirrored: seen from the back".
    sources : dict
        Where the images come from, for the provenance.
    """

    name: str
    model: str
    size_px: tuple[int, int]
    sightings: tuple[Sighting, ...]
    is_still: bool
    missed: dict[str, str] = field(default_factory=dict)
    picture: NDArray[np.float32] | None = None
    how: str = "given"
    spread_px: float | None = None
    hand_look: int | None = None
    notes: tuple[str, ...] = ()
    sources: dict[str, str | None] = field(default_factory=dict)


def is_seen(pixels: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which points (N,) of a sighting were seen."""
    return np.asarray(np.isfinite(pixels).all(axis=1))
