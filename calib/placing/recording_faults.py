"""What may be wrong with a recording: pictures that are the same, exchanged, or of another lens."""

from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.boards.board import Board, Observations, is_seen
from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.image_io import natural_order
from hybridve.calib.placing.looks import SolvedLens, corner_residuals
from hybridve.calib.pose import Pose
from hybridve.calib.solving.locate import locate_board, rms

#: A clip that misses its lens by more than so many times what the stills do, or than the limit
#: (both median root mean squares), is suspicious; another camera's lens explains it if it misses
#: less than a share of that. Beyond the last limit no view can be trusted. From the first factor on
#: it is worth a warning: the error of 40 points varies by 8 %.
_CLIP_DOUBTFUL_FACTOR = 1.5
_CLIP_FACTOR = 3.0
_CLIP_LIMIT_PX = 0.1
_EXPLAINS_SHARE = 1.0 / 3.0
_CLIP_HOPELESS_PX = 5.0

#: Views from which it is told how far a lens misses a clip, or stills.
_TYPICAL_VIEWS = 12

#: Corners of two cameras that differ by less come from one picture, or from one that was encoded
#: twice (pixels).
_SAME_PICTURE_PX = 1e-6
_ALIKE_PX = 1.0


def refuse_copies(boards: Sequence[Board], observations: Sequence[Observations]) -> list[str]:
    """Refuse two cameras whose corners are the same to the pixel; warn where they nearly are."""
    clips = [
        {(s.instant, s.board): s.pixels for s in seen.sightings if s.instant is not None}
        for seen in observations
    ]
    warnings = []
    for one, other in combinations(range(len(observations)), 2):
        common = clips[one].keys() & clips[other].keys()
        apart_px = [
            min(
                _largest_px(clips[one][key] - clips[other][key][look])
                for look in boards[key[1]].looks
            )
            for key in common
        ]
        apart_px = [px for px in apart_px if np.isfinite(px)]
        if not apart_px:
            continue
        names = f"cameras {observations[one].name!r} and {observations[other].name!r}"
        if max(apart_px) < _SAME_PICTURE_PX:
            raise CalibrationError(
                f"{names} show the same pictures: in {len(apart_px)} common views the corners are "
                "the same to the pixel; list each camera once, with its own files"
            )
        if np.median(apart_px) < _ALIKE_PX:
            warnings.append(
                f"the pictures of {names} are alike: in {len(apart_px)} common views the corners "
                f"are {np.median(apart_px):.2f} px apart at most (median); is one recording listed "
                "twice?"
            )
    return warnings


def _largest_px(apart: NDArray[np.float64]) -> float:
    """Return the largest of distances (N, 2); infinite where no point was seen twice."""
    both = is_seen(apart)
    return float(np.linalg.norm(apart[both], axis=1).max()) if both.any() else np.inf


def refuse_exchanged(
    boards: Sequence[Board],
    lenses: Sequence[SolvedLens],
    observations: Sequence[Observations],
) -> list[str]:
    """Refuse stills and clips that cannot both have been recorded through one lens.

    Return warnings where they hardly can.
    """
    suspects: list[tuple[Camera, Observations, str, float]] = []
    warnings = []
    for lens, seen in zip(lenses, observations, strict=True):
        of_clip = _typical_error(boards, lens.camera, seen, "clip", lens.views)
        of_stills = _typical_error(boards, lens.camera, seen, "stills", lens.views)
        what, missed_px = ("clip", of_clip) if of_clip > of_stills else ("stills", of_stills)
        usual_px = min(of_clip, of_stills) or _CLIP_HOPELESS_PX  # 0: nothing to compare with
        if missed_px > max(_CLIP_LIMIT_PX, _CLIP_FACTOR * usual_px):
            suspects.append((lens.camera, seen, what, missed_px))
        if of_clip > max(_CLIP_LIMIT_PX, _CLIP_DOUBTFUL_FACTOR * usual_px):
            warnings.append(
                f"camera {seen.name!r}: the board clip misses its lens by {of_clip:.2f} px, its "
                f"stills by {of_stills:.2f} px; were both recorded with the same zoom and focus, "
                "and is the board the same, and flat?"
            )
    for (own, seen, what, px), (others, other, other_what, other_px) in combinations(suspects, 2):
        exchanged_px = _typical_error(boards, others, seen, what)
        other_exchanged_px = _typical_error(boards, own, other, other_what)
        if (
            what == other_what
            and exchanged_px < _EXPLAINS_SHARE * px
            and other_exchanged_px < _EXPLAINS_SHARE * other_px
        ):
            raise CalibrationError(
                f"the clips of {seen.name!r} and {other.name!r} seem to be exchanged, or their "
                f"stills: the {what} miss the lenses by {px:.2f} and {other_px:.2f} px, exchanged "
                f"by {exchanged_px:.2f} and {other_exchanged_px:.2f} px; name the clip of each "
                "camera beside its own stills"
            )
    for _, seen, what, missed_px in suspects:
        if missed_px > _CLIP_HOPELESS_PX:
            raise CalibrationError(
                f"camera {seen.name!r}: the board {what} misses its lens by {missed_px:.1f} px; "
                "were clip and stills recorded by this camera, with the same zoom, and is the "
                "board the same?"
            )
    return warnings


def _typical_error(
    boards: Sequence[Board],
    camera: Camera,
    seen: Observations,
    what: str,
    views: Mapping[tuple[str, int], Pose] | None = None,
) -> float:
    """Return how far a lens misses the boards of the clip or the stills, median of rms, pixels.

    0 where there are none, infinite where the lens is that of another image size. Views that were
    located need not be so again.
    """
    if (camera.width_px, camera.height_px) != tuple(seen.size_px):
        return np.inf
    sightings = sorted(
        (s for s in seen.sightings if (s.instant is None) == (what == "stills")),
        key=lambda s: (s.instant or 0, natural_order(s.image), boards[s.board].name),
    )
    count = min(len(sightings), _TYPICAL_VIEWS)
    chosen = np.linspace(0, len(sightings) - 1, count).round().astype(int)
    errors = []
    for sighting in (sightings[index] for index in chosen):
        board = boards[sighting.board]
        pose = (views or {}).get((sighting.image, sighting.board))
        if pose is not None:
            errors.append(rms(corner_residuals(camera, pose, board, sighting.pixels)))
            continue
        located = locate_board(camera, board.points_board, sighting.pixels)
        if located is not None:
            errors.append(located[1])
    return float(np.median(errors)) if errors else 0.0
