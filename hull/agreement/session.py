"""What the cameras of a whole session say about each other, and how far it is to be trusted.

Outlines are gathered frame by frame, and judged once all are there: what no frame tells by itself,
a clock that is late or a camera that was bumped, all of them together do.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.agreement.causes import Cause, Diagnosis, FrameVerdicts, diagnose
from hybridve.hull.agreement.offsets import Offset
from hybridve.hull.agreement.outlines import FrameOutlines, Outline, table_of
from hybridve.hull.agreement.record import (
    STATED_PX,
    CameraAgreement,
    NamedCause,
    SessionAgreement,
)
from hybridve.hull.agreement.told import message_of, short_of
from hybridve.hull.agreement.trials import Trial
from hybridve.hull.query.silhouettes import Views

#: One-sided 95 % of a normal distribution, in standard deviations.
_ONE_SIDED_95 = 1.645

#: Outlines move by more than this many times the root mean square of their speed in 5 % of frames.
_FAST = 2.0

#: Frames that are farther apart than this tell no delay.
_LARGEST_STEP = 4


def judge_session(
    views: Views,
    frames: Sequence[FrameOutlines],
    *,
    offset_s: Mapping[str, float],
    fps: float,
) -> SessionAgreement:
    """Return what the cameras of a session say about each other.

    Parameters
    ----------
    views : Views
        The cameras, which stand still.
    frames : sequence of F FrameOutlines
        Evenly spaced; those that were not read are there, without outlines.
    offset_s : mapping of str to float
        How much later each camera is said to have begun.
    fps : float
        Frames a second.
    """
    if len(views) < 2 or not any(frame.outlines for frame in frames):
        return SessionAgreement()
    nothing = (Outline.empty(),) * len(views)
    table = table_of([frame.outlines or nothing for frame in frames])
    index = np.array([frame.index for frame in frames], np.int64)
    step = int(index[1] - index[0]) if len(index) > 1 else 1
    said = FrameVerdicts(
        np.array([frame.deniers for frame in frames]),
        np.array([frame.supported_share for frame in frames]),
        np.array([frame.alone_px for frame in frames]),
        np.array([frame.is_contradictory for frame in frames]),
    )
    found = diagnose(Trial.of(views, table), said, with_clock=step <= _LARGEST_STEP)
    return SessionAgreement(
        found.is_told,
        tuple(
            sorted(
                (_named(cause, index, step, offset_s, fps) for cause in found.causes),
                key=lambda cause: not cause.is_gross,
            )
        ),
        {name: _camera(found, camera, step) for camera, name in enumerate(views.names)},
    )


def _named(
    cause: Cause, index: NDArray[np.int64], step: int, offset_s: Mapping[str, float], fps: float
) -> NamedCause:
    per_row = float(step) if cause.kind == "late" else 1.0
    size, low, high = (_told(value * per_row) for value in (cause.size, cause.low, cause.high))
    first, last = int(index[cause.first]), int(index[cause.last])
    moved = cause.moved_px.tolist()
    is_late = cause.kind == "late"
    late_s = (size or 0.0) / fps if is_late else 0.0
    return NamedCause(
        cause.kind,
        cause.cameras,
        first,
        last,
        cause.is_gross,
        short_of(cause),
        message_of(
            cause,
            frames=(first, last, int(index[-1]), int(index[0])),
            per_row=per_row,
            late_s=late_s,
            offset_s=offset_s.get(cause.cameras[0], 0.0) if cause.cameras else 0.0,
        ),
        size,
        low,
        high,
        (moved[0], moved[1]) if np.isfinite(moved).all() else None,
        _told(cause.before_px),
        _told(cause.after_px),
    )


def _camera(found: Diagnosis, camera: int, step: int) -> CameraAgreement:
    offset: Offset = found.offsets[camera]
    error = offset.moved_se_px
    is_placed = bool(np.isfinite(error).all())
    late = offset.late * step if offset.has_clock else None
    excess = 0.0
    is_plain = bool(found.is_plain[camera])
    if is_plain and is_placed and offset.size_px > 2.0 * float(error.max()):
        reach_px = offset.size_px + _ONE_SIDED_95 * float(error.max())
        excess = max(0.0, reach_px - STATED_PX)
    if is_plain and late is not None and abs(offset.late) > 2.0 * offset.late_se:
        excess += abs(offset.late) * _FAST * offset.speed_px
    return CameraAgreement(
        _told(float(found.misfit_px[camera])),
        (float(offset.moved_px[0]), float(offset.moved_px[1])) if is_placed else None,
        (float(error[0]), float(error[1])) if is_placed else None,
        late,
        offset.late_se * step if offset.has_clock else None,
        excess,
    )


def _told(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
