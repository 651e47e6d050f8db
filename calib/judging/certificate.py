"""The verdict on a calibration: how good it is where the work is done, and what would better it.

The error that counts is that of a point in the working volume, placed by all cameras that see it,
from the rig's errors alone: 95 % of calibrations from as many and as noisy pictures are better.
What limits it is found by asking for each group of parameters how much better the rig were, were
they known exactly.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.camera import Camera
from hybridve.calib.judging.twins import find_twins, twins_text
from hybridve.calib.lengths import millimetres
from hybridve.calib.lens import cam_from_img, parameter_names
from hybridve.calib.plain import to_json
from hybridve.calib.pose import invert, transform
from hybridve.calib.record import CalibrationRecord, Noise, NoOpinion, SecondOpinion
from hybridve.calib.rig import Rig
from hybridve.calib.solving.bundle import POSE
from hybridve.calib.solving.errors_in_space import (
    image_derivatives,
    parameter_slices,
    pixel_covariance,
    point_errors,
    point_gains,
    radius95,
)

#: Points a side of the grid over the working volume.
_VOLUME_POINTS = 13

#: The volume that is looked at reaches this far from the point nearest to all optical axes, as a
#: share of the cameras' median distance from it.
_VOLUME_REACH = 0.6

#: Of a rig of which it is not known where boards were.
NO_BOARDS = np.zeros((0, 3))

#: Points of boards at which errors are asked.
_BOARD_POINTS = 500

#: With fewer points than this share of the grid seen by all cameras, those seen by two count.
_SEEN_BY_ALL = 0.02

#: The verdict holds in this share of the volume.
_SHARE = 0.95

#: Cells across and down an image in which coverage is counted.
_CELLS = (8, 6)

#: A parameter of a lens is not determined if points move by more than this (pixels), in the image
#: or in the working volume but for their outermost `_SHARE`, when it moves by its standard
#: deviation: outlines are found to a pixel, and what moves them by less changes nothing that is
#: seen. How well the very corners are known is told by itself.
_UNSURE_PX = 1.0

#: Places across and down an image at which that is asked.
_IMAGE_PLACES = 9

#: Points of the volume by which causes are compared.
_LIMIT_POINTS = 60

#: A single cause is named if without it the error were smaller by this factor.
_BETTER = 0.8

#: Noise of single points should explain this share of the residuals at least.
_LEAST_EXPLAINED = 0.5

#: A second opinion that differs by less is told as within this.
_FINEST_M = 1e-6

#: Residuals smaller than this explain nothing and need no explanation.
_NEGLIGIBLE_PX = 0.01

_ADVICE = {
    "focal length": "show it the board tilted by 30 to 45 degrees, near and far",
    "principal point": "show it the board tilted about both axes, and turned by 90 degrees",
    "distortion": "bring the board to the edges and corners of its image",
    "place": "show it the board larger, and at more places that other cameras see at once",
}


@dataclass(frozen=True, slots=True, eq=False)
class SeenPoints:
    """What one camera saw, and by how much the rig misses it.

    Attributes
    ----------
    pixels : (K, 2) float64
        Points of boards, pixels.
    residuals_px : (K, 2) float64
        Observed minus projected.
    """

    pixels: NDArray[np.float64]
    residuals_px: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Volume:
    """Where the rig is judged.

    Attributes
    ----------
    points_world : (N, 3) float64
        A grid over the volume, metres.
    low_world, high_world : (3,) float64
        The box around it.
    min_cameras : int
        How many cameras see each of its points at least.
    about : str
        What chose it: "asked", "axes" (where the cameras look), or "boards" (where boards were).
    """

    points_world: NDArray[np.float64]
    low_world: NDArray[np.float64]
    high_world: NDArray[np.float64]
    min_cameras: int
    about: str


@dataclass(frozen=True, slots=True)
class CameraCertificate:
    """The verdict on one camera.

    Attributes
    ----------
    name : str
        The camera.
    n_points : int
        Points of boards that it saw.
    rms_px : float
        Root mean square length of its residuals; NaN where it saw none.
    coverage : float
        Share of its image, in cells, in which it saw points.
    place_std_m, turn_std_rad : float
        Standard deviations of where it stands (length) and of how it is turned (angle).
    error95_px : float
        The distance in pixels that its images of the working volume exceed in 5 % of calibrations,
        at 95 % of the volume; NaN where it sees none of it.
    edge_error95_px : float
        The same for the whole image, at the middle distance of the volume, where it is largest.
    moved_px : dict of str to float
        By parameter of its lens how far points move when it moves by its standard deviation, in
        95 % of the image or of the working volume, whichever is more: by itself, or with what it is
        tied to, whichever is less. Without those that were given.
    undetermined : tuple of str
        Those among them that the pictures do not tell, worst first: points move by more than a
        pixel.
    """

    name: str
    n_points: int
    rms_px: float
    coverage: float
    place_std_m: float
    turn_std_rad: float
    error95_px: float
    edge_error95_px: float
    moved_px: dict[str, float]
    undetermined: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Limit:
    """What limits the rig most.

    Attributes
    ----------
    camera : str
        The camera.
    what : str
        The group of its parameters: "focal length", "principal point", "distortion" or "place".
    error95_m : float
        What the error would be if they were known exactly.
    advice : str
        What to record.
    """

    camera: str
    what: str
    error95_m: float
    advice: str


@dataclass(frozen=True, slots=True)
class Certificate:
    """The verdict on a rig.

    Attributes
    ----------
    verdict : str
        One line for a person.
    error95_m : float
        The error of a point, 95 % of calibrations, that 95 % of the working volume keeps; NaN
        where no two cameras see a common point.
    median_error95_m, largest_error95_m : float
        The same for half of the volume, and for all of it.
    volume_low_m, volume_high_m : tuple of float
        The box around the working volume, metres, world.
    volume_min_cameras : int
        How many cameras see each point of it at least.
    volume_about : str
        What chose it: "asked", "axes" (where the cameras look), or "boards" (where boards were).
    boards_error95_m : float
        The error of a point (95 %) that 95 % of the points keep at which boards were when two
        cameras or more saw them at once; NaN where none were.
    noise : Noise
        How noisy the points of boards were.
    cameras : tuple of CameraCertificate
        In the rig's order.
    limit : Limit or None
        What limits the error most; None where it is NaN.
    warnings : tuple of str
        What a person should look at.
    doubts : tuple of str
        Those among them that make the stated errors void: what the pictures show contradicts itself
        or leaves the rig open. A quality gate must not pass such a rig.
    second_opinion : SecondOpinion, NoOpinion or None
        By how much COLMAP's own adjustment differs; None where all cameras move.
    """

    verdict: str
    error95_m: float
    median_error95_m: float
    largest_error95_m: float
    volume_low_m: tuple[float, ...]
    volume_high_m: tuple[float, ...]
    volume_min_cameras: int
    volume_about: str
    boards_error95_m: float
    noise: Noise
    cameras: tuple[CameraCertificate, ...]
    limit: Limit | None
    warnings: tuple[str, ...]
    doubts: tuple[str, ...] = ()
    second_opinion: SecondOpinion | NoOpinion | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain JSON values; NaN becomes None."""
        plain: dict[str, Any] = to_json(asdict(self))
        return plain


def working_volume(
    rig: Rig,
    boards_world: NDArray[np.float64] = NO_BOARDS,
    box_world: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None,
    has_floor: bool = True,
) -> Volume:
    """Return where a rig is judged: what all its cameras see around the point they look at.

    Of cameras that look nearly the same way that point is anybody's guess. Where the boards were
    not near it, the volume lies about them instead: nothing is known of how good the rig is
    elsewhere that work at the boards' place would be judged by.

    Parameters
    ----------
    rig : Rig
        The cameras.
    boards_world : (K, 3) float64
        Where points of boards were that two cameras or more saw at once, metres; none where that
        is not known.
    box_world : two (3,) float64, optional
        The lowest and the highest corner of the volume instead, metres.
    has_floor : bool
        Whether nothing below z = 0 counts. A camera that stands there says that there is none.
    """
    about = "axes" if box_world is None else "asked"
    if box_world is None:
        low, high = _box_about(rig, _look_at(rig))
        if len(boards_world):
            middle = np.median(boards_world, axis=0)
            if not ((low <= middle) & (middle <= high)).all():
                about, (low, high) = "boards", _box_about(rig, middle)
        if has_floor and high[2] > 0 and (rig.centers_world[:, 2] > 0).all():
            low[2] = max(low[2], 0.0)
    else:
        low, high = box_world
    sides = [np.linspace(low[axis], high[axis], _VOLUME_POINTS) for axis in range(3)]
    grid = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 3)
    n_seeing = np.zeros(len(grid), dtype=np.intp)
    for camera in rig.cameras:
        n_seeing += np.isfinite(image_derivatives(camera, grid)[0]).all(axis=(1, 2))
    min_cameras = len(rig.cameras)
    if (n_seeing >= min_cameras).mean() < _SEEN_BY_ALL:
        min_cameras = min(2, len(rig.cameras))
    points = grid[n_seeing >= min_cameras]
    if len(points):
        low, high = points.min(axis=0), points.max(axis=0)
    return Volume(points, np.asarray(low), np.asarray(high), min_cameras, about)


def _box_about(
    rig: Rig, middle: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the lowest and the highest corner of the volume about a point."""
    distances_m = np.linalg.norm(rig.centers_world - middle, axis=1)
    reach_m = _VOLUME_REACH * float(np.median(distances_m))
    return middle - reach_m, middle + reach_m


def _look_at(rig: Rig) -> NDArray[np.float64]:
    """Return the point nearest to all optical axes, or one before the cameras: (3,) metres."""
    total, moment = np.zeros((3, 3)), np.zeros(3)
    for camera in rig.cameras:
        axis = camera.cam_from_world[2, :3]
        across = np.eye(3) - np.outer(axis, axis)
        total += across
        moment += across @ camera.center_world
    centers = rig.centers_world
    spread = np.linalg.norm(centers - centers.mean(axis=0), axis=1).max()
    if len(rig.cameras) > 1 and np.linalg.cond(total) < 1e6:
        middle = np.linalg.solve(total, moment)
        depths = [
            float(camera.cam_from_world[2] @ np.append(middle, 1.0)) for camera in rig.cameras
        ]
        if min(depths) > 0:
            return np.asarray(middle)
    axes = np.mean([camera.cam_from_world[2, :3] for camera in rig.cameras], axis=0)
    return np.asarray(centers.mean(axis=0) + axes * max(2.0 * float(spread), 1.0))


def certify(
    rig: Rig,
    record: CalibrationRecord,
    seen: Mapping[str, SeenPoints],
    volume: Volume,
    boards_world: NDArray[np.float64] = NO_BOARDS,
) -> Certificate:
    """Return the verdict on a rig.

    Parameters
    ----------
    rig : Rig
        With its covariance.
    record : CalibrationRecord
        What its calibration found and doubted; of a rig without one nothing can be certified.
    seen : mapping of str to SeenPoints
        By camera what it saw of the boards.
    volume : Volume
        Where the rig is judged.
    boards_world : (K, 3) float64
        Where points of boards were that two cameras or more saw at once, metres.
    """
    errors_m = _finite_errors(rig, volume.points_world)
    has_errors = len(errors_m) > 0
    error95_m = float(np.quantile(errors_m, _SHARE)) if has_errors else np.nan
    at_boards_m = _finite_errors(rig, boards_world[:: max(len(boards_world) // _BOARD_POINTS, 1)])
    limit = find_limit(rig, volume) if has_errors else None
    cameras = tuple(
        _certify_camera(rig, index, seen.get(camera.name), volume)
        for index, camera in enumerate(rig.cameras)
    )
    doubts = _doubts(rig, record)
    verdict = _verdict(error95_m, cameras, limit)
    if doubts:
        verdict = f"not to be trusted: {doubts[0]} Without this doubt: {verdict}"
    return Certificate(
        verdict=verdict,
        error95_m=error95_m,
        median_error95_m=float(np.median(errors_m)) if has_errors else np.nan,
        largest_error95_m=float(errors_m.max()) if has_errors else np.nan,
        volume_low_m=tuple(float(value) for value in volume.low_world),
        volume_high_m=tuple(float(value) for value in volume.high_world),
        volume_min_cameras=volume.min_cameras,
        volume_about=volume.about,
        boards_error95_m=float(np.quantile(at_boards_m, _SHARE)) if len(at_boards_m) else np.nan,
        noise=record.noise,
        cameras=cameras,
        limit=limit,
        warnings=doubts + _warnings(record, cameras),
        doubts=doubts,
        second_opinion=record.second_opinion,
    )


def _finite_errors(rig: Rig, points_world: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the errors (95 %, metres) of those of points (N, 3) that two cameras see."""
    if not len(points_world):
        return np.zeros(0)
    errors_m = point_errors(rig, points_world).radius95_m
    return errors_m[np.isfinite(errors_m)]


def find_limit(rig: Rig, volume: Volume) -> Limit | None:
    """Return the group of one camera's parameters whose errors matter most in a volume.

    None where no two cameras see a common point.
    """
    assert rig.covariance is not None
    matrix = rig.covariance.matrix
    chosen = np.linspace(0, len(volume.points_world) - 1, _LIMIT_POINTS).round().astype(int)
    gains, _ = point_gains(rig, volume.points_world[np.unique(chosen)])
    gains = gains[np.isfinite(gains).all(axis=(1, 2))]
    if not len(gains):
        return None
    best: tuple[float, Camera, str, NDArray[np.intp]] | None = None
    for camera, span in zip(rig.cameras, parameter_slices(rig.cameras), strict=True):
        for what, columns in _groups(camera).items():
            known = span.start + np.array(columns)
            left = _if_known(matrix, known)
            variance = np.einsum("nip,pq,niq->n", gains, left, gains, optimize=True)
            error_m = float(np.median(variance))
            if best is None or error_m < best[0]:
                best = (error_m, camera, what, known)
    if best is None:
        return None
    _, camera, what, known = best
    errors_m = point_errors(rig, volume.points_world, _if_known(matrix, known)).radius95_m
    left_m = float(np.nanquantile(errors_m, _SHARE))
    return Limit(camera.name, what, left_m, _ADVICE[what])


def _groups(camera: Camera) -> dict[str, list[int]]:
    """Return columns of a camera's parameters by what they are."""
    groups: dict[str, list[int]] = {"place": list(range(POSE))}
    for index, name in enumerate(parameter_names(camera.model), start=POSE):
        groups.setdefault(_kind(name), []).append(index)
    return groups


def _if_known(matrix: NDArray[np.float64], known: NDArray[np.intp]) -> NDArray[np.float64]:
    """Return the covariance if some parameters were known exactly (Schur complement)."""
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    scaled = matrix / np.outer(scale, scale)
    across = scaled[:, known]
    left = scaled - across @ np.linalg.pinv(scaled[np.ix_(known, known)], 1e-12) @ across.T
    left[known] = 0.0
    left[:, known] = 0.0
    return np.asarray(left * np.outer(scale, scale))


def _certify_camera(
    rig: Rig, index: int, seen: SeenPoints | None, volume: Volume
) -> CameraCertificate:
    camera = rig.cameras[index]
    alone = rig.only([camera.name])
    assert alone.covariance is not None
    matrix = alone.covariance.matrix
    errors_px = radius95(pixel_covariance(alone, volume.points_world)[:, 0, :, 0])
    errors_px = errors_px[np.isfinite(errors_px)]
    pixels, edge_px = image_errors(alone, volume)
    moved_px = _moved_px(alone, pixels, volume)
    has_points = seen is not None and len(seen.pixels) > 0
    return CameraCertificate(
        name=camera.name,
        n_points=len(seen.pixels) if seen is not None else 0,
        rms_px=float(np.sqrt((seen.residuals_px**2).sum(axis=1).mean()))
        if seen is not None and has_points
        else np.nan,
        coverage=coverage(camera, seen.pixels) if seen is not None else 0.0,
        # The centre moves by -R^T v, the length of which is that of v.
        place_std_m=float(np.sqrt(np.trace(matrix[3:POSE, 3:POSE]))),
        turn_std_rad=float(np.sqrt(np.trace(matrix[:3, :3]))),
        error95_px=float(np.quantile(errors_px, _SHARE)) if len(errors_px) else np.nan,
        edge_error95_px=float(np.nanmax(edge_px)) if np.isfinite(edge_px).any() else np.nan,
        moved_px=moved_px,
        undetermined=tuple(
            name
            for name, moved in sorted(moved_px.items(), key=lambda item: -item[1])
            if moved > _UNSURE_PX
        ),
    )


def coverage(camera: Camera, pixels: NDArray[np.float64]) -> float:
    """Return the share of an image, in cells, that holds points (K, 2)."""
    size = (camera.width_px, camera.height_px)
    cells = np.floor(pixels / size * _CELLS).astype(int)
    inside = ((cells >= 0) & (cells < _CELLS)).all(axis=1)
    return len(np.unique(cells[inside], axis=0)) / (_CELLS[0] * _CELLS[1])


def image_errors(alone: Rig, volume: Volume) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return how well one camera's image is known, all over it, at the volume's middle distance.

    Parameters
    ----------
    alone : Rig
        Of the one camera, with its covariance.
    volume : Volume
        Gives the distance.

    Returns
    -------
    pixels : (K, 2) float64
        A grid over the image.
    errors95_px : (K,) float64
        The distance by which a point imaged there is off in at most 95 % of calibrations; NaN
        where the lens sees nothing.
    """
    (camera,) = alone.cameras
    pixels = _image_grid(camera)
    points = _image_points(camera, pixels, volume)
    errors = np.full(len(pixels), np.nan)
    seen = np.isfinite(points).all(axis=1)
    if seen.any():
        errors[seen] = radius95(pixel_covariance(alone, points[seen])[:, 0, :, 0])
    return pixels, errors


def _image_grid(camera: Camera) -> NDArray[np.float64]:
    x = (np.arange(_IMAGE_PLACES) + 0.5) / _IMAGE_PLACES * camera.width_px
    y = (np.arange(_IMAGE_PLACES) + 0.5) / _IMAGE_PLACES * camera.height_px
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def _image_points(
    camera: Camera, pixels: NDArray[np.float64], volume: Volume
) -> NDArray[np.float64]:
    """Return the points (K, 3), world, that pixels see at the volume's middle distance."""
    distances = np.linalg.norm(volume.points_world - camera.center_world, axis=1)
    distance_m = float(np.median(distances)) if len(distances) else 1.0
    rays = np.column_stack([cam_from_img(camera, pixels), np.ones(len(pixels))])
    rays *= distance_m / np.linalg.norm(rays, axis=1, keepdims=True)
    return transform(invert(camera.cam_from_world), rays)


def _moved_px(alone: Rig, pixels: NDArray[np.float64], volume: Volume) -> dict[str, float]:
    """Return how far points move in an image when a parameter of its lens is off by its deviation.

    A parameter is seldom off alone: where a longer focal length is made up for by a camera further
    away, it moves next to nothing; where the boards were seen in one place, it moves the rest of
    the volume all the more. Neither makes a parameter undetermined that by itself moves nothing.
    """
    (camera,) = alone.cameras
    assert alone.covariance is not None
    matrix = alone.covariance.matrix
    deviations = np.sqrt(np.diag(matrix))
    image = image_derivatives(camera, _image_points(camera, pixels, volume))[1]  # (K, 2, 6 + P)
    space = image_derivatives(camera, volume.points_world)[1]  # (N, 2, 6 + P)
    moved_px = {}
    for column, name in enumerate(parameter_names(camera.model), start=POSE):
        if deviations[column] == 0:
            continue
        by_itself = np.zeros(len(matrix))
        by_itself[column] = deviations[column]
        tied = matrix[:, column] / deviations[column]
        moved_px[name] = min(
            max(_largest(image @ change), _largest(space @ change)) for change in (by_itself, tied)
        )
    return moved_px


def _largest(moves_px: NDArray[np.float64]) -> float:
    """Return the length that all moves (N, 2) but the largest keep, of those that are known."""
    lengths = np.linalg.norm(moves_px, axis=1)
    lengths = lengths[np.isfinite(lengths)]
    return float(np.quantile(lengths, _SHARE)) if len(lengths) else 0.0


def _warnings(record: CalibrationRecord, cameras: Sequence[CameraCertificate]) -> tuple[str, ...]:
    warnings, noise = [], record.noise
    for told in cameras:
        if told.undetermined:
            names = " and ".join(told.undetermined)
            kind = _kind(told.undetermined[0])
            warnings.append(
                f"{told.name}: {names} {'is' if len(told.undetermined) == 1 else 'are'} not "
                f"determined (one standard deviation of {told.undetermined[0]} moves what it sees "
                f"by up to {told.moved_px[told.undetermined[0]]:.1f} px): {_ADVICE[kind]}"
            )
    if noise.share_explained < _LEAST_EXPLAINED and noise.rms_px > _NEGLIGIBLE_PX:
        warnings.append(
            f"the noise of single points ({noise.rough_px:.2f} px) explains "
            f"{100 * noise.share_explained:.0f} % of the residuals: a lens model with more "
            'parameters (or model = "auto"), a flatter board or sharper pictures would fit '
            "better; the stated errors allow for it"
        )
    if len(cameras) == 1:
        warnings.append("one camera alone places no point in space: no error in mm is stated")
    return (*warnings, *record.warnings)


def _doubts(rig: Rig, record: CalibrationRecord) -> tuple[str, ...]:
    """Return what a calibration found to contradict itself, or could not decide."""
    # One clip that was given twice counts as two: the errors that are stated are too small.
    twins = twins_text(find_twins(rig))
    return (*record.doubts, f"{twins}.") if twins else record.doubts


def opinion_text(opinion: SecondOpinion | NoOpinion) -> str:
    """Return a second opinion in words."""
    if isinstance(opinion, NoOpinion):
        return f"no second opinion: {opinion.reason}"
    within_mm = millimetres(max(opinion.difference95_m, _FINEST_M))
    return (
        "second opinion: COLMAP's own adjustment places what the cameras see within "
        f"{within_mm} mm of where the rig does (95 %), or {opinion.sigmas:.1f} standard "
        "deviations of its error, which is "
        f"{millimetres(opinion.expected95_m)} mm (95 %)"
    )


def _kind(parameter: str) -> str:
    return {"f": "focal length", "c": "principal point"}.get(parameter[0], "distortion")


def _verdict(error95_m: float, cameras: Sequence[CameraCertificate], limit: Limit | None) -> str:
    if not np.isfinite(error95_m) or limit is None:
        errors = [told.error95_px for told in cameras if np.isfinite(told.error95_px)]
        known = f"images are known to {max(errors):.2f} px" if errors else "nothing is known"
        return f"no two cameras see a common volume, so no error in mm can be stated; {known}"
    verdict = f"good to {millimetres(error95_m)} mm in the working volume (95 %)"
    unsure = [told for told in cameras if told.undetermined]
    if unsure:
        worst = max(unsure, key=lambda told: max(told.moved_px.values()))
        name = worst.undetermined[0]
        return f"{verdict}; {worst.name}'s {name} is not determined: {_ADVICE[_kind(name)]}"
    if limit.error95_m < _BETTER * error95_m:
        return (
            f"{verdict}; it would be {millimetres(limit.error95_m)} mm if the {limit.what} of "
            f"{limit.camera} were known: {limit.advice}"
        )
    return verdict
