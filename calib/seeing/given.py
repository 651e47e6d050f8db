"""Corners that something else has found, or a hand has marked, by the pictures they are of."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.boards.board import Board, Detection
from hybridve.calib.boards.corners_io import GivenCorners, read_given
from hybridve.calib.errors import CalibrationError
from hybridve.calib.image_io import FrameSource
from hybridve.calib.seeing.inputs import CameraInput
from hybridve.calib.seeing.search import Found


@dataclass(frozen=True, slots=True, eq=False)
class Given:
    """The corners that a file gives for one camera, by index of the image and board."""

    whole: dict[int, NDArray[np.float64]] = field(default_factory=dict)
    stills: dict[tuple[int, int], NDArray[np.float64]] = field(default_factory=dict)
    clip: dict[tuple[int, int], NDArray[np.float64]] = field(default_factory=dict)


def given_corners(boards: Sequence[Board], camera: CameraInput) -> Given:
    """Return given corners with the images they name found."""
    given = Given()
    if camera.corners is None or camera.extrinsics is None:
        return given
    clip = camera.extrinsics
    stills = None if serves_as_stills(camera) else camera.intrinsics
    for corners in read_given(camera.corners, boards):
        if corners.image is None:
            given.whole[corners.board] = corners.pixels
            continue
        if isinstance(corners.image, int):
            if not clip.is_video and corners.image >= len(clip.pictures):
                raise CalibrationError(
                    f"{camera.corners}: frame {corners.image}; {clip.label} has "
                    f"{len(clip.pictures)}, from 0"
                )
            places = [(given.clip, corners.image)]
        else:
            places = []
            if not clip.is_video:  # whose frames have a column of their own
                places += [(given.clip, index) for index in _named(clip, corners.image)]
            if stills is not None:
                places += [(given.stills, index) for index in _named(stills, corners.image)]
            _check_one(camera, corners, len(places))
        for images, index in places:
            images[index, corners.board] = corners.pixels
    return given


def _check_one(camera: CameraInput, corners: GivenCorners, count: int) -> None:
    if count != 1:
        found = "no picture" if count == 0 else f"{count} pictures"
        raise CalibrationError(
            f"{camera.corners}: image {corners.image!r} is the name of {found} of camera "
            f"{camera.name!r}; give as much of its path as makes it one"
        )


def _named(source: FrameSource, name: str) -> list[int]:
    """Return which images of a source a name may mean; those of a video are called "frame 3"."""
    if source.is_video:
        number = name.removeprefix("frame ")
        return [int(number)] if number != name and number.isdecimal() else []
    parts = Path(name).parts
    return [
        index
        for index, path in enumerate(source.pictures)
        if path is not None and path.parts[-len(parts) :] == parts
    ]


def serves_as_stills(camera: CameraInput) -> bool:
    """Tell whether the views of the extrinsic clip serve for the lens, too."""
    source = camera.intrinsics
    return source is None or (
        camera.extrinsics is not None and source.paths == camera.extrinsics.paths
    )


def take_given(found: Found, given: dict[tuple[int, int], NDArray[np.float64]]) -> None:
    """Take given corners into what was found, in place of what was found there."""
    for (index, board), pixels in given.items():
        if index in found.sizes:
            found.detections[index, board] = Detection(pixels, "given")
