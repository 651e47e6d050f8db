"""When and where the hull first touched an object: between the last free frame and the next.

The paper cannot backtrack real objects (section 4.3); a recording can look at both sides of the
instant. Between two frames nothing was seen, so the outlines between them are an *estimate*:

* Each silhouette's signed distance to its outline, positive on the object, is blended:
  ``(1 - f) d_before(x) + f d_after(x) > 0``. Distances are capped at `_CAP_PX`.
* A blend alone loses what moves by its own width in a frame: a disc of radius r that moves by D
  becomes an ellipse of half-width sqrt(r^2 - D^2/4), and nothing at D = 2 r. So what moves is
  found first (`_find_moves`): a shift s that carries the changed pixels of one frame onto those of
  the other. Then ``(1 - f) d_before(x - f s) + f d_after(x + (1 - f) s)`` is asked as well, within
  the box that moves along. A pixel is on the object where either is positive.

Why either: the distance of a convex shape is concave, and the two places asked have the mean x, or
differ from the right ones by an offset whose weighted mean is 0. By Jensen's inequality the blend
with a wrong shift lies within the blend with the right one, for what stands still as for what
moves. A shift that is off by e thins an outline of radius r by no more than e^2 / (8 r), so whole
pixels are good enough.

An outline that moves by one pixel passes that pixel half-way, by construction: a thing slower than
some pixels a frame has its contact in the middle, which is the best that can be said.

A camera that moves is taken to go straight and to turn evenly between its two poses. Both of its
silhouettes are first turned to where it looks at the instant, which is exact but for what its
straight way shifts; the rest is motion as above.

What no shift explains and no blend keeps, something that was not there a frame before, is told by
the status "outline lost": then the instant is unknown within the frame.
"""

import itertools
import math
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.hull.contact.detect import Body, Contact
from hybridve.hull.query.certify import COLLIDING, Certifier
from hybridve.hull.query.engine import Engine
from hybridve.hull.query.reference import contains_points
from hybridve.hull.query.silhouettes import Hull, Views, interpolated_views, make_hull
from hybridve.hull.query.viewport import sample_positions

#: Distances to an outline end here, so that they depend on no pixel farther away.
_CAP_PX = 64

#: First looks at each frame pair, evenly spaced: contact is not assumed to last once begun.
_N_COARSE = 16

#: The first colliding fraction is known to this.
_RESOLUTION = 1.0 / 256

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

#: A change of this width is an outline that moved by a pixel or two.
_OUTLINE_PX = 2.0

#: Halfway, a blend covers about half of what was gained; below this share its outline is lost.
_LOST_SHARE = 0.25

#: Samples across the square in which the patch of first contact is looked for, and triangles.
_PATCH_SAMPLES = 33
_PATCH_TRIANGLES = 32

#: Collision points of an engine that are asked again in double precision.
_MOST_SAMPLES = 4096

#: A part of an image: rows and columns, both from the first to the one after the last.
_Box = tuple[int, int, int, int]


@dataclass(frozen=True, slots=True, eq=False)
class FirstContact:
    """When and where the hull first touched an object, between two frames.

    Attributes
    ----------
    fraction : float
        Estimate: the instant, 0 at the last free frame, 1 at the first that collides.
    fraction_uncertainty : float
        Bound: how far the instant can be from it. All that is certain is that it lies between the
        two frames: ``max(fraction, 1 - fraction)``.
    point_world : (3,) float64
        Metres: estimate of the point of first contact. It lies on the object's surface.
    status : str
        ``""``: as described. ``"outline lost"``: what touches was not there a frame before, or
        moved in a way that cannot be followed; the fraction is 0.5, the point one of the second
        frame. ``"touches before"``: the object's surface is in the hull of the free frame already,
        between its samples; the fraction is 0, and contact began there or earlier.
        ``"no touch found"``: not even the second frame's hull holds a point of the surface in
        double precision; the fraction is 1, the point that of the contact.
    """

    fraction: float
    fraction_uncertainty: float
    point_world: NDArray[np.float64]
    status: str


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
        _follow(_binary(first), _binary(second), (0, first.shape[0], 0, first.shape[1])).at(
            fraction
        )
        for first, second in zip(before, after, strict=True)
    ]


def interpolated_hull(before: Hull, after: Hull, fraction: float) -> Hull:
    """Return the estimated hull of an instant between two frames; see `interpolate_masks`.

    Raises
    ------
    ValueError
        If the fraction is not within 0..1, or the two hulls are not of the same cameras.
    """
    if not 0.0 <= fraction <= 1.0:
        raise ValueError(f"fraction is {fraction}, expected 0..1")
    windows = [(0, int(height), 0, int(width)) for width, height in before.views.sizes_px]
    return _Between(before, after, windows).hull(fraction)


def first_contact(
    before: Hull,
    after: Hull,
    body: Body,
    contact: Contact,
    certifier: Certifier | None,
    engine: Engine,
) -> FirstContact:
    """Return when and where an object that is free in one frame and collides in the next was hit.

    The interpolated hulls of `_N_COARSE` instants are asked in turn, then the interval before the
    first that touches is halved down to `_RESOLUTION`.

    Parameters
    ----------
    before, after : Hull
        The last frame without and the first with a collision, of the same cameras.
    body : Body
        The object, at rest between the two.
    contact : Contact
        Its contact with `after`.
    certifier : Certifier or None
        Says whether a hull holds a point of the surface. Without one the samples of `engine` do,
        checked in double precision.
    engine : Engine
        Not used where there is a certifier.

    Raises
    ------
    ValueError
        If the hulls are not of the same cameras, or the contact has neither points nor a witness.
    """
    interpolated_views(before.views, after.views, 0.5)  # other cameras are refused
    if not contact.collides and not np.isfinite(contact.witness_world).all():
        raise ValueError(f"object {body.name}: the contact has neither points nor a witness")
    probe = _Probe(body, certifier, engine)
    if probe.touches(before):
        return FirstContact(0.0, 1.0, probe.patch_center(before), "touches before")
    between = _Between(before, after, _windows(before.views, body))
    free, touching = 0.0, 1.0
    last_free, first_touching = before, after
    for step in range(1, _N_COARSE + 1):
        fraction = step / _N_COARSE
        hull = between.hull(fraction)
        if probe.touches(hull):
            touching, first_touching = fraction, hull
            break
        free, last_free = fraction, hull
    else:
        return FirstContact(1.0, 1.0, _point_of(contact), "no touch found")
    while touching - free > _RESOLUTION:
        middle = 0.5 * (free + touching)
        hull = between.hull(middle)
        if probe.touches(hull):
            touching, first_touching = middle, hull
        else:
            free, last_free = middle, hull
    point_world = probe.patch_center(first_touching)
    outlines = between.outlines(touching)
    if _outline_is_lost(outlines, last_free, first_touching, touching, point_world):
        return FirstContact(0.5, 0.5, probe.patch_center(after), "outline lost")
    return FirstContact(touching, max(touching, 1.0 - touching), point_world, "")


def approach_speed(
    clearance_before_m: tuple[float, float], clearance_last_m: tuple[float, float], dt_s: float
) -> tuple[float, float]:
    """Return bounds of the mean speed in m/s at which a clearance shrank between two frames.

    Parameters
    ----------
    clearance_before_m, clearance_last_m : (lower, upper)
        Bounds of the clearance, in metres, in the last frame but one and in the last; an upper
        bound may be infinite, and NaN says that a bound is unknown.
    dt_s : float
        Time between the two.

    Returns
    -------
    (lower, upper)
        Positive where the hull came nearer; NaN where it depends on an unknown bound, infinite
        where nothing bounds it.

    Raises
    ------
    ValueError
        If the time is not positive, or a lower bound is above its upper one.

    Examples
    --------
    From 30 to 10 mm, each known to a millimetre, in a fiftieth of a second:

    >>> lower, upper = approach_speed((0.030, 0.031), (0.010, 0.011), 0.02)
    >>> round(lower, 3), round(upper, 3)
    (0.95, 1.05)
    """
    if not 0.0 < dt_s < math.inf:
        raise ValueError(f"dt_s is {dt_s}, expected a positive time")
    for lower, upper in (clearance_before_m, clearance_last_m):
        if lower > upper:
            raise ValueError(f"a clearance of {lower} to {upper} m: the bounds are the wrong way")
    return (
        _difference(clearance_before_m[0], clearance_last_m[1], -math.inf) / dt_s,
        _difference(clearance_before_m[1], clearance_last_m[0], math.inf) / dt_s,
    )


def _difference(first: float, second: float, unbounded: float) -> float:
    """Return first - second, and `unbounded` where both are infinite."""
    return unbounded if math.isinf(first) and first == second else float(first) - float(second)


def _point_of(contact: Contact) -> NDArray[np.float64]:
    """Return a point of a contact: its witness, or the first of its points."""
    if np.isfinite(contact.witness_world).all():
        return contact.witness_world
    return np.asarray(contact.some_points(1)[0][0])


# --- outlines between two frames ------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _Move:
    """Something that moves in an image: a shift (x, y) in pixels, and its box in `before`."""

    shift_px: tuple[int, int]
    box: _Box


@dataclass(frozen=True, slots=True, eq=False)
class _Outline:
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
        Signed distances in pixels, positive on the object; right to `_CAP_PX` within `changed`
        and the boxes of `moves`.
    moves : tuple of _Move
        What moves.
    """

    before: NDArray[np.uint8]
    after: NDArray[np.uint8]
    changed: _Box
    crop: _Box
    distance_before: NDArray[np.float32]
    distance_after: NDArray[np.float32]
    moves: tuple[_Move, ...]

    def at(self, fraction: float) -> NDArray[np.uint8]:
        """Return the mask (H, W) of an instant."""
        if fraction == 1.0:
            return self.after.copy()
        mask = self.before.copy()
        if fraction == 0.0 or _is_empty(self.changed):
            return mask
        mask[_slices(self.changed)] = self.blend(fraction, self.changed)
        for move in self.moves:
            box = self.moved_box(move, fraction)
            if not _is_empty(box):
                mask[_slices(box)] |= self.blend(fraction, box, move.shift_px)
        return mask

    def blend(
        self, fraction: float, box: _Box, shift_px: tuple[int, int] = (0, 0)
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

    def moved_box(self, move: _Move, fraction: float) -> _Box:
        """Return where something that moves is at an instant, within `changed`."""
        top, bottom, left, right = move.box
        x, y = fraction * move.shift_px[0], fraction * move.shift_px[1]
        moved = (
            math.floor(top + y),
            math.ceil(bottom + y),
            math.floor(left + x),
            math.ceil(right + x),
        )
        return _intersection(moved, self.changed)

    def _distance(
        self, distance: NDArray[np.float32], box: _Box, x: float, y: float
    ) -> NDArray[np.float32]:
        """Return distances in a box, looked up (x, y) pixels beside it."""
        top, bottom, left, right = box
        center = (
            left - self.crop[2] + x + (right - left - 1) / 2,
            top - self.crop[0] + y + (bottom - top - 1) / 2,
        )
        size = (right - left, bottom - top)
        return np.asarray(cv2.getRectSubPix(distance, size, center), np.float32)


def _follow(before: NDArray[np.uint8], after: NDArray[np.uint8], window: _Box) -> _Outline:
    """Return one camera's outlines between two frames, right within a window.

    What they are there does not depend on the window.
    """
    nothing = np.zeros((0, 0), np.float32)
    difference = before ^ after
    all_changed = _box_of(difference)
    changed = _intersection(all_changed, window)
    if _is_empty(changed):
        return _Outline(before, after, changed, changed, nothing, nothing, ())
    swept = [
        (move, _union(move.box, _shifted(move.box, move.shift_px)))
        for move in _find_moves(before, after, difference, all_changed)
    ]
    swept = [(move, box) for move, box in swept if not _is_empty(_intersection(box, changed))]
    whole = (0, before.shape[0], 0, before.shape[1])
    needed = changed
    for _, box in swept:
        needed = _union(needed, box)
    crop = _intersection(_grown(needed, _CAP_PX), whole)
    return _Outline(
        before,
        after,
        changed,
        crop,
        _signed_distance(before[_slices(crop)]),
        _signed_distance(after[_slices(crop)]),
        tuple(move for move, _ in swept),
    )


class _Between:
    """The hulls of instants between two frames.

    Parameters
    ----------
    before, after : Hull
        Of the two frames, of the same cameras.
    windows : list of box
        Where the silhouettes of each camera have to be right; those of a camera that moves are so
        everywhere, as an object may pass through any part of its image.

    Raises
    ------
    ValueError
        If the hulls are not of the same cameras.
    """

    def __init__(self, before: Hull, after: Hull, windows: list[_Box]) -> None:
        interpolated_views(before.views, after.views, 0.5)  # other cameras are refused
        self._before, self._after = before, after
        first, second = before.views.img_from_local, after.views.img_from_local
        self._still = {
            camera: _follow(before.mask(camera), after.mask(camera), window)
            for camera, window in enumerate(windows)
            if (first[camera] == second[camera]).all()
        }

    def outlines(self, fraction: float) -> list[_Outline]:
        """Return the outlines of all cameras; those of moving ones as they look at an instant."""
        views = interpolated_views(self._before.views, self._after.views, fraction)
        return [
            self._still[camera] if camera in self._still else self._turned(camera, views)
            for camera in range(len(views))
        ]

    def hull(self, fraction: float) -> Hull:
        """Return the hull of an instant."""
        if fraction == 1.0:
            return self._after
        views = interpolated_views(self._before.views, self._after.views, fraction)
        return make_hull(views, [outline.at(fraction) for outline in self.outlines(fraction)])

    def _turned(self, camera: int, views: Views) -> _Outline:
        height, width = self._before.mask(camera).shape
        before, after = (
            _turned_mask(
                hull.mask(camera),
                hull.views.img_from_local[camera, :, :3],
                views.img_from_local[camera, :, :3],
            )
            for hull in (self._before, self._after)
        )
        return _follow(before, after, (0, height, 0, width))


def _turned_mask(
    mask: NDArray[np.uint8], from_local: NDArray[np.float64], to_local: NDArray[np.float64]
) -> NDArray[np.uint8]:
    """Return a silhouette as its camera sees it turned on the spot; 0 where it saw nothing.

    The projections (3, 3), without their last columns, hold lens and rotation.
    """
    if (from_local == to_local).all():
        return mask
    centre = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])  # OpenCV's is at 0
    turn = np.linalg.inv(centre) @ to_local @ np.linalg.inv(from_local) @ centre
    size = (mask.shape[1], mask.shape[0])
    return np.asarray(cv2.warpPerspective(mask, turn, size, flags=cv2.INTER_NEAREST), np.uint8)


def _binary(mask: NDArray[np.uint8]) -> NDArray[np.uint8]:
    binary: NDArray[np.uint8] = np.greater(mask, 0).view(np.uint8)
    return binary


def _signed_distance(mask: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return distances to the outline in pixels, positive on the object, capped.

    The outline lies halfway between the centres of pixels, so no pixel has a distance of 0.
    """
    inside = cv2.distanceTransform(mask, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    outside = cv2.distanceTransform(1 - mask, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    np.clip(inside, 0.0, _CAP_PX, out=inside)
    np.clip(outside, 0.0, _CAP_PX, out=outside)
    signed = inside - outside
    return np.asarray(signed - np.float32(0.5) * np.sign(signed), np.float32)


def _find_moves(
    before: NDArray[np.uint8],
    after: NDArray[np.uint8],
    difference: NDArray[np.uint8],
    changed: _Box,
) -> list[_Move]:
    """Return the shifts that explain what changed between two masks, largest change first.

    None if one mask lies within the other: what grows is only blended, and so grows all the time.
    Else changed pixels are joined into clusters. A cluster that a plain blend would thin, because
    the change is wider than an outline, looks for the shift under which both masks agree in it.
    """
    reach = max(16, changed[1] - changed[0], changed[3] - changed[2])
    crop = _intersection(_grown(changed, reach), (0, before.shape[0], 0, before.shape[1]))
    first, second = before[_slices(crop)], after[_slices(crop)]
    left_over = difference[_slices(crop)].copy()
    if not (left_over & first).any() or not (left_over & second).any():
        return []
    near = cv2.dilate(left_over, np.ones((2 * _MARGIN_PX + 1, 2 * _MARGIN_PX + 1), np.uint8))
    _, labels, stats, _ = cv2.connectedComponentsWithStats(near, connectivity=8)
    areas = np.bincount(labels[left_over.view(np.bool_)], minlength=len(stats))
    moves: list[_Move] = []
    for label in np.argsort(-areas, kind="stable")[:_MOST_MOVES].tolist():
        if areas[label] < _SMALLEST_CHANGE_PX:
            break
        left, top, width, height = stats[label, :4].tolist()
        part = (slice(top, top + height), slice(left, left + width))
        cluster = labels[part] == label
        change = left_over[part] * cluster
        if 2 * int(change.sum()) < areas[label]:
            continue  # explained by an earlier shift
        kept = int((first[part] & second[part] & cluster).sum())
        thickness_px = cv2.distanceTransform(change, cv2.DIST_L2, cv2.DIST_MASK_3).max()
        if thickness_px < _OUTLINE_PX and 2 * kept >= areas[label]:
            continue
        shift_px = _shift_of(first, second, (top, top + height, left, left + width), cluster)
        if shift_px == (0, 0):
            continue
        box = _explain(first, second, left_over, labels == label, shift_px)
        if not _is_empty(box):
            moves.append(_Move(shift_px, _shifted(box, (crop[2], crop[0]))))
    return moves


def _shift_of(
    before: NDArray[np.uint8],
    after: NDArray[np.uint8],
    box: _Box,
    cluster: NDArray[np.bool_],
) -> tuple[int, int]:
    """Return the shift (x, y) under which two masks agree in a cluster; (0, 0) if there is none.

    Agreement is counted both ways: the pixels of the cluster in `after` against `before`, and
    those in `before` against `after`; everywhere by correlation in reduced images, then by pixels.
    """
    factor = max(1, -(-max(before.shape) // _SEARCH_PX))
    masks = [mask.astype(np.float64) for mask in (before, after)]
    parts = [np.zeros_like(mask) for mask in masks]
    for part, mask in zip(parts, masks, strict=True):
        # Background as a whole weighs no more than what is thin in it, which reducing blurs.
        here = mask[_slices(box)] * cluster
        n_object, n_background = here.sum(), (cluster > here).sum()
        weight = min(1.0, n_object / n_background) if n_object and n_background else 1.0
        part[_slices(box)] = here - weight * (cluster > here)
    small = [_reduced(image, factor) for image in (*masks, *parts)]
    size = tuple(cv2.getOptimalDFTSize(2 * length) for length in small[0].shape)
    before_f, after_f, part_before_f, part_after_f = (np.fft.rfft2(image, size) for image in small)
    agreement = np.fft.irfft2(
        part_after_f * np.conj(before_f) + np.conj(part_before_f) * after_f, size
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
    here_before, here_after = before[at_y, at_x], after[at_y, at_x]

    @cache
    def judged(x: int, y: int) -> tuple[int, int, int, int]:
        """Return how much disagrees, then what settles ties: the shorter shift, then any order."""
        disagree = 0
        for mask, here, sign in ((before, here_after, -1), (after, here_before, 1)):
            rows = np.clip(at_y + sign * y, 0, mask.shape[0] - 1)
            columns = np.clip(at_x + sign * x, 0, mask.shape[1] - 1)
            disagree += int(np.count_nonzero(mask[rows, columns] != here))
        return disagree, x * x + y * y, y, x

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
) -> _Box:
    """Return the box, in `before`, of what a shift explains in a cluster.

    Takes the changed pixels that it explains in the box, and where the box goes, from `left_over`.
    """
    x, y = shift_px
    height, width = before.shape
    # A pixel p of `before` and p + shift of `after`, where both are in the image.
    whole = (0, height, 0, width)
    source = _intersection(whole, _shifted(whole, (-x, -y)))
    if _is_empty(source):
        return source
    target = _shifted(source, shift_px)
    carried = before[_slices(source)] & after[_slices(target)]
    change = left_over * cluster
    box = _box_of(carried & (change[_slices(source)] | change[_slices(target)]))
    if _is_empty(box):
        return box
    box = _intersection(_grown(_shifted(box, (source[2], source[0])), _MARGIN_PX), source)
    goal = _shifted(box, shift_px)
    moved = before[_slices(box)] & after[_slices(goal)]
    left_over[_slices(box)] &= 1 - moved
    left_over[_slices(goal)] &= 1 - moved
    return box


def _outline_is_lost(
    outlines: list[_Outline],
    last_free: Hull,
    first_touching: Hull,
    fraction: float,
    point_world: NDArray[np.float64],
) -> bool:
    """Tell whether the interpolation lost what it lets touch a point first.

    Only the cameras count whose pixel of the point became an object pixel last. There the blend
    must have kept to what that camera gained: halfway it covers about half of it, or little if
    nothing near could move or grow into it.
    """
    views = first_touching.views
    for camera, outline in enumerate(outlines):
        x, y, depth_m = views.project(point_world, camera)
        width, height = views.sizes_px[camera]
        if not (depth_m > 0 and 0 <= x < width * depth_m and 0 <= y < height * depth_m):
            continue  # a camera that abstains
        column, row = int(x / depth_m), int(y / depth_m)
        if last_free.mask(camera)[row, column] or not first_touching.mask(camera)[row, column]:
            continue
        if any(_contains(outline.moved_box(move, fraction), row, column) for move in outline.moves):
            continue
        gained = outline.after & ~outline.before
        if not gained[row, column]:
            continue
        _, labels, stats, _ = cv2.connectedComponentsWithStats(gained, connectivity=8)
        label = labels[row, column]
        left, top, box_width, box_height, area = stats[label].tolist()
        box = (top, top + box_height, left, left + box_width)
        crop = _intersection(_grown(box, _CAP_PX), (0, *gained.shape[:1], 0, *gained.shape[1:]))
        distance_before = _signed_distance(outline.before[_slices(crop)])
        halfway = distance_before + _signed_distance(outline.after[_slices(crop)]) > 0
        halfway |= distance_before > -_OUTLINE_PX  # that near, there is nothing to lose
        covered = int(np.count_nonzero(halfway & (labels[_slices(crop)] == label)))
        if covered < _LOST_SHARE * area:
            return True
    return False


# --- boxes in images ------------------------------------------------------------------------------


def _slices(box: _Box) -> tuple[slice, slice]:
    return slice(box[0], box[1]), slice(box[2], box[3])


def _is_empty(box: _Box) -> bool:
    return box[0] >= box[1] or box[2] >= box[3]


def _contains(box: _Box, row: int, column: int) -> bool:
    return box[0] <= row < box[1] and box[2] <= column < box[3]


def _intersection(a: _Box, b: _Box) -> _Box:
    return max(a[0], b[0]), min(a[1], b[1]), max(a[2], b[2]), min(a[3], b[3])


def _union(a: _Box, b: _Box) -> _Box:
    return min(a[0], b[0]), max(a[1], b[1]), min(a[2], b[2]), max(a[3], b[3])


def _grown(box: _Box, margin: int) -> _Box:
    return box[0] - margin, box[1] + margin, box[2] - margin, box[3] + margin


def _shifted(box: _Box, shift_px: tuple[int, int]) -> _Box:
    x, y = shift_px
    return box[0] + y, box[1] + y, box[2] + x, box[3] + x


def _box_of(mask: NDArray[np.uint8]) -> _Box:
    """Return the box of the pixels that are not 0."""
    left, top, width, height = cv2.boundingRect(mask)
    return top, top + height, left, left + width


def _windows(views: Views, body: Body) -> list[_Box]:
    """Return for each camera a box that the object projects into, with some pixels to spare."""
    ends_world = np.stack([body.lower_world, body.upper_world])
    corners_world = np.array(list(itertools.product(*ends_world.T)))  # (8, 3)
    windows = []
    for camera, (width, height) in enumerate(views.sizes_px.tolist()):
        whole = (0, height, 0, width)
        projected = views.project(corners_world, camera)  # (8, 3)
        if projected[:, 2].min() <= 1e-6:
            windows.append(whole)  # part of it is behind the camera
            continue
        pixels = projected[:, :2] / projected[:, 2:]
        left, top = np.clip(np.floor(pixels.min(axis=0)) - 2, 0, (width, height)).tolist()
        right, bottom = np.clip(np.ceil(pixels.max(axis=0)) + 2, 0, (width, height)).tolist()
        windows.append((int(top), int(bottom), int(left), int(right)))
    return windows


# --- where an object touches a hull ---------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _Probe:
    """Asks hulls about one object, with a certifier or, without one, by samples."""

    body: Body
    certifier: Certifier | None
    engine: Engine

    def touches(self, hull: Hull) -> bool:
        """Tell whether a point of the surface is known to be in a hull."""
        if self.certifier is None:
            return len(self._witnesses(hull)[0]) > 0
        return self.certifier.certify_mesh(hull, self.body.triangles).verdict == COLLIDING

    def patch_center(self, hull: Hull) -> NDArray[np.float64]:
        """Return a point (3,) of the surface in a hull that it touches, amid those about it.

        The patch about the witness on the first triangle that touches is sampled, in squares that
        grow until it is inside them; of its samples the one nearest to their mean is taken.
        """
        triangle, witness_world = self._witnesses(hull)
        first_world = witness_world[0]
        apart_m = np.linalg.norm(witness_world - first_world, axis=1)
        near = np.argsort(apart_m, kind="stable")[:_PATCH_TRIANGLES]
        corners_world = self.body.triangles.corners_world[triangle[near]]
        reach_m = 2.0 * _footprint_m(hull.views, first_world)
        samples_world = np.zeros((0, 3))
        for _ in range(8):
            inside_world, in_rim = _patch(hull, corners_world, first_world, reach_m)
            if len(inside_world) == 0:
                break
            samples_world = inside_world
            if not in_rim:
                break
            reach_m *= 2.0
        if len(samples_world) == 0:
            return np.asarray(first_world, np.float64)
        distance_m = np.linalg.norm(samples_world - samples_world.mean(axis=0), axis=1)
        return np.asarray(samples_world[int(distance_m.argmin())], np.float64)

    def _witnesses(self, hull: Hull) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return triangles (K,) that touch a hull, ascending, and a point (K, 3) of each in it."""
        mesh = self.body.triangles
        if self.certifier is not None:
            found = self.certifier.certify(hull, mesh)
            touching = np.flatnonzero(found.verdict == COLLIDING)
            return touching, found.witness_world[touching]
        (hits,) = self.engine.query(hull, [mesh])
        triangle, sample = hits.samples(_MOST_SAMPLES)
        points_world = sample_positions(
            mesh.vertices_world[mesh.faces[triangle]], mesh.viewports[triangle], sample
        )
        # An engine in single precision may err at the rim of a silhouette.
        inside = contains_points(hull, points_world)
        touching, first = np.unique(triangle[inside], return_index=True)
        return touching.astype(np.int64), points_world[inside][first]


def _footprint_m(views: Views, point_world: NDArray[np.float64]) -> float:
    """Return the smallest side of a pixel at a point, in metres, of the cameras before it."""
    local = np.append(point_world - views.origin_world, 1.0)
    depths_m = views.img_from_local[:, 2] @ local
    px_per_m = np.linalg.norm(views.img_from_local[:, :2, :3], axis=2).max(axis=1)  # at one metre
    seen = depths_m > 0
    return float((depths_m[seen] / px_per_m[seen]).min())


def _patch(
    hull: Hull,
    corners_world: NDArray[np.float64],
    center_world: NDArray[np.float64],
    reach_m: float,
) -> tuple[NDArray[np.float64], bool]:
    """Return samples (N, 3) of triangles (T, 3, 3) in a hull, within reach of a centre.

    Also whether some of them lie at the rim of the square that was sampled.
    """
    steps = np.linspace(-1.0, 1.0, _PATCH_SAMPLES)
    across, along = (grid.ravel() for grid in np.meshgrid(steps, steps))
    is_rim = np.maximum(np.abs(across), np.abs(along)) > 0.9
    samples_world, in_rim = [np.zeros((0, 3))], False
    for a, b, c in corners_world:
        edge, other = b - a, c - a
        normal = np.cross(edge, other)
        length, area = np.linalg.norm(edge), np.linalg.norm(normal)
        if not (length > 0 and area > 0):
            continue  # no area: nothing to be amid
        axis_u = edge / length
        axis_v = np.cross(normal / area, axis_u)
        if not other @ axis_v > 0:
            continue  # as thin as rounding: no direction is across it
        foot = center_world - ((center_world - a) @ normal / area) * normal / area
        points = foot + reach_m * (across[:, None] * axis_u + along[:, None] * axis_v)
        # Weights of b and c: within the triangle where both are at least 0 and add up to 1 or less.
        weight_c = (points - a) @ axis_v / (other @ axis_v)
        weight_b = ((points - a) @ axis_u - weight_c * (other @ axis_u)) / length
        kept = (weight_b >= 0) & (weight_c >= 0) & (weight_b + weight_c <= 1)
        kept[kept] = contains_points(hull, points[kept])
        samples_world.append(points[kept])
        in_rim |= bool((kept & is_rim).any())
    return np.concatenate(samples_world), in_rim
