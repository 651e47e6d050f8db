"""The hull as it looked: colours from the right cameras, none through what hides a place."""

from collections.abc import Iterator, Sequence

import moderngl
import numpy as np
import pytest
from helpers.hulls import look_at, projection, random_views, ring_views
from numpy.typing import NDArray

from hybridve.hull.query.device import open_device
from hybridve.hull.query.silhouettes import Hull, Views, make_hull, make_views
from hybridve.hull.view.novel import HullOnDevice, NovelView, full_screen
from hybridve.hull.view.paint import Painter
from hybridve.hull.view.recorded import recorded_view
from hybridve.hull.view.skin import SkinOnDevice

pytestmark = pytest.mark.gl

Image = NDArray[np.uint8]

RED, GREEN = (40, 40, 220), (40, 220, 40)  # BGR

#: A ball: its centre, its radius, and its colour.
Ball = tuple[tuple[float, float, float], float, tuple[int, int, int] | None]


@pytest.fixture(scope="module")
def device() -> Iterator[moderngl.Context]:
    context = open_device()
    yield context
    context.release()


def picture_of(view: NovelView, size_px: tuple[int, int], balls: Sequence[Ball]) -> Image:
    """Return balls as a view shows them, BGR, black around; without a colour one has stripes."""
    columns, rows = np.meshgrid(np.arange(size_px[0]) + 0.5, np.arange(size_px[1]) + 0.5)
    origins, rays = view.rays(np.column_stack([columns.ravel(), rows.ravel()]), size_px)
    nearest = np.full(len(rays), np.inf)
    image = np.zeros((len(rays), 3))
    for center, radius, colour in balls:
        start = origins - np.array(center)
        a, b = (rays**2).sum(axis=1), (rays * start).sum(axis=1)
        root = b * b - a * ((start**2).sum(axis=1) - radius**2)
        depth = np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0.0))) / a, np.inf)
        hit = depth < nearest
        points = origins[hit] + depth[hit, None] * rays[hit] - np.array(center)
        if colour is None:
            stripe = 0.5 + 0.5 * np.sin(25.0 * points)
            image[hit] = 60 + 180 * stripe
        else:
            image[hit] = colour
        nearest[hit] = depth[hit]
    return np.rint(image).astype(np.uint8).reshape(size_px[1], size_px[0], 3)


def seen_by(views: Views, balls: Sequence[Ball]) -> tuple[Hull, list[Image]]:
    """Return the hull of balls, and their pictures."""
    images = [
        picture_of(recorded_view(views, camera, (0.1, 20.0)), (int(w), int(h)), balls)
        for camera, (w, h) in enumerate(views.sizes_px)
    ]
    masks = [np.asarray(image.any(axis=2), np.uint8) for image in images]
    return make_hull(views, masks), images


def skin_of(
    device: moderngl.Context,
    hull: Hull,
    images: Sequence[Image | None],
    view: NovelView,
    size_px: tuple[int, int],
) -> Image:
    """Return the hull's colours, BGR and how surely, (H, W, 4)."""
    depth, normal = device.texture(size_px, 1, dtype="f4"), device.texture(size_px, 4, dtype="f2")
    colours = device.texture(size_px, 4, dtype="f1")
    on_device = HullOnDevice(device, full_screen(device, "novel.frag.glsl"), hull)
    on_device.draw(device.framebuffer([depth, normal]), view, size_px)
    skin = SkinOnDevice(device, hull, on_device, images)
    paint = full_screen(device, "skin.frag.glsl")
    skin.draw(device.framebuffer([colours]), paint, (depth, normal), view, size_px)
    found = np.frombuffer(colours.read(), np.uint8).reshape(size_px[1], size_px[0], 4)
    device.gc()
    return found[..., [2, 1, 0, 3]]


def ring_view(angle: float, height_m: float = 0.8) -> NovelView:
    """Return a view from between the cameras of `ring_views`."""
    center = np.array([3.0 * np.cos(angle), 3.0 * np.sin(angle), height_m])
    matrix = projection(look_at(center, np.zeros(3)), 300.0, 240, 180)
    views = make_views(("novel",), np.array([[240, 180]]), matrix[None])
    return recorded_view(views, 0, (0.5, 10.0))


def test_a_recorded_cameras_view_is_its_projection() -> None:
    """Of cameras of any roll, with the principal point anywhere, and skewed ones."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        views = random_views(rng, 2)
        shear = np.eye(3)
        shear[0, 1:] = rng.normal(size=2) * (0.2, 30.0)
        shear[1, 2] = rng.normal() * 30.0
        world = shear @ views.img_from_local
        world[:, :, 3] -= world[:, :, :3] @ views.origin_world
        views = make_views(views.names, views.sizes_px, world)
        for camera, (width, height) in enumerate(views.sizes_px):
            view = recorded_view(views, camera, (1e-3, 100.0))
            points = rng.normal(size=(30, 3)) * 0.5
            expected = views.project(points, camera)
            size_px = (int(width), int(height))

            pixels, depth_m = view.pixels(points, size_px)
            origins, rays = view.rays(pixels, size_px)
            clip = np.column_stack([points, np.ones(30)]) @ view.clip_from_local(np.zeros(3)).T

            np.testing.assert_allclose(depth_m, expected[:, 2], atol=1e-9)
            np.testing.assert_allclose(pixels, expected[:, :2] / expected[:, 2:], atol=1e-6)
            np.testing.assert_allclose(origins + depth_m[:, None] * rays, points, atol=1e-9)
            places = clip[:, :2] / clip[:, 3:]
            np.testing.assert_allclose((places + 1) / 2 * size_px, pixels, atol=1e-6)


@pytest.mark.parametrize("unseen", ["carve", "keep"])
def test_from_a_cameras_own_place_the_hull_is_its_silhouette(unseen: str) -> None:
    """All cameras see the whole ball; images of unequal size one after another on one device."""
    views = ring_views(3, unseen=unseen)  # type: ignore[arg-type]
    sizes = np.array([[400, 300], [720, 486], [810, 520]])
    world = views.img_from_local.copy()
    world[:, :2] += (sizes - views.sizes_px)[:, :, None] / 2 * world[:, 2:]
    world[:, :, 3] -= world[:, :, :3] @ views.origin_world
    views = make_views(views.names, sizes, world, views.unseen)
    hull, images = seen_by(views, [((0.05, 0.0, 0.1), 0.35, RED)])

    with Painter() as painter:
        for camera, image in enumerate(images):
            view = recorded_view(views, camera, (1e-3, 100.0))
            depth_m = painter.depth(hull, view, (image.shape[1], image.shape[0]))
            drawn, silhouette = np.isfinite(depth_m), image.any(axis=2)
            assert not (drawn & ~silhouette).any()
            assert (drawn & silhouette).sum() / silhouette.sum() > 0.98


@pytest.mark.slow
def test_between_cameras_the_hull_looks_as_the_thing_does(device: moderngl.Context) -> None:
    balls: list[Ball] = [((0.0, 0.0, 0.0), 0.4, None)]
    hull, images = seen_by(ring_views(16), balls)
    view, size_px = ring_view(0.5), (240, 180)
    truth = picture_of(view, size_px, balls)

    skin = skin_of(device, hull, images, view, size_px)

    inside = (skin[..., 3] > 0) & truth.any(axis=2)
    assert inside.sum() > 0.9 * truth.any(axis=2).sum()
    error = skin[inside][:, :3].astype(float) - truth[inside]
    plain = truth[inside] - truth[inside].mean(axis=0)  # the best that a single colour can do
    assert np.square(error).mean() < 0.15 * np.square(plain).mean()


@pytest.mark.slow
def test_what_the_hull_hides_from_a_camera_takes_no_colour_from_it(
    device: moderngl.Context,
) -> None:
    """A red ball stands before a green one, for the camera nearest to the viewer."""
    front, back = (0.8, 0.0, 0.25), (-0.5, 0.0, -0.15)
    centers = [(3.0, 0.0, 1.2), (-0.6, 3.0, 1.2), (-0.6, -3.0, 1.2), (0.3, 0.2, 3.2)]
    world = np.array(
        [projection(look_at(np.array(c), np.zeros(3)), 500.0, 640, 480) for c in centers]
    )
    views = make_views(tuple("abcd"), np.array([[640, 480]] * 4), world)
    hull, images = seen_by(views, [(front, 0.25, RED), (back, 0.35, GREEN)])
    eye = np.array([2.7, -1.2, 1.5])
    matrix = projection(look_at(eye, np.array([-0.1, 0.0, 0.0])), 300.0, 320, 240)
    view = recorded_view(make_views(("n",), np.array([[320, 240]]), matrix[None]), 0, (0.5, 10.0))
    truth = picture_of(view, (320, 240), [(front, 0.25, RED), (back, 0.35, GREEN)])

    skin = skin_of(device, hull, images, view, (320, 240))

    told = skin[..., 3] > 0
    is_red = told & (skin[..., 2] > 1.5 * skin[..., 1])
    is_green = told & (skin[..., 1] > 1.5 * skin[..., 2])
    truly_green = told & (truth[..., 1] > 200)
    assert (is_green & truly_green).sum() > 0.9 * truly_green.sum()
    assert (is_red & truly_green).sum() < 0.02 * truly_green.sum()


@pytest.mark.slow
def test_what_no_camera_with_a_picture_sees_has_no_colour(device: moderngl.Context) -> None:
    """Only the camera at the other side has one: from here next to nothing is told."""
    views = ring_views(6)
    hull, images = seen_by(views, [((0.0, 0.0, 0.0), 0.4, GREEN)])
    only: list[Image | None] = [
        image if camera == 3 else None for camera, image in enumerate(images)
    ]
    size_px = (240, 180)

    behind = skin_of(device, hull, only, ring_view(0.3), size_px)  # at camera 0
    before = skin_of(device, hull, only, ring_view(0.3 + np.pi), size_px)
    nobody = skin_of(device, hull, [None] * 6, ring_view(0.3), size_px)

    assert (before[..., 3] > 0).sum() > 4000
    assert (behind[..., 3] > 0).sum() < 0.05 * (before[..., 3] > 0).sum()
    assert not nobody.any()
