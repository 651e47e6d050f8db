"""By how much cameras are out of time, told by a board that moves before them.

A camera's *offset* is how many frames late its clock is: its frame k was recorded when the
session's frame ``k + offset`` was. (A session's ``offset_s`` is the same in seconds.) The clock of
the first camera, by name, is the session's.

Whole frames are found by trying them: with the right one, two cameras have the same relative pose
at all instants. Fractions follow from a least-squares fit of the offsets, the cameras' poses and
the board's pose at each instant: the corners that a camera saw at the session's instants are
interpolated on their tracks, by cubics through four frames, and moved as the offsets change. Only
where the board moves does a frame's place in time show; constant speed in one direction looks like
another place of the camera, and shows nothing either. What cannot be told is NaN.

This work is based on: Albl, Kukelova, Fitzgibbon, Heller, Smid and Pajdla, *On the two-view
geometry of unsynchronized cameras*, CVPR 2017 (image tracks linearised in time); Rehder, Siegwart
and Furgale, *A general approach to spatiotemporal calibration in multisensor systems*, IEEE Trans.
Robotics 32(2), 2016 (the offset as one more parameter of the adjustment).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from hybridve.calib.boards.board import Board, Observations, Sighting
from hybridve.calib.camera import Camera
from hybridve.calib.placing.board_tracks import (
    interpolated,
    jumped_keys,
    listed_alike,
    spacing_of,
    tracks_of,
)
from hybridve.calib.placing.clock_problem import KNOWN_FRAMES, MIN_MOTION, MIN_TELLING, ClockProblem
from hybridve.calib.placing.clock_start import MAX_OFFSET_FRAMES, located, start_of


@dataclass(frozen=True, slots=True, eq=False)
class Clocks:
    """How late the cameras are.

    Attributes
    ----------
    reference : str
        The camera whose clock is the session's.
    offset_frames : dict of str to float
        By camera: its frame k was recorded at the session's frame ``k + offset``. NaN: unknown.
    std_frames : dict of str to float
        Standard deviations; 0 for the reference, NaN where the offset is unknown.
    is_known : dict of str to bool
        Whether the offset is known to a quarter of a frame.
    rms_px : float
        Of the corners that the offsets were fitted to; NaN where none were.
    notes : tuple of str
        Why an offset is not known.
    left_out : dict of str to tuple of int
        By camera the instants at which a board, all of it, is far off its path through the frames
        before and after; nothing was told by these.
    """

    reference: str
    offset_frames: dict[str, float]
    std_frames: dict[str, float]
    is_known: dict[str, bool]
    rms_px: float
    notes: tuple[str, ...] = ()
    left_out: dict[str, tuple[int, ...]] = field(default_factory=dict)


def estimate_offsets(
    boards: Sequence[Board],
    cameras: Sequence[Camera],
    observations: Sequence[Observations],
    max_offset_frames: int = MAX_OFFSET_FRAMES,
) -> Clocks:
    """Estimate how late each camera is, from a clip in which boards move before all of them.

    Parameters
    ----------
    boards : sequence of Board
        The boards.
    cameras : sequence of Camera
        The lenses; their poses are not used.
    observations : sequence of Observations
        What the same cameras saw, in order of their names; every frame of the clip, so that
        neighbours can be interpolated.
    max_offset_frames : int
        The largest offset between two cameras that is looked for.
    """
    names = [seen.name for seen in observations]
    n_cameras = len(names)
    offsets, stds = np.full(n_cameras, np.nan), np.full(n_cameras, np.nan)
    offsets[0] = stds[0] = 0.0
    notes: dict[int, str] = {}
    left_out: dict[str, tuple[int, ...]] = dict.fromkeys(names, ())
    rms_px = np.nan
    if any(seen.is_still for seen in observations):
        notes |= dict.fromkeys(range(1, n_cameras), "the boards lie still in the clip")
    elif n_cameras > 1:
        tracks = [tracks_of(seen.sightings) for seen in observations]
        spacing = spacing_of(tracks)
        tracks = [listed_alike(boards, track, spacing) for track in tracks]
        for camera, track in enumerate(tracks):
            jumped = jumped_keys(track, spacing)
            left_out[names[camera]] = tuple(sorted({instant for _, instant in jumped}))
            tracks[camera] = {key: track[key] for key in track if key not in jumped}
        poses = [located(boards, *pair) for pair in zip(cameras, tracks, strict=True)]
        start = start_of(boards, poses, spacing, max_offset_frames)
        for index in range(1, n_cameras):
            if index not in start:
                notes[index] = (
                    "it shares no run of frames with the others in which their views of a board "
                    "agree on where the cameras stand"
                )
        problem = ClockProblem.of(boards, cameras, tracks, poses, start, spacing)
        if problem is None:
            notes |= dict.fromkeys(
                start.keys() - {0}, "too few neighbouring frames show a board to two cameras"
            )
        else:
            found = problem.solve()
            rms_px = found.rms_px
            for index in sorted(start.keys() - {0}):
                std = found.std_frames[index]
                if found.motion[index] < MIN_MOTION:
                    notes[index] = "the board hardly moves before it"
                elif not (std < KNOWN_FRAMES and found.telling[index] > MIN_TELLING):
                    notes[index] = (
                        "the board's motion does not tell it: move it to and fro, and turn it"
                    )
                else:
                    offsets[index], stds[index] = found.offset_frames[index], std
    return Clocks(
        names[0],
        {name: float(offset) for name, offset in zip(names, offsets, strict=True)},
        {name: float(std) for name, std in zip(names, stds, strict=True)},
        {name: bool(np.isfinite(offset)) for name, offset in zip(names, offsets, strict=True)},
        rms_px,
        tuple(
            f"camera {names[index]!r}: its offset in time cannot be told: {why}"
            for index, why in sorted(notes.items())
        ),
        left_out,
    )


def resampled(
    observations: Sequence[Observations],
    offset_frames: Mapping[str, float],
    boards: Sequence[Board] | None = None,
) -> list[Observations]:
    """Return what the cameras would have seen of moving boards, had their clocks been right.

    Corners are interpolated by cubics through four neighbouring frames, where these were seen, and
    none of them is off the path of the others; other sightings in the clip are left out. Stills,
    still clips and cameras without offset stay.

    Parameters
    ----------
    observations : sequence of Observations
        What the cameras saw.
    offset_frames : mapping of str to float
        As `Clocks.offset_frames`; cameras that are not named, or NaN, are taken to be in time.
    boards : sequence of Board, optional
        The boards: where one looks the same when turned, neighbouring frames may list it from
        different ends, and are then listed alike.
    """
    instants = sorted(
        {s.instant for seen in observations for s in seen.sightings if s.instant is not None}
    )
    spacing = spacing_of([tracks_of(seen.sightings) for seen in observations])
    found = []
    for seen in observations:
        offset = offset_frames.get(seen.name, 0.0)
        if seen.is_still or not np.isfinite(offset) or offset == 0.0:
            found.append(seen)
            continue
        tracks = tracks_of(seen.sightings)
        if boards is not None:
            tracks = listed_alike(boards, tracks, spacing)
        jumped = jumped_keys(tracks, spacing)
        tracks = {key: tracks[key] for key in tracks if key not in jumped}
        stills = tuple(s for s in seen.sightings if s.instant is None)
        moved = []
        for instant in instants:
            for board in sorted({board for board, _ in tracks}):
                track = interpolated(tracks, board, instant - offset, spacing)
                if track is not None:
                    image = f"board clip, instant {instant}"
                    moved.append(Sighting(image, instant, board, track.points))
        found.append(replace(seen, sightings=(*stills, *moved)))
    return found
