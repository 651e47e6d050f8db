"""The specification of inside, on cameras small enough to be worked out by hand."""

from dataclasses import replace

import numpy as np
import pytest

from hybridve.hull.query import reference
from hybridve.hull.query.engine import Triangles
from hybridve.hull.query.reference import Reference, contains_points
from hybridve.hull.query.silhouettes import Hull, Unseen, Views, make_hull, make_seen

#: Looks along +z from the origin; a point (x, y, 1) projects to pixel (x, y).
ALONG_Z = np.eye(3, 4)
#: Looks along -z from (0, 0, 10), mirrored so that (x, y, 9) projects to pixel (x, y).
ALONG_MINUS_Z = np.array([[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, -1.0, 10.0]])


def small_hull(
    masks: list[list[list[int]]],
    unseen: Unseen = "carve",
    min_cameras: int = 1,
    matrices: tuple[np.ndarray, ...] = (ALONG_Z, ALONG_MINUS_Z),
) -> Hull:
    """Cameras by hand; make_views is left out so that nothing is rounded."""
    arrays = [np.array(mask, np.uint8) for mask in masks]
    sizes = np.array([[mask.shape[1], mask.shape[0]] for mask in arrays])
    views = Views(
        tuple("ab"[: len(arrays)]),
        sizes,
        np.array(matrices[: len(arrays)]),
        np.zeros(3),
        unseen,
        min_cameras,
    )
    return make_hull(views, arrays)


@pytest.mark.parametrize(
    ("point", "inside"),
    [
        ((0.0, 0.0, 1.0), True),  # the corner of pixel (0, 0)
        ((0.999, 0.5, 1.0), True),
        ((1.0, 0.5, 1.0), False),  # an edge belongs to the pixel on its right
        ((2.5, 1.5, 1.0), True),  # column 2, row 1
        ((1.5, 2.5, 1.0), False),  # there is no row 2
        ((5.0, 3.0, 2.0), True),  # twice as far
        ((3.0, 0.5, 1.0), False),  # x = width is outside the image
        ((2.5, 2.0, 1.0), False),  # y = height likewise
        ((-1e-9, 0.5, 1.0), False),
        ((0.5, -1e-9, 1.0), False),
        ((-0.5, -0.5, -1.0), False),  # behind the camera, though it would project into pixel (0, 0)
        ((0.0, 0.0, 0.0), False),  # the camera itself
    ],
)
def test_a_pixel_is_the_floor_of_the_projection(
    point: tuple[float, float, float], inside: bool
) -> None:
    hull = small_hull([[[1, 0, 0], [0, 0, 1]]])

    assert contains_points(hull, np.array([point])).tolist() == [inside]


def test_points_are_given_in_the_world() -> None:
    hull = small_hull([[[1, 0, 0], [0, 0, 1]]])
    shifted = Views(
        hull.views.names, hull.views.sizes_px, hull.views.img_from_local, np.array([5.0, 6.0, 7.0])
    )

    result = contains_points(make_hull(shifted, [hull.mask(0)]), np.array([[5.5, 6.5, 8.0]]))

    assert result.tolist() == [True]


#: Points by which cameras see them: (0.5, 0.5, 5) both, (0.5, 0.5, 11) a, (0.5, 0.5, -1) b,
#: (100, 0.5, 5) neither.
SEEN_BY_BOTH, SEEN_BY_A, SEEN_BY_B, SEEN_BY_NONE = np.array(
    [[0.5, 0.5, 5.0], [0.5, 0.5, 11.0], [0.5, 0.5, -1.0], [100.0, 0.5, 5.0]]
)[:, None]
OBJECT, BACKGROUND = [[1]], [[0]]


@pytest.mark.parametrize(
    ("unseen", "min_cameras", "masks", "point", "inside"),
    [
        ("carve", 1, [OBJECT, OBJECT], SEEN_BY_BOTH, True),
        ("carve", 1, [OBJECT, OBJECT], SEEN_BY_A, False),
        ("carve", 1, [OBJECT, OBJECT], SEEN_BY_NONE, False),
        ("carve", 1, [OBJECT, BACKGROUND], SEEN_BY_BOTH, False),
        ("keep", 1, [OBJECT, OBJECT], SEEN_BY_BOTH, True),
        ("keep", 1, [OBJECT, OBJECT], SEEN_BY_A, True),
        ("keep", 1, [OBJECT, BACKGROUND], SEEN_BY_A, True),
        ("keep", 1, [BACKGROUND, OBJECT], SEEN_BY_A, False),
        ("keep", 1, [OBJECT, BACKGROUND], SEEN_BY_B, False),
        ("keep", 1, [OBJECT, BACKGROUND], SEEN_BY_BOTH, False),
        ("keep", 1, [OBJECT, OBJECT], SEEN_BY_NONE, False),
        ("keep", 2, [OBJECT, OBJECT], SEEN_BY_A, False),
        ("keep", 2, [OBJECT, OBJECT], SEEN_BY_BOTH, True),
    ],
)
def test_a_camera_that_cannot_see_a_point_carves_or_abstains(
    unseen: Unseen, min_cameras: int, masks: list[list[list[int]]], point: np.ndarray, inside: bool
) -> None:
    hull = small_hull(masks, unseen, min_cameras)

    assert contains_points(hull, point).tolist() == [inside]


@pytest.mark.parametrize(
    ("min_cameras", "masks", "x", "inside"),
    [
        (1, [[[1, 0, 0]], [[1, 1, 1]]], 0.5, True),
        (1, [[[1, 0, 0]], [[1, 1, 1]]], 1.5, False),  # background
        (1, [[[1, 0, 0]], [[1, 1, 1]]], 2.5, True),  # a did not record this pixel, and b saw it
        (2, [[[1, 0, 0]], [[1, 1, 1]]], 2.5, False),  # which is one camera
        (2, [[[1, 0, 0]], [[1, 1, 1]]], 0.5, True),
        (1, [[[1, 1, 1]], [[0, 0, 0]]], 2.5, False),
        (1, [[[1, 1, 1]], [[0, 0, 0]]], 1.5, False),
        (1, [[[0, 0, 1]], [[1, 1, 1]]], 2.5, True),  # whatever stands in its silhouette there
        (2, [[[0, 0, 1]], [[1, 1, 1]]], 2.5, False),
    ],
)
def test_a_camera_abstains_on_a_pixel_that_it_did_not_record(
    min_cameras: int, masks: list[list[list[int]]], x: float, inside: bool
) -> None:
    hull = small_hull(masks, "keep", min_cameras)
    recorded = np.array([[True, True, False]])
    seen = make_seen(hull.views.names, hull.views.sizes_px, [recorded, None])
    hull = make_hull(replace(hull.views, seen=seen), [np.array(mask, np.uint8) for mask in masks])
    half_way = np.array([[5 * x, 2.5, 5.0]])  # pixels of both are 5 m wide there

    assert contains_points(hull, half_way).tolist() == [inside]


def test_no_points_are_no_answers() -> None:
    assert contains_points(small_hull([OBJECT]), np.zeros((0, 3))).shape == (0,)


def test_samples_are_asked_across_chunks_in_order(monkeypatch: pytest.MonkeyPatch) -> None:
    """Triangles of viewports 1, 2, 3, 2 over the pixels (0, 0), (1, 0), ... of one camera."""
    hull = small_hull([[[1, 1, 1, 0]]])
    corners = np.array([[[0.1, 0.5, 1.0], [3.1, 0.5, 1.0], [0.1, 0.5, 1.0]]])
    mesh = Triangles(
        np.tile(corners, (4, 1, 1)).reshape(-1, 3),
        np.arange(12, dtype=np.int32).reshape(4, 3),
        np.array([1, 2, 3, 2], np.int32),
    )
    expected_triangle = [0, 1, 1, 2, 2, 2, 2, 2, 3, 3]
    # Of six samples of a 3 x 3 viewport only number 2, vertex b, lies in the last column.
    expected_sample = [0, 0, 2, 0, 1, 3, 4, 5, 0, 2]

    for chunk in (1, 2, 3, 5, 1000):
        monkeypatch.setattr(reference, "_CHUNK", chunk)
        (hits,) = Reference().query(hull, [mesh])

        triangle, sample = hits.samples()
        assert triangle.tolist() == expected_triangle
        assert sample.tolist() == expected_sample
        assert triangle.dtype == sample.dtype == np.uint32
