"""What of each object was touched, as it stands in a report."""

from pathlib import Path

import numpy as np
from helpers.clash_reports import Spot, write_clash_report

from hybridve.hull.report.read import read_points, read_report
from hybridve.hull.report.touched import read_touched


def test_triangles_and_points_are_those_of_the_report(tmp_path: Path) -> None:
    frames = [[Spot((0.1, 0.0, 0.5), 0.03)], [], [Spot((0.1, 0.0, 0.5), 0.03)] * 2]
    path = write_clash_report(tmp_path / "r.h5", frames)
    origin_m, objects = read_touched(path)
    triangles, offset = objects["box"].triangles()

    assert np.array_equal(np.diff(offset), read_report(path).objects["box"].n_triangles)
    for row in range(3):
        xyz_m, on = read_points(path, "box", row)
        assert set(triangles[offset[row] : offset[row + 1]].tolist()) == set(on.tolist())
        assert np.allclose(objects["box"].points(row) + origin_m, xyz_m)
