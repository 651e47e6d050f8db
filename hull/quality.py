"""How good a session's silhouettes are: which frames to look at first, a page, a film, a score."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.errors import SessionError
from hybridve.hull.capture.recording import Mask, recording_of
from hybridve.hull.capture.scoring import HandMask, Score, find_hand_masks, read_hand_mask
from hybridve.hull.capture.session import Session, SessionCamera
from hybridve.hull.capture.silhouette_io import SilhouetteReader
from hybridve.hull.cut_out import Segmented
from hybridve.hull.view.film import write_film
from hybridve.hull.view.outlined import outlined
from hybridve.hull.view.picture import contact_sheet, sheet_layout
from hybridve.hull.view.quality_page import LookAt, write_quality_page
from hybridve.hull.watcher import Watcher

Image = NDArray[np.uint8]

#: So many frames are named that a person should look at first.
_MOST_LOOKS = 12

#: Frames of one camera are named at least so many apart: neighbours show the same.
_APART = 10

#: The area of a silhouette is compared with the median of so many frames on either side.
_AROUND = 5

#: An area that differs from that by less than this factor is a person who moves.
_JUMP = 1.25

#: Silhouettes of less than this share of a picture jump by themselves.
_LEAST_SHARE = 1e-3

#: A silhouette stands out that the others support to a share less by this than in half of the
#: frames; what is lacking in all of them is said of the session.
_LESS_SUPPORTED = 0.05

#: Width of a picture on the page, and what a frame of the film may measure, pixels.
_PAGE_PX, _FILM_PX = 420, (1280, 960)

#: Pictures side by side on the page.
_PAGE_COLUMNS = 4


@dataclass(frozen=True, slots=True)
class Scored:
    """A silhouette beside the mask that somebody made of it by hand."""

    camera: str
    frame: int
    path: Path
    score: Score


# --- Frames to look at first --------------------------------------------------------------------


def frames_to_look_at(
    names: Sequence[str],
    shares: NDArray[np.float64],
    supported: NDArray[np.float64],
    denies: NDArray[np.bool_],
) -> list[tuple[int, str]]:
    """Return frames whose silhouettes are least like what they should be, and why, worst first.

    A camera that denies what several others see comes first; then silhouettes that the others
    support least, and those whose area is not that of the frames around them.

    Parameters
    ----------
    names : sequence of C str
        The cameras.
    shares, supported, denies : (F, C)
        As of `hybridve.hull.cut_out.Segmented`.
    """
    n_frames, n_cameras = shares.shape
    badness = np.zeros((n_frames, n_cameras))
    reason = np.full((n_frames, n_cameras), "", object)
    usual = _usual_shares(shares)
    support_of = [
        float(np.median(known)) if len(known := column[np.isfinite(column)]) else np.nan
        for column in supported.T
    ]
    for frame, camera in np.ndindex(n_frames, n_cameras):
        share, expected = float(shares[frame, camera]), float(usual[frame, camera])
        if np.isfinite(share) and max(share, expected) > _LEAST_SHARE:
            factor = max(share, _LEAST_SHARE) / max(expected, _LEAST_SHARE)
            if not 1 / _JUMP <= factor <= _JUMP:
                badness[frame, camera] = abs(np.log(factor))
                much = f"{abs(share / expected - 1.0):.0%}" if expected > 0 else "much"
                than = "larger" if factor > 1 else "smaller"
                reason[frame, camera] = f"{names[camera]} is {much} {than} than in frames around it"
        support = float(supported[frame, camera])
        lacking = support_of[camera] - support
        if lacking > max(_LESS_SUPPORTED, float(badness[frame, camera])):
            badness[frame, camera] = lacking
            reason[frame, camera] = (
                f"{support:.0%} of {names[camera]} is supported by the other cameras"
            )
        if denies[frame, camera]:
            badness[frame, camera] += 10.0
            reason[frame, camera] = f"{names[camera]} denies what several others see"
    chosen: list[tuple[int, int]] = []
    for flat in np.argsort(-badness, axis=None, kind="stable").tolist():
        frame, camera = divmod(flat, n_cameras)
        if badness[frame, camera] == 0.0 or len(chosen) == _MOST_LOOKS:
            break
        if all(abs(frame - other) >= _APART or camera != same for other, same in chosen):
            chosen.append((frame, camera))
    named: dict[int, list[str]] = {}
    for frame, camera in chosen:
        named.setdefault(frame, []).append(reason[frame, camera])
    return [(frame, "; ".join(why)) for frame, why in named.items()]


def _usual_shares(shares: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the median of each camera's shares (F, C) in the frames around each, without it."""
    n_frames, n_cameras = shares.shape
    padded = np.full((n_frames + 2 * _AROUND, n_cameras), np.nan)
    padded[_AROUND : _AROUND + n_frames] = shares
    steps = [step for step in range(2 * _AROUND + 1) if step != _AROUND]
    around = np.stack([padded[step : step + n_frames] for step in steps])  # (2 A, F, C)
    known = np.isfinite(around).any(axis=0)
    usual = shares.copy()
    usual[known] = np.nanmedian(around[:, known], axis=0)
    return usual


# --- The page -----------------------------------------------------------------------------------


def write_page(path: Path, session: Session, found: Segmented) -> int:
    """Write the page of a session's silhouettes, and return how many frames it says to look at.

    Raises
    ------
    SessionError
        If the recordings cannot be read any more.
    ReportError
        If the page cannot be written.
    """
    looks = frames_to_look_at(found.names, found.shares, found.supported, found.denies)
    read = [frame for frame, why in enumerate(found.reasons) if not why]
    usual = list(dict.fromkeys((read[0], read[len(read) // 2], read[-1]))) if read else []
    wanted = sorted({*usual, *(frame for frame, _ in looks)})
    pictures = [_pictures_of(session, camera, wanted) for camera in session.cameras]
    with SilhouetteReader(found.path) as reader:
        sheets = {
            frame: _sheet(session, frame, [one.get(frame) for one in pictures], masks, _PAGE_PX)
            for frame in wanted
            if (masks := reader.frame(frame)[0]) is not None
        }
    write_quality_page(
        path,
        title=session.name,
        names=found.names,
        time_s=np.arange(len(found.reasons)) / session.fps,
        shares=found.shares,
        supported=found.supported,
        invalid=[(frame, why) for frame, why in enumerate(found.reasons) if why],
        causes=found.agreement.causes,
        is_trusted=found.agreement.is_trusted,
        is_confirmed=found.is_confirmed,
        looks=[LookAt(frame, why, sheets[frame]) for frame, why in looks if frame in sheets],
        usual=[LookAt(frame, "", sheets[frame]) for frame in usual if frame in sheets],
    )
    return len(looks)


def _pictures_of(
    session: Session, camera: SessionCamera, frames: Sequence[int]
) -> dict[int, Image]:
    """Return a camera's pictures of some frames of the session, read forwards; none of masks."""
    if camera.has_masks or not frames:
        return {}
    numbers = {frame - camera.nearest_shift: frame for frame in frames}
    first, last = max(min(numbers), 0), max(numbers)
    if last < 0:
        return {}
    images = recording_of(session, camera).frames_or_errors(first, last + 1)
    return {
        numbers[number]: _in_colours(image)
        for number, image in enumerate(images, start=first)
        if number in numbers and not isinstance(image, SessionError)
    }


def _in_colours(image: NDArray[np.generic]) -> Image:
    if image.ndim == 2:
        image = np.repeat(image[..., None], 3, axis=2)
    return np.ascontiguousarray(image[..., :3], np.uint8)


def _sheet(
    session: Session,
    frame: int,
    images: Sequence[Image | None],
    masks: Sequence[Mask],
    width_px: int,
) -> Image:
    drawn = [
        outlined(image, mask, f"{camera.name}, frame {frame}: {mask.mean():.1%}", width_px)
        for camera, image, mask in zip(session.cameras, images, masks, strict=True)
    ]
    return contact_sheet(drawn, min(len(drawn), _PAGE_COLUMNS))


# --- The film -----------------------------------------------------------------------------------


def write_outline_film(path: Path, session: Session, found: Segmented, watcher: Watcher) -> int:
    """Write a film of what all cameras saw, with outlines, and return its number of frames.

    Raises
    ------
    SessionError
        If the recordings cannot be read any more.
    ReportError
        If there is no frame, or the film cannot be written.
    """
    with watcher.steps("film", len(found.reasons)) as advance:

        def drawn() -> Iterator[Image]:
            for image in _film_frames(session, found):
                yield image
                advance()

        return write_film(path, drawn(), session.fps)


def _film_frames(session: Session, found: Segmented) -> Iterator[Image]:
    sizes_px = [_size_px(session, camera) for camera in session.cameras]
    columns, share = sheet_layout(sizes_px, _FILM_PX)
    width_px = max(round(share * max(width for width, _ in sizes_px)), 64)
    sources = [_every_picture(session, camera) for camera in session.cameras]
    with SilhouetteReader(found.path) as reader:
        for frame in range(reader.n_frames):
            masks, why = reader.frame(frame)
            images = [next(source, None) for source in sources]
            if masks is None:
                masks = [np.zeros((height, width), np.uint8) for width, height in sizes_px]
            labels = [why or f"{camera.name}, frame {frame}" for camera in session.cameras]
            yield contact_sheet(
                [
                    outlined(image, mask, label, width_px)
                    for image, mask, label in zip(images, masks, labels, strict=True)
                ],
                columns,
            )


def _size_px(session: Session, camera: SessionCamera) -> tuple[int, int]:
    height, width = recording_of(session, camera).first().shape[:2]
    return width, height


def _every_picture(session: Session, camera: SessionCamera) -> Iterator[Image | None]:
    """Yield a camera's picture of each frame of the session; None where there is none to show."""
    shift = camera.nearest_shift
    if camera.has_masks:
        return
    for _ in range(shift):
        yield None
    for image in recording_of(session, camera).frames_or_errors(max(-shift, 0)):
        yield None if isinstance(image, SessionError) else _in_colours(image)


# --- The score ----------------------------------------------------------------------------------


def score_silhouettes(
    session: Session, stored: Path, pattern: str, ignored: Sequence[int] = ()
) -> list[Scored]:
    """Return how well stored silhouettes agree with masks made by hand, mask by mask.

    Parameters
    ----------
    session : Session
        Whose they are.
    stored : Path
        The silhouettes.
    pattern : str
        The masks; see `hybridve.hull.capture.scoring.find_hand_masks`.
    ignored : sequence of int
        Grey levels of their pixels that do not count.

    Raises
    ------
    SessionError
        If there are no such masks, one cannot be read, is of another size, or of a frame that has
        no silhouettes.
    """
    hand_masks = find_hand_masks(session, pattern)
    with SilhouetteReader(stored) as reader:
        return [_scored(session, reader, one, ignored) for one in hand_masks]


def _scored(
    session: Session, reader: SilhouetteReader, one: HandMask, ignored: Sequence[int]
) -> Scored:
    name = session.cameras[one.camera].name
    if not 0 <= one.frame < reader.n_frames:
        raise SessionError(
            f"{one.path}: is that of frame {one.frame}; the session has {reader.n_frames}, from 0"
        )
    masks, why = reader.frame(one.frame)
    if masks is None:
        raise SessionError(f"{one.path}: is that of frame {one.frame}, without silhouettes: {why}")
    truth, counts = read_hand_mask(one.path, ignored)
    if truth.shape != masks[one.camera].shape:
        (height, width), (tall, wide) = truth.shape, masks[one.camera].shape
        raise SessionError(
            f"{one.path}: is {width}x{height}, pictures of camera {name!r} are {wide}x{tall}; "
            "expected masks of the same size"
        )
    return Scored(name, one.frame, one.path, Score.of(masks[one.camera], truth, counts))
