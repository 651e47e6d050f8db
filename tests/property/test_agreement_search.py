"""What a search proves or finds holds, for every rig, silhouettes and rule."""

import cv2
import numpy as np
from helpers.agreement import balls, random_views, shifted
from helpers.hulls import with_gaps
from helpers.thorough import asked
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from hybridve.hull.agreement.search import (
    EMPTY,
    FOUND,
    Rule,
    make_pencils,
    search,
    search_hull,
)
from hybridve.hull.agreement.search_reference import points_count
from hybridve.hull.query.reference import contains_points
from hybridve.hull.query.silhouettes import Hull, Views, make_hull

seeds = st.integers(0, 2**32 - 1)


def random_hull(rng: np.random.Generator, views: Views) -> Hull:
    """Return silhouettes of up to two balls, some shifted, with rectangles and holes."""
    things = [
        (rng.uniform(-0.4, 0.4, 3), float(rng.uniform(0.02, 0.3)))
        for _ in range(rng.integers(1, 3))
    ]
    masks = balls(views, *things)
    for camera, mask in enumerate(masks):
        if rng.random() < 0.3:
            masks[camera] = shifted(mask, *rng.integers(-40, 40, 2).tolist())
        for value in (0, 1):
            if rng.random() < 0.2:
                left, top = rng.integers(0, mask.shape[1]), rng.integers(0, mask.shape[0])
                masks[camera][top : top + 30, left : left + rng.integers(1, 60)] = value
    return make_hull(views, masks)


def random_rule(rng: np.random.Generator, count: int) -> Rule:
    is_asked = rng.random(count) < 0.85
    is_asked[rng.integers(count)] = True
    return Rule(
        is_asked,
        rng.random(count) < rng.choice([0.0, 0.5, 1.0]),
        int(rng.integers(1, is_asked.sum() + 1)),
        rng.integers(0, rng.choice([1, 7]), count),
    )


def points_on_rays(
    rng: np.random.Generator, hull: Hull, camera: int, grown_px: int, count: int
) -> NDArray[np.float64]:
    """Return points (N, 3), world, of a camera's grown silhouette, most within the common view."""
    views = hull.views
    padded = cv2.copyMakeBorder(
        hull.mask(camera),
        grown_px,
        grown_px,
        grown_px,
        grown_px,
        borderType=cv2.BORDER_CONSTANT,
        value=0,
    )
    grown = cv2.dilate(padded, np.ones((2 * grown_px + 1, 2 * grown_px + 1), np.uint8))
    rows, columns = np.nonzero(grown)
    if len(rows) == 0:
        return np.zeros((0, 3))
    chosen = rng.integers(0, len(rows), count)
    pixels = np.column_stack([columns[chosen], rows[chosen]]) - grown_px + rng.random((count, 2))
    depths_m = np.where(
        rng.random(count) < 0.9, rng.uniform(0.5, 6.0, count), rng.lognormal(0.0, 2.0, count)
    )
    matrix = views.img_from_local[camera]
    homogeneous = np.column_stack([pixels, np.ones(count)]) * depths_m[:, None] - matrix[:, 3]
    return np.linalg.solve(matrix[:, :3], homogeneous.T).T + views.origin_world


@given(seed=seeds, n_cameras=st.integers(1, 6))
@settings(max_examples=asked(150))
def test_what_is_proved_empty_holds_no_point_and_what_is_found_is_one(
    seed: int, n_cameras: int
) -> None:
    rng = np.random.default_rng(seed)
    views = random_views(rng, n_cameras, "keep", spread_m=0.5)
    hull = random_hull(rng, with_gaps(rng, views) if rng.random() < 0.5 else views)
    rule = random_rule(rng, n_cameras)
    camera = int(rng.choice(np.flatnonzero(rule.is_asked)))

    found = search(hull, make_pencils(hull.views), camera, rule, None, 20_000)

    points = points_on_rays(rng, hull, camera, int(rule.tolerance_px[camera]), 5000)
    counting = points_count(hull, points, rule)
    if found.verdict == EMPTY:
        assert not counting.any()
    elif found.verdict == FOUND:
        assert points_count(hull, found.point_world[None], rule).all()
        seen_by_it = Rule(
            np.arange(n_cameras) == camera, np.zeros(n_cameras, np.bool_), 1, rule.tolerance_px
        )
        assert points_count(hull, found.point_world[None], seen_by_it).all()


@given(
    seed=seeds,
    n_cameras=st.integers(1, 5),
    unseen=st.sampled_from(["carve", "keep", "gaps"]),
    data=st.data(),
)
@settings(max_examples=asked(100))
def test_a_hull_is_proved_empty_only_if_it_is(
    seed: int, n_cameras: int, unseen: str, data: st.DataObject
) -> None:
    rng = np.random.default_rng(seed)
    min_cameras = data.draw(st.integers(1, n_cameras))
    views = random_views(rng, n_cameras, "carve" if unseen == "carve" else "keep", min_cameras, 0.5)
    hull = random_hull(rng, with_gaps(rng, views) if unseen == "gaps" else views)

    found = search_hull(hull, make_pencils(hull.views), Rule.of(views), 20_000)

    points = np.concatenate(
        [rng.uniform(-1.0, 1.0, (5000, 3)), rng.uniform(-5.0, 5.0, (2000, 3))]
        + [points_on_rays(rng, hull, camera, 0, 2000) for camera in range(n_cameras)]
    )
    if found.verdict == FOUND:
        assert contains_points(hull, found.point_world[None]).all()
    elif found.verdict == EMPTY:
        assert not contains_points(hull, points).any()


@given(seed=seeds, n_cameras=st.integers(2, 5), grown_px=st.integers(0, 6))
@settings(max_examples=asked(60))
def test_growing_silhouettes_as_images_is_the_same(
    seed: int, n_cameras: int, grown_px: int
) -> None:
    """Well within the images, where no border cuts what was grown."""
    rng = np.random.default_rng(seed)
    views = random_views(rng, n_cameras)
    masks = balls(views, (rng.uniform(-0.1, 0.1, 3), 0.05))
    masks[0] = shifted(masks[0], *rng.integers(-12, 12, 2).tolist())
    kernel = np.ones((2 * grown_px + 1,) * 2, np.uint8)
    grown = [np.asarray(cv2.dilate(mask, kernel), np.uint8) for mask in masks]
    tolerance_px = np.full(n_cameras, grown_px)
    pencils = make_pencils(views)

    asked = search_hull(make_hull(views, masks), pencils, Rule.of(views, tolerance_px))
    made = search_hull(make_hull(views, grown), pencils, Rule.of(views))

    assert {asked.verdict, made.verdict} != {EMPTY, FOUND}
