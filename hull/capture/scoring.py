"""How well silhouettes agree with masks that somebody made by hand, pixel by pixel."""

import re
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.errors import SessionError
from hybridve.calib.image_io import frame_numbers, natural_order, read_raw
from hybridve.hull.capture.session import Session, SessionCamera

#: A mask made by hand is object where it is brighter, of 255: what is painted has soft edges.
_OBJECT_ABOVE = 127


@dataclass(frozen=True, slots=True)
class Score:
    """How many pixels of silhouettes and of masks made by hand are the same.

    Attributes
    ----------
    both, extra, missed : int
        Object pixels of both, of the silhouettes alone, of the masks made by hand alone.
    """

    both: int = 0
    extra: int = 0
    missed: int = 0

    @classmethod
    def of(
        cls, mask: NDArray[np.uint8], truth: NDArray[np.bool_], counts: NDArray[np.bool_]
    ) -> Self:
        """Return that of a silhouette (H, W), 1 on object, in the pixels that count."""
        found = mask.astype(np.bool_) & counts
        there = truth & counts
        return cls(
            int((found & there).sum()), int((found & ~there).sum()), int((there & ~found).sum())
        )

    @classmethod
    def total(cls, scores: Iterable["Score"]) -> "Score":
        """Return that of all pixels together."""
        every = list(scores)
        return Score(
            sum(one.both for one in every),
            sum(one.extra for one in every),
            sum(one.missed for one in every),
        )

    @property
    def iou(self) -> float:
        """Intersection over union; 1 where neither has an object."""
        union = self.both + self.extra + self.missed
        return self.both / union if union else 1.0

    @property
    def precision(self) -> float:
        """Which share of the silhouettes is object; 1 where there is none."""
        found = self.both + self.extra
        return self.both / found if found else 1.0

    @property
    def recall(self) -> float:
        """Which share of the object is in the silhouettes; 1 where there is none."""
        there = self.both + self.missed
        return self.both / there if there else 1.0

    @property
    def f1(self) -> float:
        """Harmonic mean of precision and recall."""
        counted = 2 * self.both + self.extra + self.missed
        return 2 * self.both / counted if counted else 1.0


@dataclass(frozen=True, slots=True)
class HandMask:
    """A mask made by hand: of which camera and frame of the session, and where it is."""

    camera: int
    frame: int
    path: Path


def find_hand_masks(session: Session, pattern: str) -> list[HandMask]:
    """Return the masks made by hand that a pattern names, by camera and frame.

    Parameters
    ----------
    session : Session
        Whose cameras.
    pattern : str
        A path in which ``{camera}`` stands for a camera's name, ``{number}`` for which camera of
        the session it is (from 1), and ``{frame}`` for digits: the number of that camera's picture,
        of a video or of pictures without numbers that of the session's frame, from 0. Without
        ``{frame}`` the masks are those of frame 0.

    Raises
    ------
    SessionError
        If no camera has such a file.
    """
    found: list[HandMask] = []
    for number, camera in enumerate(session.cameras):
        named = pattern.replace("{camera}", camera.name).replace("{number}", str(number + 1))
        if "{frame}" not in named:
            if Path(named).is_file():
                found.append(HandMask(number, 0, Path(named)))
            continue
        frame_of = _frames_of_numbers(camera)
        for path, digits in _numbered(named):
            frame = digits if frame_of is None else frame_of.get(digits)
            if frame is not None:
                found.append(HandMask(number, frame + camera.nearest_shift, path))
    if len(session.cameras) > 1 and "{camera}" not in pattern and "{number}" not in pattern:
        raise SessionError(
            f"{pattern}: one mask cannot be that of {len(session.cameras)} cameras; write "
            "{camera} where their names differ, or {number} for 1, 2, ... in the session's order"
        )
    if not found:
        raise SessionError(
            f"{pattern}: there is no such mask of any camera and frame; expected images, with "
            "{camera} or {number} for the camera and {frame} for the number of its picture"
        )
    return found


def _frames_of_numbers(camera: SessionCamera) -> dict[int, int] | None:
    """Return which frame of a camera has the picture of a number; None where numbers count them."""
    recording = camera.recording
    if recording is None or recording.is_video:
        return None
    pictures = recording.pictures
    numbers = frame_numbers([path for path in pictures if path is not None])
    if numbers is None:
        return None
    frames = [frame for frame, path in enumerate(pictures) if path is not None]
    return dict(zip(numbers, frames, strict=True))


def _numbered(named: str) -> list[tuple[Path, int]]:
    """Return the files that a path with ``{frame}`` names, and the digits that stand there."""
    before, _, after = named.partition("{frame}")
    folder = Path(before + "0").parent
    lead, trail = Path(before + "0").name[:-1], after
    if "/" in trail or not folder.is_dir():
        return []
    form = re.compile(rf"{re.escape(lead)}(\d+){re.escape(trail)}")
    matches = [(path, form.fullmatch(path.name)) for path in folder.iterdir()]
    found = [(path, int(match.group(1))) for path, match in matches if match is not None]
    return sorted(found, key=lambda pair: natural_order(pair[0].name))


def read_hand_mask(
    path: Path, ignored: Collection[int] = ()
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return where a mask made by hand has an object, and which of its pixels count, (H, W) both.

    Parameters
    ----------
    path : Path
        An image; of one in colours the brightest channel counts.
    ignored : collection of int
        Grey levels of pixels that are nobody's: outside of what was looked at, or undecided.

    Raises
    ------
    SessionError
        If it cannot be read.
    """
    image = read_raw(path)
    if image.dtype == np.uint16:
        image = (image >> 8).astype(np.uint8)
    grey = image if image.ndim == 2 else image[..., :3].max(axis=2)
    counts = ~np.isin(grey, list(ignored))
    return grey > _OBJECT_ABOVE, counts
