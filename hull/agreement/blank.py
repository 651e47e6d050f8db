"""Cameras that tell little by themselves: empty all the time, nearly all object, or never changing.

None of these is wrong as such: nobody may enter a camera's view, or what it sees may stand still.
Yet of an empty camera follows that nothing is touched, and one picture that is there many times
hides what came after it. So it is told, with the number of frames, and nothing is refused.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

#: "saw nothing": no object pixel in any frame; "all object": nearly the whole picture on average;
#: "unchanging": the very same silhouette in all frames.
BlankKind = Literal["saw nothing", "all object", "unchanging"]

#: A camera that is object to such a share, on average, is asked whether its masks are inverted.
NEARLY_ALL = 0.9

#: In so many frames in a row silhouettes of slow things may well be the same.
LEAST_SAME = 10


@dataclass(frozen=True, slots=True)
class Blank:
    """Cameras that show one and the same all the time.

    Attributes
    ----------
    kind : BlankKind
        What they show.
    cameras : tuple of int
        Which, by number; several only where all are the same.
    n_frames : int
        In how many frames.
    share : float
        Share of object pixels on average, of the first.
    is_every : bool
        Whether these are all cameras.
    """

    kind: BlankKind
    cameras: tuple[int, ...]
    n_frames: int
    share: float
    is_every: bool


def blank_cameras(
    shares: NDArray[np.float64], is_same: NDArray[np.bool_], least_same: int = LEAST_SAME
) -> tuple[Blank, ...]:
    """Return the cameras that show one and the same all the time.

    Parameters
    ----------
    shares : (F, C) float64
        Of each picture that was recorded, which share is object; NaN in frames that were not read.
    is_same : (C,) bool
        Whether a camera's silhouette is the same, pixel by pixel, in all frames that were read.
    least_same : int
        In fewer frames a silhouette may be the same without a word.

    Examples
    --------
    >>> shares = np.array([[0.0, 0.2], [0.0, 0.3]])
    >>> blank_cameras(shares, np.array([True, False]))[0].kind
    'saw nothing'
    """
    read = shares[~np.isnan(shares).any(axis=1)]
    n_frames, n_cameras = read.shape
    if not n_frames:
        return ()
    is_empty = read.max(axis=0) == 0.0
    is_full = read.mean(axis=0) > NEARLY_ALL
    is_still = is_same & ~is_empty & ~is_full & (n_frames >= least_same)
    found = []
    kinds: tuple[tuple[BlankKind, NDArray[np.bool_]], ...] = (
        ("saw nothing", is_empty),
        ("all object", is_full),
        ("unchanging", is_still),
    )
    for kind, which in kinds:
        cameras = np.flatnonzero(which).tolist()
        is_every = len(cameras) == n_cameras
        groups = [cameras] if is_every and kind != "all object" else [[one] for one in cameras]
        for group in groups:
            share = float(read[:, group[0]].mean())
            found.append(Blank(kind, tuple(group), n_frames, share, is_every))
    return tuple(found)


class BlankLooks:
    """Gathers what `blank_cameras` asks for, from silhouettes as they come.

    Attributes
    ----------
    index : list of int
        Numbers of the frames that were taken.
    """

    def __init__(self) -> None:
        self.index: list[int] = []
        self._first: list[NDArray[np.uint8]] = []
        self._shares: list[list[float]] = []
        self._is_same: list[bool] = []

    def take(self, index: int, masks: Sequence[NDArray[np.uint8]]) -> None:
        """Take in the silhouettes (H, W) of all cameras in one frame: 1 on object pixels."""
        if not self.index:
            self._first = [mask.copy() for mask in masks]
            self._is_same = [True] * len(masks)
        self.index.append(index)
        self._shares.append([float(mask.mean()) for mask in masks])
        self._is_same = [
            known and np.array_equal(first, mask)
            for known, first, mask in zip(self._is_same, self._first, masks, strict=True)
        ]

    @property
    def shares(self) -> NDArray[np.float64]:
        """Which share of each picture is object, (F, C)."""
        return np.array(self._shares).reshape(len(self.index), -1)

    @property
    def is_same(self) -> NDArray[np.bool_]:
        """Whether each camera's silhouette was the same in all frames, (C,)."""
        return np.array(self._is_same, np.bool_)


def blank_short(blank: Blank, names: Sequence[str], looked: str = "") -> str:
    """Return what such cameras show, in a few words.

    Parameters
    ----------
    blank : Blank
        What was found.
    names : sequence of C str
        All cameras.
    looked : str
        What stands behind the number of frames, as " looked at".
    """
    frames = f"in all {blank.n_frames} frames" if blank.n_frames > 1 else "in the one frame"
    frames += looked
    who = names[blank.cameras[0]]
    if blank.kind == "saw nothing":
        saw = "no camera saw anything" if blank.is_every else f"{who} saw nothing"
        return f"{saw} {frames}"
    if blank.kind == "all object":
        return f"{who} is {blank.share:.0%} object {frames}, on average"
    if blank.is_every:
        return f"no camera's silhouette changes {frames}"
    return f"{who} shows the very same silhouette {frames}"


def blank_message(blank: Blank, names: Sequence[str], *, has_masks: bool, looked: str = "") -> str:
    """Return what such cameras show, what follows, and what to ask: one line.

    `has_masks` says whether their silhouettes came ready made; the others are as of `blank_short`.
    """
    short = blank_short(blank, names, looked)
    if blank.kind == "saw nothing":
        short = f"{short}, and all that is kept or free rests on that"
        if blank.is_every:
            return f"{short}; is this the recording of the task?"
        its = "are these its masks" if has_masks else "is this its recording"
        return f"{short}; does it see where the task is, and {its}?"
    if blank.kind == "all object":
        if has_masks:
            return f"{short}; are the masks black on white?"
        return f"{short}; is the background of this room, in this light?"
    if blank.is_every:
        return f"{short}: nothing moves in them, or one picture is there many times"
    return f"{short}; is one picture there many times, or did the recording stop?"


def rests_on_text(names: Sequence[str], n_frames: int) -> str:
    """Return in words that what is free rests on cameras that saw nothing.

    Examples
    --------
    >>> rests_on_text(["cam1", "cam3"], 40)
    'cam1 and cam3 having seen nothing in all 40 frames'
    """
    frames = f"all {n_frames} frames" if n_frames > 1 else "the one frame"
    return f"{' and '.join(names)} having seen nothing in {frames}"
