"""Rigs as COLMAP models: what COLMAP, and all that reads its models, works on."""

import tempfile
from pathlib import Path

from hybridve.calib.camera import Camera
from hybridve.calib.colmap_library import pycolmap
from hybridve.calib.errors import CalibrationError
from hybridve.calib.files import write_together
from hybridve.calib.lens import as_colmap
from hybridve.calib.pose import Pose, compose, invert
from hybridve.calib.provenance import MadeElsewhere
from hybridve.calib.rig import Rig

#: The files of a COLMAP text model that are written.
COLMAP_FILES = ("cameras.txt", "frames.txt", "images.txt", "points3D.txt", "rigs.txt")


def refusal(camera: Camera) -> str | None:
    """Return why {folder}: COLMAP cannot hold a camera, or None."""
    if camera.skew_px:
        return f"a skew of {camera.skew_px:.3g} px, which no lens of COLMAP has"
    return None


def remove_colmap_model(folder: Path) -> None:
    """Remove what `write_colmap_model` wrote into a folder: it would be taken for that of a rig.

    Raises
    ------
    CalibrationError
        If a file cannot be removed.
    """
    try:
        for name in COLMAP_FILES:
            (folder / name).unlink(missing_ok=True)
        if folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()
    except OSError as error:
        raise CalibrationError(f"{folder}: cannot be removed ({error.strerror})") from error


def write_colmap_model(folder: Path, rig: Rig) -> None:
    """Write a rig as a COLMAP text model: one rig, one frame, one image a camera.

    The rig's first camera is COLMAP's reference sensor, so that the frame's pose is its pose.
    Images are named after the cameras, with ``_`` for a space, at which COLMAP would cut the name
    off. No file is replaced before all are complete.

    Raises
    ------
    CalibrationError
        If a camera has a skew, which COLMAP's models cannot hold, or the folder cannot be written.
    """
    model = pycolmap.Reconstruction()
    colmap_rig = pycolmap.Rig(rig_id=1)
    frame = pycolmap.Frame(frame_id=1, rig_id=1)
    rig_from_world = rig.cameras[0].cam_from_world
    for number, camera in enumerate(rig.cameras, start=1):
        why = refusal(camera)
        if why is not None:
            raise CalibrationError(
                f"{folder}: COLMAP cannot hold camera {camera.name!r}: it has {why}"
            )
        model.add_camera(as_colmap(camera, number))
        sensor = pycolmap.sensor_t(pycolmap.SensorType.CAMERA, number)
        if number == 1:
            colmap_rig.add_ref_sensor(sensor)
        else:
            sensor_from_rig = compose(camera.cam_from_world, invert(rig_from_world))
            colmap_rig.add_sensor(sensor, pycolmap.Rigid3d(sensor_from_rig))
        frame.add_data_id(pycolmap.data_t(sensor, number))
    model.add_rig(colmap_rig)
    frame.rig_from_world = pycolmap.Rigid3d(rig_from_world)
    model.add_frame(frame)
    for number, camera in enumerate(rig.cameras, start=1):
        name = camera.name.replace(" ", "_")
        model.add_image(pycolmap.Image(name=name, camera_id=number, image_id=number, frame_id=1))
    model.register_frame(1)
    try:
        with tempfile.TemporaryDirectory(prefix="hybridve-") as partial:
            model.write_text(partial)
            contents = {path.name: path.read_bytes() for path in Path(partial).iterdir()}
            # COLMAP does not notice that a disk is full.
            if not _is_whole(Path(partial), len(rig.cameras)):
                raise CalibrationError(
                    f"{folder}: cannot be written: the folder for temporary files, "
                    f"{tempfile.gettempdir()}, has no room for the model"
                )
        folder.mkdir(parents=True, exist_ok=True)
        write_together({folder / name: content for name, content in sorted(contents.items())})
    except OSError as error:
        raise CalibrationError(f"{folder}: cannot be written ({error.strerror})") from error


def _is_whole(folder: Path, count: int) -> bool:
    """Tell whether a model that was written has as many cameras and images as it should."""
    try:
        model = pycolmap.Reconstruction(str(folder))
    except (ValueError, RuntimeError):
        return False
    return model.num_cameras() == count and len(model.reg_image_ids()) == count


def read_colmap_model(folder: Path) -> Rig:
    """Read the cameras of a COLMAP model, binary or text, each named after its image.

    Raises
    ------
    CalibrationError
        If the folder holds no model, or no image with a pose.
    """
    try:
        model = pycolmap.Reconstruction(str(folder))
    except (ValueError, RuntimeError) as error:
        raise CalibrationError(f"{folder}: not a COLMAP model that can be read") from error
    cameras = []
    for image_id in sorted(model.reg_image_ids()):
        image = model.image(image_id)
        lens = image.camera
        cameras.append(
            Camera(
                image.name,
                lens.model_name,
                lens.width,
                lens.height,
                lens.params,
                _pose(image.cam_from_world()),
            )
        )
    if not cameras:
        raise CalibrationError(f"{folder}: the COLMAP model holds no image with a pose")
    return Rig(tuple(cameras), MadeElsewhere({"method": "COLMAP model", "folder": str(folder)}))


def _pose(transform: pycolmap.Rigid3d) -> Pose:
    matrix: Pose = transform.matrix()
    return matrix
