"""Pictures: who obscures whom, what is red, and what is written."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.hulls import ring_views
from helpers.view_scene import (
    BALL_RADIUS_M,
    HEIGHT_PX,
    WIDTH_PX,
    ball_scene,
    box,
    is_blue_grey,
    is_red,
    is_warm_grey,
    pixels_of,
    ring_rig,
    touched_box,
    view_from,
)
from numpy.typing import NDArray

from hybridve.calib.camera import Camera
from hybridve.calib.errors import ReportError
from hybridve.calib.lens import project_points
from hybridve.calib.rig import Rig
from hybridve.hull.query.silhouettes import Hull, make_hull
from hybridve.hull.view.drawn import Marks, Measure
from hybridve.hull.view.picture import (
    HeatScale,
    choose_viewpoint,
    contact_sheet,
    draw_overlay,
    draw_picture,
    sheet_layout,
    write_picture,
)

pytestmark = pytest.mark.gl

SIZE_PX = (320, 200)

#: The middle of the picture, where the viewpoints below look at the ball. No text stands there.
MIDDLE = (slice(90, 110), slice(150, 170))

#: Share of these pixels that has the colour of what is seen: axes and their names pass before it.
MOST = 0.75


@pytest.fixture(scope="module")
def scene() -> tuple[Hull, Rig]:
    return ball_scene()


def empty_hull() -> Hull:
    views = ring_views(4)
    return make_hull(views, [np.zeros((HEIGHT_PX, WIDTH_PX), np.uint8)] * 4)


def test_the_hull_stands_in_the_middle(scene: tuple[Hull, Rig]) -> None:
    image = draw_picture(*scene, [], viewpoint=view_from(3, -2, 1.5), size_px=SIZE_PX)

    assert image.shape == (200, 320, 3)
    assert image.dtype == np.uint8
    assert is_warm_grey(image[MIDDLE]).mean() > MOST


def test_an_object_in_front_hides_the_hull(scene: tuple[Hull, Rig]) -> None:
    front = box("front", (1.0, 0.0, 0.0), 0.4)

    image = draw_picture(*scene, [front], viewpoint=view_from(4, 0, 0), size_px=SIZE_PX)

    assert is_blue_grey(image[MIDDLE]).mean() > MOST


def test_the_hull_hides_an_object_behind(scene: tuple[Hull, Rig]) -> None:
    behind = box("behind", (-1.0, 0.0, 0.0), 0.4)

    image = draw_picture(*scene, [behind], viewpoint=view_from(4, 0, 0), size_px=SIZE_PX)

    assert is_warm_grey(image[MIDDLE]).mean() > MOST


def test_an_object_half_in_the_hull_is_cut_by_its_surface(scene: tuple[Hull, Rig]) -> None:
    """A long bar through the ball: seen beside it, hidden in it."""
    bar = box("bar", (0.0, 0.0, 0.0), (0.1, 1.4, 0.1))

    image = draw_picture(*scene, [bar], viewpoint=view_from(4, 0, 0), size_px=SIZE_PX)

    assert is_warm_grey(image[MIDDLE]).mean() > MOST
    middle_row = image[100]
    # The ball spans 0.8 of the bar's 1.4 m; perspective and rims cost a little.
    assert is_blue_grey(middle_row).sum() > 0.3 * is_warm_grey(middle_row).sum()


@pytest.mark.slow
def test_what_touches_is_red_and_what_is_free_is_not(scene: tuple[Hull, Rig]) -> None:
    """A box dips into the ball; the same box is drawn as if it were free."""
    view = view_from(3, 1.5, 1.5)
    touched = touched_box("box", scene[0], (0.35, 0.2, 0.2))
    free = box("box", (0.35, 0.2, 0.2), 0.3)

    red = is_red(draw_picture(*scene, [touched], viewpoint=view, size_px=SIZE_PX))
    none = is_red(draw_picture(*scene, [free], viewpoint=view, size_px=SIZE_PX))

    # The world's x axis and the legend are drawn in red too: only the middle counts.
    assert red[50:150, 110:210].sum() > 50
    assert none[50:150, 110:210].sum() == 0


@pytest.mark.slow
def test_what_a_lamp_does_not_reach_is_darker_triangle_by_triangle(scene: tuple[Hull, Rig]) -> None:
    front = box("front", (1.0, 0.0, 0.0), 0.4)
    view, count = view_from(4, 0, 0), len(front.faces)

    def drawn(share_lit: NDArray[np.float64] | None) -> NDArray[np.float64]:
        item = replace(front, share_lit=share_lit)
        image = draw_picture(*scene, [item], viewpoint=view, size_px=SIZE_PX)
        return np.asarray(image[MIDDLE], np.float64)

    plain, lit, dark = drawn(None), drawn(np.ones(count)), drawn(np.zeros(count))
    half = drawn(np.full(count, 0.5))

    np.testing.assert_array_equal(plain, lit)
    # Colours are multiplied as they are encoded: 0.55 in the dark, and half-way 0.775.
    is_face = is_blue_grey(lit.astype(np.uint8))
    assert is_face.mean() > MOST
    assert np.median(dark[is_face] / lit[is_face]) == pytest.approx(0.55, abs=0.02)
    assert np.median(half[is_face] / lit[is_face]) == pytest.approx(0.775, abs=0.02)


def test_touching_triangles_shine_through_the_hull(scene: tuple[Hull, Rig]) -> None:
    inside = touched_box("inside", scene[0], (0.0, 0.0, 0.0))

    image = draw_picture(*scene, [inside], viewpoint=view_from(4, 0, 0), size_px=SIZE_PX)

    red, blue = (image[MIDDLE][..., channel].astype(int) for channel in (2, 0))
    assert (red > 1.3 * blue).mean() > 0.7  # collision points and edges are darker


def test_an_empty_hull_is_drawn(scene: tuple[Hull, Rig]) -> None:
    _, rig = scene
    image = draw_picture(empty_hull(), rig, [box("alone", (0, 0, 0))], size_px=SIZE_PX)

    assert is_blue_grey(image).sum() > 100


def test_nothing_but_cameras_is_drawn(scene: tuple[Hull, Rig]) -> None:
    image = draw_picture(empty_hull(), scene[1], [], size_px=SIZE_PX)

    assert image.std() > 1


def test_an_object_around_the_viewer_is_cut_where_it_passes_behind(
    scene: tuple[Hull, Rig],
) -> None:
    """A slab from in front of the viewer to behind: its front end hides the ball."""
    slab = box("slab", (3.0, 0.0, 0.4), (4.0, 2.0, 0.02))

    image = draw_picture(*scene, [slab], viewpoint=view_from(4, 0, 0), size_px=SIZE_PX)

    assert is_blue_grey(image[24:48, 120:180]).mean() > MOST
    assert is_warm_grey(image[MIDDLE]).mean() > MOST


@pytest.mark.slow
def test_title_and_caption_stand_above(scene: tuple[Hull, Rig]) -> None:
    view = view_from(3, -2, 1.5)
    without = draw_picture(*scene, [], viewpoint=view, size_px=SIZE_PX)
    with_text = draw_picture(
        *scene, [], viewpoint=view, size_px=SIZE_PX, title="Frame 7", caption="nothing is touched"
    )

    changed = (without != with_text).any(axis=2)
    assert changed[:24].any()
    assert not changed[24:].any()


def test_the_chosen_view_shows_what_touches(scene: tuple[Hull, Rig]) -> None:
    """The touching side faces away from the x axis: the view goes there."""
    hull, rig = scene
    touching = box("left", (-0.45, 0.0, 0.0), 0.2, hits=(8, 9))  # the faces at smallest x

    viewpoint = choose_viewpoint(hull, rig, [touching])

    assert viewpoint.eye_world[0] < -0.5
    assert viewpoint.eye_world[2] > 0


def test_the_chosen_view_holds_hull_and_objects(scene: tuple[Hull, Rig]) -> None:
    hull, rig = scene
    far = box("far", (1.5, 1.0, 0.0))

    viewpoint = choose_viewpoint(hull, rig, [far])

    ball = BALL_RADIUS_M * np.concatenate([np.eye(3), -np.eye(3)])
    for points in (far.vertices_world, ball):
        pixels = pixels_of(viewpoint, points, (1600, 1000))
        assert ((pixels > 0) & (pixels < (1600, 1000))).all()


def bent_camera() -> Camera:
    """Return a camera at the origin that looks along z through a lens that bends inwards."""
    return Camera(
        "bent",
        "OPENCV",
        640,
        480,
        np.array([500.0, 500.0, 320.0, 240.0, -0.25, 0.05, 0.0, 0.0]),
        np.eye(3, 4),
    )


def test_the_overlay_puts_the_object_where_the_lens_puts_it() -> None:
    camera = bent_camera()
    drawn = box("aside", (0.9, 0.5, 2.0), 0.2)
    grey = np.full((480, 640, 3), 128, np.uint8)

    image = draw_overlay(grey, camera, np.zeros((480, 640), np.uint8), [drawn])

    changed = (image != 128).any(axis=2)
    changed[:60, :160] = False  # the camera's name
    pixels, _ = project_points(camera, drawn.vertices_world)
    rows, columns = np.nonzero(changed)
    # The rim is drawn a pixel to either side.
    assert columns.min() == pytest.approx(pixels[:, 0].min(), abs=2)
    assert columns.max() == pytest.approx(pixels[:, 0].max(), abs=2)
    assert rows.min() == pytest.approx(pixels[:, 1].min(), abs=2)
    assert rows.max() == pytest.approx(pixels[:, 1].max(), abs=2)


def test_the_overlay_bends_a_long_straight_edge() -> None:
    """A bar across the image is drawn where the lens puts its middle and its ends."""
    camera = bent_camera()
    bar = box("bar", (0.0, 0.6, 2.0), (2.0, 0.02, 0.02))
    grey = np.full((480, 640, 3), 128, np.uint8)

    image = draw_overlay(grey, camera, np.zeros((480, 640), np.uint8), [bar])

    expected, _ = project_points(camera, np.array([[0.0, 0.6, 2.0], [0.9, 0.6, 2.0]]))
    for column, row in expected:
        rows = np.flatnonzero((image[:, int(column)] != 128).any(axis=1))
        assert abs(rows.mean() - row) < 4  # the bar is 5 px thick
    assert abs(expected[0, 1] - expected[1, 1]) > 5, "the lens bends too little to tell"


def test_the_overlay_leaves_out_what_is_behind_the_camera() -> None:
    grey = np.full((480, 640, 3), 128, np.uint8)
    silhouette = np.zeros((480, 640), np.uint8)

    behind = draw_overlay(grey, bent_camera(), silhouette, [box("behind", (0, 0, -2.0))])
    nothing = draw_overlay(grey, bent_camera(), silhouette, [])

    np.testing.assert_array_equal(behind, nothing)


def test_the_overlay_shows_silhouette_and_collision() -> None:
    grey = np.full((480, 640, 3), 128, np.uint8)
    silhouette = np.zeros((480, 640), np.uint8)
    cv2.circle(silhouette, (320, 240), 100, 255, -1)
    touched = box("touched", (0, 0, 2.0), hits=tuple(range(12)))
    free = box("free", (0, 0, 2.0))

    image = draw_overlay(grey, bent_camera(), silhouette, [touched])

    blue, green, red = (image[240, 218:223, channel].astype(int) for channel in range(3))
    assert (green > np.maximum(red, blue) + 40).any(), "the outline passes here"
    middle = (slice(235, 245), slice(315, 325))
    plain = draw_overlay(grey, bent_camera(), silhouette, [free])
    assert (image[middle][..., 2] > 1.3 * image[middle][..., 0]).mean() > MOST
    assert (plain[middle][..., 2] < plain[middle][..., 0]).all()


def test_what_the_hull_hides_is_faint_in_the_overlay() -> None:
    """The left half of the image has the hull before the box, the right half behind it."""
    grey = np.full((480, 640, 3), 128, np.uint8)
    depth_m = np.full((480, 640), 1.0, np.float32)
    depth_m[:, 320:] = 4.0
    nothing = np.zeros((480, 640), np.uint8)

    image = draw_overlay(
        grey, bent_camera(), nothing, [box("half", (0, 0, 2.0), 0.4)], hull_depth_m=depth_m
    )

    changed = np.abs(image.astype(int) - 128).sum(axis=2)
    left, right = changed[220:260, 290:310], changed[220:260, 330:350]
    assert left.mean() > 0
    assert left.mean() < 0.4 * right.mean()


def test_a_clearance_is_a_line_between_its_points_with_its_number() -> None:
    camera = bent_camera()
    start, end = np.array([-0.3, 0.2, 2.0]), np.array([0.3, 0.2, 2.0])
    grey = np.full((480, 640, 3), 128, np.uint8)
    nothing = np.zeros((480, 640), np.uint8)

    def drawn(text: str) -> NDArray[np.uint8]:
        measure = Measure(start, end, text, (0.0, 0.0, 1.0))
        return draw_overlay(grey, camera, nothing, [], measures=(measure,))

    bare, told = drawn(""), drawn("464.4 mm")
    blue = (bare[..., 0] > 200) & (bare[..., 2] < 60)
    rows, columns = np.nonzero(blue)
    expected, _ = project_points(camera, np.stack([start, end]))
    assert columns.min() == pytest.approx(expected[0, 0], abs=2)
    assert columns.max() == pytest.approx(expected[1, 0], abs=2)
    assert np.abs(rows - expected[:, 1].mean()).max() < 4
    assert (told != bare).any(axis=2).sum() > 200


def test_a_measure_is_drawn_into_the_scene_from_end_to_end(scene: tuple[Hull, Rig]) -> None:
    ends = np.array([[0.0, -0.6, 0.3], [0.0, 0.6, 0.3]])
    measure = Measure(ends[0], ends[1], "12 mm", (0.0, 1.0, 0.0))
    view = view_from(4, 0, 0)

    image = draw_picture(
        *scene, [], viewpoint=view, size_px=SIZE_PX, marks=Marks(measures=(measure,))
    )

    green = (image[..., 1] > 180) & (image[..., 0] < 90) & (image[..., 2] < 90)
    _, columns = np.nonzero(green)
    expected = pixels_of(view, ends, SIZE_PX)[:, 0]
    assert columns.min() == pytest.approx(expected.min(), abs=3)
    assert columns.max() == pytest.approx(expected.max(), abs=3)


def test_the_warmth_of_a_part_is_the_colour_of_its_scale(scene: tuple[Hull, Rig]) -> None:
    """A box that is cold at one side and hot at the other, by the brightness of the red in it."""
    plain = box("heated", (0.9, 0.0, 0.0), (0.02, 1.0, 0.4))
    warmth = (plain.vertices_world[:, 1] > 0).astype(np.float32)
    heat = HeatScale(0.25, 0.003, "frames 0 to 9")
    view = view_from(4, 0, 0)

    image = draw_picture(
        *scene, [replace(plain, warmth=warmth)], viewpoint=view, size_px=SIZE_PX, heat=heat
    )

    ends = np.array([[0.91, -0.45, 0.0], [0.91, 0.45, 0.0]])
    (cold, hot) = pixels_of(view, ends, SIZE_PX).astype(int)
    blue, _, red = image[cold[1], cold[0]].astype(int)
    assert blue > red
    blue, green, red = image[hot[1], hot[0]].astype(int)
    assert red > 2 * max(blue, green)
    assert heat.warmth(np.array([0.0, 0.125, 0.25, 9.0])).tolist() == [1.0, 0.5, 0.0, 0.0]


def test_twenty_pictures_make_a_sheet_and_no_strip() -> None:
    columns, share = sheet_layout([(2048, 1536)] * 20, (3200, 2400))

    rows = -(-20 // columns)
    width, height = columns * share * 2048, rows * share * 1536
    assert width <= 3200
    assert height <= 2400
    assert 1.0 < width / height < 1.7
    assert sheet_layout([(640, 480)] * 4, (3200, 2400)) == (2, 1.0)
    assert sheet_layout([(640, 480)], (3200, 2400)) == (1, 1.0)


def test_a_contact_sheet_holds_pictures_of_unequal_size() -> None:
    small = np.full((40, 60, 3), 10, np.uint8)
    large = np.full((80, 120, 3), 200, np.uint8)

    sheet = contact_sheet([small, large, small], columns=2)

    assert sheet.shape[0] >= 160
    assert sheet.shape[1] >= 240
    assert (sheet == 200).all(axis=2).sum() == 80 * 120
    rows, columns = np.nonzero((sheet == 10).all(axis=2))
    assert len(rows) >= 2 * 40 * 60
    # One left of the large picture, one in the row below it.
    large_rows, large_columns = np.nonzero((sheet == 200).all(axis=2))
    assert columns.max() < large_columns.min()
    assert rows.max() > large_rows.max()


def test_a_picture_is_read_back(tmp_path: Path) -> None:
    image = np.arange(30 * 40 * 3, dtype=np.uint8).reshape(30, 40, 3)
    path = tmp_path / "picture.png"

    write_picture(path, image)

    np.testing.assert_array_equal(cv2.imread(str(path)), image)
    assert [entry.name for entry in tmp_path.iterdir()] == ["picture.png"]


@pytest.mark.parametrize("name", ["missing/picture.png", "picture.xyz", "picture", "file/a.png"])
def test_an_unwritable_picture_is_named_and_leaves_nothing(tmp_path: Path, name: str) -> None:
    (tmp_path / "file").write_text("in the way")
    path = tmp_path / name

    with pytest.raises(ReportError, match=path.name):
        write_picture(path, np.zeros((4, 4, 3), np.uint8))

    assert [entry.name for entry in tmp_path.iterdir()] == ["file"]


def test_a_picture_does_not_replace_a_folder(tmp_path: Path) -> None:
    folder = tmp_path / "picture.png"
    folder.mkdir()

    with pytest.raises(ReportError, match=r"picture\.png"):
        write_picture(folder, np.zeros((4, 4, 3), np.uint8))

    assert [entry.name for entry in tmp_path.iterdir()] == ["picture.png"]


@pytest.mark.slow
def test_importing_pictures_loads_no_mesh_library() -> None:
    code = "import sys, hybridve.hull.view.picture; print('open3d' in sys.modules)"
    answer = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert answer.stdout.strip() == "False"


def test_rings_of_test_cameras_are_what_they_seem(scene: tuple[Hull, Rig]) -> None:
    """The rig drawn is the rig that saw the hull."""
    views = ring_views(6)
    rig = ring_rig(views)
    pixels = [project_points(camera, np.zeros((1, 3)))[0] for camera in rig.cameras]
    np.testing.assert_allclose(np.concatenate(pixels), [[360.0, 243.0]] * 6, atol=1e-6)
