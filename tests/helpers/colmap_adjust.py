"""COLMAP's own bundle adjustment of boards, through pycolmap: what ours is compared with.

The board is the reconstruction's world: its corners are constant points, every view of it is an
image, views of one pose are one frame of the rig, and the pose of a frame is that of the board.
"""

from dataclasses import replace

import numpy as np
import pycolmap

from hybridve.calib.pose import compose, invert
from hybridve.calib.solving.bundle import Bundle

pycolmap.logging.minloglevel = 2


def colmap_adjust(bundle: Bundle) -> Bundle:
    """Adjust a bundle to the least squares of its residuals, with COLMAP.

    Parameters
    ----------
    bundle : Bundle
        Start values. One board, that is its own body; each camera has a lens of its own, and all
        are adjusted. Every point is seen in every view.

    Raises
    ------
    RuntimeError
        If COLMAP says that its answer is of no use.
    """
    model = _reconstruction(bundle)
    problem = pycolmap.BundleAdjustmentConfig()
    for image_id in range(1, len(bundle.views) + 1):
        problem.add_image(image_id)
    for point_id in range(1, len(bundle.points_board[0]) + 1):
        problem.add_constant_point(point_id)
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(_options(), problem, model)
    summary = adjuster.solve()
    if not summary.is_solution_usable():
        raise RuntimeError(summary.brief_report())
    return _read_back(model, bundle)


def _reconstruction(bundle: Bundle) -> pycolmap.Reconstruction:
    model, rig = pycolmap.Reconstruction(), pycolmap.Rig(rig_id=1)
    anchor = bundle.cameras[0].cam_from_world
    for number, camera in enumerate(bundle.cameras, start=1):
        model.add_camera(
            pycolmap.Camera(
                camera_id=number,
                model=camera.model,
                width=camera.width_px,
                height=camera.height_px,
                params=camera.params,
            )
        )
        sensor = pycolmap.sensor_t(pycolmap.SensorType.CAMERA, number)
        if number == 1:
            rig.add_ref_sensor(sensor)
        else:
            sensor_from_rig = compose(camera.cam_from_world, invert(anchor))
            rig.add_sensor(sensor, pycolmap.Rigid3d(sensor_from_rig))
    model.add_rig(rig)
    for pose, rig_from_body in enumerate(bundle.rig_from_body):
        frame = pycolmap.Frame(frame_id=pose + 1, rig_id=1)
        for image_id, view in enumerate(bundle.views, start=1):
            if view.pose == pose:
                sensor = pycolmap.sensor_t(pycolmap.SensorType.CAMERA, view.camera + 1)
                frame.add_data_id(pycolmap.data_t(sensor, image_id))
        frame.rig_from_world = pycolmap.Rigid3d(compose(anchor, rig_from_body))
        model.add_frame(frame)
    for image_id, view in enumerate(bundle.views, start=1):
        model.add_image(
            pycolmap.Image(
                name=f"{image_id}",
                points2D=pycolmap.Point2DList([pycolmap.Point2D(pixel) for pixel in view.pixels]),
                camera_id=view.camera + 1,
                image_id=image_id,
                frame_id=view.pose + 1,
            )
        )
    for pose in range(len(bundle.rig_from_body)):
        model.register_frame(pose + 1)
    for index, point in enumerate(bundle.points_board[0]):
        model.add_point3D_with_id(index + 1, pycolmap.Point3D(xyz=point))
        for image_id in range(1, len(bundle.views) + 1):
            model.add_observation(index + 1, pycolmap.TrackElement(image_id, index))
    return model


def _options() -> pycolmap.BundleAdjustmentOptions:
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_principal_point = True
    options.refine_points3D = False
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.TRIVIAL
    solver = options.ceres.solver_options
    solver.max_num_iterations = 200
    solver.gradient_tolerance = 1e-10
    solver.function_tolerance = 1e-14
    solver.parameter_tolerance = 1e-12
    return options


def _read_back(model: pycolmap.Reconstruction, bundle: Bundle) -> Bundle:
    """Return the adjusted bundle, in the frame of its held pose."""
    rig = model.rig(1)
    rig_from_held = model.frames[bundle.held_pose + 1].rig_from_world.matrix()
    cameras = []
    for number, camera in enumerate(bundle.cameras, start=1):
        sensor = pycolmap.sensor_t(pycolmap.SensorType.CAMERA, number)
        own = np.eye(3, 4) if number == 1 else rig.sensor_from_rig(sensor).matrix()
        cameras.append(
            replace(
                camera,
                params=model.camera(number).params,
                cam_from_world=compose(own, rig_from_held),
            )
        )
    return replace(
        bundle,
        cameras=tuple(cameras),
        rig_from_body=tuple(
            compose(invert(rig_from_held), model.frames[pose + 1].rig_from_world.matrix())
            for pose in range(len(bundle.rig_from_body))
        ),
    )
