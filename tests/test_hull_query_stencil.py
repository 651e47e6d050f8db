"""The paper's engine: what is drawn where, in how many rounds, how precisely, and its manners."""

import gc
from collections.abc import Iterator

import moderngl
import numpy as np
import pytest
from helpers.hulls import (
    EDGE_BAND_PX,
    assert_same_samples,
    ball_hull,
    differences,
    is_in_order,
    large_views,
    projection,
    random_corners,
    random_masks,
    random_views,
    ring_views,
    soup,
    sphere_mesh,
)
from helpers.thorough import some_of
from numpy.typing import NDArray

from hybridve.calib.errors import DeviceError
from hybridve.hull.query import device as device_module
from hybridve.hull.query import stencil as stencil_module
from hybridve.hull.query.choose import open_engine
from hybridve.hull.query.device import open_device
from hybridve.hull.query.engine import Triangles
from hybridve.hull.query.native import Native
from hybridve.hull.query.reference import Reference
from hybridve.hull.query.silhouettes import Hull, Unseen, Views, make_hull
from hybridve.hull.query.stencil import Stencil

pytestmark = pytest.mark.gl

reference = Reference()
native = Native(n_threads=1)


@pytest.fixture(scope="module")
def context() -> Iterator[moderngl.Context]:
    context = open_device()
    yield context
    context.release()


@pytest.fixture
def clean(context: moderngl.Context) -> Iterator[moderngl.Context]:
    """A device that is clean before the test and must be clean after it."""
    assert context.error == "GL_NO_ERROR"
    yield context
    assert context.error == "GL_NO_ERROR"


@pytest.fixture
def stencil(clean: moderngl.Context) -> Iterator[Stencil]:
    with Stencil(clean, window_px=128) as engine:
        yield engine


def full_hull(views: Views, value: int = 1) -> Hull:
    """Return a hull whose silhouettes are all object, or all background."""
    return make_hull(
        views, [np.full((height, width), value, np.uint8) for width, height in views.sizes_px]
    )


def in_view(n_triangles: int, viewports: NDArray[np.int32] | int) -> Triangles:
    """Return triangles that all cameras of `ring_views` see whole."""
    rng = np.random.default_rng(n_triangles)
    corners = rng.uniform(-0.3, 0.3, (n_triangles, 3, 3))
    faces = np.arange(3 * n_triangles, dtype=np.int32).reshape(-1, 3)
    sizes = np.broadcast_to(viewports, n_triangles).astype(np.int32)
    return Triangles(corners.reshape(-1, 3), faces, sizes)


def counters(engine: Stencil, window: int) -> NDArray[np.uint8]:
    """Return what the pixels of a window count, all of them."""
    framebuffer = engine._windows[window]
    pixels = np.frombuffer(framebuffer.read(components=1, alignment=1), np.uint8)
    return pixels.reshape(framebuffer.size[::-1])


def test_exactly_the_lower_left_half_of_each_cell_is_drawn(clean: moderngl.Context) -> None:
    hull = full_hull(ring_views(3))
    for window_px in (41, 97, 128):
        with Stencil(clean, window_px) as engine:
            for u in range(1, 41):
                per_row = window_px // u
                mesh = in_view(per_row * per_row, u)

                engine.query(hull, [mesh])

                # As many cells as fit stand in rows, without gaps, from the corner on.
                expected = np.zeros((window_px, window_px), np.uint8)
                row, column = np.indices((per_row * u, per_row * u))
                expected[: per_row * u, : per_row * u] = 3 * (row % u + column % u <= u - 1)
                n_rows = per_row * u  # the rest is neither cleared nor read
                np.testing.assert_array_equal(counters(engine, 0)[:n_rows], expected[:n_rows])
                assert len(engine._meshes[mesh].layout.pieces) == 1


def test_what_is_larger_than_the_window_is_drawn_in_tiles(clean: moderngl.Context) -> None:
    with Stencil(clean, window_px=32) as engine:
        (hits,) = engine.query(full_hull(ring_views(3)), [in_view(1, 75)])

        drawn = [counters(engine, window) for window in range(6)]

    assert (hits.start.min(), hits.stop.max(), len(hits)) == (0, 75 * 76 // 2, 75 * 76 // 2)
    whole = np.zeros((96, 96), np.uint8)
    tiles = [(0, 0), (0, 32), (0, 64), (32, 0), (32, 32), (64, 0)]  # row, column
    for (row, column), pixels in zip(tiles, drawn, strict=True):
        n_rows = min(32, 75 - row)
        whole[row : row + n_rows, column : column + 32] = pixels[:n_rows]
    rows, columns = np.indices(whole.shape)
    np.testing.assert_array_equal(whole, 3 * (rows + columns <= 74))


@pytest.mark.parametrize("window_px", [10, 31, 200])
def test_rounds_find_what_one_round_finds(clean: moderngl.Context, window_px: int) -> None:
    hull = ball_hull(ring_views(), np.array([0.5, 0.0, 0.0]), 0.2)
    mesh = sphere_mesh(700)
    with Stencil(clean) as engine:
        (at_once,) = engine.query(hull, [mesh])
        assert len(stencil_module._rounds([engine._meshes[mesh]], 1024)) == 1
    with Stencil(clean, window_px) as engine:
        (in_rounds,) = engine.query(hull, [mesh])
        n_rounds = len(stencil_module._rounds([engine._meshes[mesh]], window_px))

    assert n_rounds == -(-len(mesh) // (window_px // 10) ** 2)
    assert len(at_once) > 500
    assert_same_samples(in_rounds, at_once)


@pytest.mark.parametrize("viewport", [128, 129, 1000])
def test_a_viewport_larger_than_the_window_is_sampled_whole(
    stencil: Stencil, viewport: int
) -> None:
    hull = ball_hull(ring_views(), np.array([0.1, 0.0, 0.0]), 0.15)
    mesh = in_view(1, viewport)

    (found,), (expected,) = stencil.query(hull, [mesh]), reference.query(hull, [mesh])

    assert is_in_order(mesh, found)
    assert differences(hull.views, mesh, found, expected, EDGE_BAND_PX).outside_band == []
    assert len(expected) > viewport


@pytest.mark.parametrize("seed", some_of(range(5)))
def test_mixed_viewports_share_windows(stencil: Stencil, seed: int) -> None:
    rng = np.random.default_rng(seed)
    hull = ball_hull(ring_views(), np.zeros(3), 0.25)
    sizes = [*rng.integers(1, 41, 300), *rng.integers(100, 300, 3), *[1] * 50]
    mesh = in_view(len(sizes), rng.permutation(sizes).astype(np.int32))

    (found,), (expected,) = stencil.query(hull, [mesh]), reference.query(hull, [mesh])

    assert is_in_order(mesh, found)
    assert differences(hull.views, mesh, found, expected, EDGE_BAND_PX).outside_band == []
    assert len(expected) > 1000


def test_no_two_cells_overlap() -> None:
    rng = np.random.default_rng(0)
    viewports = rng.integers(1, 90, 500).astype(np.int32)

    layout = stencil_module._lay_out(viewports, 64)

    covered = 0
    for piece in layout.pieces:
        window = np.zeros((piece.n_rows, 64), np.int64)
        for place, i, j, u in layout.cells[piece.start : piece.stop].astype(np.int64):
            row, column = place >> 16, place & 65535
            height, width = min(64, u - j), min(64, u - i - j)
            assert row + height <= piece.n_rows
            assert column + width <= 64
            window[row : row + height, column : column + width] += 1
            down, across = np.indices((height, width))
            covered += int((down + across <= u - 1 - i - j).sum())
        assert window.max() == 1
    assert covered == sum(int(u) * (int(u) + 1) // 2 for u in viewports)
    assert [piece.start for piece in layout.pieces[1:]] == [x.stop for x in layout.pieces[:-1]]


def test_small_meshes_share_a_round(clean: moderngl.Context) -> None:
    meshes = [in_view(20, 10 + k) for k in range(5)]
    with Stencil(clean, 400) as engine:
        found = engine.query(full_hull(ring_views()), meshes)

        assert len(engine._windows) == 1
    assert [len(hits) for hits in found] == [20 * u * (u + 1) // 2 for u in range(10, 15)]


def test_a_moved_mesh_is_found_where_it_is(stencil: Stencil) -> None:
    hull = ball_hull(ring_views(), np.array([0.5, 0.0, 0.0]), 0.2)
    mesh = sphere_mesh(500, 0.3)
    stencil.query(hull, [mesh])
    layout = stencil._layouts[mesh.topology]

    for shift_m in (0.3, 0.1, 0.0):
        moved = mesh.moved(mesh.vertices_world + np.array([shift_m, 0.0, 0.0]))
        (found,), (expected,) = stencil.query(hull, [moved]), reference.query(hull, [moved])

        assert differences(hull.views, moved, found, expected, EDGE_BAND_PX).outside_band == []
        assert stencil._meshes[moved].layout is layout
    assert len(stencil.query(hull, [mesh])[0]) == len(found)


def test_a_frame_may_be_asked_twice_and_frames_in_turn(stencil: Stencil) -> None:
    views = ring_views()
    frames = [ball_hull(views, np.array([x, 0.0, 0.0]), 0.15) for x in (0.5, -0.4)]
    mesh = sphere_mesh(500)
    expected = [reference.query(hull, [mesh])[0] for hull in frames]

    for turn in (0, 0, 1, 0, 1, 1):
        (found,) = stencil.query(frames[turn], [mesh])

        difference = differences(views, mesh, found, expected[turn], EDGE_BAND_PX)
        assert difference.outside_band == []
    assert 0 < len(expected[0]) != len(expected[1]) > 0


@pytest.mark.parametrize("min_cameras", [1, 3, 20])
def test_a_camera_that_cannot_see_abstains_if_told(stencil: Stencil, min_cameras: int) -> None:
    rng = np.random.default_rng(min_cameras)
    views = random_views(rng, 20, "keep", min_cameras)
    # Wholly object in front of some cameras, so that abstaining decides; holes in the others.
    kinds = ["full"] * 10 + ["holes"] * 5 + ["blobs"] * 5
    hull = make_hull(views, random_masks(rng, views, kinds))
    corners = np.array([random_corners(rng, views, "large") for _ in range(200)])
    mesh = soup(views, corners, np.full(200, 12, np.int32))

    (found,), (expected,) = stencil.query(hull, [mesh]), reference.query(hull, [mesh])

    assert differences(views, mesh, found, expected, EDGE_BAND_PX).outside_band == []
    if min_cameras < 20:
        assert 100 < len(expected) < 200 * 78 - 100


def test_one_background_outweighs_every_object_pixel(stencil: Stencil) -> None:
    """The counter saturates: what a camera has ruled out, 253 others do not count back in."""
    mesh = in_view(4, 6)
    views = ring_views(254, 60, 40, 50.0, unseen="keep")
    for background in (None, 0, 100, 253):
        masks = [np.full((40, 60), camera != background, np.uint8) for camera in range(254)]

        (hits,) = stencil.query(make_hull(views, masks), [mesh])

        assert len(hits) == (4 * 21 if background is None else 0)


@pytest.mark.parametrize(("unseen", "most"), [("carve", 255), ("keep", 254)])
def test_more_cameras_than_a_counter_counts_are_refused(
    stencil: Stencil, unseen: Unseen, most: int
) -> None:
    mesh = in_view(2, 3)
    hits = stencil.query(full_hull(ring_views(most, 60, 40, 50.0, unseen=unseen)), [mesh])
    assert len(hits[0]) == 12

    with pytest.raises(DeviceError, match=f"{most + 1} cameras.*counts to {most}.*native"):
        stencil.query(full_hull(ring_views(most + 1, 60, 40, 50.0, unseen=unseen)), [mesh])


# One cell a window: whether it needs double precision is decided for each triangle alone. About
# 0.3 m it changes; what neither program drew, or both, would show.
@pytest.mark.slow
@pytest.mark.parametrize("extent_m", [0.003, 0.1, 0.2, 0.3, 0.5, 6.0])
def test_a_large_image_is_sampled_to_a_thousandth_of_a_pixel(
    clean: moderngl.Context, extent_m: float
) -> None:
    rng = np.random.default_rng(1)
    views = large_views(rng)
    # In noise that differs from pixel to pixel nearly every wrong pixel shows.
    hull = make_hull(views, [rng.integers(0, 5, (1200, 1600)).astype(np.uint8) for _ in range(4)])
    n_triangles = 300 if extent_m < 1.0 else 2000
    corners = rng.normal(size=(n_triangles, 1, 3)) * 0.2
    corners = corners + rng.normal(size=(n_triangles, 3, 3)) * extent_m
    mesh = soup(views, corners, np.full(n_triangles, 40, np.int32))
    with Stencil(clean, window_px=40) as engine:
        (found,) = engine.query(hull, [mesh])
        share_in_double = engine._meshes[mesh].needs_double.mean()

    (expected,) = reference.query(hull, [mesh])
    assert differences(views, mesh, found, expected, EDGE_BAND_PX).outside_band == []
    assert len(expected) > 5_000, "the test would prove too little"
    if extent_m in (0.2, 0.3, 0.5):
        assert 0.02 < share_in_double < 0.98
    elif extent_m < 0.1:
        assert share_in_double == 0.0


@pytest.mark.slow
def test_triangles_of_ten_thousands_of_pixels_are_sampled_as_precisely(stencil: Stencil) -> None:
    """Their first sample lies far outside the image, and single precision would not do."""
    rng = np.random.default_rng(3)
    views = large_views(rng)
    hull = make_hull(views, [rng.integers(0, 5, (1200, 1600)).astype(np.uint8) for _ in range(4)])
    middle = rng.normal(size=(30, 1, 3)) * 0.2
    spread = rng.normal(size=(30, 1, 3)) * np.array([-40.0, 1.0, 1.0])[:, None]
    corners = middle + spread + rng.normal(size=(30, 3, 3)) * 0.5
    for camera in range(4):
        view = Views(
            ("cam",),
            views.sizes_px[:1],
            views.img_from_local[camera : camera + 1],
            views.origin_world,
        )
        of_one = make_hull(view, [hull.mask(camera)])
        mesh = soup(view, corners, np.full(len(corners), 500, np.int32))

        (found,), (expected,) = stencil.query(of_one, [mesh]), native.query(of_one, [mesh])

        assert differences(view, mesh, found, expected, EDGE_BAND_PX).outside_band == []
        assert len(expected) > 10_000, "the test would prove too little"


def test_a_tile_whose_far_corner_lies_behind_the_camera_is_carved_there(
    clean: moderngl.Context,
) -> None:
    """Its three corners on the edges lie in front; only the fourth, on the diagonal, does not."""
    pose = np.column_stack([np.eye(3), np.zeros(3)])
    view = Views(
        ("cam",), np.array([[400, 400]]), projection(pose, 50.0, 400, 400)[None], np.zeros(3)
    )
    hull = full_hull(view)
    rng = np.random.default_rng(0)
    corners = rng.uniform(-0.3, 0.3, (20, 3, 3))
    corners[:, :, 2] = [1.0, -0.3, -0.3]
    mesh = soup(view, corners, np.full(20, 100, np.int32))
    with Stencil(clean, window_px=64) as engine:
        (found,) = engine.query(hull, [mesh])

    (expected,) = reference.query(hull, [mesh])
    assert differences(view, mesh, found, expected, EDGE_BAND_PX).outside_band == []
    assert 0 < len(expected) < 20 * 5050


def test_what_belonged_to_a_mesh_leaves_the_device_with_it(stencil: Stencil) -> None:
    hull = ball_hull(ring_views(), np.zeros(3), 0.2)
    kept = sphere_mesh(100)
    stencil.query(hull, [kept, sphere_mesh(200)])
    gc.collect()

    stencil.query(hull, [kept])

    assert list(stencil._meshes) == [kept]
    assert list(stencil._layouts) == [kept.topology]


def test_what_others_draw_is_blended_as_they_say(
    context: moderngl.Context, stencil: Stencil
) -> None:
    target = context.framebuffer([context.texture((1, 1), 1)])
    target.use()
    program = context.program(
        vertex_shader="""#version 430 core
            void main() { gl_Position = vec4(0.0, 0.0, 0.0, 1.0); }""",
        fragment_shader="""#version 430 core
            out vec4 colour; void main() { colour = vec4(0.2, 0.0, 0.0, 0.5); }""",
    )
    vertices = context.vertex_array(program, [])

    stencil.query(ball_hull(ring_views(), np.zeros(3), 0.2), [sphere_mesh(100)])

    assert context.fbo is target
    for _ in range(2):
        vertices.render(moderngl.POINTS, vertices=1)
    assert target.read(components=1, alignment=1) == bytes([51])
    target.clear()
    context.enable(moderngl.BLEND)  # and what is blended on purpose is blended as OpenGL begins
    vertices.render(moderngl.POINTS, vertices=1)
    context.disable(moderngl.BLEND)
    assert abs(target.read(components=1, alignment=1)[0] - 25.5) < 1.0


def test_a_window_that_the_device_does_not_draw_is_refused(clean: moderngl.Context) -> None:
    for window_px in (0, 1 << 20):
        with pytest.raises(
            DeviceError, match=rf"windows of 1 to \d+ pixels a side, not {window_px}"
        ):
            Stencil(clean, window_px)


def test_a_driver_that_does_not_compile_the_shaders_is_named(
    clean: moderngl.Context, monkeypatch: pytest.MonkeyPatch
) -> None:
    broken = "#version 430 core\nvoid main() { nothing(); }"
    monkeypatch.setattr(device_module, "load_shader", lambda name: broken)

    with pytest.raises(DeviceError, match=r"does not compile stencil_cell.*nothing.*native"):
        Stencil(clean)


def test_it_is_opened_by_name_and_gives_back_its_own_device() -> None:
    hull, mesh = ball_hull(ring_views(), np.zeros(3), 0.2), sphere_mesh(100, 0.1)

    for _ in range(3):
        with open_engine("stencil") as engine:
            assert engine.name == "stencil"
            assert engine.renderer
            (hits,) = engine.query(hull, [mesh])
        assert len(hits) == len(mesh) * 55
