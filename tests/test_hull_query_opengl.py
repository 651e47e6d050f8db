"""What both OpenGL engines owe whoever uses them: their manners on the device, mesh after mesh."""

from collections.abc import Iterator
from itertools import product

import moderngl
import numpy as np
import pytest
from helpers.hulls import EDGE_BAND_PX, ball_hull, differences, is_in_order, ring_views, sphere_mesh

from hybridve.calib.errors import DeviceError
from hybridve.hull.query.compute import Compute
from hybridve.hull.query.device import open_device
from hybridve.hull.query.engine import Triangles
from hybridve.hull.query.native import Native
from hybridve.hull.query.stencil import Stencil

pytestmark = pytest.mark.gl

OpenGL = Compute | Stencil

native = Native(n_threads=1)
KINDS: list[type[OpenGL]] = [Compute, Stencil]

both = pytest.mark.parametrize("kind", KINDS)


@pytest.fixture(scope="module")
def context() -> Iterator[moderngl.Context]:
    context = open_device()
    yield context
    context.release()


@pytest.fixture
def engine(context: moderngl.Context, kind: type[OpenGL]) -> Iterator[OpenGL]:
    """An engine, on a device that is clean before the test and must be clean after it."""
    assert context.error == "GL_NO_ERROR"
    with kind(context) as engine:
        yield engine
    assert context.error == "GL_NO_ERROR"


@both
def test_meshes_are_told_apart(engine: OpenGL) -> None:
    hull = ball_hull(ring_views(), np.zeros(3), 0.2)
    nothing = Triangles(np.zeros((0, 3)), np.zeros((0, 3), np.int32), np.zeros(0, np.int32))
    far = sphere_mesh(100, center_world=(2.0, 0.0, 0.0))
    meshes = [sphere_mesh(100, 0.1), nothing, far, sphere_mesh(500, 0.19, viewport=7), nothing]

    found, expected = engine.query(hull, meshes), native.query(hull, meshes)

    assert [len(hits) > 0 for hits in found] == [True, False, False, True, False]
    for mesh, hits, expected_hits in zip(meshes, found, expected, strict=True):
        assert is_in_order(mesh, hits)
        assert differences(hull.views, mesh, hits, expected_hits, EDGE_BAND_PX).outside_band == []


@both
def test_no_meshes_is_no_hits(engine: OpenGL) -> None:
    assert engine.query(ball_hull(ring_views(), np.zeros(3), 0.2), []) == []


@both
def test_the_same_engine_serves_other_cameras(engine: OpenGL) -> None:
    mesh = sphere_mesh(2000, 0.2, viewport=5)
    for n_cameras in (2, 9, 4, 1, 17, 255):
        for center in ([0.2, 0.0, 0.0], [0.0, 0.1, 0.1]):
            hull = ball_hull(ring_views(n_cameras, 80, 60, 80.0), np.array(center), 0.15)

            (found,), (expected,) = engine.query(hull, [mesh]), native.query(hull, [mesh])

            difference = differences(hull.views, mesh, found, expected, EDGE_BAND_PX)
            assert difference.outside_band == []
            assert len(expected) > 0


@both
def test_without_opengl_one_line_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, kind: type[OpenGL]
) -> None:
    def no_library(**settings: object) -> None:
        raise Exception("libEGL.so not loaded")

    monkeypatch.setattr(moderngl, "create_context", no_library)

    with pytest.raises(DeviceError, match=r"libEGL.so not loaded.*libegl1.*libgl1-mesa-dri"):
        kind()


@both
def test_closing_twice_is_harmless(context: moderngl.Context, kind: type[OpenGL]) -> None:
    engine = kind(context)
    engine.query(ball_hull(ring_views(), np.zeros(3), 0.2), [sphere_mesh(100)])
    engine.close()
    engine.close()

    assert context.error == "GL_NO_ERROR"


@pytest.mark.parametrize("kinds", list(product(KINDS, repeat=2)))
def test_engines_with_devices_of_their_own_take_turns(
    kinds: tuple[type[OpenGL], type[OpenGL]],
) -> None:
    views = ring_views()
    frames = [ball_hull(views, np.array([x, 0.0, 0.0]), 0.15) for x in (0.5, -0.4)]
    mesh = sphere_mesh(500)
    expected = [native.query(hull, [mesh])[0] for hull in frames]
    with kinds[0]() as first, kinds[1]() as second:
        for turn in (0, 1, 0):
            for engine in (first, second):
                (found,) = engine.query(frames[turn], [mesh])

                difference = differences(views, mesh, found, expected[turn], EDGE_BAND_PX)
                assert difference.outside_band == []
                assert len(found) > 0
