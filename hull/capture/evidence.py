"""How surely each pixel shows an object, compiled."""

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.jit import compiled

#: The factor of a shadow is compared with its mean over this many pixels each way.
SHADE_REACH_PX = 3

#: By how much the factor of a shadow varies over these pixels, where it is soft: 1 sigma.
_SHADE_VARIES = 0.04

#: Evidence from which a pixel is an object beyond doubt, and tells what colours objects have.
_BEYOND_DOUBT = 12.0

#: Colours are counted in boxes of 16 x 16 x 16 grey levels.
_COLOUR_SHIFT = 4
_N_COLOURS = (256 >> _COLOUR_SHIFT) ** 3

#: As many pixels beyond doubt as this give the colours that they show half of their full weight,
#: and full weight means that half of the objects' pixels have colours seen elsewhere.
_COLOUR_PIXELS = 500
_COLOUR_WEIGHT = 0.5

#: Evidence is limited to this in both directions, lest one pixel outweighs its neighbours.
EVIDENCE_LIMIT = 6.0

#: Evidence as bytes: this many steps a unit, about 128.
_EVIDENCE_STEPS = 20.0


def as_byte(evidence: float) -> int:
    """Return evidence as an image holds it."""
    return 128 + round(_EVIDENCE_STEPS * evidence)


@compiled
def compare_with_background(
    image: NDArray[np.uint8],
    looked_at: NDArray[np.uint8],
    mean: NDArray[np.float32],
    low: NDArray[np.float32],
    high: NDArray[np.float32],
    weight: NDArray[np.float32],
    norm2: NDArray[np.float32],
    inverse_gain: np.float32,
    darkest: np.float32,
    brightest: np.float32,
    shadow_threshold2: np.float32,
    misfit2: NDArray[np.float32],
    shadow_misfit2: NDArray[np.float32],
    shade: NDArray[np.float32],
    trust: NDArray[np.float32],
) -> None:
    """Compare pixels that are not 0 in `looked_at` with the empty scene, by themselves.

    Writes to (H, W) arrays: the squared distances from the empty scene and from its darker colours
    in standard deviations, the factor by which a pixel is darker, and how much that can be trusted
    (the inverse of its variance; 0 where the colour does not fit a shadow). Other pixels are left
    as they were.
    """
    zero = np.float32(0.0)
    for row in range(image.shape[0]):
        for column in range(image.shape[1]):
            if looked_at[row, column] == 0:
                continue
            outside2 = zero
            along = zero
            for channel in range(3):
                value = np.float32(image[row, column, channel]) * inverse_gain
                w = weight[row, column, channel]
                off = min(value - low[row, column, channel], zero) + max(
                    value - high[row, column, channel], zero
                )
                outside2 += off * off * w
                along += value * mean[row, column, channel] * w
            factor = along / max(norm2[row, column], np.float32(1e-6))
            factor = min(max(factor, darkest), brightest)
            across2 = zero
            for channel in range(3):
                value = np.float32(image[row, column, channel]) * inverse_gain
                off = value - factor * mean[row, column, channel]
                across2 += off * off * weight[row, column, channel]
            misfit2[row, column] = outside2
            shadow_misfit2[row, column] = across2
            shade[row, column] = factor
            trust[row, column] = norm2[row, column] if across2 < shadow_threshold2 else zero


@compiled
def weigh_evidence(
    image: NDArray[np.uint8],
    open_questions: NDArray[np.uint8],
    norm2: NDArray[np.float32],
    bar: NDArray[np.float32],
    shadow_bar: NDArray[np.float32],
    shade: NDArray[np.float32],
    trust: NDArray[np.float32],
    shadow_misfit2: NDArray[np.float32],
    evidence: NDArray[np.float32],
    places: NDArray[np.int32],
    result: NDArray[np.uint8],
) -> None:
    """Write the evidence of pixels that are not 0 in `open_questions` to `result`, as bytes.

    `evidence` is the output `misfit2` of `compare_with_background` and is overwritten; `places` is
    (H W, 2) to work on.
    """
    height, width = open_questions.shape
    half = np.float32(0.5)
    varies2 = np.float32(_SHADE_VARIES * _SHADE_VARIES)
    # Sums over the rows of the window; a margin of zeros on both sides saves looking for borders.
    trusts = np.zeros(width + 2 * SHADE_REACH_PX, np.float32)
    shades = np.zeros(width + 2 * SHADE_REACH_PX, np.float32)
    counts = np.zeros(_N_COLOURS, np.int64)
    n_counted = 0
    n_places = 0
    for row in range(height):
        for column in range(width):
            if open_questions[row, column] != 0:
                places[n_places, 0] = row
                places[n_places, 1] = column
                n_places += 1

    stop = 0
    while stop < n_places:
        # Pixels of one row whose windows touch share their sums over the rows of the window.
        start = stop
        row = places[start, 0]
        stop += 1
        while (
            stop < n_places
            and places[stop, 0] == row
            and places[stop, 1] - places[stop - 1, 1] <= 2 * SHADE_REACH_PX
        ):
            stop += 1
        left = max(places[start, 1] - SHADE_REACH_PX, 0)
        right = min(places[stop - 1, 1] + SHADE_REACH_PX + 1, width)
        for column in range(left + SHADE_REACH_PX, right + SHADE_REACH_PX):
            trusts[column] = shades[column] = 0
        for other in range(max(row - SHADE_REACH_PX, 0), min(row + SHADE_REACH_PX + 1, height)):
            for column in range(left, right):
                value = trust[other, column]
                trusts[column + SHADE_REACH_PX] += value
                shades[column + SHADE_REACH_PX] += value * shade[other, column]
        for place in range(start, stop):
            column = places[place, 1]
            trust_around = np.float32(0.0)
            shade_around = np.float32(0.0)
            for step in range(2 * SHADE_REACH_PX + 1):
                trust_around += trusts[column + step]
                shade_around += shades[column + step]
            texture2 = np.float32(0.0)
            if trust_around > 0:
                off = shade[row, column] - shade_around / trust_around
                n2 = norm2[row, column]
                texture2 = off * off * n2 / (np.float32(1.0) + varies2 * n2)
            found = min(
                half * evidence[row, column] - bar[row, column],
                half * (shadow_misfit2[row, column] + texture2) - shadow_bar[row, column],
            )
            evidence[row, column] = found
            if found > _BEYOND_DOUBT:
                counts[_colour(image, row, column)] += 1
                n_counted += 1

    weight = _COLOUR_WEIGHT * n_counted / (n_counted + _COLOUR_PIXELS)
    unseen, likelier = np.float32(np.log(1.0 - weight)), np.zeros(_N_COLOURS, np.float32)
    for colour in range(_N_COLOURS):
        likelier[colour] = unseen
        if counts[colour] > 0:
            share = counts[colour] * _N_COLOURS / n_counted
            likelier[colour] = np.log(weight * share + 1.0 - weight)
    limit = np.float32(EVIDENCE_LIMIT)
    for place in range(n_places):
        row = places[place, 0]
        column = places[place, 1]
        found = evidence[row, column] + likelier[_colour(image, row, column)]
        found = min(max(found, -limit), limit)
        result[row, column] = np.uint8(np.float32(128.5) + np.float32(_EVIDENCE_STEPS) * found)


@compiled
def _colour(image: NDArray[np.uint8], row: int, column: int) -> int:
    """Return which box of colours a pixel is in."""
    bits = 8 - _COLOUR_SHIFT
    blue = image[row, column, 0] >> _COLOUR_SHIFT
    green = image[row, column, 1] >> _COLOUR_SHIFT
    red = image[row, column, 2] >> _COLOUR_SHIFT
    return int((((blue << bits) + green) << bits) + red)
