"""The hull of each frame of a report, from the session that it is of: meshes, and for ParaView."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from hybridve.calib.errors import ReportError, SessionError
from hybridve.hull.capture.recording import FrameRange
from hybridve.hull.recorded import Recorded, seen_frames
from hybridve.hull.report.read import Report
from hybridve.hull.report.touched import read_touched
from hybridve.hull.report.vtk_export import ShownHull, write_vtk
from hybridve.hull.view.mesh_file import write_mesh
from hybridve.hull.view.surface import Surface, hull_surface

Progress = Callable[[str, int, int], None]


def hull_surfaces(
    report: Report, recorded: Recorded, cell_m: float, progress: Progress | None = None
) -> Iterator[tuple[int, Surface]]:
    """Yield of each row of a report its frame's number and the surface of its hull.

    A frame that cannot be read has none.

    Raises
    ------
    ReportError
        If the cells are too small for the hull.
    SessionError
        If the recordings cannot be read, or lack frames of the report.
    """
    index = report.index.astype(np.int64)
    steps = np.diff(index)
    step = int(np.gcd.reduce(steps)) if len(steps) else 1
    nothing = Surface(np.zeros((0, 3)), np.zeros((0, 3), np.int32), cell_m)
    wanted = index.tolist()
    frames = FrameRange(wanted[0], wanted[-1] + 1, max(step, 1))
    done = 0
    for seen in seen_frames(recorded, frames, with_images=False):
        if done == len(wanted) or seen.index != wanted[done]:
            continue
        done += 1
        if progress is not None:
            progress("hulls", done, len(wanted))
        if seen.hull is None:
            yield seen.index, nothing
            continue
        try:
            yield seen.index, hull_surface(seen.hull, cell_m=cell_m)
        except ValueError as error:
            raise ReportError(f"frame {seen.index}: {error} with --cell-mm") from error
    if done < len(wanted):
        raise SessionError(
            f"{recorded.session.path}: has no frame {wanted[done]}, which {report.path} is of; "
            "name the session that the report was made from"
        )


def write_hull_meshes(
    folder: Path,
    suffix: str,
    report: Report,
    recorded: Recorded,
    *,
    cell_m: float,
    progress: Progress | None = None,
) -> int:
    """Write the hull of each frame as ``hull_FRAME.ply`` or .glb, and return how many they are.

    Frames without a hull have no file.
    """
    count = 0
    for number, surface in hull_surfaces(report, recorded, cell_m, progress):
        if len(surface.faces):
            write_mesh(folder / f"hull_{number:06d}{suffix}", surface)
            count += 1
    return count


def write_paraview(
    path: Path,
    report: Report,
    *,
    recorded: Recorded | None = None,
    cell_m: float = 0.02,
    progress: Progress | None = None,
) -> None:
    """Write what ParaView shows of a report, with the hull where its recordings are given.

    Raises
    ------
    ReportError
        If the report is of version 1, which holds no meshes, or the file cannot be written.
    """
    origin_m, touched = read_touched(report.path)
    if not touched:
        raise ReportError(
            f"{report.path}: holds no meshes to show (version 1 of reports has none); make it "
            "again with `hybridve detect`"
        )
    hulls = None
    if recorded is not None:
        hulls = (
            ShownHull(surface.vertices_world, surface.faces)
            for _, surface in hull_surfaces(report, recorded, cell_m, progress)
        )
    write_vtk(path, report, origin_m, touched, hulls)
