"""The certificate of a calibration as a page: one HTML file that needs nothing else.

Figures are inside it as vector graphics; nothing is fetched and nothing runs. Equal input gives
the same file to the byte.
"""

import base64
import io
import math
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.files import write_whole
from hybridve.calib.judging.certificate import CameraCertificate, Certificate, SeenPoints, Volume
from hybridve.calib.lens import parameter_names
from hybridve.calib.rig import Rig, RigCovariance
from hybridve.calib.solving.bundle import POSE
from hybridve.calib.solving.errors_in_space import parameter_slices
from hybridve.hull.view.certificate_charts import draw_camera
from hybridve.hull.view.pages import Unknown, number, page_template
from hybridve.hull.view.rig_charts import draw_errors, draw_rig

#: What a page can say at first sight.
State = Literal["good", "limits", "refused"]

#: Marks put in as images have this many dots an inch.
_DPI = 150

#: A photograph is at most so wide.
_PHOTO_PX = 960

#: The error without its largest cause must be smaller by this factor for the cause to stand out.
_STANDS_OUT = 0.8


@dataclass(frozen=True, slots=True)
class _Parameter:
    """A line of the table of a camera's parameters: numbers as text, in `unit`."""

    label: str
    value: str
    deviation: str | Unknown
    unit: str
    is_determined: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class _CameraTold:
    """What the page says of a camera; `svg` is the picture of what it saw, in base64."""

    camera: Camera
    told: CameraCertificate
    svg: str
    parameters: tuple[_Parameter, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Photo:
    """A picture in which one sees where the world is.

    Attributes
    ----------
    camera : str
        Which camera took it.
    axis_m : float
        How long the axes are that are drawn in it, metres.
    image : (H, W, 3) uint8
        BGR.
    """

    camera: str
    axis_m: float
    image: NDArray[np.uint8]


def write_certificate_page(
    path: Path,
    rig: Rig,
    certificate: Certificate,
    seen: Mapping[str, SeenPoints],
    volume: Volume,
    *,
    title: str,
    details: Mapping[str, Any],
    max_error_m: float | None = None,
    photo: Photo | None = None,
) -> None:
    """Write the page, which appears only when it is complete.

    Parameters
    ----------
    path : Path
        An .html.
    rig : Rig
        With its covariance.
    certificate : Certificate
        The verdict on it.
    seen : mapping of str to SeenPoints
        By camera what it saw of the boards; a camera that saw nothing may be missing.
    volume : Volume
        Where the rig was judged.
    title : str
        What was calibrated.
    details : mapping of str to anything
        Plain values, lists and mappings, nested at will: how the calibration came about.
    max_error_m : float, optional
        The error that is asked for: a rig that is worse, or has none, is refused.
    photo : Photo, optional
        A picture in which the world's axes are drawn.

    Raises
    ------
    CalibrationError
        If it cannot be written.
    ValueError
        If the rig has no covariance, or the certificate is that of other cameras.
    """
    if rig.covariance is None:
        raise ValueError("the rig has no covariance")
    names = [camera.name for camera in rig.cameras]
    if names != [told.name for told in certificate.cameras]:
        raise ValueError(f"the certificate is not that of the cameras {', '.join(names)}")
    style = mpl.rc_context({"svg.fonttype": "path", "svg.hashsalt": "hybridve"})
    with style, warnings.catch_warnings():
        # Letters that the font of the figures lacks become boxes there; the page's text has them.
        warnings.filterwarnings("ignore", "Glyph .* missing from")
        errors = draw_errors(rig, volume) if len(volume.points_world) else None
        error_map = None if errors is None else _svg(errors)
        arrangement = _svg(draw_rig(rig, volume))
        cameras = list(_cameras(rig, rig.covariance, certificate, seen, volume))
    low_m, high_m = certificate.volume_low_m, certificate.volume_high_m
    text = page_template("certificate.html.jinja").render(
        title=title,
        state=state_of(certificate, max_error_m),
        max_error_m=max_error_m,
        rig=rig,
        certificate=certificate,
        volume=volume,
        size_m=[high - low for low, high in zip(low_m, high_m, strict=True)],
        stands_out=_stands_out(certificate),
        todo=_todo(certificate),
        error_map=error_map,
        arrangement=arrangement,
        photo=None if photo is None else (photo, _jpeg(photo.image)),
        world=getattr(rig.provenance, "world", None),
        cameras=cameras,
        details=details,
    )
    try:
        write_whole(path, text)
    except OSError as error:
        raise CalibrationError(f"{path}: cannot be written: {error}") from error


def state_of(certificate: Certificate, max_error_m: float | None = None) -> State:
    """Return how good a rig is at first sight.

    Refused: there are doubts about it, its error is more than `max_error_m`, or there is none to
    state though it has several cameras, or though one is asked for. Limits: it comes with warnings.
    """
    is_known = math.isfinite(certificate.error95_m)
    if certificate.doubts:
        return "refused"
    if max_error_m is not None and not certificate.error95_m <= max_error_m:
        return "refused"
    if not is_known and len(certificate.cameras) > 1:
        return "refused"
    return "limits" if certificate.warnings or not is_known else "good"


def _svg(figure: Figure) -> str:
    """Return a figure as vector graphics, in base64."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="svg", dpi=_DPI, metadata={"Date": None})
    return base64.b64encode(buffer.getvalue()).decode("ascii")


def _jpeg(image: NDArray[np.uint8]) -> str:
    """Return a picture, not wider than a page needs it, in base64."""
    height, width = image.shape[:2]
    share = min(1.0, _PHOTO_PX / width)
    if share < 1.0:
        size = (_PHOTO_PX, max(1, round(share * height)))
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    _, encoded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 85])
    return base64.b64encode(encoded.tobytes()).decode("ascii")


def _stands_out(certificate: Certificate) -> bool:
    """Tell whether the error would be much smaller without its largest cause."""
    limit = certificate.limit
    return limit is not None and limit.error95_m < _STANDS_OUT * certificate.error95_m


def _todo(certificate: Certificate) -> list[tuple[str, str]]:
    """Return what to record next: cameras, and what each of them needs."""
    limit = certificate.limit
    most = [] if limit is None else [(limit.camera, limit.advice)]
    blind = [told.name for told in certificate.cameras if told.n_points == 0]
    return most + [(name, "it saw no board: show it one") for name in blind]


def _cameras(
    rig: Rig,
    covariance: RigCovariance,
    certificate: Certificate,
    seen: Mapping[str, SeenPoints],
    volume: Volume,
) -> Iterator[_CameraTold]:
    """Yield what is told of each camera, in the rig's order."""
    deviations = np.sqrt(np.diag(covariance.matrix))
    nothing = SeenPoints(np.zeros((0, 2)), np.zeros((0, 2)))
    spans = parameter_slices(rig.cameras)
    for index, (camera, told) in enumerate(zip(rig.cameras, certificate.cameras, strict=True)):
        points = seen.get(camera.name, nothing)
        figure = draw_camera(rig, index, points, certificate.noise.rough_px, volume)
        labels = covariance.labels[spans[index]]
        parameters = _parameters(camera, told, labels, deviations[spans[index]])
        yield _CameraTold(camera, told, _svg(figure), tuple(parameters))


def _parameters(
    camera: Camera,
    told: CameraCertificate,
    labels: tuple[str, ...],
    deviations: NDArray[np.float64],
) -> Iterator[_Parameter]:
    """Yield the parameters of a camera's pose, then those of its lens.

    Parameters
    ----------
    camera : Camera
    told : CameraCertificate
        The verdict on it.
    labels : tuple of str
        What the parameters are called.
    deviations : (len(labels),) float64
        Their standard deviations, radians, metres and pixels; 0 for what was given.
    """
    for column in range(POSE):
        unit = "mrad" if column < 3 else "mm"
        yield _Parameter(labels[column], "", _deviation(1000 * deviations[column]), unit)
    lens = zip(
        parameter_names(camera.model), labels[POSE:], camera.params, deviations[POSE:], strict=True
    )
    for name, label, value, std in lens:
        unit = "px" if name[0] in "fc" else ""
        is_determined = name not in told.undetermined
        yield _Parameter(label, _to_deviation(value, std), _deviation(std), unit, is_determined)


def _deviation(std: float) -> str | Unknown:
    return number(std) if std > 0 else "given"


def _to_deviation(value: float, std: float) -> str:
    """Return a value as far as its standard deviation makes sense of it."""
    if not std > 0:
        return f"{value:.9g}"
    decimals = int(np.clip(1 - math.floor(math.log10(std)), 0, 12))
    return f"{value:.{decimals}f}"
