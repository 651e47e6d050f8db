"""What a certificate says of single parameters: by how far they move points, and of twins."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.boards import board_poses, look_at, observe_exactly, project, ring
from helpers.records import make_record
from helpers.thorough import asked
from hypothesis import given, settings
from hypothesis import strategies as st

from hybridve.calib.boards.board import Sighting
from hybridve.calib.boards.target import Chessboard
from hybridve.calib.calibrate import solve_rig
from hybridve.calib.camera import Camera
from hybridve.calib.judging.certificate import Certificate, certify, working_volume
from hybridve.calib.lens import img_from_cam, parameter_names
from hybridve.calib.pose import transform
from hybridve.calib.rig import Rig, RigCovariance
from hybridve.calib.solving.bundle import POSE
from hybridve.calib.solving.covariance import camera_parameter_names
from hybridve.calib.solving.errors_in_space import parameter_slices

CAMERAS = ring(Chessboard(7, 6, 0.1), ["OPENCV"] * 3)

#: How a first derivative differs from a whole step, as a share.
_LINEAR = 0.05


def with_covariance(cameras: list[Camera], entries: dict[tuple[str, str], float]) -> Rig:
    """Return a rig with a covariance of which only these entries, by label, are not zero."""
    labels = tuple(f"{c.name} {name}" for c in cameras for name in camera_parameter_names(c))
    matrix = np.zeros((len(labels), len(labels)))
    for (one, other), value in entries.items():
        i, j = labels.index(one), labels.index(other)
        matrix[i, j] = matrix[j, i] = value
    return Rig(tuple(cameras), covariance=RigCovariance(labels, matrix))


def certified(rig: Rig) -> Certificate:
    return certify(rig, make_record([one.name for one in rig.cameras]), {}, working_volume(rig))


@settings(max_examples=asked(16))
@given(
    index=st.integers(0, 7),
    factor=st.floats(0.05, 20.0),
)
def test_a_parameter_that_is_off_alone_is_undetermined_if_it_moves_a_pixel(
    index: int, factor: float
) -> None:
    """Closed form: the lens with the parameter moved, against the lens as it is."""
    camera = CAMERAS[0]
    name = parameter_names(camera.model)[index]
    step = 1e-5
    volume = working_volume(Rig(tuple(CAMERAS)))

    def image(params: np.ndarray, points_cam: np.ndarray) -> np.ndarray:
        return img_from_cam(replace(camera, params=params), points_cam)

    points_cam = transform(camera.cam_from_world, volume.points_world)
    nudged = camera.params.copy()
    nudged[index] += step
    moves = (image(nudged, points_cam) - image(camera.params, points_cam)) / step
    lengths = np.linalg.norm(moves, axis=1)
    # Within the image the volume's points are some of all; the others can only move further.
    inside = image(camera.params, points_cam)
    within = ((inside > 0) & (inside < (camera.width_px, camera.height_px))).all(axis=1)
    of_volume = float(np.quantile(lengths[within], 0.95))
    sigma = factor / of_volume
    label = f"cam1 {name}"

    told = certified(with_covariance(CAMERAS, {(label, label): sigma**2})).cameras[0]

    assert set(told.moved_px) == {name}
    assert told.moved_px[name] >= factor * (1.0 - _LINEAR)
    assert told.undetermined == ((name,) if told.moved_px[name] > 1.0 else ())


def test_it_makes_no_difference_how_well_the_rest_of_the_image_is_known() -> None:
    """A ratio to the image's median called a lens undetermined because its middle is known well."""
    label = "cam1 k2"
    small = {(label, label): 0.0035**2}
    unsure = {(f"cam1 {name}", f"cam1 {name}"): 0.01**2 for name in ("rx", "ry", "rz")}

    for entries in (small, small | unsure):
        certificate = certified(with_covariance(CAMERAS, entries))

        assert certificate.cameras[0].undetermined == ()
        assert certificate.cameras[0].moved_px["k2"] < 1.0
        assert not any("not determined" in warning for warning in certificate.warnings)


def test_what_a_pose_makes_up_for_is_determined() -> None:
    """A principal point that is off by 3 pixels with a turn that takes 3 pixels back."""
    fx = CAMERAS[0].params[0]
    alone = {("cam1 cx", "cam1 cx"): 9.0}
    tied = alone | {
        ("cam1 ry", "cam1 ry"): (3.0 / fx) ** 2,
        ("cam1 cx", "cam1 ry"): -9.0 / fx,
    }

    apart = certified(with_covariance(CAMERAS, alone)).cameras[0]
    made_up = certified(with_covariance(CAMERAS, tied)).cameras[0]

    assert apart.moved_px["cx"] == pytest.approx(3.0, rel=_LINEAR)
    assert apart.undetermined == ("cx",)
    # A turn shifts the edges of an image by more than its middle: what is left is that.
    assert made_up.moved_px["cx"] < 0.6 * apart.moved_px["cx"]


def test_the_warning_says_how_far_points_move() -> None:
    label = "cam2 fx"

    certificate = certified(with_covariance(CAMERAS, {(label, label): 20.0**2}))

    told = certificate.cameras[1]
    assert told.undetermined == ("fx",)
    (warning,) = (one for one in certificate.warnings if "not determined" in one)
    assert warning.startswith("cam2: fx is not determined (one standard deviation of fx moves")
    assert f"{told.moved_px['fx']:.1f} px" in warning
    assert "cam2's fx is not determined" in certificate.verdict


@pytest.mark.slow
def test_a_lens_of_which_only_the_middle_was_seen_is_undetermined_and_its_neighbours_are_not() -> (
    None
):
    """By pictures: twelve boards all over the image, or far away in its middle."""
    board = Chessboard(7, 6, 0.1)
    observations = observe_exactly(board, CAMERAS, noise_px=0.2)
    rng = np.random.default_rng(5)
    middle = []
    for number, pose in enumerate(board_poses(board, 12, 1)):
        center = pose @ np.append(board.center_board, 1.0)
        far = pose.copy()
        far[:, 3] += 3.0 * np.array([0.0, 0.0, center[2]]) - center * [1.0, 1.0, 0.0]
        pixels = project(CAMERAS[1], far, board)
        pixels += rng.normal(0.0, 0.2, pixels.shape)
        middle.append(Sighting(f"{number}.png", None, 0, pixels))
    clip = observations[1].sightings[-1]
    observations[1] = replace(observations[1], sightings=(*middle, clip))

    calibration = solve_rig([board], observations)
    certificate = certified(calibration.rig)

    whole, part, other = certificate.cameras
    assert whole.undetermined == other.undetermined == ()
    assert set(part.undetermined) & {"k1", "k2"}
    for told in certificate.cameras:
        assert (max(told.moved_px.values()) > 1.0) == bool(told.undetermined)


def test_parameters_that_were_given_are_not_told() -> None:
    certificate = certified(with_covariance(CAMERAS, {}))

    assert all(told.moved_px == {} and told.undetermined == () for told in certificate.cameras)
    assert parameter_slices(CAMERAS)[0] == slice(0, POSE + 8)


def test_cameras_with_one_view_are_a_doubt() -> None:
    """What one clip shows was counted twice: the errors that are stated are too small."""
    twin = replace(CAMERAS[1], name="again")

    certificate = certified(with_covariance([*CAMERAS, twin], {}))

    (doubt,) = certificate.doubts
    assert "'cam2' and 'again' stand in one place and have one view" in doubt
    assert certificate.verdict.startswith("not to be trusted: ")
    assert certified(with_covariance(CAMERAS, {})).doubts == ()


def test_of_cameras_that_look_one_way_the_volume_lies_where_the_boards_were() -> None:
    """Axes that are 1 degree apart meet 29 m away; the boards were 2 m before the cameras."""
    boards_world = np.random.default_rng(1).uniform((-0.3, 1.7, -0.3), (0.3, 2.3, 0.3), (60, 3))
    cameras = [
        replace(
            CAMERAS[0],
            name=name,
            cam_from_world=look_at(
                (x_m, 0.0, 0.0), (0.0, 0.25 / float(np.tan(np.radians(0.5))), 0.0)
            ),
        )
        for name, x_m in (("left", -0.25), ("right", 0.25))
    ]
    rig = with_covariance(cameras, {("left tx", "left tx"): 1e-6})

    far = working_volume(rig)
    near = working_volume(rig, boards_world)

    assert far.about == "axes"
    assert far.low_world[1] > boards_world[:, 1].max()
    assert near.about == "boards"
    assert (near.low_world < boards_world.min(axis=0)).all()
    assert (near.high_world > boards_world.max(axis=0)).all()
    # The nearer of two places has the smaller error where depth is what is not known.
    told = certify(rig, make_record(["left", "right"]), {}, near, boards_world)
    assert told.boards_error95_m <= told.largest_error95_m
    assert told.boards_error95_m < certified(rig).error95_m / 5.0


def test_where_axes_meet_about_the_boards_the_volume_is_what_the_cameras_look_at() -> None:
    rig = Rig(tuple(CAMERAS))
    middle = working_volume(rig).points_world.mean(axis=0)

    about = working_volume(rig, middle + np.array([[0.1, 0.0, 0.0], [0.0, 0.2, 0.0]]))

    assert about.about == "axes"
    assert np.array_equal(about.points_world, working_volume(rig).points_world)
