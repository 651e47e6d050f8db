"""COLMAP's own bundle adjustment of a rig and its boards, through pycolmap.

A body is the world of the frames in which it was seen: its boards' corners are constant points, a
pose of it is a frame of the rig, and what one camera saw of it then is an image. So the frames of
several bodies stand beside each other in one reconstruction, each with points of its own. The rig
stays free in space; what comes back is in the frame of the bundle's held pose.

COLMAP weighs all points alike, and has no body that is adjusted and no lens that cameras of one rig
share. It runs on one thread, so that its answer is the same bits for any number of them.

This work is based on: Schoenberger and Frahm, *Structure-from-motion revisited*, CVPR 2016;
Agarwal, Mierle and others, *Ceres Solver*.
"""

from dataclasses import replace

import numpy as np

from hybridve.calib.boards.board import is_seen
from hybridve.calib.colmap_library import pycolmap
from hybridve.calib.lens import as_colmap
from hybridve.calib.pose import Pose, compose, invert, transform
from hybridve.calib.solving.bundle import Bundle, BundleView, total_cost

pycolmap.logging.minloglevel = max(pycolmap.logging.minloglevel, 2)  # its warnings are no answer

_MAX_STEPS = 200

#: An answer costs no more than its start, but for rounding: a share, and pixels a point.
_ROUNDING = 1e-9
_ROUNDING_PX = 1e-6


def what_colmap_lacks(bundle: Bundle) -> str:
    """Return why COLMAP cannot express a bundle, as a sentence; empty where it can."""
    adjusted = [lens for lens in bundle.lens_of if lens not in bundle.fixed_lenses]
    if len(set(adjusted)) < len(adjusted):
        return "COLMAP has no lens that several cameras of one rig share"
    if len(bundle.held_boards) < len(bundle.points_board):
        return "COLMAP has no boards that are mounted together at places to be found"
    return ""


def colmap_adjust(bundle: Bundle, loss_px: float = np.inf) -> Bundle | str:
    """Adjust a bundle to the least squares of its residuals, all points alike, with COLMAP.

    Parameters
    ----------
    bundle : Bundle
        Start values; `BundleView.sigma_px` is not used.
    loss_px : float
        Points that miss by more than this many pixels count less than squared (soft L1); infinite
        for plain least squares.

    Returns
    -------
    Bundle or str
        Adjusted, in the frame of its held pose; or why COLMAP has no answer, as a sentence.
    """
    if reason := what_colmap_lacks(bundle):
        return reason
    model, problem = _reconstruction(bundle)
    options = _options(loss_px)
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, problem, model)
    summary = adjuster.solve()
    if summary.termination_type != pycolmap.BundleAdjustmentTerminationType.CONVERGENCE:
        return "COLMAP's adjustment did not converge"
    found = _read_back(model, bundle)
    # COLMAP takes a point that its lens does not see for one that fits.
    n_points = sum(int(is_seen(view.pixels).sum()) for view in bundle.views)
    allowed = total_cost(bundle, loss_px) * (1.0 + _ROUNDING) + n_points * _ROUNDING_PX**2
    if not total_cost(found, loss_px) <= allowed:
        return "COLMAP's adjustment lost boards out of sight"
    return found


def _reconstruction(
    bundle: Bundle,
) -> tuple[pycolmap.Reconstruction, pycolmap.BundleAdjustmentConfig]:
    """Return a bundle as COLMAP has it, and what of it is adjusted."""
    model, problem = pycolmap.Reconstruction(), pycolmap.BundleAdjustmentConfig()
    _add_cameras(model, bundle)
    for number, lens in enumerate(bundle.lens_of, start=1):
        if lens in bundle.fixed_lenses:
            problem.set_constant_cam_intrinsics(number)
    tracks = _add_images(model, bundle)
    for image_id in model.images:
        problem.add_image(image_id)
    first_points = _first_points(bundle)
    for (board, index), seen in tracks.items():
        xyz = transform(bundle.body_from_board[board], bundle.points_board[board][index, None])[0]
        # COLMAP wants a point to be seen twice; as points stay, that matters to nothing else.
        track = pycolmap.Track(seen if len(seen) > 1 else seen * 2)
        point_id = first_points[board] + index
        model.add_point3D_with_id(point_id, pycolmap.Point3D(xyz=xyz, track=track))
    return model, problem


def _add_cameras(model: pycolmap.Reconstruction, bundle: Bundle) -> None:
    """Put lenses into a model, and the rig of all cameras; its frame is that of the first."""
    rig, anchor = pycolmap.Rig(rig_id=1), bundle.cameras[0].cam_from_world
    for number, camera in enumerate(bundle.cameras, start=1):
        model.add_camera(as_colmap(camera, number))
        if number == 1:
            rig.add_ref_sensor(_sensor(number))
        else:
            sensor_from_rig = compose(camera.cam_from_world, invert(anchor))
            rig.add_sensor(_sensor(number), pycolmap.Rigid3d(sensor_from_rig))
    model.add_rig(rig)


def _add_images(
    model: pycolmap.Reconstruction, bundle: Bundle
) -> dict[tuple[int, int], list[pycolmap.TrackElement]]:
    """Put all poses and images into a model; return where each point (board, index) is seen."""
    views: dict[tuple[int, int], list[BundleView]] = {}
    for view in bundle.views:
        views.setdefault((view.pose, view.camera), []).append(view)
    ids = {key: number for number, key in enumerate(sorted(views), start=1)}
    anchor = bundle.cameras[0].cam_from_world
    frames = []
    for pose, rig_from_body in enumerate(bundle.rig_from_body):
        frame = pycolmap.Frame(frame_id=pose + 1, rig_id=1)
        frame.rig_from_world = pycolmap.Rigid3d(compose(anchor, rig_from_body))
        frames.append(frame)
    for (pose, camera), image_id in ids.items():
        frames[pose].add_data_id(pycolmap.data_t(_sensor(camera + 1), image_id))
    for frame in frames:
        model.add_frame(frame)
    first_points = _first_points(bundle)
    tracks: dict[tuple[int, int], list[pycolmap.TrackElement]] = {}
    for (pose, camera), image_id in ids.items():
        points = pycolmap.Point2DList()
        for view in views[pose, camera]:
            for index in np.flatnonzero(is_seen(view.pixels)).tolist():
                element = pycolmap.TrackElement(image_id, len(points))
                tracks.setdefault((view.board, index), []).append(element)
                points.append(
                    pycolmap.Point2D(view.pixels[index], first_points[view.board] + index)
                )
        model.add_image(
            pycolmap.Image(
                name=f"{image_id}",
                points2D=points,
                camera_id=camera + 1,
                image_id=image_id,
                frame_id=pose + 1,
            )
        )
    for frame in frames:
        model.register_frame(frame.frame_id)
    return tracks


def _first_points(bundle: Bundle) -> list[int]:
    """Return by board the number of its first point."""
    counts = [len(points_board) for points_board in bundle.points_board]
    return [1 + sum(counts[:board]) for board in range(len(counts))]


def _sensor(camera_id: int) -> pycolmap.sensor_t:
    return pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id)


def _options(loss_px: float) -> pycolmap.BundleAdjustmentOptions:
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_principal_point = True
    options.refine_points3D = False
    options.print_summary = False
    ceres = options.ceres
    if np.isfinite(loss_px):
        ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
        ceres.loss_function_scale = loss_px
    # COLMAP would choose by the number of images, and iterate inexactly where they are many.
    ceres.auto_select_solver_type = False
    solver = ceres.solver_options
    solver.linear_solver_type = type(solver.linear_solver_type).SPARSE_SCHUR
    solver.num_threads = 1
    solver.max_num_iterations = _MAX_STEPS
    solver.gradient_tolerance = 1e-10
    solver.function_tolerance = 1e-12
    solver.parameter_tolerance = 1e-12
    return options


def _read_back(model: pycolmap.Reconstruction, bundle: Bundle) -> Bundle:
    """Return the adjusted bundle, in the frame of its held pose."""
    rig = model.rig(1)

    def anchor_from_body(pose: int) -> Pose:
        return np.asarray(model.frame(pose + 1).rig_from_world.matrix())

    held = bundle.held_pose
    rig_from_anchor = compose(bundle.rig_from_body[held], invert(anchor_from_body(held)))
    cameras = []
    for number, camera in enumerate(bundle.cameras, start=1):
        own = np.eye(3, 4) if number == 1 else rig.sensor_from_rig(_sensor(number)).matrix()
        cameras.append(
            replace(
                camera,
                params=model.camera(number).params.copy(),
                cam_from_world=compose(own, invert(rig_from_anchor)),
            )
        )
    return replace(
        bundle,
        cameras=tuple(cameras),
        rig_from_body=tuple(
            start if pose == held else compose(rig_from_anchor, anchor_from_body(pose))
            for pose, start in enumerate(bundle.rig_from_body)
        ),
    )
