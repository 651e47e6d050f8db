"""Where samples lie, and how they are numbered."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybridve.hull.query.viewport import (
    MAX_VIEWPORT,
    n_samples,
    place_runs,
    sample_positions,
    sample_steps,
    samples_before,
    viewports_for_accuracy,
)

CORNERS = np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0], [0.0, 6.0, 3.0]])


@pytest.mark.parametrize("viewport", [1, 2, 3, 10, 33, 100])
def test_samples_are_numbered_row_by_row(viewport: int) -> None:
    expected = [(i, j) for j in range(viewport) for i in range(viewport - j)]

    i, j = sample_steps(
        np.full(len(expected), viewport, np.int32), np.arange(len(expected), dtype=np.uint32)
    )

    assert n_samples(viewport) == len(expected)
    assert list(zip(i.tolist(), j.tolist(), strict=True)) == expected


@given(viewport=st.integers(1, MAX_VIEWPORT) | st.just(MAX_VIEWPORT))
def test_the_numbers_at_both_ends_of_a_row_lead_back_to_their_steps(viewport: int) -> None:
    j = np.unique(np.linspace(0, viewport - 1, 1000).astype(np.int64))
    first = j * viewport - j * (j - 1) // 2
    last = first + viewport - 1 - j
    viewports = np.full(len(j), viewport, np.int32)

    i_first, j_first = sample_steps(viewports, first.astype(np.uint32))
    i_last, j_last = sample_steps(viewports, last.astype(np.uint32))

    np.testing.assert_array_equal(j_first, j)
    np.testing.assert_array_equal(j_last, j)
    np.testing.assert_array_equal(i_first, 0)
    np.testing.assert_array_equal(i_last, viewport - 1 - j)


def test_samples_lie_on_vertices_and_edges() -> None:
    positions = sample_positions(
        np.tile(CORNERS, (10, 1, 1)), np.full(10, 4, np.int32), np.arange(10, dtype=np.uint32)
    )

    # Samples 0, 3 and 9 are a, b and c; 5 is the only one inside: a third of the way to each.
    np.testing.assert_allclose(positions[[0, 3, 9]], CORNERS)
    np.testing.assert_allclose(positions[5], CORNERS.mean(axis=0))


def test_a_viewport_of_one_samples_the_centroid() -> None:
    positions = sample_positions(CORNERS[None], np.array([1], np.int32), np.zeros(1, np.uint32))

    np.testing.assert_allclose(positions, [[1.0, 2.0, 1.0]])


@given(
    lengths=st.lists(st.floats(1e-6, 10.0), min_size=1, max_size=5),
    accuracy_m=st.floats(2e-4, 1.0),
)
def test_the_chosen_viewport_is_the_smallest_that_keeps_the_accuracy(
    lengths: list[float], accuracy_m: float
) -> None:
    corners = np.zeros((len(lengths), 3, 3))
    corners[:, 1, 0] = lengths
    corners[:, 2, 1] = 1e-7

    viewports = viewports_for_accuracy(corners, accuracy_m)

    longest = np.hypot(lengths, 1e-7)
    rounding = 1 + 1e-12
    assert (longest / (viewports - 1) <= accuracy_m * rounding).all()
    coarser = viewports > 2
    assert (longest[coarser] * rounding / (viewports[coarser] - 2) > accuracy_m).all()


def test_an_accuracy_beyond_every_viewport_is_refused() -> None:
    with pytest.raises(ValueError, match=r"viewport of \d+, more than 65535"):
        viewports_for_accuracy(CORNERS[None], 1e-6)


@given(seed=st.integers(0, 2**32 - 1), largest=st.integers(1, 40))
def test_hits_are_positioned_to_the_bits_of_the_specification(seed: int, largest: int) -> None:
    rng = np.random.default_rng(seed)
    vertices = rng.normal(size=(9, 3)) * 10.0 ** rng.integers(-3, 4)
    faces = rng.integers(0, 9, (7, 3)).astype(np.int32)
    viewports = rng.integers(1, largest + 1, 7).astype(np.int32)
    triangle = np.repeat(np.arange(7, dtype=np.uint32), [n_samples(int(u)) for u in viewports])
    sample = np.concatenate([np.arange(n_samples(int(u)), dtype=np.uint32) for u in viewports])
    before = samples_before(viewports)
    some = np.flatnonzero(rng.random(len(triangle)) < rng.choice([0.05, 0.5, 0.95]))
    for chosen in (np.arange(len(triangle)), some, some[:0]):
        # As few runs as can be, and each sample a run of its own.
        cuts = np.flatnonzero(np.diff(chosen) != 1) + 1
        parts = [part for part in np.split(chosen, cuts) if len(part)]
        longest = [[part[0] for part in parts], [part[-1] + 1 for part in parts]]
        for start, stop in (np.array(longest, np.int64), np.stack([chosen, chosen + 1])):
            expected = sample_positions(
                vertices[faces[triangle[chosen]]], viewports[triangle[chosen]], sample[chosen]
            )

            found = place_runs(start, stop, before, vertices, faces, viewports)

            np.testing.assert_array_equal(found[0], triangle[chosen])
            np.testing.assert_array_equal(found[1], expected)
