"""How far a clearance can be trusted, against cones in closed form."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.boards import look_at, make_camera
from helpers.cones import BOX_FACES, ball_extent, box_vertices, hull_of_balls, plate, views_from
from helpers.contacts import FREE
from helpers.hulls import ball_hull, ball_masks, ring_views
from helpers.records import make_camera_record, make_check, make_record
from numpy.typing import NDArray
from scipy.stats import binom, norm

from hybridve.calib.camera import Camera
from hybridve.calib.pose import moved_pose
from hybridve.calib.rig import Rig, RigCovariance
from hybridve.calib.verdict import RigTest
from hybridve.hull.contact.clearance import Clearance, ClearanceMeter
from hybridve.hull.contact.cones import metres_per_pixel
from hybridve.hull.contact.detect import Contact
from hybridve.hull.contact.outline_errors import DoubtSettings, OutlineErrors, outline_errors
from hybridve.hull.contact.uncertainty import ONE_SIDED_95, Doubt, Doubter, without_camera
from hybridve.hull.query.reference import contains_points
from hybridve.hull.query.silhouettes import Hull, Views, make_hull, make_views

CLOSELY = DoubtSettings(near_m=np.inf)

#: A phantom of two balls: the first camera sees it before ball B, the second before ball A.
BALL_A, BALL_B = np.array([-0.4, 0.1, 0.0]), np.array([0.5, -0.1, 0.0])
FIRST, SECOND = np.array([-0.6, -3.0, 0.0]), np.array([1.2, -2.8, 0.0])
PHANTOM = np.array([0.17828863, -0.94814815, 0.0])
ABOVE = np.array([0.2, 2.0, 2.4])  # sees both balls, and between them
BEHIND = PHANTOM + (BALL_A - PHANTOM) * 3.0 / np.linalg.norm(BALL_A - PHANTOM)  # sees A before it
RADIUS_M = 0.08


def errors_of(views: Views, segmentation_px: float = 1.0) -> OutlineErrors:
    n_cameras = len(views)
    return OutlineErrors(
        np.full(n_cameras, 0.3), np.ones(n_cameras, np.bool_), segmentation_px, np.zeros(n_cameras)
    )


def box_meter(center: NDArray[np.float64], half_m: float) -> ClearanceMeter:
    return ClearanceMeter(box_vertices(center, half_m), BOX_FACES, is_closed=True)


def doubt(
    hull: Hull,
    meter: ClearanceMeter,
    contact: Contact = FREE,
    errors: OutlineErrors | None = None,
) -> tuple[Doubt, Clearance]:
    """Doubt an object, looking closely however far away it is."""
    clearance = meter.measure(hull)
    frame = Doubter(errors or errors_of(hull.views), CLOSELY).frame(hull)
    return frame.doubt(meter, contact, clearance), clearance


def touching(point: NDArray[np.float64]) -> Contact:
    return replace(FREE, certificate="colliding", witness_world=point)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("n_cameras", "toward"),
    [(4, (1.0, 0.2, 0.1)), (5, (0.6, 0.3, 1.0)), (3, (0.3, -1.0, 0.5)), (6, (-0.5, 0.6, -0.2))],
)
def test_clearance_moves_with_the_outlines_as_the_cones_do(
    n_cameras: int, toward: tuple[float, float, float]
) -> None:
    views = ring_views(n_cameras, 1440, 972, 1400.0)
    center, radius_m = np.array([0.05, -0.1, 0.08]), 0.2
    normal = np.array(toward) / np.linalg.norm(toward)
    sigma_px = 2.0
    # Cones in closed form, opened and closed by two pixels: in turn, and all at once.
    opening = sigma_px / 1400.0 * np.concatenate([np.eye(n_cameras), np.ones((1, n_cameras))])
    extent_m = ball_extent(views, center, radius_m, normal, np.zeros(n_cameras))
    moved_m = 0.5 * np.array(
        [
            ball_extent(views, center, radius_m, normal, by)
            - ball_extent(views, center, radius_m, normal, -by)
            for by in opening
        ]
    )
    meter = ClearanceMeter(*plate(center + (extent_m + 0.3) * normal, normal), is_closed=False)
    errors = OutlineErrors(
        np.zeros(n_cameras), np.ones(n_cameras, np.bool_), sigma_px, np.zeros(n_cameras)
    )

    found, clearance = doubt(ball_hull(views, center, radius_m), meter, errors=errors)

    pixel_m = 3.5 / 1400.0
    assert clearance.upper_m == pytest.approx(0.3, abs=1.5 * pixel_m)
    assert found.m_per_px.sum() == pytest.approx(moved_m[-1] / sigma_px, rel=0.15)
    # Where cones all but meet, it is open which of them ends the hull; the fewest vary most.
    rounding = np.hypot(1.0, errors.quantisation_px / sigma_px)
    assert 0.85 < found.std_m / rounding / np.linalg.norm(moved_m[:-1]) < 1.45
    # Of all cones that may end the hull any may err: of six that were independent, by 2.39 sigma.
    least_m = clearance.lower_m - 2.39 * 1.45 * found.std_m
    assert least_m < found.at_least_m <= clearance.lower_m - ONE_SIDED_95 * found.std_m + 1e-12
    assert not found.is_remeasured


@pytest.mark.parametrize("n_level", [2, 3, 4])
def test_where_each_of_several_cameras_ends_the_hull_any_may_have_erred(n_level: int) -> None:
    """All cameras level with a ball see its top: the lowest of their outlines ends the hull."""
    angles = np.pi * np.arange(n_level) / n_level
    centers = [np.array([3.0 * np.cos(a), 3.0 * np.sin(a), 0.0]) for a in angles]
    views = views_from(centers, 1440, 972, 1400.0)
    up = np.array([0.0, 0.0, 1.0])
    meter = ClearanceMeter(*plate(0.5 * up, up), is_closed=False)
    errors = OutlineErrors(np.zeros(n_level), np.ones(n_level, np.bool_), 3.0, np.zeros(n_level))
    hull = ball_hull(views, np.zeros(3), 0.2)

    found = Doubter(errors).frame(hull).deviation(meter, meter.measure(hull))

    # The largest of n independent errors, each of one cone, at 95 % (Sidak).
    assert found.m_per_px.sum() == pytest.approx(3.0 / 1400.0, rel=0.1)
    sidak = norm.ppf(0.95 ** (1.0 / n_level))
    expected_m = sidak * errors.sigma_px[0] * found.m_per_px.sum()
    assert found.too_large_95_m == pytest.approx(expected_m, rel=0.05)


def test_a_cone_moves_by_the_pixel_of_its_depth() -> None:
    # Focal length 200 px and depth 4 m: 20 mm a pixel straight ahead. Off the axis by 45 degrees
    # (600 px beside the middle would be 71.6), sideways moves are seen foreshortened.
    views = views_from([np.array([0.0, -4.0, 0.0])], focal_px=200.0)

    ahead, _ = metres_per_pixel(views, 0, np.zeros(3), np.array([0.0, 0.0, 1.0]))
    beside, _ = metres_per_pixel(
        views, 0, np.array([4.0, 0.0, 0.0]), np.array([1.0, -1.0, 0.0]) / 2**0.5
    )

    assert ahead == pytest.approx(4.0 / 200.0)
    # A pixel at x = tan(a) spans cos(a)^2 / f radians; the point is 4 sqrt(2) m away.
    assert beside == pytest.approx(4.0 * 2**0.5 * 0.5 / 200.0)


def test_std_grows_in_proportion_to_the_errors_and_adds_up_in_squares() -> None:
    views = ring_views(4)
    hull = ball_hull(views, np.zeros(3), 0.2)
    meter = box_meter(np.array([0.5, 0.3, 0.2]), 0.1)
    one = OutlineErrors(np.full(4, 0.3), np.ones(4, np.bool_), 0.8, np.full(4, 0.2))
    none = OutlineErrors(np.zeros(4), np.ones(4, np.bool_), 0.0, np.zeros(4))
    thrice = replace(
        one, calibration_px=np.full(4, 0.9), segmentation_px=2.4, lens_px=np.full(4, 0.6)
    )

    std_m = [doubt(hull, meter, errors=errors)[0].std_m for errors in (one, none, thrice)]

    # Rounding to pixels stays as it is.
    variance = np.square(std_m) - std_m[1] ** 2
    assert variance[2] == pytest.approx(9.0 * variance[0])
    assert std_m[1] > 0
    assert one.sigma_px == pytest.approx(np.sqrt(0.09 + 0.64 + 0.04 + 1.0 / 12.0))


@pytest.mark.slow
def test_the_true_hull_is_at_least_so_far_away_in_95_percent_of_recordings() -> None:
    # Outlines and cameras are disturbed, drawn in pixels, and the true cones' hull is kept aside.
    rng = np.random.default_rng(4)
    errors_px = {"calibration_px": 0.7, "segmentation_px": 1.2}
    covered, pulls = [], []
    for _ in range(8):
        n_cameras = int(rng.integers(3, 6))
        views = ring_views(n_cameras, 360, 243, 350.0)
        center, radius_m = rng.uniform(-0.15, 0.15, 3), rng.uniform(0.1, 0.25)
        normal = rng.normal(size=3)
        normal /= np.linalg.norm(normal)
        extent_m = ball_extent(views, center, radius_m, normal, np.zeros(n_cameras))
        meter = ClearanceMeter(
            *plate(center + (extent_m + 0.15) * normal, normal), is_closed=False, tolerance_m=5e-4
        )
        errors = OutlineErrors(
            np.full(n_cameras, errors_px["calibration_px"]),
            np.ones(n_cameras, np.bool_),
            errors_px["segmentation_px"],
            np.zeros(n_cameras),
        )
        for _ in range(25):
            hull = _disturbed(rng, views, center, radius_m, **errors_px)
            clearance = meter.measure(hull)
            found = Doubter(errors).frame(hull).deviation(meter, clearance)
            covered.append(clearance.lower_m - found.too_large_95_m <= 0.15)
            pulls.append((clearance.upper_m - 0.15) / found.std_m)

    # Of a rule that is right in exactly 95 % of the cases, 999 of 1000 such tests pass.
    assert sum(covered) >= binom.ppf(0.001, len(covered), 0.95)
    # Nor is the doubt larger than need be: errors are what it says they are, within a third.
    assert 0.67 < np.std(pulls) < 1.33


@pytest.mark.slow
def test_a_rig_that_knows_its_covariance_tells_how_clearances_scatter() -> None:
    """Cameras that err together: the hull of where they are thought to be, over many rigs."""
    rng = np.random.default_rng(8)
    center, radius_m, n_cameras = np.array([0.05, 0.0, 0.1]), 0.2, 4
    cameras = [
        make_camera(
            f"cam{number}",
            "PINHOLE",
            look_at((3.0 * np.cos(a), 3.0 * np.sin(a), 0.8), (0.0, 0.0, 0.0)),
        )
        for number, a in enumerate(2.0 * np.pi * (np.arange(n_cameras) + 0.2) / n_cameras)
    ]
    size = 10 * n_cameras
    # Errors that all cameras share (they turn alike about the vertical), and some of their own.
    shared = np.zeros((size, 1))
    for number, camera in enumerate(cameras):
        axis = camera.cam_from_world[:, :3] @ [0.0, 0.0, 1.0]
        at = camera.cam_from_world[:, 3]
        shared[10 * number : 10 * number + 6, 0] = 0.002 * np.concatenate(
            [axis, -np.cross(axis, at)]
        )
        shared[10 * number + 1, 0] += 0.001
    own = np.tile([0.0004, 0.0004, 0.0004, 0.001, 0.001, 0.001, 0.5, 0.5, 0.3, 0.3], n_cameras)
    rig = Rig(
        tuple(cameras),
        covariance=RigCovariance(
            tuple(f"cam{index // 10} {index % 10}" for index in range(size)),
            shared @ shared.T + np.diag(own**2),
        ),
    )
    normal = np.array([0.8, 0.3, 0.2]) / np.linalg.norm([0.8, 0.3, 0.2])
    meter = ClearanceMeter(*plate(center + 0.4 * normal, normal), is_closed=False, tolerance_m=2e-4)
    names = tuple(camera.name for camera in cameras)
    found_m, stated_m = [], []
    errors = outline_errors(names, rig, [0.0] * n_cameras, DoubtSettings(segmentation_px=0.0))
    believed = _views_of(cameras)
    for _ in range(60):
        change = shared[:, 0] * rng.normal() + own * rng.normal(size=size)
        true = [_changed(camera, change[10 * k : 10 * k + 10]) for k, camera in enumerate(cameras)]
        hull = make_hull(believed, ball_masks(_views_of(true), center, radius_m))
        clearance = meter.measure(hull)
        sensitivity_m, _, normals_px = Doubter(errors).frame(hull).sensitivity(meter, clearance)
        variance = errors.calibration_variance_m2(
            clearance.on_hull_world, sensitivity_m, normals_px
        )
        found_m.append(clearance.upper_m)
        stated_m.append(np.sqrt(variance))

    import sys

    sys.stderr.write(f"{np.std(found_m)} {np.mean(stated_m)} {np.mean(found_m)}\n")
    # 60 draws tell a standard deviation to 9 %; pixels add 0.3 px each, which is little here.
    assert np.std(found_m) == pytest.approx(np.sqrt(np.mean(np.square(stated_m))), rel=0.35)
    # Taken to be independent, the same images would scatter otherwise.
    assert errors.sigma_px == pytest.approx(np.full(n_cameras, errors.quantisation_px))


def _views_of(cameras: list[Camera]) -> Views:
    return make_views(
        tuple(camera.name for camera in cameras),
        np.array([(camera.width_px, camera.height_px) for camera in cameras]),
        np.array([camera.pinhole @ camera.cam_from_world for camera in cameras]),
    )


def _changed(camera: Camera, change: NDArray[np.float64]) -> Camera:
    pose = moved_pose(camera.cam_from_world, change[:6])
    return replace(camera, cam_from_world=pose, params=camera.params + change[6:])


def _disturbed(
    rng: np.random.Generator,
    views: Views,
    center: NDArray[np.float64],
    radius_m: float,
    calibration_px: float,
    segmentation_px: float,
) -> Hull:
    """Return the hull that cameras a little beside where they are thought to be make of a ball."""
    masks = []
    for camera in range(len(views)):
        moved = views.img_from_local.copy()
        moved[camera, :2] += rng.normal(0.0, calibration_px, 2)[:, None] * moved[camera, 2]
        there = replace(without_others(views, camera), img_from_local=moved[[camera]])
        matrix = views.img_from_local[camera]
        camera_world = views.origin_world - np.linalg.solve(matrix[:, :3], matrix[:, 3])
        distance_m = float(np.linalg.norm(center - camera_world))
        opening = np.arcsin(radius_m / distance_m) + rng.normal(0.0, segmentation_px) / 350.0
        masks += ball_masks(there, center, distance_m * np.sin(opening))
    return make_hull(views, masks)


def without_others(views: Views, camera: int) -> Views:
    return Views(
        (views.names[camera],),
        views.sizes_px[[camera]],
        views.img_from_local[[camera]],
        views.origin_world,
    )


def test_where_outlines_explain_nothing_the_clearance_is_measured_again() -> None:
    # One pixel of one camera: no outline has a direction there.
    views = ring_views(3)
    masks = ball_masks(views, np.zeros(3), 0.2)
    masks[0][:] = 0
    masks[0][240:242, 360:362] = 1
    hull = make_hull(views, masks)
    meter = box_meter(np.array([0.0, 0.0, 0.5]), 0.05)

    found, clearance = doubt(hull, meter)

    assert found.is_remeasured
    bigger = masks[0].copy()
    bigger[239:243, 359:363] = 1
    moved = meter.measure(make_hull(views, [bigger, *masks[1:]]))
    assert found.m_per_px[0] == pytest.approx(clearance.upper_m - moved.upper_m, abs=1e-12)


def test_a_clearance_that_one_camera_alone_keeps_hinges_on_it() -> None:
    hull = hull_of_balls(
        views_from([FIRST, SECOND, ABOVE]), [(BALL_A, RADIUS_M), (BALL_B, RADIUS_M)]
    )

    found, clearance = doubt(hull, box_meter(PHANTOM, 0.03))
    beyond, _ = doubt(hull, box_meter(np.array([0.05, 0.0, 1.0]), 0.03))

    assert clearance.lower_m > 0.3
    assert (found.survives, found.hinges_on) == (False, ("cam2",))
    assert (beyond.survives, beyond.hinges_on) == (True, ())


@pytest.mark.parametrize(
    ("near_m", "required_m", "is_close"),
    [(0.1, 0.0, False), (0.5, 0.0, True), (0.1, 0.2, True), (0.1, 0.1, False), (0.0, 0.0, False)],
)
def test_what_is_far_away_is_not_looked_at_closely_and_nothing_is_claimed_of_it(
    near_m: float, required_m: float, is_close: bool
) -> None:
    hull = ball_hull(ring_views(4), np.zeros(3), 0.2)
    meter = box_meter(np.array([0.0, 0.0, 0.6]), 0.05)
    clearance = meter.measure(hull)
    assert 0.2 < clearance.lower_m < 0.4
    closely, _ = doubt(hull, meter)

    frame = Doubter(errors_of(hull.views), DoubtSettings(near_m=near_m)).frame(hull)
    found = frame.doubt(meter, FREE, clearance, required_m)

    np.testing.assert_array_equal(found.m_per_px, closely.m_per_px)
    same = (found.std_m, found.at_least_m, found.n_seeing)
    assert same == (closely.std_m, closely.at_least_m, closely.n_seeing)
    close = (found.survives, found.hinges_on, found.component)
    if is_close:
        assert close == (closely.survives, closely.hinges_on, closely.component)
        assert found.real_upper_m == closely.real_upper_m >= clearance.lower_m
    else:
        assert close == (None, (), "")
        assert np.isnan(found.real_upper_m)


def test_what_clashes_is_always_looked_at_closely() -> None:
    hull = ball_hull(ring_views(4), np.zeros(3), 0.1)
    settings = DoubtSettings(near_m=0.0)
    for half_m, contact in ((0.05, touching(np.zeros(3))), (0.3, FREE)):  # touched; around it
        meter = box_meter(np.zeros(3), half_m)

        frame = Doubter(errors_of(hull.views), settings).frame(hull)
        found = frame.doubt(meter, contact, meter.measure(hull))

        assert (found.survives, found.component) == (True, "real")
        assert np.isfinite(found.real_upper_m)


def test_a_contact_with_a_phantom_is_unsure_and_one_with_a_ball_is_real() -> None:
    hull = hull_of_balls(
        views_from([FIRST, SECOND, BEHIND]), [(BALL_A, RADIUS_M), (BALL_B, RADIUS_M)]
    )

    of_phantom, _ = doubt(hull, box_meter(PHANTOM, 0.03), touching(PHANTOM))
    of_ball, _ = doubt(hull, box_meter(BALL_B, 0.03), touching(BALL_B))
    beside_ball, _ = doubt(hull, box_meter(BALL_B + np.array([0.0, 0.0, 0.3]), 0.03))

    assert of_phantom.component == "unsure"
    assert of_phantom.survives, "a camera only carves"
    assert of_phantom.n_seeing == 3
    assert of_ball.component == beside_ball.component == "real"
    # The nearest thing that must be real is a ball.
    nearest_m = min(np.linalg.norm(PHANTOM - ball) for ball in (BALL_A, BALL_B)) - RADIUS_M
    assert of_phantom.real_upper_m > nearest_m - 0.06


def test_a_contact_in_the_middle_of_a_ball_is_certainly_real() -> None:
    views = views_from([FIRST, SECOND, ABOVE])
    hull = hull_of_balls(views, [(BALL_A, 0.02)])
    meter = box_meter(BALL_A, 0.15)

    found, clearance = doubt(hull, meter)  # swallowed: no sample of the surface is in the hull

    assert clearance.depth_lower_m > 0.1
    assert found.real_upper_m == 0.0
    assert found.at_least_m == 0.0
    assert found.survives
    assert found.component == "real"


def test_with_one_camera_everything_hinges_on_it() -> None:
    views = views_from([FIRST])
    hull = hull_of_balls(views, [(BALL_A, RADIUS_M)])

    contact, _ = doubt(hull, box_meter(BALL_A, 0.03), touching(BALL_A))
    free, _ = doubt(hull, box_meter(np.array([0.3, 0.0, 0.5]), 0.03))

    assert contact.hinges_on == free.hinges_on == ("cam0",)
    with pytest.raises(ValueError, match="one camera"):
        without_camera(hull, 0)


def test_a_contact_that_too_few_cameras_would_see_hinges_on_those_that_do() -> None:
    # The third camera looks past the ball, and abstains.
    aside = views_from([FIRST, SECOND, ABOVE])
    turned = aside.img_from_local.copy()
    turned[2, 0] += 1000.0 * turned[2, 2]
    views = replace(aside, img_from_local=turned, unseen="keep", min_cameras=2)
    masks = [*ball_masks(aside, BALL_A, RADIUS_M)[:2], np.zeros((480, 640), np.uint8)]
    hull = make_hull(views, masks)
    assert contains_points(hull, BALL_A[None])[0]

    found, _ = doubt(hull, box_meter(BALL_A, 0.03), touching(BALL_A))

    assert found.n_seeing == 2
    assert (found.survives, found.hinges_on) == (False, ("cam0", "cam1"))


def test_without_a_camera_the_hull_is_that_of_the_others() -> None:
    hull = hull_of_balls(
        views_from([FIRST, SECOND, ABOVE]), [(BALL_A, RADIUS_M), (BALL_B, RADIUS_M)]
    )
    points = np.random.default_rng(0).uniform(-1.0, 1.0, (20_000, 3)) * [1.0, 1.0, 0.1]

    fewer = without_camera(hull, 1)

    expected = hull_of_balls(views_from([FIRST, ABOVE]), [(BALL_A, RADIUS_M), (BALL_B, RADIUS_M)])
    np.testing.assert_array_equal(contains_points(fewer, points), contains_points(expected, points))
    assert contains_points(fewer, points).sum() > contains_points(hull, points).sum() > 0


def test_no_hull_no_doubt() -> None:
    views = ring_views()
    hull = make_hull(views, [np.zeros((486, 720), np.uint8)] * 4)

    found, clearance = doubt(hull, box_meter(np.zeros(3), 0.1))

    assert clearance.upper_m == np.inf
    assert np.isnan(found.std_m)
    assert np.isnan(found.at_least_m)
    assert found.real_upper_m == np.inf
    assert (found.n_seeing, found.component, found.survives) == (0, "", True)


def test_errors_come_from_the_rig_where_it_tells_them() -> None:
    pose = look_at((1.0, 2.0, 3.0), (0.0, 0.0, 0.0))
    cameras = tuple(make_camera(name, "PINHOLE", pose) for name in ("a", "b"))
    cameras_told = {"a": make_camera_record(0.4, 0.1), "b": make_camera_record(None, 0.2)}
    of_calibration = Rig(cameras, make_record((), cameras=cameras_told))
    of_check = Rig(cameras, check=RigTest("agrees", "", make_check(rms_px={"a": 2.0})))
    settings = DoubtSettings(segmentation_px=0.6, calibration_px=0.9)

    calibrated = outline_errors(("a", "b"), of_calibration, (0.0, 0.6), settings)
    checked = outline_errors(("a", "b"), of_check, (0.5, None), settings)

    np.testing.assert_allclose(calibrated.calibration_px, np.array([0.4, 0.2]) / 2**0.5)
    assert calibrated.is_measured.tolist() == [True, True]
    np.testing.assert_allclose(calibrated.lens_px, np.array([0.0, 0.6]) / 3**0.5)
    np.testing.assert_allclose(checked.calibration_px, [2**0.5, 0.9])
    assert checked.is_measured.tolist() == [True, False]
    np.testing.assert_allclose(checked.lens_px, np.array([0.5, 1.0]) / 3**0.5)
    assert checked.segmentation_px == 0.6
