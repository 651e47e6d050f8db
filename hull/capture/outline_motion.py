"""How outlines move from one frame to the next: parts that are shifted, and what is neither."""

import math
from dataclasses import dataclass, replace
from functools import cache
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.hull.capture.pixel_boxes import (
    Box,
    box_of,
    grown_box,
    intersection,
    is_empty,
    shifted,
    slices_of,
    union,
)
from hybridve.hull.jit import compiled

#: Distances to an outline end here, so that they depend on no pixel farther away.
CAP_PX = 64

#: Changed pixels this near to each other belong to one moving thing.
_MARGIN_PX = 3

#: Changes smaller than this are the noise of a segmentation.
_SMALLEST_CHANGE_PX = 12

#: Moving things followed in one camera, largest change first.
_MOST_MOVES = 6

#: Longest side of the images that shifts are searched in before they are refined.
_SEARCH_PX = 96

#: Pixels that judge a shift, at most.
_JUDGES = 1000

#: Shifts are about as good if they lack at most this share of what the best gains.
_AS_GOOD = 0.2

#: A shift must leave at most this share of the changed pixels unexplained.
_UNEXPLAINED = 0.5

#: Images of fewer pixels are OpenCV's to measure.
_SMALL_PX = 1 << 14

#: What is looked up of a moving thing is that near to its box: whole pixels, and between two.
_LOOKED_AT_PX = 3

#: A change of this width is an outline that moved by a pixel or two.
OUTLINE_PX = 2.0


def interpolate_masks(
    before: list[NDArray[np.uint8]], after: list[NDArray[np.uint8]], fraction: float
) -> list[NDArray[np.uint8]]:
    """Return estimated silhouettes of an instant between two frames.

    Parameters
    ----------
    before, after : list of C (H, W) uint8
        Silhouettes of two frames; object pixels are those above 0.
    fraction : float
        The instant: 0 gives `before`, 1 gives `after`, pixel for pixel.

    Returns
    -------
    list of C (H, W) uint8
        1 on object pixels, else 0. Where both frames agree, so does the result, unless something
        that moves crosses the place in between; nothing changes outside the box of all changes.

    Raises
    ------
    ValueError
        If the fraction is not within 0..1, or the frames' images differ in number or size.

    Examples
    --------
    A bar of four pixels that moves by ten, more than twice its width:

    >>> before, after = np.zeros((2, 9, 24), np.uint8)
    >>> before[3:7, 2:6] = after[3:7, 12:16] = 1
    >>> (middle,) = interpolate_masks([before], [after], 0.5)
    >>> np.flatnonzero(middle[4]).tolist()
    [7, 8, 9, 10]
    """
    if not 0.0 <= fraction <= 1.0:
        raise ValueError(f"fraction is {fraction}, expected 0..1")
    if len(before) != len(after):
        raise ValueError(f"{len(before)} masks before and {len(after)} after")
    for camera, (first, second) in enumerate(zip(before, after, strict=True)):
        if first.shape != second.shape:
            raise ValueError(
                f"mask {camera} has shape {first.shape} before and {second.shape} after"
            )
    return [
        follow_outline(_binary(first), _binary(second), (0, first.shape[0], 0, first.shape[1])).at(
            fraction
        )
        for first, second in zip(before, after, strict=True)
    ]


@dataclass(frozen=True, slots=True, eq=False)
class _Move:
    """Something that moves in an image: a shift (x, y) in pixels, and its box in `before`."""

    shift_px: tuple[int, int]
    box: Box


@dataclass(frozen=True, slots=True, eq=False)
class Outline:
    """The silhouettes of one camera between two frames, right within a window.

    Attributes
    ----------
    before, after : (H, W) uint8
        The masks of the two frames.
    changed : box
        Around all pixels in which the masks differ, cut to the window; elsewhere `at` gives
        `before`.
    crop : box
        Where distances are known.
    distance_before, distance_after : (crop) float32
        Signed distances in pixels, positive on the object; right to `CAP_PX` where the masks differ
        and about the boxes of `moves`, there before and here after. Elsewhere no more than their
        sign is right, and nothing more is asked of them: where both masks agree they blend to that.
    moves : tuple of _Move
        What moves.
    """

    before: NDArray[np.uint8]
    after: NDArray[np.uint8]
    changed: Box
    crop: Box
    distance_before: NDArray[np.float32]
    distance_after: NDArray[np.float32]
    moves: tuple[_Move, ...]

    def at(self, fraction: float) -> NDArray[np.uint8]:
        """Return the mask (H, W) of an instant."""
        if fraction == 1.0:
            return self.after.copy()
        mask = self.before.copy()
        if fraction == 0.0 or is_empty(self.changed):
            return mask
        mask[slices_of(self.changed)] = self.blend(fraction, self.changed)
        for move in self.moves:
            box = self.moved_box(move, fraction)
            if not is_empty(box):
                mask[slices_of(box)] |= self.blend(fraction, box, move.shift_px)
        return mask

    def blend(
        self, fraction: float, box: Box, shift_px: tuple[int, int] = (0, 0)
    ) -> NDArray[np.uint8]:
        """Return the blend of both distances, shifted towards each other, where it is positive."""
        x, y = shift_px
        first = self._distance(self.distance_before, box, -fraction * x, -fraction * y)
        second = self._distance(
            self.distance_after, box, (1.0 - fraction) * x, (1.0 - fraction) * y
        )
        blended = cv2.addWeighted(first, 1.0 - fraction, second, fraction, 0.0)
        positive: NDArray[np.uint8] = np.greater(blended, 0.0).view(np.uint8)
        return positive

    def moved_box(self, move: _Move, fraction: float) -> Box:
        """Return where something that moves is at an instant, within `changed`."""
        top, bottom, left, right = move.box
        x, y = fraction * move.shift_px[0], fraction * move.shift_px[1]
        moved = (
            math.floor(top + y),
            math.ceil(bottom + y),
            math.floor(left + x),
            math.ceil(right + x),
        )
        return intersection(moved, self.changed)

    def _distance(
        self, distance: NDArray[np.float32], box: Box, x: float, y: float
    ) -> NDArray[np.float32]:
        """Return distances in a box, looked up (x, y) pixels beside it."""
        top, bottom, left, right = box
        center = (
            left - self.crop[2] + x + (right - left - 1) / 2,
            top - self.crop[0] + y + (bottom - top - 1) / 2,
        )
        size = (right - left, bottom - top)
        return np.asarray(cv2.getRectSubPix(distance, size, center), np.float32)


def follow_outline(before: NDArray[np.uint8], after: NDArray[np.uint8], window: Box) -> Outline:
    """Return one camera's outlines between two frames, right within a window.

    What they are there does not depend on the window.
    """
    nothing = np.zeros((0, 0), np.float32)
    difference = before ^ after
    all_changed = box_of(difference)
    changed = intersection(all_changed, window)
    if is_empty(changed):
        return Outline(before, after, changed, changed, nothing, nothing, ())
    swept = [
        (move, union(move.box, shifted(move.box, move.shift_px)))
        for move in _find_moves(before, after, difference, all_changed)
    ]
    swept = [(move, box) for move, box in swept if not is_empty(intersection(box, changed))]
    whole = (0, before.shape[0], 0, before.shape[1])
    needed = changed
    for _, box in swept:
        needed = union(needed, box)
    crop = intersection(grown_box(needed, CAP_PX), whole)
    distances = []
    for mask, is_after in ((before, False), (after, True)):
        wanted = difference[slices_of(crop)].copy()
        for move, _ in swept:
            box = shifted(move.box, move.shift_px) if is_after else move.box
            box = intersection(grown_box(box, _LOOKED_AT_PX), crop)
            wanted[slices_of(shifted(box, (-crop[2], -crop[0])))] = 1
        distances.append(distances_where(np.ascontiguousarray(mask[slices_of(crop)]), wanted))
    return Outline(
        before, after, changed, crop, distances[0], distances[1], tuple(move for move, _ in swept)
    )


def _binary(mask: NDArray[np.uint8]) -> NDArray[np.uint8]:
    binary: NDArray[np.uint8] = np.greater(mask, 0).view(np.uint8)
    return binary


def signed_distance_px(mask: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return distances to the outline in pixels, positive on the object, capped.

    The outline lies halfway between the centres of pixels, so no pixel has a distance of 0.
    """
    inside = cv2.distanceTransform(mask, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    outside = cv2.distanceTransform(1 - mask, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    np.clip(inside, 0.0, CAP_PX, out=inside)
    np.clip(outside, 0.0, CAP_PX, out=outside)
    signed = inside - outside
    return np.asarray(signed - np.float32(0.5) * np.sign(signed), np.float32)


def distances_where(mask: NDArray[np.uint8], wanted: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return what `signed_distance_px` does where it is wanted, and elsewhere its sign alone.

    OpenCV has another code, less exact by a rounding, for images so small that it takes no time.

    Parameters
    ----------
    mask : (H, W) uint8
        1 on the object, else 0.
    wanted : (H, W) uint8
        Not 0 where distances are to be right.
    """
    if mask.size < _SMALL_PX:
        return signed_distance_px(mask)
    return _distances_where(mask, wanted)


@compiled
def _distances_where(mask: NDArray[np.uint8], wanted: NDArray[np.uint8]) -> NDArray[np.float32]:
    height, width = mask.shape
    beyond = np.int32(CAP_PX + 1)
    # How far the nearest pixel of the other kind is in the same column.
    away = np.zeros((height, width), np.int32)
    for x in range(width):
        away[0, x] = beyond
    for y in range(1, height):
        for x in range(width):
            far = min(away[y - 1, x] + 1, beyond)
            away[y, x] = far if mask[y, x] == mask[y - 1, x] else 1
    for y in range(height - 2, -1, -1):
        for x in range(width):
            far = away[y + 1, x] + 1 if mask[y, x] == mask[y + 1, x] else 1
            away[y, x] = min(away[y, x], far)
    found = np.zeros((height, width), np.float32)
    for y in range(height):
        for x in range(width):
            kind = mask[y, x]
            pixels = np.float32(1.5)
            if wanted[y, x]:
                nearest = away[y, x] * away[y, x]
                for beside in range(1, CAP_PX + 1):
                    squared = beside * beside
                    if squared >= nearest:
                        break
                    if x >= beside:
                        far = away[y, x - beside] if mask[y, x - beside] == kind else 0
                        nearest = min(nearest, squared + far * far)
                    if x + beside < width:
                        far = away[y, x + beside] if mask[y, x + beside] == kind else 0
                        nearest = min(nearest, squared + far * far)
                pixels = min(np.sqrt(np.float32(nearest)), np.float32(CAP_PX))
            pixels -= np.float32(0.5)
            found[y, x] = pixels if kind else -pixels
    return found


def _find_moves(
    before: NDArray[np.uint8],
    after: NDArray[np.uint8],
    difference: NDArray[np.uint8],
    changed: Box,
) -> list[_Move]:
    """Return the shifts that explain what changed between two masks, largest change first.

    None if one mask lies within the other: what grows is only blended, and so grows all the time.
    Else changed pixels are joined into clusters. A cluster that a plain blend would thin, because
    the change is wider than an outline, looks for the shift under which both masks agree in it.
    """
    reach = max(16, changed[1] - changed[0], changed[3] - changed[2])
    crop = intersection(grown_box(changed, reach), (0, before.shape[0], 0, before.shape[1]))
    first, second = before[slices_of(crop)], after[slices_of(crop)]
    left_over = difference[slices_of(crop)].copy()
    if not (left_over & first).any() or not (left_over & second).any():
        return []
    # Even offsets: OpenCV numbers components by squares of two pixels.
    whole = (0, first.shape[0], 0, first.shape[1])
    top, bottom, left, right = grown_box(shifted(changed, (-crop[2], -crop[0])), 2 * _MARGIN_PX)
    busy = intersection((top - top % 2, bottom, left - left % 2, right), whole)
    near = cv2.dilate(
        left_over[slices_of(busy)], np.ones((2 * _MARGIN_PX + 1, 2 * _MARGIN_PX + 1), np.uint8)
    )
    _, labels, stats, _ = cv2.connectedComponentsWithStats(near, connectivity=8)
    areas = np.bincount(labels[left_over[slices_of(busy)].view(np.bool_)], minlength=len(stats))
    pair: _Pair | None = None
    moves: list[_Move] = []
    for label in np.argsort(-areas, kind="stable")[:_MOST_MOVES].tolist():
        if areas[label] < _SMALLEST_CHANGE_PX:
            break
        left, top, width, height = stats[label, :4].tolist()
        cluster = labels[top : top + height, left : left + width] == label
        box = shifted((top, top + height, left, left + width), (busy[2], busy[0]))
        part = slices_of(box)
        change = left_over[part] * cluster
        if 2 * int(change.sum()) < areas[label]:
            continue  # explained by an earlier shift
        kept = int((first[part] & second[part] & cluster).sum())
        thickness_px = cv2.distanceTransform(change, cv2.DIST_L2, cv2.DIST_MASK_3).max()
        if thickness_px < OUTLINE_PX and 2 * kept >= areas[label]:
            continue
        pair = pair or _Pair.of(first, second)
        shift_px = _shift_of(pair, box, cluster)
        if shift_px == (0, 0):
            continue
        there = np.zeros(first.shape, np.bool_)
        there[part] = cluster
        explained = _explain(first, second, left_over, there, shift_px)
        if not is_empty(explained):
            moves.append(_Move(shift_px, shifted(explained, (crop[2], crop[0]))))
    return moves


@dataclass(frozen=True, slots=True, eq=False)
class _Pair:
    """Two masks in which shifts are searched, and their reduced images in frequencies.

    Attributes
    ----------
    before, after : (H, W) uint8
        The masks.
    factor : int
        By how much they are reduced.
    size : (int, int)
        Of the reduced images, with room to shift.
    before_f, after_f : complex128
        Their transforms.
    """

    before: NDArray[np.uint8]
    after: NDArray[np.uint8]
    factor: int
    size: tuple[int, int]
    before_f: NDArray[np.complex128]
    after_f: NDArray[np.complex128]

    @classmethod
    def of(cls, before: NDArray[np.uint8], after: NDArray[np.uint8]) -> Self:
        """Return the pair of two masks."""
        height, width = before.shape
        factor = max(1, -(-max(before.shape) // _SEARCH_PX))
        size = (
            cv2.getOptimalDFTSize(2 * -(-height // factor)),
            cv2.getOptimalDFTSize(2 * -(-width // factor)),
        )
        nothing = np.zeros((0, 0), np.complex128)
        pair = cls(before, after, factor, size, nothing, nothing)
        found = []
        for mask in (before, after):
            box = box_of(np.ascontiguousarray(mask))
            found.append(pair.transformed(box, mask[slices_of(box)].astype(np.float64)))
        return replace(pair, before_f=found[0], after_f=found[1])

    def transformed(self, box: Box, part: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Return the transform of an image that is `part` in a box and 0 elsewhere, reduced."""
        factor, (height, width) = self.factor, self.before.shape
        small = np.zeros((-(-height // factor), -(-width // factor)))
        if not is_empty(box):
            top, left = box[0] // factor, box[2] // factor
            # Squares that begin within the box, whole or cut by the border.
            bottom, right = -(-box[1] // factor), -(-box[3] // factor)
            own = intersection(
                (factor * top, factor * bottom, factor * left, factor * right),
                (0, height, 0, width),
            )
            image = np.zeros((own[1] - own[0], own[3] - own[2]))
            image[slices_of(shifted(box, (-own[2], -own[0])))] = part
            small[top:bottom, left:right] = _reduced(image, factor)
        return np.fft.rfft2(small, self.size)


def _shift_of(pair: _Pair, box: Box, cluster: NDArray[np.bool_]) -> tuple[int, int]:
    """Return the shift (x, y) under which two masks agree in a cluster; (0, 0) if there is none.

    Agreement is counted both ways: the pixels of the cluster in `after` against `before`, and
    those in `before` against `after`; everywhere by correlation in reduced images, then by pixels.
    """
    before, after, factor, size = pair.before, pair.after, pair.factor, pair.size
    parts = []
    for mask in (before, after):
        # Background as a whole weighs no more than what is thin in it, which reducing blurs.
        here = mask[slices_of(box)].astype(np.float64) * cluster
        n_object, n_background = here.sum(), (cluster > here).sum()
        weight = min(1.0, n_object / n_background) if n_object and n_background else 1.0
        parts.append(pair.transformed(box, here - weight * (cluster > here)))
    part_before_f, part_after_f = parts
    agreement = np.fft.irfft2(
        part_after_f * np.conj(pair.before_f) + np.conj(part_before_f) * pair.after_f, size
    )
    # To whole pixels, so that ties are ties. Of peaks that are about as good the shortest shift: of
    # two like things each came from where it was, not from where the other was.
    agreement = np.rint(agreement * factor**2)
    most = agreement.max()  # 0 where nothing meets anything
    enough = most - _AS_GOOD * max(0.0, min(most, most - agreement[0, 0]))
    is_peak = agreement == cv2.dilate(agreement, np.ones((3, 3), np.uint8))
    rows, columns = np.nonzero(is_peak & (agreement >= enough))
    ys = np.where(rows * 2 >= size[0], rows - size[0], rows)
    xs = np.where(columns * 2 >= size[1], columns - size[1], columns)
    nearest = int(np.argmin(ys**2 + xs**2))
    x, y = factor * int(xs[nearest]), factor * int(ys[nearest])

    at_y, at_x = np.nonzero(cluster)
    every = -(-len(at_y) // _JUDGES)
    at_y, at_x = at_y[::every] + box[0], at_x[::every] + box[2]
    at_y, at_x = np.ascontiguousarray(at_y), np.ascontiguousarray(at_x)

    @cache
    def judged(x: int, y: int) -> tuple[int, int, int, int]:
        """Return how much disagrees, then what settles ties: the shorter shift, then any order."""
        return _n_disagree(before, after, at_y, at_x, x, y), x * x + y * y, y, x

    best = judged(x, y)
    step = factor
    while step >= 1:
        _, _, y, x = best
        best = min(judged(x + step * i, y + step * j) for i in (-1, 0, 1) for j in (-1, 0, 1))
        if best[2:] == (y, x):
            step //= 2
    if best[0] > _UNEXPLAINED * judged(0, 0)[0]:
        return 0, 0
    return best[3], best[2]


@compiled
def _n_disagree(
    before: NDArray[np.uint8],
    after: NDArray[np.uint8],
    at_y: NDArray[np.int64],
    at_x: NDArray[np.int64],
    x: int,
    y: int,
) -> int:
    """Return how many of some pixels of each mask disagree with the other, shifted by (x, y)."""
    height, width = before.shape
    count = 0
    for i in range(len(at_y)):
        row, column = at_y[i], at_x[i]
        source_y, source_x = min(max(row - y, 0), height - 1), min(max(column - x, 0), width - 1)
        goal_y, goal_x = min(max(row + y, 0), height - 1), min(max(column + x, 0), width - 1)
        count += before[source_y, source_x] != after[row, column]
        count += after[goal_y, goal_x] != before[row, column]
    return count


def _reduced(image: NDArray[np.float64], factor: int) -> NDArray[np.float64]:
    """Return means over squares of `factor` pixels; those beyond the border count as 0."""
    height, width = image.shape
    padded = cv2.copyMakeBorder(
        image, 0, -height % factor, 0, -width % factor, cv2.BORDER_CONSTANT, value=0.0
    )
    size = (padded.shape[1] // factor, padded.shape[0] // factor)
    return np.asarray(cv2.resize(padded, size, interpolation=cv2.INTER_AREA), np.float64)


def _explain(
    before: NDArray[np.uint8],
    after: NDArray[np.uint8],
    left_over: NDArray[np.uint8],
    cluster: NDArray[np.bool_],
    shift_px: tuple[int, int],
) -> Box:
    """Return the box, in `before`, of what a shift explains in a cluster.

    Takes the changed pixels that it explains in the box, and where the box goes, from `left_over`.
    """
    x, y = shift_px
    height, width = before.shape
    # A pixel p of `before` and p + shift of `after`, where both are in the image.
    whole = (0, height, 0, width)
    source = intersection(whole, shifted(whole, (-x, -y)))
    if is_empty(source):
        return source
    target = shifted(source, shift_px)
    carried = before[slices_of(source)] & after[slices_of(target)]
    change = left_over * cluster
    box = box_of(carried & (change[slices_of(source)] | change[slices_of(target)]))
    if is_empty(box):
        return box
    box = intersection(grown_box(shifted(box, (source[2], source[0])), _MARGIN_PX), source)
    goal = shifted(box, shift_px)
    moved = before[slices_of(box)] & after[slices_of(goal)]
    left_over[slices_of(box)] &= 1 - moved
    left_over[slices_of(goal)] &= 1 - moved
    return box
