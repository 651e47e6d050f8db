"""A report as a recording for the Rerun viewer: the scene, and clearances, over time.

Rerun's library is an extra of this package (``hybridve[rerun]``): nobody else waits for it.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.errors import ReportError
from hybridve.calib.files import appearing
from hybridve.calib.rig import Rig
from hybridve.hull.curves import curve_of
from hybridve.hull.report.read import Report
from hybridve.hull.report.touched import read_touched
from hybridve.hull.report.vtk import MOST_SHOWN
from hybridve.hull.view.surface import Surface

#: Colours, RGB: CAD, what is touched, shortest ways, the hull.
_CAD, _TOUCHED, _NEAREST, _HULL = (143, 168, 196), (210, 16, 28), (123, 47, 160), (217, 185, 140)


def write_rerun(
    path: Path, report: Report, rig: Rig | None, surfaces: Iterable[tuple[int, Surface]] | None
) -> None:
    """Write a report as an .rrd: places in metres in the world, times of the session in seconds.

    Parameters
    ----------
    path : Path
        The file.
    report : Report
        Which.
    rig : Rig or None
        Its cameras; those that move are left out.
    surfaces : iterable of (int, Surface), optional
        The hull of each row's frame.

    Raises
    ------
    ReportError
        If Rerun's library is not installed, or the file cannot be written.
    """
    try:
        import rerun as rr
    except ImportError as error:
        raise ReportError(
            f"{path}: Rerun's library is not installed; `pip install hybridve[rerun]` installs it"
        ) from error
    try:
        with appearing(path) as partial:
            stream = rr.RecordingStream("hybridve", recording_id=report.path.stem)
            stream.save(partial)
            _log(rr, stream, report, rig, surfaces)
            stream.flush()
            stream.disconnect()
    except OSError as error:
        raise ReportError(f"{path}: cannot be written: {error.strerror}") from error


def _log(
    rr: Any,
    stream: Any,
    report: Report,
    rig: Rig | None,
    surfaces: Iterable[tuple[int, Surface]] | None,
) -> None:
    origin_m, touched = read_touched(report.path)
    stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for camera in () if rig is None else rig.cameras:
        if rig is None or camera.name in rig.mounts:
            continue
        at = f"world/cameras/{camera.name}"
        rotation = camera.cam_from_world[:, :3].T
        stream.log(
            at, rr.Transform3D(translation=camera.center_world, mat3x3=rotation), static=True
        )
        lens = rr.Pinhole(
            image_from_camera=camera.pinhole, resolution=[camera.width_px, camera.height_px]
        )
        stream.log(at, lens, static=True)
    for name, one in touched.items():
        at = f"world/cad/{name}"
        mesh = rr.Mesh3D(
            vertex_positions=one.mesh.vertices_m,
            triangle_indices=one.mesh.faces,
            albedo_factor=_CAD,
        )
        stream.log(at, mesh, static=True)
        if len(one.mesh.placement) == 1:
            stream.log(at, _placed(rr, one.mesh.placement[0], origin_m), static=True)
    hulls = None if surfaces is None else iter(surfaces)
    curves = {
        name: curve_of(name, rows, report)
        for name, rows in report.objects.items()
        if "clearance_m" in rows
    }
    for row, (index, time_s) in enumerate(
        zip(report.index.tolist(), report.time_s.tolist(), strict=True)
    ):
        stream.set_time("frame", sequence=index)
        stream.set_time("time", duration=time_s)
        for name, rows in report.objects.items():
            stream.log(f"verdict/{name}", rr.TextLog(f"{name}: {rows.verdict[row]}"))
            if name in curves and np.isfinite(curves[name].upper_mm[row]):
                stream.log(f"clearance_mm/{name}", rr.Scalars(curves[name].upper_mm[row]))
            ends = [rows.get(f"clearance_on_{one}_m") for one in ("object", "hull")]
            if ends[0] is not None and ends[1] is not None:
                both = np.stack([ends[0][row], ends[1][row]])
                lines = [both] if np.isfinite(both).all() else []
                stream.log(f"world/nearest/{name}", rr.LineStrips3D(lines, colors=_NEAREST))
            if name not in touched:
                continue
            one = touched[name]
            points = rr.Points3D(one.points(row, MOST_SHOWN) + origin_m, colors=_TOUCHED)
            stream.log(f"world/touched/{name}", points)
            if len(one.mesh.placement) > 1 and np.isfinite(one.mesh.placement[row]).all():
                stream.log(f"world/cad/{name}", _placed(rr, one.mesh.placement[row], origin_m))
        if hulls is not None:
            _, surface = next(hulls)
            hull = rr.Mesh3D(
                vertex_positions=surface.vertices_world,
                triangle_indices=surface.faces,
                albedo_factor=_HULL,
            )
            stream.log("world/hull", hull if len(surface.faces) else rr.Clear(recursive=False))


def _placed(rr: Any, placement: NDArray[np.float64], origin_m: NDArray[np.float64]) -> Any:
    return rr.Transform3D(translation=placement[:, 3] + origin_m, mat3x3=placement[:, :3])
