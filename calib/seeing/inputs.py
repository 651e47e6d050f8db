"""What is asked: the pictures of each camera, and how they are looked through."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from hybridve.calib.image_io import FrameSource

Progress = Callable[[str, int, int], None]


#: The model of a lens whose degrees of freedom are found out from the pictures.
AUTO_MODEL = "auto"


#: What a still clip is called where images are named.
CLIP = "board clip"


@dataclass(frozen=True, slots=True)
class CameraInput:
    """What was recorded of the boards by one camera.

    Attributes
    ----------
    name : str
        Unique within the rig.
    model : str
        A COLMAP camera model, a key of `hybridve.calib.camera.N_PARAMS`, or "auto".
    intrinsics : FrameSource or None
        Boards in many places, in this camera alone. None: the views of `extrinsics` serve,
        if the boards move there.
    extrinsics : FrameSource or None
        The boards as all cameras see them at once, frame by frame.
    corners : Path or None
        Corners found by something else, see `hybridve.calib.boards.corners_io`. Those of named
        images stand instead of what would be found there; those of the clip as a whole serve where
        nothing is found.
    lens : str or None
        Cameras with the same lens share intrinsics.
    params : tuple of float, or None
        Intrinsics that are known, in COLMAP's order.
    """

    name: str
    model: str
    intrinsics: FrameSource | None
    extrinsics: FrameSource | None
    corners: Path | None = None
    lens: str | None = None
    params: tuple[float, ...] | None = None


@dataclass(frozen=True, slots=True)
class ObserveSettings:
    """How pictures are searched; the defaults serve.

    Attributes
    ----------
    max_stills : int
        Stills looked at, evenly spread over what there is.
    enough_stills : int
        With fewer stills found by the quick search, the others are searched again with more
        effort.
    clip_frames : int
        Frames of the extrinsic clip looked at, evenly spread.
    still_px : float
        A board that moves less than this in the clip lies still, and the clip is averaged.
    threads : int
        Images searched at the same time; 0 for as many as there are processors.
    every_clip_frame : bool
        Whether each frame of a clip with moving boards is looked at (quickly, between those of
        `clip_frames`): what moves is a clock only if it is seen often.
    """

    max_stills: int = 120
    enough_stills: int = 20
    clip_frames: int = 40
    still_px: float = 1.0
    threads: int = 0
    every_clip_frame: bool = False
