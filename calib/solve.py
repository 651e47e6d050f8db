"""Lenses and poses from the corners of a board: seeds in closed form, then bundle adjustment.

The adjustment is COLMAP's, through pycolmap. The board is the world: its corners are constant
points, every view of it is an image, views at one instant are one frame of the rig, and the pose
of a frame is the pose of the board. The scale is metric and no gauge is left free.

This work is based on: Zhang, *A flexible new technique for camera calibration*, IEEE Trans. PAMI
22(11), 2000; Collins and Bartoli, *Infinitesimal plane-based pose estimation*, IJCV 109(3), 2014;
Triggs, McLauchlan, Hartley and Fitzgibbon, *Bundle adjustment: a modern synthesis*, 2000.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.lens import cam_from_img, img_from_cam
from hybridve.calib.pose import Pose, angle_between, compose, invert, transform
from hybridve.calib.target import Chessboard

pycolmap.logging.minloglevel = 2  # errors only: what matters is raised or reported

#: Focal lengths tried as seeds, as shares of the longer image side: 150 to 12 degrees of view.
_FOCAL_SEEDS = np.geomspace(0.25, 5.0, 25)

#: Views from which the focal length is seeded: more do not change it, and each is located once
#: for every focal length tried.
_SEED_VIEWS = 12

#: Turns of fitting and dropping; a handful is usual.
_MAX_TURNS = 50

#: Relative poses further apart than this come from different looks of the board. The right one
#: must fit the common frames better than others by a factor and a margin (radians, and shares of
#: the cameras' distance).
_OTHER_LOOK_RAD = 0.5
_CLEAR_FACTOR = 3.0
_CLEAR_MARGIN = 0.05

#: The adjustment has converged when the gradient is below this (pixels squared a unit); the
#: default of 1e-4 stops at a relative error of about 1e-5 on noise-free corners.
_GRADIENT_TOLERANCE = 1e-10
_FUNCTION_TOLERANCE = 1e-14
_PARAMETER_TOLERANCE = 1e-12
_MAX_ITERATIONS = 200


@dataclass(frozen=True, slots=True, eq=False)
class BoardView:
    """The board in one image.

    Attributes
    ----------
    camera : int
        Which camera of the problem took it.
    frame : int
        Which instant: views of one frame saw the board in one place.
    pixels : (N, 2) float64
        Its corners in pixels, pixel centre at 0.5, in the order of the board's points.
    name : str
        The image, for messages.
    """

    camera: int
    frame: int
    pixels: NDArray[np.float64]
    name: str


@dataclass(frozen=True, slots=True, eq=False)
class Adjustment:
    """Cameras and board poses after a bundle adjustment.

    Attributes
    ----------
    cameras : tuple of Camera
        Lenses and poses; their "world" is the frame of the rig they were given in.
    rig_from_board : dict of int to (3, 4) float64
        The board's pose in each frame.
    residuals_px : tuple of (N, 2) float64
        Observed minus projected corners of each view, pixels.
    """

    cameras: tuple[Camera, ...]
    rig_from_board: dict[int, Pose]
    residuals_px: tuple[NDArray[np.float64], ...]


def rms(residuals_px: NDArray[np.float64]) -> float:
    """Return the root mean square length of residuals (N, 2), in pixels."""
    return float(np.sqrt((residuals_px**2).sum(axis=-1).mean())) if len(residuals_px) else np.nan


def board_residuals(
    camera: Camera,
    cam_from_board: Pose,
    points_board: NDArray[np.float64],
    pixels: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return observed minus projected corners (N, 2), pixels; NaN where a corner is not seen."""
    points_cam = transform(cam_from_board, points_board)
    projected = np.full((len(points_cam), 2), np.nan)
    ahead = points_cam[:, 2] > 0
    if ahead.any():
        projected[ahead] = img_from_cam(camera, points_cam[ahead])
    return np.asarray(pixels - projected, np.float64)


def locate_board(
    camera: Camera,
    points_board: NDArray[np.float64],
    pixels: NDArray[np.float64],
    refine: bool = True,
) -> tuple[Pose, float, float] | None:
    """Return where a flat board lies as one camera sees it.

    Parameters
    ----------
    camera : Camera
        Its lens is used, its pose is not.
    points_board : (N, 3) float64
        Corners in metres, z = 0.
    pixels : (N, 2) float64
        The same corners in the image.
    refine : bool
        Least squares after the closed form, on rays.

    Returns
    -------
    cam_from_board : (3, 4) float64
        The better of the two poses that a plane allows.
    error_px, other_error_px : float
        Root mean square reprojection error of this pose and of the other one: where they are
        nearly equal the board is too small or too flat to tell its tilt. None is returned where
        the lens sees no ray at a corner.
    """
    rays = cam_from_img(camera, pixels)
    if not np.isfinite(rays).all():
        return None
    center = points_board.mean(axis=0)
    try:
        _, rotations, translations, _ = cv2.solvePnPGeneric(
            points_board - center, rays, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
        )
    except cv2.error:
        return None
    poses = []
    for rotation, translation in zip(rotations, translations, strict=True):
        if refine:
            rotation, translation = cv2.solvePnPRefineLM(
                points_board - center, rays, np.eye(3), None, rotation, translation
            )
        matrix = cv2.Rodrigues(rotation)[0]
        pose = np.column_stack([matrix, translation.ravel() - matrix @ center])
        error_px = rms(board_residuals(camera, pose, points_board, pixels))
        if np.isfinite(error_px):
            poses.append((error_px, pose))
    if not poses:
        return None
    poses.sort(key=lambda item: item[0])
    return poses[0][1], poses[0][0], poses[-1][0] if len(poses) > 1 else np.inf


def seed_camera(
    name: str,
    model: str,
    size_px: tuple[int, int],
    points_board: NDArray[np.float64],
    views: Sequence[NDArray[np.float64]],
) -> Camera:
    """Return a camera whose focal length is about right, without distortion, at the origin.

    Zhang's closed form fails on views that are nearly parallel and knows no fisheye. One unknown
    can be searched: the focal length under which the boards are seen best, by the model itself.

    Parameters
    ----------
    name, model : str
        As in `Camera`.
    size_px : (width, height)
        Of the image.
    points_board : (N, 3) float64
        Corners of the board in metres.
    views : sequence of (N, 2) float64
        The corners in pixels, one array a view.
    """
    width_px, height_px = size_px
    best, best_error = None, np.inf
    for share in _FOCAL_SEEDS:
        lens = pycolmap.Camera.create_from_model_name(
            1, model, share * max(size_px), width_px, height_px
        )
        camera = Camera(name, model, width_px, height_px, lens.params, np.eye(3, 4))
        located = [locate_board(camera, points_board, pixels, False) for pixels in views]
        # The median: blurred and wrong views have not been dropped yet.
        error = float(np.median([np.inf if found is None else found[1] for found in located]))
        if error < best_error:
            best, best_error = camera, error
    if best is None:
        raise CalibrationError(
            f"camera {name!r}: model {model} fits none of its {len(views)} views of the board; "
            "check the board's columns and rows, or choose another model"
        )
    return best


@dataclass(frozen=True, slots=True, eq=False)
class FittedLens:
    """A camera's lens and the views it was fitted to.

    Attributes
    ----------
    camera : Camera
        The lens; its pose is the identity.
    views : dict of str to ((N, 2) float64, (3, 4) float64)
        By name the corners that were used, pixels, and cam_from_board of that view.
    dropped : dict of str to str
        Views that do not fit, and why.
    """

    camera: Camera
    views: dict[str, tuple[NDArray[np.float64], Pose]]
    dropped: dict[str, str]


def fit_lens(
    points_board: NDArray[np.float64],
    name: str,
    model: str,
    size_px: tuple[int, int],
    views: dict[str, NDArray[np.float64]],
    limit_px: Callable[[Sequence[float]], float],
    min_views: int,
    loss_px: float,
) -> FittedLens:
    """Fit one camera's lens to views of a board, and drop views by their own error.

    The worst views go first, a fifth at a time, since a wrong view spoils the error of the
    others; after each turn all are asked again, also those that had gone.

    Parameters
    ----------
    points_board : (N, 3) float64
        Corners of the board in metres.
    name, model : str
        As in `Camera`.
    size_px : (width, height)
        Of the images.
    views : dict of str to (N, 2) float64
        By name the corners in pixels.
    limit_px : callable
        From the root mean square errors of the views used to the largest that is accepted.
    min_views : int
        How many views must fit.
    loss_px : float
        As in `adjust`.

    Raises
    ------
    CalibrationError
        If fewer views fit.
    """
    names, corners = list(views), list(views.values())
    chosen = np.linspace(0, len(names) - 1, min(len(names), _SEED_VIEWS)).round().astype(int)
    lens = seed_camera(name, model, size_px, points_board, [corners[index] for index in chosen])
    kept = set(range(len(names)))
    boards: dict[int, Pose] = {}
    reasons: dict[int, str] = {}
    is_rough = True  # the seed is: first leave the principal point in the middle
    for _ in range(_MAX_TURNS):
        for index in sorted(kept - boards.keys()):
            located = locate_board(lens, points_board, corners[index])
            if located is not None:
                boards[index] = located[0]
        used = sorted(kept & boards.keys())
        if len(used) < min_views:
            raise CalibrationError(
                f"camera {name!r}: only {len(used)} of {len(names)} views of the board fit model "
                f"{model}, expected {min_views} or more; check columns and rows, take sharper "
                "pictures, or choose another model"
            )
        result = adjust(
            points_board,
            [lens],
            {index: boards[index] for index in used},
            [BoardView(0, index, corners[index], names[index]) for index in used],
            loss_px,
            fix_principal_point=is_rough,
        )
        lens = result.cameras[0]
        boards.update(result.rig_from_board)
        if is_rough:
            is_rough = False
            continue
        errors = dict(zip(used, map(rms, result.residuals_px), strict=True))
        limit = limit_px(list(errors.values()))
        for index in sorted(set(range(len(names))) - set(used)):
            located = locate_board(lens, points_board, corners[index])
            if located is not None:
                errors[index], boards[index] = located[1], located[0]
        bad = sorted((i for i in used if errors[i] > limit), key=lambda i: -errors[i])
        bad = bad[: max(1, len(used) // 5)]
        good = {i for i in errors if errors[i] <= limit or (i in used and i not in bad)}
        for index in set(range(len(names))) - good:
            reasons[index] = "the lens sees no ray at some corner"
            if index in errors:
                reasons[index] = f"{errors[index]:.2f} px rms, limit {limit:.2f} px"
        if good == kept:
            break
        kept = good
    return FittedLens(
        lens,
        {names[index]: (corners[index], boards[index]) for index in used},
        {names[index]: reasons[index] for index in range(len(names)) if index not in used},
    )


def adjust(
    points_board: NDArray[np.float64],
    cameras: Sequence[Camera],
    rig_from_board: dict[int, Pose],
    views: Sequence[BoardView],
    loss_px: float,
    fix_principal_point: bool = False,
) -> Adjustment:
    """Adjust lenses, the cameras' poses in the rig and the board's poses, all at once.

    Parameters
    ----------
    points_board : (N, 3) float64
        Corners in metres; they stay where they are.
    cameras : sequence of Camera
        Start values. Their "world" is the rig's frame, which the first camera holds: it keeps
        its pose.
    rig_from_board : dict of int to (3, 4) float64
        Start values of the board's pose in each frame.
    views : sequence of BoardView
        What was seen. Each frame of `rig_from_board` should be seen at least once.
    loss_px : float
        Residuals beyond this many pixels count less than squared (soft L1).
    fix_principal_point : bool
        Leave the principal points in place: a first step where the start is rough.
    """
    anchor = cameras[0].cam_from_world
    used = sorted({view.camera for view in views} | {0})
    model = pycolmap.Reconstruction()
    rig = pycolmap.Rig(rig_id=1)
    for index in used:
        camera = cameras[index]
        model.add_camera(
            pycolmap.Camera(
                camera_id=index + 1,
                model=camera.model,
                width=camera.width_px,
                height=camera.height_px,
                params=camera.params,
            )
        )
        sensor = pycolmap.sensor_t(pycolmap.SensorType.CAMERA, index + 1)
        if index == 0:
            rig.add_ref_sensor(sensor)
        else:
            sensor_from_rig = compose(camera.cam_from_world, invert(anchor))
            rig.add_sensor(sensor, pycolmap.Rigid3d(sensor_from_rig))
    model.add_rig(rig)
    _add_views(model, anchor, rig_from_board, views, len(points_board))

    problem = pycolmap.BundleAdjustmentConfig()
    tracks: list[list[pycolmap.TrackElement]] = [[] for _ in points_board]
    for image_id in range(1, len(views) + 1):
        problem.add_image(image_id)
        for corner, track in enumerate(tracks):
            track.append(pycolmap.TrackElement(image_id, corner))
    for corner, (point, track) in enumerate(zip(points_board, tracks, strict=True)):
        model.add_point3D_with_id(corner + 1, pycolmap.Point3D(xyz=point))
        for element in track:
            model.add_observation(corner + 1, element)
        problem.add_constant_point(corner + 1)
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(
        _options(loss_px, fix_principal_point), problem, model
    )
    summary = adjuster.solve()
    if not summary.is_solution_usable():
        raise CalibrationError(
            f"the bundle adjustment of {len(views)} views did not converge: "
            f"{summary.brief_report()}"
        )
    return _read_back(model, points_board, cameras, used, anchor, views)


def _add_views(
    model: pycolmap.Reconstruction,
    anchor: Pose,
    rig_from_board: dict[int, Pose],
    views: Sequence[BoardView],
    n_corners: int,
) -> None:
    images_of_frame: dict[int, list[int]] = {}
    for image_id, view in enumerate(views, start=1):
        images_of_frame.setdefault(view.frame, []).append(image_id)
    for frame_id, image_ids in sorted(images_of_frame.items()):
        frame = pycolmap.Frame(frame_id=frame_id + 1, rig_id=1)
        for image_id in image_ids:
            sensor = pycolmap.sensor_t(pycolmap.SensorType.CAMERA, views[image_id - 1].camera + 1)
            frame.add_data_id(pycolmap.data_t(sensor, image_id))
        frame.rig_from_world = pycolmap.Rigid3d(compose(anchor, rig_from_board[frame_id]))
        model.add_frame(frame)
    for image_id, view in enumerate(views, start=1):
        image = pycolmap.Image(
            name=f"{image_id}",
            points2D=pycolmap.Point2DList([pycolmap.Point2D(pixel) for pixel in view.pixels]),
            camera_id=view.camera + 1,
            image_id=image_id,
            frame_id=view.frame + 1,
        )
        model.add_image(image)
    for frame_id in images_of_frame:
        model.register_frame(frame_id + 1)


def _options(loss_px: float, fix_principal_point: bool) -> pycolmap.BundleAdjustmentOptions:
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_principal_point = not fix_principal_point
    options.refine_points3D = False
    options.print_summary = False
    ceres = options.ceres
    ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    ceres.loss_function_scale = loss_px
    solver = ceres.solver_options
    solver.max_num_iterations = _MAX_ITERATIONS
    solver.gradient_tolerance = _GRADIENT_TOLERANCE
    solver.function_tolerance = _FUNCTION_TOLERANCE
    solver.parameter_tolerance = _PARAMETER_TOLERANCE
    solver.num_threads = 1  # sums in one order: the same result on every run
    return options


def _read_back(
    model: pycolmap.Reconstruction,
    points_board: NDArray[np.float64],
    cameras: Sequence[Camera],
    used: Sequence[int],
    anchor: Pose,
    views: Sequence[BoardView],
) -> Adjustment:
    rig = model.rig(1)
    adjusted = list(cameras)
    for index in used:
        pose = anchor
        if index:
            sensor = pycolmap.sensor_t(pycolmap.SensorType.CAMERA, index + 1)
            pose = compose(rig.sensor_from_rig(sensor).matrix(), anchor)
        adjusted[index] = replace(
            cameras[index], params=model.camera(index + 1).params, cam_from_world=pose
        )
    rig_from_board = {
        frame_id - 1: compose(invert(anchor), frame.rig_from_world.matrix())
        for frame_id, frame in model.frames.items()
    }
    residuals = tuple(
        board_residuals(
            adjusted[view.camera],
            compose(adjusted[view.camera].cam_from_world, rig_from_board[view.frame]),
            points_board,
            view.pixels,
        )
        for view in views
    )
    return Adjustment(tuple(adjusted), rig_from_board, residuals)


def link_cameras(
    board: Chessboard,
    cameras: Sequence[Camera],
    corners: Sequence[dict[int, NDArray[np.float64]]],
    is_labelled: bool,
) -> tuple[list[Camera], dict[int, Pose], list[BoardView]]:
    """Chain cameras that see a board at the same time, by closed-form poses.

    A board that looks the same when turned is listed in each view as it agrees with the others:
    the true relative pose of two cameras is the one that all their common frames share.

    Parameters
    ----------
    board : Chessboard
        The board.
    cameras : sequence of Camera
        Lenses; poses are not used.
    corners : sequence of dict of int to (N, 2) float64
        For each camera, by frame, the corners it sees in pixels.
    is_labelled : bool
        Whether a symmetric board is listed consistently already.

    Returns
    -------
    cameras : list of Camera
        With poses in the frame of the first one.
    rig_from_board : dict of int to (3, 4) float64
        The board in each frame.
    views : list of BoardView
        All views of these frames, listed consistently.

    Raises
    ------
    CalibrationError
        If a camera shares no frame with those it could be linked to, or the common frames do not
        tell which way round they saw the board.
    """
    points = board.points_board
    n_looks = 1 if is_labelled else len(board.looks)
    located: list[dict[int, Pose]] = []
    for camera, seen in zip(cameras, corners, strict=True):
        found = {frame: locate_board(camera, points, pixels) for frame, pixels in seen.items()}
        located.append({frame: best[0] for frame, best in found.items() if best is not None})
    cam_from_rig = {0: np.eye(3, 4)}
    while len(cam_from_rig) < len(cameras):
        # The next camera is the one that shares most frames with one that stands already.
        edges = [
            (len(located[known].keys() & located[new].keys()), -known, -new)
            for known in cam_from_rig
            for new in range(len(cameras))
            if new not in cam_from_rig
        ]
        n_shared, known, new = max(edges)
        if n_shared == 0:
            raise _not_linked(cameras, set(cam_from_rig))
        new_from_known, is_clear = _common_relative_pose(
            board, n_looks, located[-known], located[-new]
        )
        if not is_clear:
            raise CalibrationError(
                f"cameras {cameras[-known].name!r} and {cameras[-new].name!r}: their {n_shared} "
                "common views of a board that looks the same when turned do not tell which way "
                "round they saw it; tilt and move the board more, let it lie still, or use one "
                "with an odd sum of columns and rows"
            )
        cam_from_rig[-new] = compose(new_from_known, cam_from_rig[-known])

    rig_from_board: dict[int, Pose] = {}
    views: list[BoardView] = []
    for frame in sorted({frame for poses in located for frame in poses}):
        for index, poses in enumerate(located):
            if frame not in poses:
                continue
            look = 0
            from_cam = invert(cam_from_rig[index])
            if frame in rig_from_board and n_looks > 1:
                look = min(
                    range(n_looks),
                    key=lambda turn: angle_between(
                        compose(from_cam, compose(poses[frame], board.board_from_turned(turn))),
                        rig_from_board[frame],
                    ),
                )
            if frame not in rig_from_board:
                rig_from_board[frame] = compose(from_cam, poses[frame])
            pixels = corners[index][frame][board.looks[look]]
            views.append(BoardView(index, frame, pixels, f"board clip, frame {frame}"))
    placed = [
        replace(camera, cam_from_world=cam_from_rig[index]) for index, camera in enumerate(cameras)
    ]
    return placed, rig_from_board, views


def _not_linked(cameras: Sequence[Camera], linked: set[int]) -> CalibrationError:
    names = [camera.name for camera in cameras]
    inside = ", ".join(repr(names[index]) for index in sorted(linked))
    outside = ", ".join(repr(name) for index, name in enumerate(names) if index not in linked)
    return CalibrationError(
        f"camera {outside} never sees the board at the same time as {inside}; record the board "
        "where one of each sees it at once"
    )


def _common_relative_pose(
    board: Chessboard, n_looks: int, first: dict[int, Pose], second: dict[int, Pose]
) -> tuple[Pose, bool]:
    """Return second_from_first, as most of the common frames have it, and if no other serves."""
    shared = sorted(first.keys() & second.keys())
    turns = [board.board_from_turned(look) for look in range(n_looks)]
    candidates = [
        [compose(compose(second[frame], turn), invert(first[frame])) for turn in turns]
        for frame in shared
    ]

    def disagreement(pose: Pose) -> float:
        # Per frame the nearest of its candidates: angle, and shift by the cameras' distance. The
        # median over frames lets bad frames be bad.
        scale = max(float(np.linalg.norm(pose[:, 3])), 1e-9)
        return float(
            np.median(
                [
                    min(
                        angle_between(other, pose)
                        + float(np.linalg.norm(other[:, 3] - pose[:, 3])) / scale
                        for other in frame
                    )
                    for frame in candidates
                ]
            )
        )

    errors = [(disagreement(pose), pose) for frame in candidates for pose in frame]
    error, best = min(errors, key=lambda item: item[0])
    rivals = [other for other, pose in errors if angle_between(pose, best) > _OTHER_LOOK_RAD]
    return best, min(rivals, default=np.inf) > _CLEAR_FACTOR * error + _CLEAR_MARGIN
