"""What can be wrong with silhouettes: cameras exchanged, mirrored, late, bumped, and so on."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import product
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from helpers.seen import Recording
from hybridve.calib.lens import img_from_cam
from hybridve.calib.pose import transform
from hybridve.hull.agreement.record import NamedCause, SessionAgreement
from hybridve.hull.capture.recording import Mask

#: Takes a recording, the number of a row, and its silhouettes as recorded, and returns others.
Change = Callable[[Recording, int, list[Mask]], list[Mask]]

#: What was said: the cause alone, the cause and others besides, another camera with this one as
#: what it may be as well, something else, nothing, or nothing but that this cannot be told.
Outcome = Literal["rightly", "beside", "instead", "wrongly", "not", "cannot"]
OUTCOMES: tuple[Outcome, ...] = ("rightly", "beside", "instead", "wrongly", "not", "cannot")

#: When a fault that begins within a session is found, in frames, and a mistake of it is none.
_NEAR_FRAMES = 3

#: What a delay and a bump must be beyond, with two standard errors, to be named.
_LEAST_LATE, _LEAST_BUMP_PX = 0.15, 1.5


@dataclass(frozen=True, slots=True, eq=False)
class Spoil:
    """One thing that is wrong with a recording.

    Attributes
    ----------
    name : str
        What.
    kind : str
        As what it is to be named; empty where nothing is to be.
    cameras : tuple of int
        Whose.
    change : callable, optional
        What becomes of recorded silhouettes.
    late : float
        By how many frames the camera is late; negative: early.
    moved_px : (2,) float64, optional
        By how much its pinhole images are shifted.
    first : int
        In which row it begins.
    is_gross : bool
        Whether nothing may be certified then.
    is_optional : bool
        Whether it may as well pass unnoticed.
    """

    name: str
    kind: str = ""
    cameras: tuple[int, ...] = ()
    change: Change | None = None
    late: float = 0.0
    moved_px: NDArray[np.float64] | None = None
    first: int = 0
    is_gross: bool = False
    is_optional: bool = False

    @property
    def size(self) -> float:
        """How late, or how far moved; NaN of what has no size."""
        if self.late:
            return self.late
        return np.nan if self.moved_px is None else float(np.linalg.norm(self.moved_px))

    def applies(self, recording: Recording) -> bool:
        """Tell whether it can be done to a recording."""
        return not self.late or recording.has_time(abs(self.late))

    def frames(self, recording: Recording) -> range:
        """Return the frames in which all cameras have seen something."""
        lost = math.ceil(abs(self.late))
        return range(
            lost if self.late > 0 else 0, recording.n_frames - (lost if self.late < 0 else 0)
        )

    def masks(self, recording: Recording, index: int) -> list[Mask]:
        """Return the silhouettes of a frame, as recorded."""
        masks = recording.frame(index)
        if self.late:
            (camera,) = self.cameras
            masks[camera] = recording.seen(camera, index - self.late)
        return self.change(recording, index, masks) if self.change else masks


def spoils(recording: Recording, camera: int, other: int | None) -> Iterator[Spoil]:
    """Yield all that is done to a camera, or to it and another one of pictures as large."""
    one = (camera,)
    middle = recording.n_frames // 2
    if other is not None:
        both = camera, other
        yield Spoil("exchanged", "exchanged", both, _exchange(*both), is_gross=True)
        yield Spoil(
            "another's mask, 1 frame", "frames", one, _once(middle, _take(*both)), first=middle
        )
    yield Spoil("mirrored", "mirrored", one, _one(camera, lambda m: m[:, ::-1]), is_gross=True)
    yield Spoil("turned", "turned", one, _one(camera, lambda m: m[::-1, ::-1]), is_gross=True)
    yield Spoil("inverted, one", "inverted", one, _one(camera, lambda m: 1 - m), is_gross=True)
    everyone = tuple(range(len(recording.cameras)))
    yield Spoil(
        "inverted, all",
        "inverted",
        everyone,
        lambda _, __, masks: [1 - mask for mask in masks],
        is_gross=True,
    )
    sign = 1.0 if camera == 1 else -1.0
    for late in (0.3, 1.0, 2.5, 6.0, 10.0):
        yield Spoil(f"late by {late:g}", "late", one, late=sign * late, is_gross=late >= 2.5)
    way = np.array([0.6, 0.8]) if camera == 1 else np.array([-0.96, 0.28])
    for first, when in ((0, ""), (middle, ", half-way")):
        for px in (1.0, 3.0, 6.0, 20.0):
            yield Spoil(
                f"bumped by {px:g} px{when}",
                "bumped",
                one,
                _move(camera, px * way, first, recording.n_frames),
                moved_px=recording.pinhole_shift(camera, px * way),
                first=first,
                is_gross=px >= 6.0,
            )
    yield Spoil(
        "shifted by 40 px, 3 frames",
        "frames",
        one,
        _move(camera, np.array([40.0, 0.0]), middle, middle + 3),
        first=middle,
    )
    yield Spoil("chair, in one", "any", one, _blob(camera), is_optional=True)
    yield Spoil("camouflage, in one", "any", one, _one(camera, _without_a_band), is_optional=True)


def for_all(recording: Recording) -> Iterator[Spoil]:
    """Yield what is done to no camera, or to all."""
    yield Spoil("none")
    yield Spoil("chair, in all", change=_box)


def _one(camera: int, change: Callable[[Mask], Mask]) -> Change:
    def changed(recording: Recording, index: int, masks: list[Mask]) -> list[Mask]:
        return [
            np.ascontiguousarray(change(mask)) if k == camera else mask
            for k, mask in enumerate(masks)
        ]

    return changed


def _exchange(first: int, second: int) -> Change:
    def changed(recording: Recording, index: int, masks: list[Mask]) -> list[Mask]:
        masks = list(masks)
        masks[first], masks[second] = masks[second], masks[first]
        return masks

    return changed


def _take(camera: int, other: int) -> Change:
    def changed(recording: Recording, index: int, masks: list[Mask]) -> list[Mask]:
        return [masks[other] if k == camera else mask for k, mask in enumerate(masks)]

    return changed


def _once(frame: int, change: Change) -> Change:
    def changed(recording: Recording, index: int, masks: list[Mask]) -> list[Mask]:
        return change(recording, index, masks) if index == frame else masks

    return changed


def _move(camera: int, moved_px: NDArray[np.float64], first: int, stop: int) -> Change:
    def changed(recording: Recording, index: int, masks: list[Mask]) -> list[Mask]:
        if not first <= index < stop:
            return masks
        return [moved(mask, moved_px) if k == camera else mask for k, mask in enumerate(masks)]

    return changed


def moved(mask: Mask, moved_px: NDArray[np.float64]) -> Mask:
    """Return a silhouette shifted by (2,) pixels; between pixels, where half of it is covered."""
    height, width = mask.shape
    shift = np.column_stack([np.eye(2), moved_px])
    grey = cv2.warpAffine((mask > 0).astype(np.uint8) * 254, shift, (width, height))
    return np.asarray(grey > 127, np.uint8)


def _without_a_band(mask: Mask) -> Mask:
    """Return a silhouette without the middle fifth of its height."""
    _, y, _, height = cv2.boundingRect(mask)
    result = mask.copy()
    result[y + 2 * height // 5 : y + 3 * height // 5] = 0
    return result


def _blob(camera: int) -> Change:
    def changed(recording: Recording, index: int, masks: list[Mask]) -> list[Mask]:
        mask = masks[camera].copy()
        height, width = mask.shape
        mask[int(0.55 * height) : int(0.8 * height), int(0.1 * width) : int(0.22 * width)] = 1
        return [mask if k == camera else one for k, one in enumerate(masks)]

    return changed


def _box(recording: Recording, index: int, masks: list[Mask]) -> list[Mask]:
    """Add a box beside what is seen, as all cameras see it."""
    middle = recording.middle_world
    away = np.mean([np.linalg.norm(one.center_world - middle) for one in recording.cameras])
    along = np.linspace(-0.5, 0.5, 21)
    edges = [
        np.insert(np.array(ends, np.float64), axis, value)
        for axis in range(3)
        for ends in product((-0.5, 0.5), repeat=2)
        for value in along
    ]
    corners = middle + away * (np.array([0.13, 0.05, 0.0]) + 0.08 * np.array(edges))
    result = []
    for camera, mask in zip(recording.cameras, masks, strict=True):
        points = transform(camera.cam_from_world, corners)
        drawn = mask.copy()
        if (points[:, 2] > 0).all():
            pixels = img_from_cam(camera, points)
            hull = cv2.convexHull(np.round(16.0 * (pixels - 0.5)).astype(np.int32))
            cv2.fillConvexPoly(drawn, hull, 1, shift=4)
        result.append(drawn)
    return result


@dataclass(frozen=True, slots=True, eq=False)
class Told:
    """What was said of a spoilt recording.

    Attributes
    ----------
    outcome : Outcome
        How it was named.
    cause : NamedCause or None
        The cause that is the right one.
    text : str
        All that was named, in short.
    """

    outcome: Outcome
    cause: NamedCause | None
    text: str


def told(found: SessionAgreement, spoil: Spoil, names: tuple[str, ...]) -> Told:
    """Return whether a fault was named rightly."""
    wanted = {names[camera] for camera in spoil.cameras}
    mine = [cause for cause in found.causes if _is_right(cause, spoil, wanted)]
    others = [cause for cause in found.causes if cause not in mine]
    named = {name for cause in mine for name in cause.cameras}
    text = "; ".join(map(in_short, found.causes))
    if spoil.kind not in ("", "frames"):  # real silhouettes err in single frames besides
        others = [cause for cause in others if cause.kind != "frames"]
    outcome: Outcome = "not"
    if not spoil.kind:
        outcome = "wrongly" if others else "rightly"
    elif mine and named == wanted:
        outcome = "beside" if others else "rightly"
    elif any(cause.kind == spoil.kind and wanted & set(_alternatives(cause)) for cause in others):
        outcome = "instead"
    elif others:
        outcome = "wrongly"
    elif _cannot_tell(found, spoil, names):
        outcome = "cannot"
    return Told(outcome, mine[0] if mine else None, text)


def _is_right(cause: NamedCause, spoil: Spoil, wanted: set[str]) -> bool:
    if not set(cause.cameras) <= wanted:
        return False
    if spoil.kind == "any":
        return True
    if cause.kind != spoil.kind:
        return False
    if cause.kind == "exchanged":
        return set(cause.cameras) == wanted
    if cause.kind == "frames":
        return cause.first_frame <= spoil.first + 2 and cause.last_frame >= spoil.first
    if cause.kind == "bumped":
        return abs(cause.first_frame - spoil.first) <= _NEAR_FRAMES
    return True


def _alternatives(cause: NamedCause) -> list[str]:
    """Return which other cameras it is said that it may be."""
    _, found, rest = cause.message.rpartition("; or ")
    return rest.split(" is off the other way")[0].split(", ") if found else []


def _cannot_tell(found: SessionAgreement, spoil: Spoil, names: tuple[str, ...]) -> bool:
    """Tell whether it is said that so much of this cannot be told."""
    if not found.is_told:
        return True
    if spoil.kind == "late":
        error = found.cameras[names[spoil.cameras[0]]].late_se_frames
        return error is None or abs(spoil.late) - 2.0 * error < _LEAST_LATE
    if spoil.moved_px is not None:
        errors = found.cameras[names[spoil.cameras[0]]].moved_se_px
        return errors is None or spoil.size - 2.0 * max(errors) < _LEAST_BUMP_PX
    return False


def in_short(cause: NamedCause) -> str:
    """Return a cause in few words."""
    text = f"{'+'.join(cause.cameras)} {cause.kind}"
    if cause.size is not None:
        text += f" {cause.size:.2f}"
    if cause.low is not None and cause.high is not None:
        text += f" ({cause.low:.2f} to {cause.high:.2f})"
    if cause.moved_px is not None:
        text += " by {:.1f}, {:.1f}".format(*cause.moved_px)
    if cause.kind in ("frames", "bumped"):
        text += f" in {cause.first_frame}-{cause.last_frame}"
    also = _alternatives(cause)
    return text + (f" [or {', '.join(also)}]" if also else "")
