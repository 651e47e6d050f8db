"""The outlines of silhouettes, as few points as tell where rays of other cameras touch them.

A plane that only touches a thing touches its silhouette in every camera that sees it. Of a
connected piece of a silhouette, those lines through a point outside that touch it from outside
touch its convex hull: a polygon of some dozens of corners stands for thousands of pixels, and what
would become of it if the picture were mirrored, shifted, or that of another camera, is found
without a look at the pixels.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import cv2
import numpy as np
from numpy.typing import NDArray

#: Pieces of less area than this, in pixels, are noise.
_LEAST_AREA_PX = 20.0

#: A corner is cut off if the image, or what was recorded of it, ends within so many pixels.
_CUT_PX = 2

#: Marks of a corner: the first of its piece; on the border of what the camera saw.
FIRST, CUT = 1, 2


@dataclass(frozen=True, slots=True, eq=False)
class Outline:
    """The outline of one camera's silhouette in one frame.

    Attributes
    ----------
    corners_px : (V, 2) float32
        The corners of the convex hulls of its pieces, piece after piece: the centres of pixels.
    marks : (V,) uint8
        Of each corner `FIRST` and `CUT`, added up.
    is_inverse : bool
        Whether most of the picture is object: then these are the pieces of what is not.
    """

    corners_px: NDArray[np.float32]
    marks: NDArray[np.uint8]
    is_inverse: bool = False

    @classmethod
    def empty(cls, *, is_inverse: bool = False) -> Self:
        """Return that of a camera that saw nothing, or nothing but object."""
        return cls(np.zeros((0, 2), np.float32), np.zeros(0, np.uint8), is_inverse)

    def is_same(self, other: "Outline") -> bool:
        """Tell whether another outline has the very same corners."""
        return (
            self.is_inverse == other.is_inverse
            and np.array_equal(self.corners_px, other.corners_px)
            and np.array_equal(self.marks, other.marks)
        )


def outline_of(mask: NDArray[np.uint8], inner: NDArray[np.uint8] | None = None) -> Outline:
    """Return the outline of a silhouette.

    Parameters
    ----------
    mask : (H, W) uint8
        Above 0 on object pixels, without lens distortion.
    inner : (H, W) uint8, optional
        What `inner_of` says; None where all of the image was recorded.
    """
    height, width = mask.shape
    is_inverse = 2 * cv2.countNonZero(mask) > height * width
    if is_inverse:
        mask = np.asarray((mask == 0).view(np.uint8))
        if inner is not None:  # what was not recorded is neither
            mask = np.asarray(cv2.bitwise_and(mask, inner))
            inner = np.asarray(cv2.erode(inner, np.ones((3, 3), np.uint8)), np.uint8)
    pieces, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    corners, marks = [], []
    for piece in pieces:
        # Of pixel centres: the outermost half pixel all round is not in it.
        if len(piece) < 3 or cv2.contourArea(piece) + len(piece) < _LEAST_AREA_PX:
            continue
        hull = cv2.convexHull(piece)[:, 0, :]
        x, y = hull[:, 0], hull[:, 1]
        is_cut = (x < _CUT_PX) | (y < _CUT_PX) | (x >= width - _CUT_PX) | (y >= height - _CUT_PX)
        if inner is not None:
            is_cut |= inner[y, x] == 0
        mark = np.where(is_cut, CUT, 0).astype(np.uint8)
        mark[0] += FIRST
        corners.append(hull)
        marks.append(mark)
    if not corners:
        return Outline.empty(is_inverse=is_inverse)
    points = np.concatenate(corners).astype(np.float32) + np.float32(0.5)
    return Outline(points, np.concatenate(marks), is_inverse)


def inner_of(seen: NDArray[np.bool_] | None) -> NDArray[np.uint8] | None:
    """Return 1 where a camera recorded all pixels around; None where it recorded all pixels.

    `seen` is (H, W), True where it recorded a pixel.
    """
    if seen is None:
        return None
    around = np.ones((2 * _CUT_PX + 1, 2 * _CUT_PX + 1), np.uint8)
    return np.asarray(cv2.erode(seen.astype(np.uint8), around), np.uint8)


@dataclass(frozen=True, slots=True, eq=False)
class FrameOutlines:
    """What one frame gives to the judgement of the session.

    Attributes
    ----------
    index : int
        Number of the frame.
    outlines : tuple of C Outline
        Empty where the frame was not read.
    deniers : (C,) bool
        The cameras that deny what several others see.
    supported_share : (C,) float64
        How much of each silhouette the others support; NaN where nobody can tell.
    alone_px : (C, 4) float64
        Left, top, right and bottom of what each camera sees alone, that all others deny; NaN
        where there is no such piece.
    object_share : (C,) float64
        Which share of each undistorted picture is object; NaN where the frame was not read.
    is_contradictory : bool
        Whether no point is in all silhouettes, by more than they err.
    """

    index: int
    outlines: tuple[Outline, ...]
    deniers: NDArray[np.bool_]
    supported_share: NDArray[np.float64]
    alone_px: NDArray[np.float64]
    object_share: NDArray[np.float64]
    is_contradictory: bool = False

    @classmethod
    def unread(cls, index: int, n_cameras: int) -> Self:
        """Return what is kept of a frame that could not be read."""
        nothing = np.full(n_cameras, np.nan)
        nowhere = np.full((n_cameras, 4), np.nan)
        return cls(index, (), np.zeros(n_cameras, np.bool_), nothing, nowhere, nothing)


def pack_frames(frames: Sequence[FrameOutlines]) -> dict[str, NDArray[Any]]:
    """Return what frames give to the judgement, at least one of them, as arrays to be stored."""
    outlines = [outline for frame in frames for outline in frame.outlines]
    return {
        "index": np.array([frame.index for frame in frames], np.int64),
        "n_outlines": np.array([len(frame.outlines) for frame in frames], np.int64),
        "n_corners": np.array([len(outline.marks) for outline in outlines], np.int64),
        "corners_px": np.concatenate(
            [np.zeros((0, 2), np.float32), *(outline.corners_px for outline in outlines)]
        ),
        "marks": np.concatenate([np.zeros(0, np.uint8), *(outline.marks for outline in outlines)]),
        "is_inverse": np.array([outline.is_inverse for outline in outlines], np.bool_),
        "deniers": np.array([frame.deniers for frame in frames]),
        "supported_share": np.array([frame.supported_share for frame in frames]),
        "alone_px": np.array([frame.alone_px for frame in frames]),
        "object_share": np.array([frame.object_share for frame in frames]),
        "is_contradictory": np.array([frame.is_contradictory for frame in frames]),
    }


def unpack_frames(packed: Mapping[str, NDArray[Any]]) -> list[FrameOutlines]:
    """Return the frames that `pack_frames` was given."""
    corner_ends = packed["n_corners"].cumsum()
    outlines = [
        Outline(packed["corners_px"][start:stop], packed["marks"][start:stop], bool(is_inverse))
        for start, stop, is_inverse in zip(
            corner_ends - packed["n_corners"], corner_ends, packed["is_inverse"], strict=True
        )
    ]
    ends = packed["n_outlines"].cumsum()
    return [
        FrameOutlines(
            int(packed["index"][row]),
            tuple(outlines[stop - packed["n_outlines"][row] : stop]),
            packed["deniers"][row],
            packed["supported_share"][row],
            packed["alone_px"][row],
            packed["object_share"][row],
            is_contradictory=bool(packed["is_contradictory"][row]),
        )
        for row, stop in enumerate(ends.tolist())
    ]


@dataclass(frozen=True, slots=True, eq=False)
class OutlineTable:
    """The outlines of F frames of C cameras, in one row each: of frame f and camera c, f C + c.

    Attributes
    ----------
    corners_px : (V, 2) float64
        All corners.
    is_cut : (V,) bool
        Which are cut off.
    first_corner : (P + 1,) int64
        Where each piece begins in `corners_px`.
    first_piece : (F C + 1,) int64
        Where each row begins in `first_corner`.
    is_inverse : (F, C) bool
        Which are outlines of what is not object.
    """

    corners_px: NDArray[np.float64]
    is_cut: NDArray[np.bool_]
    first_corner: NDArray[np.int64]
    first_piece: NDArray[np.int64]
    is_inverse: NDArray[np.bool_]

    @property
    def n_frames(self) -> int:
        """How many frames there are."""
        return len(self.is_inverse)


def table_of(frames: Sequence[Sequence[Outline]]) -> OutlineTable:
    """Return the outlines of frames, at least one of them, of the same cameras each."""
    rows = [outline for frame in frames for outline in frame]
    corners = np.concatenate([row.corners_px for row in rows]).astype(np.float64)
    marks = np.concatenate([row.marks for row in rows])
    n_pieces = [int(np.count_nonzero(row.marks & FIRST)) for row in rows]
    return OutlineTable(
        corners,
        (marks & CUT) != 0,
        np.append(np.flatnonzero(marks & FIRST), len(marks)).astype(np.int64),
        np.concatenate([[0], np.cumsum(n_pieces)]).astype(np.int64),
        np.array([row.is_inverse for row in rows]).reshape(len(frames), -1),
    )
