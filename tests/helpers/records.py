"""Records of calibrations that never were."""

from collections.abc import Sequence
from typing import Any

from hybridve.calib.record import (
    METHOD,
    Adjustment,
    BoardRecord,
    CalibrationRecord,
    CameraRecord,
    ClipRecord,
    Labelling,
    Noise,
    SecondOpinion,
    StillsRecord,
    WorldRecord,
)
from hybridve.calib.rig import Rig
from hybridve.calib.verdict import RigCheck


def record_of(rig: Rig) -> CalibrationRecord:
    """Return how a rig of ours came about."""
    assert isinstance(rig.provenance, CalibrationRecord)
    return rig.provenance


def make_camera_record(
    stills_px: float | None = 0.2, clip_px: float | None = 0.1, model: str = "PINHOLE"
) -> CameraRecord:
    """A camera whose corners in stills and in the clip are missed by this, rms, pixels."""
    return CameraRecord(
        model=model,
        intrinsics=StillsRecord(
            source="stills/*.png",
            views_used=0 if stills_px is None else 9,
            rms_px=stills_px,
            max_px=stills_px,
            views_dropped={},
            views_without_board={},
            outliers=0,
        ),
        extrinsics=ClipRecord(
            source="clip/*.png",
            corners_by_hand=None,
            views_used=0 if clip_px is None else 1,
            rms_px=clip_px,
            max_px=clip_px,
            how="given",
            other_tilt_times_worse=20.0,
        ),
        warnings=(),
        notes=(),
    )


def make_record(names: Sequence[str], **changes: Any) -> CalibrationRecord:
    """A record of cameras by a board that lay still, without a doubt; but for these changes."""
    told: dict[str, Any] = {
        "method": METHOD,
        "software": {"hybridve": "0"},
        "boards": (BoardRecord("board", "cube", "a board"),),
        "rms_px": 0.3,
        "noise": Noise(0.2, 0.2, 0.3, 1.0, 100, 10),
        "cameras": {name: make_camera_record() for name in names},
        "labelling": Labelling(looks=1, decided_by="the board's colours or markers"),
        "world": WorldRecord(kind="board", text="the board", warnings=()),
        "settings": {},
        "adjustment": Adjustment(
            steps=3,
            views=9,
            outliers=0,
            worst_outliers=(),
            left_out={},
            warnings=(),
            start="COLMAP's adjustment",
        ),
        "second_opinion": make_opinion(0.1),
    }
    return CalibrationRecord(**(told | changes))


def make_opinion(sigmas: float) -> SecondOpinion:
    """A second opinion that differs by so many standard deviations of 1 mm (95 %: 3 mm)."""
    return SecondOpinion(
        difference95_m=1e-3 * sigmas, expected95_m=3e-3, sigmas=sigmas, difference95_px=sigmas
    )


def make_check(**changes: Any) -> RigCheck:
    """A check that nothing came of; but for these changes."""
    told: dict[str, Any] = {
        "scale": 1.0,
        "pair_scales": {},
        "rms_px": {},
        "odd_camera": None,
        "is_trustworthy": True,
        "is_refuted": False,
        "message": "the rig agrees with the board",
        "moved": {},
        "suspects": (),
        "exchanged": None,
        "turned": {},
        "turned_sides": (),
        "undecided": (),
        "twins": (),
        "untested": (),
        "p_value": None,
        "scale_sigma": None,
        "n_placements": 1,
    }
    return RigCheck(**(told | changes))
