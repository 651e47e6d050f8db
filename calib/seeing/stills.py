"""Boards in the stills of one camera."""

import logging
from collections import Counter
from collections.abc import Iterable, Sequence
from itertools import combinations

import cv2
import numpy as np

from hybridve.calib.boards.board import Board, Detection, Observations, Sighting, is_seen
from hybridve.calib.boards.target import Chessboard
from hybridve.calib.errors import CalibrationError
from hybridve.calib.image_io import FrameSource
from hybridve.calib.seeing.given import Given, serves_as_stills, take_given
from hybridve.calib.seeing.inputs import CameraInput
from hybridve.calib.seeing.search import Choice, Found, Search, length_of, search_pictures

logger = logging.getLogger(__name__)


def observe_stills(search: Search, camera: CameraInput, given: Given) -> Observations | None:
    """Return what the stills of a camera show of the boards; None if there are none of its own."""
    source = camera.intrinsics
    if source is None or serves_as_stills(camera):
        return None
    step = -(-length_of(search, source) // search.settings.max_stills)
    choice = Choice(step, frozenset(index for index, _ in given.stills))
    found = Found()
    what = f"stills of {camera.name}"

    def is_searched(index: int, board: int) -> bool:
        return (index, board) not in given.stills

    search_pictures(search, source, choice, lambda _: "quick", is_searched, found, what)
    if not found.sizes:
        raise CalibrationError(f"camera {camera.name!r}: {source.label} holds no picture")
    take_given(found, given.stills)
    first = found.with_board
    if len(first) < min(search.settings.enough_stills, len(found.sizes)):
        search_pictures(
            search,
            source,
            choice,
            lambda _: "usual",
            lambda index, board: index not in first and is_searched(index, board),
            found,
            f"{what}, again",
        )
    logger.info(
        "camera %s: boards found in %d of %d stills",
        camera.name,
        len(found.with_board),
        len(found.sizes),
    )
    names = _names_of_images(source, found.sizes)
    counts = Counter(found.sizes.values())
    size_px = max(counts, key=lambda size: (counts[size], size))
    missed = {}
    for index in sorted(found.sizes):
        if found.sizes[index] != size_px:
            missed[names[index]] = "is {}x{} pixels, most are {}x{}".format(
                *found.sizes[index], *size_px
            )
        elif index not in found.with_board:
            missed[names[index]] = "no board found"
    fitting = {index: names[index] for index in names if names[index] not in missed}
    sightings, notes = sightings_of(search.boards, found, fitting, False)
    return Observations(
        camera.name, camera.model, size_px, sightings, False, missed=missed, notes=notes
    )


def _names_of_images(source: FrameSource, indices: Iterable[int]) -> dict[int, str]:
    """Return what to call images: by as little of their paths as tells them apart."""
    if source.is_video:
        return {index: f"frame {index}" for index in sorted(indices)}
    paths = {index: path for index, path in enumerate(source.pictures) if path is not None}
    names = {index: path.name for index, path in paths.items()}
    for depth in range(2, max(len(path.parts) for path in paths.values())):
        if len(set(names.values())) == len(names):
            break
        names = {index: "/".join(path.parts[-depth:]) for index, path in paths.items()}
    return {index: names[index] for index in sorted(indices)}


def sightings_of(
    boards: Sequence[Board], found: Found, names: dict[int, str], is_clip: bool
) -> tuple[tuple[Sighting, ...], tuple[str, ...]]:
    """Return the sightings in pictures that have names, and what is unusual about them."""
    sightings = []
    notes = []
    for index, image in names.items():
        in_image = {
            number: found.detections[index, number]
            for number in range(len(boards))
            if (index, number) in found.detections
        }
        for number, detection in without_parts(boards, in_image).items():
            if detection.corners is not None:
                instant = index if is_clip else None
                sightings.append(
                    Sighting(image, instant, number, detection.corners, detection.beyond)
                )
                notes += notes_of(boards, number, image, detection)
    return tuple(sightings), tuple(notes)


def without_parts(boards: Sequence[Board], found: dict[int, Detection]) -> dict[int, Detection]:
    """Return what was found in one picture without chessboards that are a part of a larger one."""
    plain = {
        number: detection.corners[is_seen(detection.corners)].astype(np.float32)
        for number, detection in found.items()
        if detection.corners is not None and isinstance(boards[number], Chessboard)
    }
    kept = dict(found)
    for (i, first), (j, second) in combinations(plain.items(), 2):
        part, whole = (i, second) if len(first) < len(second) else (j, first)
        middle = plain[part].mean(axis=0)
        outline = np.asarray(cv2.convexHull(whole))
        if cv2.pointPolygonTest(outline, (float(middle[0]), float(middle[1])), False) > 0:
            kept[part] = Detection(None, "found only as a part of a larger board")
    return kept


def notes_of(boards: Sequence[Board], number: int, image: str, detection: Detection) -> list[str]:
    """Return what is to be told of a detection: in which image, of which board."""
    which = f", {boards[number].name}" if len(boards) > 1 else ""
    return [f"{image}{which}: {note}" for note in detection.notes]
