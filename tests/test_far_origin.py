"""A scene far from the world's origin is as well known as one beside it."""

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers.mesh_files import binary_stl
from helpers.sessions import write_ball_session, write_cube_scene
from numpy.typing import NDArray

from hybridve.hull.cad.mesh import read_cad
from hybridve.hull.report.read import read_points, read_report

Run = Callable[..., int]

CENTERS = np.array([[-0.4, 0.02, 0.01], [-0.24, 0.02, 0.01]])
PLACES = ("witness_m", "clearance_on_hull_m", "cp_obj_m", "cp_hull_m", "cp_hull_paper_m")
NUMBERS = ("clearance_m", "d_rec_m", "v_rec", "n_hull", "free_shift_m", "depth_m")


def moved(session: Path, scene: Path, shift_m: NDArray[np.float64]) -> None:
    """Move a session's cameras and its scene by the same whole metres."""
    rows = []
    rig = session.parent / "rig.csv"
    for line in rig.read_text(encoding="utf-8").splitlines():
        name, *values = line.split(",")
        matrix = np.array([float(value) for value in values]).reshape(3, 4)
        matrix[:, 3] -= matrix[:, :3] @ shift_m
        rows.append(",".join([name, *(repr(float(value)) for value in matrix.ravel())]))
    rig.write_text("\n".join(rows) + "\n", encoding="utf-8")
    at_mm = ", ".join(str(1000.0 * value) for value in shift_m)
    text = scene.read_text(encoding="utf-8")
    text = text.replace("translate_mm = [0.0, 0.0, 0.0]", f"translate_mm = [{at_mm}]")
    assert at_mm in text or not shift_m.any()
    scene.write_text(text, encoding="utf-8")


def report_of(run: Run, folder: Path, shift_m: NDArray[np.float64]) -> Path:
    session = write_ball_session(folder / "session", CENTERS)
    scene = write_cube_scene(folder, {"hit": (0.0, 0.0, 0.0)})
    moved(session, scene, shift_m)
    path = folder / "report.h5"
    call = ("detect", session, "--scene", scene, "-o", path, "--points", "all", "--no-progress")
    assert run(*call) == 0
    return path


@pytest.mark.slow
@pytest.mark.parametrize("shift_m", [(10_000, -200, 3), (5_000_000, 3_000_000, -4_000_000)])
def test_nothing_is_lost_far_from_the_origin(
    run: Run, tmp_path: Path, shift_m: tuple[float, float, float]
) -> None:
    shift = np.array(shift_m, np.float64)
    near, far = report_of(run, tmp_path / "near", np.zeros(3)), report_of(run, tmp_path, shift)

    here, there = read_report(near).objects["hit"], read_report(far).objects["hit"]

    assert here.verdict.tolist() == there.verdict.tolist() == ["kept", "clash"]
    # The cameras' matrices hold the shift in double precision: 1e-9 m, and through them 1e-6 px.
    for name in PLACES:
        np.testing.assert_allclose(there[name] - shift, here[name], atol=1e-7, err_msg=name)
    for name in NUMBERS:
        np.testing.assert_allclose(there[name], here[name], atol=1e-6, err_msg=name)
    assert np.isfinite(there["d_rec_m"][1])
    found_m, triangle = read_points(far, "hit", 1)
    expected_m, expected = read_points(near, "hit", 1)
    np.testing.assert_array_equal(triangle, expected)
    np.testing.assert_allclose(found_m - shift, expected_m, atol=2e-9)
    with h5py.File(far) as file:
        origin_m = file["hybridve/settings/local_origin_m"][:]
        assert np.abs(origin_m - shift).max() <= 50.0
        stored_m = file["hybridve/objects/hit/points/xyz_m"][:]
        assert stored_m.dtype == np.float32
        np.testing.assert_allclose(stored_m + (origin_m - shift), expected_m, atol=5e-6)
        shown_m = file["VTKHDF/hit_points/Points"][:]
        np.testing.assert_array_equal(shown_m, stored_m)


@pytest.mark.slow
def test_what_single_precision_leaves_of_a_file_is_in_the_bounds(run: Run, tmp_path: Path) -> None:
    """Of a part that is drawn 5 km off its origin, and put back: a quarter of a millimetre."""
    away_mm = 5_000_000.24
    session = write_ball_session(tmp_path / "session", CENTERS[:1])
    scene = write_cube_scene(tmp_path, {"exact": (0.0, 0.0, 0.0)})
    (part,) = read_cad(tmp_path / "cube.obj").parts
    content = binary_stl(part.vertices + np.array([away_mm, 0.0, 0.0]), part.faces.tolist())
    (tmp_path / "coarse.stl").write_bytes(content)
    with scene.open("a", encoding="utf-8") as file:
        file.write(
            '\n[[object]]\nname = "coarse"\nmesh = "coarse.stl"\nunit = "mm"\n'
            f"translate_mm = [{-away_mm}, 0, 0]\n"
        )
    path = tmp_path / "report.h5"

    assert run("detect", session, "--scene", scene, "-o", path, "--no-progress") == 0

    objects = read_report(path).objects
    exact_m, coarse_m = (objects[name]["clearance_m"][0] for name in ("exact", "coarse"))
    assert np.ptp(exact_m) < 2e-4
    # Its corners moved by 0.24 mm towards the ball or away from it, all alike.
    assert coarse_m[0] <= exact_m[0]
    assert exact_m[1] <= coarse_m[1]
    assert np.ptp(coarse_m) < 1e-3
