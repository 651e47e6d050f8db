"""Files of tracked poses: what is read, and what is refused by name."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybridve.calib.errors import CalibrationError
from hybridve.calib.formats.tracker import read_angles, read_poses

HEAD = "frame,x,y,z,qw,qx,qy,qz\n"
#: A turn by 90 degrees about z: x becomes y.
QUARTER = "0.7071067811865476,0,0,0.7071067811865476"


def written(folder: Path, text: str) -> Path:
    path = folder / "poses.csv"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_quaternion_turns_as_it_says(tmp_path: Path) -> None:
    poses = read_poses(written(tmp_path, f"{HEAD}4,1,2,3,{QUARTER}\n"))

    assert list(poses) == [4]
    np.testing.assert_allclose(poses[4][:, :3] @ [1, 0, 0], [0, 1, 0], atol=1e-15)
    np.testing.assert_array_equal(poses[4][:, 3], [1, 2, 3])


def test_columns_are_found_by_name_and_others_left_alone(tmp_path: Path) -> None:
    text = "# from the lab\nTime,qz,qx,qy,qw,z,y,x\n0.1,1,0,0,0,3,2,1\n\n0.2,0,1,0,0,3,2,9\n"

    poses = read_poses(written(tmp_path, text))

    assert list(poses) == [0, 1]
    np.testing.assert_allclose(poses[0][:, :3], np.diag([-1, -1, 1]), atol=1e-15)
    np.testing.assert_allclose(poses[1][:, :3], np.diag([1, -1, -1]), atol=1e-15)
    np.testing.assert_array_equal(poses[1][:, 3], [9, 2, 3])


@given(
    quaternion=st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1),
    rounding=st.floats(-9e-4, 9e-4),
)
def test_a_matrix_and_a_quaternion_say_the_same(
    tmp_path_factory: pytest.TempPathFactory,
    quaternion: tuple[float, float, float, float],
    rounding: float,
) -> None:
    folder = tmp_path_factory.mktemp("poses")
    w, x, y, z = (1.0 + rounding) * np.array(quaternion) / np.linalg.norm(quaternion)
    first = read_poses(written(folder, f"{HEAD}0,1,2,3,{w},{x},{y},{z}\n"))[0]
    names = ",".join(f"m{row}{column}" for row in (1, 2, 3) for column in (1, 2, 3, 4))
    numbers = ",".join(f"{value:.5f}" for value in first.ravel())

    second = read_poses(written(folder, f"{names}\n{numbers}\n"))[0]

    for pose in (first, second):
        np.testing.assert_allclose(pose[:, :3] @ pose[:, :3].T, np.eye(3), atol=1e-14)
        assert np.linalg.det(pose[:, :3]) > 0
    np.testing.assert_allclose(second, first, atol=3e-5)


def test_frames_come_in_order_and_lost_ones_not_at_all(tmp_path: Path) -> None:
    text = f"{HEAD}7,1,2,3,{QUARTER}\n2,1,2,3,{QUARTER}\n3,,,,,,,\n4,nan,nan,nan,nan,nan,nan,nan\n"

    assert list(read_poses(written(tmp_path, text))) == [2, 7]


def test_angles_are_read_in_radians_as_poses_are(tmp_path: Path) -> None:
    text = "# the door\nnote,Angle_deg,frame\nopen,90,7\n\nshut,-180,2\nlost,,3\nlost,nan,4\n"

    assert read_angles(written(tmp_path, text)) == {2: -np.pi, 7: np.pi / 2}
    assert list(read_angles(written(tmp_path, "angle_deg\n1\n\n2\n"))) == [0, 1]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("frame,x,y,z\n0,1,2,3\n", "expected the columns frame,x,y,z,qw,qx,qy,qz or"),
        ("", "expected the columns"),
        (HEAD, "holds no pose"),
        (f"{HEAD}0,1,2,3,1,1,0,0\n", "line 2: the quaternion has length 1.414, expected 1"),
        (f"{HEAD}0,1,2,3,1,0,0\n", "line 2: has 7 columns, the first line 8"),
        (f"{HEAD}0,1,,3,{QUARTER}\n", "line 2: a part of the pose is missing"),
        (f"{HEAD}0,1,two,3,{QUARTER}\n", "line 2: 'two' is not a number"),
        (f"{HEAD}1.5,1,2,3,{QUARTER}\n", "line 2: frame is '1.5'"),
        (f"{HEAD}-1,1,2,3,{QUARTER}\n", "line 2: frame is '-1'"),
        (f"{HEAD}# half\n0,1,2,3,{QUARTER}\n0,1,2,3,{QUARTER}\n", "line 4: frame 0 stands"),
        (
            "m11,m12,m13,m14,m21,m22,m23,m24,m31,m32,m33,m34\n1,0,0,0,0,1,0,0,0,0,-1,0\n",
            "not a rotation",
        ),
    ],
)
def test_what_is_wrong_is_told_in_one_line(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(CalibrationError) as error:
        read_poses(written(tmp_path, text))

    assert said in str(error.value)
    assert str(error.value).startswith(str(tmp_path / "poses.csv"))
    assert "\n" not in str(error.value)


def test_a_file_that_is_not_there_is_told(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="there is no such file"):
        read_poses(tmp_path / "poses.csv")
