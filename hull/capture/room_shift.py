"""Whether a camera stands where it stood: two pictures of one room, compared feature by feature.

What of a room is recognised in both pictures lies at the same pixels if the camera was not touched.
A camera that was turned a little shifts all of them as a rotation does, whatever their distance;
one that was pushed aside shifts them nearly so, by more the nearer they are. So a rotation, and how
many times longer the focal length became, are fitted to what most parts of the picture agree on.
People, and things that were carried about, are outvoted.

This work is based on: Hartley and Zisserman, *Multiple View Geometry*, 2nd ed., 2003 (section 8.4,
the picture of a camera that turns); Fischler and Bolles, *Random sample consensus*, Comm. ACM
24(6), 1981; Huber and Ronchetti, *Robust Statistics*, 2nd ed., 2009 (chapter 7, the covariance of a
robust fit); Liang and Zeger, *Longitudinal data analysis using generalized linear models*,
Biometrika 73(1), 1986 (errors that neighbours share).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.camera import Camera
from hybridve.calib.lens import img_from_cam
from hybridve.calib.plain import Told
from hybridve.calib.pose import rotation_of, rotation_vector
from hybridve.calib.seeing.features import find_features, mutual_matches
from hybridve.calib.solving.locate import rays_of

State = Literal["same", "moved", "cannot tell"]

#: A camera has moved if somewhere in its picture the room is shifted by more than this. Outlines
#: of silhouettes are told to a pixel: what moved less is within what is doubted anyway.
LIMIT_PX = 1.0

#: ... and by more than so many standard errors: in a plane chance exceeds this once in 3,000 times.
LIMIT_SE = 4.0

#: Fewer features that agree, or in fewer parts of the picture, tell nothing: they may all be of one
#: thing that was carried about.
MIN_FEATURES = 12
MIN_PARTS = 6

#: What is shifted has to fill this share of the picture, as a convex outline: a table or a board
#: that was carried about fills less.
MIN_SHARE = 0.25

#: That a camera has not moved is said where the shift in the picture's middle is known to so many
#: pixels (standard error).
_MAX_SE_PX = 0.5

#: Larger pictures are reduced to at most so many pixels: features are found again to a tenth of
#: one, and the search costs 0.1 s a picture.
_MAX_PIXELS = 1_500_000

_MAX_FEATURES = 2000

#: A feature is found again if nothing else in the other picture looks nearly like it (Lowe).
_RATIO = 0.8

#: The picture is divided into so many parts, across and down; what agrees within one counts as no
#: more than `_MOST_OF_PART` features, and shares its errors.
_ACROSS, _DOWN = 8, 6
_MOST_OF_PART = 4

#: Features agree with a motion if they miss it by less than this, pixels; or, where so few do that
#: the camera may have been pushed aside, by less than this share of the picture's diagonal.
_NEAR_PX = 3.0
_NEAR_SHARE = 0.02

#: How many pairs of features are asked for the motion. At one right match in six, all are wrong
#: once in a million times.
_DRAWS = 500

#: What stands still with this share of the support of what moved, or the other way round, leaves
#: undecided which is the room: a picture laid over the camera's, or much of the furniture carried.
_RIVAL_SHARE = 1.0 / 3.0

#: Least standard deviation of a feature, and of a shift, pixels: what codecs leave in common.
_LEAST_SIGMA_PX = 0.1
_LEAST_SE_PX = 0.02

#: Tukey's bisquare: features that miss by more standard deviations have no weight.
_CUT = 4.685


@dataclass(frozen=True, slots=True)
class RoomShift(Told):
    """How the room stands in one camera's picture, against an earlier one.

    Attributes
    ----------
    state : str
        "same", "moved", or "cannot tell".
    message : str
        What was found, in words that follow the camera's name.
    n_features : int
        Features of the room that were found again and agree with the shift.
    n_found : int
        All that were found again.
    shift_px : tuple of (float, float), or None
        Where the room now appears in the middle of the picture, less where it did: pixels to the
        right and down. None where it cannot be told.
    se_px : tuple of (float, float), or None
        Standard errors of these.
    largest_px : float or None
        The largest shift of nine places all over the picture, which differs where the camera was
        turned about its axis.
    turn_deg : float or None
        By how much the camera was turned, if it was only turned.
    zoom : float or None
        How many times larger the room appears.
    """

    state: State
    message: str
    n_features: int
    n_found: int
    shift_px: tuple[float, float] | None = None
    se_px: tuple[float, float] | None = None
    largest_px: float | None = None
    turn_deg: float | None = None
    zoom: float | None = None


def cannot_tell(reason: str, n_features: int = 0, n_found: int = 0) -> RoomShift:
    """Return that nothing can be said, and why."""
    return RoomShift("cannot tell", reason, n_features, n_found)


def room_shift(
    lens: Camera,
    then: NDArray[np.uint8],
    now: NDArray[np.uint8],
    then_mask: NDArray[np.uint8] | None = None,
    now_mask: NDArray[np.uint8] | None = None,
) -> RoomShift:
    """Compare a room in two pictures of a camera that should not have moved.

    Parameters
    ----------
    lens : Camera
        Its lens is used, its pose is not.
    then, now : (H, W) uint8
        Grey pictures, as recorded.
    then_mask, now_mask : (H, W) uint8, optional
        0 where features are not of the room, as on a board that was carried about.
    """
    found = _found_again(lens, then, now, then_mask, now_mask)
    n_found = len(found.rays)
    if n_found < MIN_FEATURES:
        return cannot_tell(_too_few(n_found), n_found, n_found)
    fit = _agreed(found)
    n_agree = int(fit.agree.sum())
    if not _is_enough(found, fit.agree):
        return cannot_tell(_too_few(n_agree), n_agree, n_found)

    shift, covariance = _shifts(found, fit, np.array([[0.5, 0.5]]) * found.size_px)
    right, down = (float(along) for along in shift[0])
    se = np.sqrt(covariance[0].diagonal())
    steps = (np.arange(3) + 0.5) / 3.0
    shifts, covariances = _shifts(
        found, fit, np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2) * found.size_px
    )
    sizes = np.linalg.norm(shifts, axis=1)
    squares = np.einsum("ki,kij,kj->k", shifts, np.linalg.inv(covariances), shifts)
    has_moved = bool(((sizes > LIMIT_PX) & (squares > LIMIT_SE**2)).any())
    if has_moved:
        doubt = _doubt_of_shift(found, fit, float(np.hypot(right, down)))
    else:
        doubt = _doubt_of_rest(found, fit)
    if not has_moved and se.max() > _MAX_SE_PX:
        doubt = (
            f"{n_agree} features of the room tell its shift to {se.max():.2g} px only, expected "
            f"{_MAX_SE_PX:g} px or less (standard errors)"
        )
    if doubt:
        return cannot_tell(doubt, n_agree, n_found)
    known = f"+- {float(se.max()):.2g} px, {n_agree} features"
    message = f"the room stands where it stood, to {sizes.max():.2f} px ({known})"
    if has_moved:
        message = (
            f"the room stands {_aside(right, down)} of where it stood ({known}; by up to "
            f"{sizes.max():.1f} px in the picture, expected less than {LIMIT_PX:g})"
        )
    return RoomShift(
        "moved" if has_moved else "same",
        message,
        n_agree,
        n_found,
        (right, down),
        (float(se[0]), float(se[1])),
        float(sizes.max()),
        float(np.degrees(np.linalg.norm(fit.motion[:3]))),
        float(1.0 + fit.motion[3]),
    )


def _doubt_of_shift(found: "_Found", fit: "_Fit", shift_px: float) -> str:
    """Return why it may not be the room that is shifted, or nothing."""
    n_agree, share = int(fit.agree.sum()), _share(found, fit.agree)
    stands = _misses(found, _STILL) < LIMIT_PX
    if fit.near_px == _NEAR_PX:  # else what agrees may be of two motions
        stands &= ~fit.agree
    if _support(found, stands) > _RIVAL_SHARE * _support(found, fit.agree):
        return (
            f"{n_agree} features of the room are shifted by {shift_px:.1f} px, but "
            f"{int(stands.sum())} stand where they stood"
        )
    if share < MIN_SHARE:
        return (
            f"{n_agree} features are shifted by {shift_px:.1f} px, but they fill {share:.0%} of "
            f"the picture, expected {MIN_SHARE:.0%} or more: they may be of one thing that was "
            "carried"
        )
    return ""


def _doubt_of_rest(found: "_Found", fit: "_Fit") -> str:
    """Return why it may not be the room that stands where it stood, or nothing."""
    rest = found.of(_misses(found, fit.motion) > _NEAR_PX)  # nearer ones are only worse found
    if len(rest.rays) < MIN_FEATURES:
        return ""
    others = _misses(rest, _best(rest, _candidates(rest), _NEAR_PX)) < _NEAR_PX
    if (
        not _is_enough(rest, others)
        or _share(rest, others) < MIN_SHARE
        or _support(rest, others) < _RIVAL_SHARE * _support(found, fit.agree)
    ):
        return ""
    return (
        f"{int(fit.agree.sum())} features of the room stand where they stood, but "
        f"{int(others.sum())} moved together"
    )


def _too_few(count: int) -> str:
    return (
        f"too few features of the room were found again: {count}, expected {MIN_FEATURES} or more, "
        f"in {MIN_PARTS} or more of {_ACROSS * _DOWN} parts of the picture"
    )


def _aside(right: float, down: float) -> str:
    return (
        f"{abs(right):.1f} px to the {'right' if right >= 0 else 'left'} and {abs(down):.1f} px "
        f"{'down' if down >= 0 else 'up'}"
    )


# --- What is found again ----------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    """Features that both pictures show.

    Attributes
    ----------
    lens : Camera
        Whose.
    size_px : (2,) float64
        Width and height.
    rays, rays_now : (N, 3) float64
        Unit rays, then and now.
    pixels_now : (N, 2) float64
        Where they are now.
    parts : (N,) int
        In which part of the picture they were.
    """

    lens: Camera
    size_px: NDArray[np.float64]
    rays: NDArray[np.float64]
    rays_now: NDArray[np.float64]
    pixels_now: NDArray[np.float64]
    parts: NDArray[np.intp]

    def of(self, chosen: NDArray[np.bool_]) -> "_Found":
        """Return some of the features, (N,) bool."""
        return _Found(
            self.lens,
            self.size_px,
            self.rays[chosen],
            self.rays_now[chosen],
            self.pixels_now[chosen],
            self.parts[chosen],
        )


def _found_again(
    lens: Camera,
    then: NDArray[np.uint8],
    now: NDArray[np.uint8],
    then_mask: NDArray[np.uint8] | None,
    now_mask: NDArray[np.uint8] | None,
) -> _Found:
    places, looks = _features(then, then_mask)
    places_now, looks_now = _features(now, now_mask)
    first, second = mutual_matches(looks, looks_now, _RATIO)
    pixels, pixels_now = places[first], places_now[second]
    rays, rays_now = rays_of(lens, pixels), rays_of(lens, pixels_now)
    seen = np.isfinite(rays).all(axis=1) & np.isfinite(rays_now).all(axis=1)
    size_px = np.array([lens.width_px, lens.height_px], np.float64)
    column, row = np.clip(
        (pixels[seen] / size_px * [_ACROSS, _DOWN]).astype(np.intp), 0, [_ACROSS - 1, _DOWN - 1]
    ).T
    return _Found(
        lens, size_px, rays[seen], rays_now[seen], pixels_now[seen], row * _ACROSS + column
    )


def _features(
    grey: NDArray[np.uint8], mask: NDArray[np.uint8] | None
) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Return places (K, 2) in pixels of the whole picture, and what they look like."""
    height_px, width_px = grey.shape
    reduction = min(1.0, float(np.sqrt(_MAX_PIXELS / grey.size)))
    if reduction < 1.0:
        size = (round(reduction * width_px), round(reduction * height_px))
        grey = np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), np.uint8)
        if mask is not None:
            mask = np.asarray(cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST), np.uint8)
    places, looks = find_features(grey, _MAX_FEATURES, mask)
    return places * [width_px / grey.shape[1], height_px / grey.shape[0]], looks


# --- The motion that most parts of the picture agree on ----------------------------------------
# A motion (4,): the vector of a rotation from the rays then to those now, and by how much of itself
# the focal length grew.

_STILL = np.zeros(4)


def _imaged(
    lens: Camera, rays: NDArray[np.float64], motion: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return where rays (N, 3) are seen after a motion, pixels (N, 2); far off where nowhere."""
    turned = rays @ rotation_of(motion[:3]).T
    ahead = turned[:, 2] > 1e-3
    turned[~ahead] = [0.0, 0.0, 1.0]
    center = lens.pinhole[:2, 2]
    pixels = center + (1.0 + motion[3]) * (img_from_cam(lens, turned) - center)
    pixels[~(ahead & np.isfinite(pixels).all(axis=1))] = 1e9
    return np.asarray(pixels)


def _misses(found: _Found, motion: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how far features (N,) lie from where a motion has them, pixels."""
    return np.asarray(
        np.linalg.norm(found.pixels_now - _imaged(found.lens, found.rays, motion), axis=1)
    )


def _is_enough(found: _Found, agree: NDArray[np.bool_]) -> bool:
    return bool(agree.sum() >= MIN_FEATURES and len(np.unique(found.parts[agree])) >= MIN_PARTS)


def _share(found: _Found, agree: NDArray[np.bool_]) -> float:
    """Return what share of the picture features that agree surround."""
    if not agree.any():
        return 0.0
    outline = np.asarray(cv2.convexHull(found.pixels_now[agree].astype(np.float32)))
    return float(cv2.contourArea(outline) / found.size_px.prod())


def _support(found: _Found, agree: NDArray[np.bool_]) -> float:
    """Return how many features agree, those of one part as a few at most."""
    counts = np.bincount(found.parts[agree], minlength=_ACROSS * _DOWN)
    return float(np.minimum(counts, _MOST_OF_PART).sum())


def _candidates(found: _Found) -> NDArray[np.float64]:
    """Return rotations (K, 3, 3): none, and those of pairs of features."""
    rng = np.random.default_rng(0)  # the same pictures get the same answer
    count = len(found.rays)
    first = rng.integers(count, size=_DRAWS)
    second = (first + 1 + rng.integers(count - 1, size=_DRAWS)) % count

    def frames(rays: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        normal = np.cross(rays[first], rays[second])
        sine = np.linalg.norm(normal, axis=1)
        normal /= np.maximum(sine, 1e-12)[:, None]
        return np.stack([rays[first], normal, np.cross(rays[first], normal)], axis=-1), sine

    then, sine = frames(found.rays)
    now, sine_now = frames(found.rays_now)
    # Two places as far from each other now as then, or no rotation leads from these to those.
    focal_px = float(found.lens.pinhole[0, 0])
    fit = (np.abs(sine - sine_now) < 2.0 * _NEAR_SHARE) & (focal_px * sine > 10.0 * _NEAR_PX)
    rotations = now[fit] @ np.swapaxes(then[fit], 1, 2)
    return np.concatenate([np.eye(3)[None], rotations])


def _best(found: _Found, rotations: NDArray[np.float64], near_px: float) -> NDArray[np.float64]:
    """Return the motion (4,) that features in most parts of the picture agree with."""
    focal_px = float(found.lens.pinhole[0, 0])
    turned = np.einsum("kij,nj->kni", rotations, found.rays)
    near = np.linalg.norm(turned - found.rays_now, axis=2) < near_px / focal_px
    in_part = np.eye(_ACROSS * _DOWN)[found.parts]
    support = np.minimum(near @ in_part, _MOST_OF_PART).sum(axis=1)
    best = rotations[int(np.argmax(support))]
    return np.append(rotation_vector(best), 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """A motion, and what agrees with it.

    Attributes
    ----------
    motion : (4,) float64
        The motion.
    covariance : (4, 4) float64
        Of its errors.
    agree : (N,) bool
        Which features have weight.
    near_px : float
        How near those that were asked lie.
    """

    motion: NDArray[np.float64]
    covariance: NDArray[np.float64]
    agree: NDArray[np.bool_]
    near_px: float


def _agreed(found: _Found) -> _Fit:
    """Return the motion that features agree with closely or, if too few do, less closely."""
    rotations = _candidates(found)
    fit = _fit(found, _best(found, rotations, _NEAR_PX), _NEAR_PX)
    if _is_enough(found, fit.agree) and _share(found, fit.agree) > MIN_SHARE:
        return fit
    near_px = _NEAR_SHARE * float(np.linalg.norm(found.size_px))
    return _fit(found, _best(found, rotations, near_px), near_px)


def _fit(found: _Found, motion: NDArray[np.float64], near_px: float) -> _Fit:
    """Return the motion by weighted least squares, from where it is roughly."""
    for _ in range(20):
        residuals = found.pixels_now - _imaged(found.lens, found.rays, motion)
        misses = np.linalg.norm(residuals, axis=1)
        near = misses < near_px
        if near.sum() < 4:
            return _Fit(motion, np.zeros((4, 4)), near, near_px)
        # 1.177: the median of a distance in a plane, in standard deviations of each coordinate.
        sigma = max(float(np.median(misses[near])) / 1.1774, _LEAST_SIGMA_PX)
        reach_px = min(_CUT * sigma, near_px)
        squares = np.minimum(misses / reach_px, 1.0) ** 2
        weights = (1.0 - squares) ** 2
        jacobian = _derivatives(lambda at: _imaged(found.lens, found.rays, at), motion)
        normal = np.einsum("n,nij,nik->jk", weights, jacobian, jacobian)
        gradient = np.einsum("n,nij,ni->j", weights, jacobian, residuals)
        step = np.linalg.lstsq(normal, gradient, rcond=None)[0]
        motion = motion + step
        if np.abs(step).max() < 1e-7:
            break
    # The slope of a weighted residual is less than its weight: the weight falls as it grows.
    slopes = weights[:, None, None] * np.eye(2) - (4.0 / reach_px**2 * (1.0 - squares))[
        :, None, None
    ] * (residuals[:, :, None] * residuals[:, None, :])
    slopes[squares >= 1.0] = 0.0
    bread = np.einsum("nij,nil,nlk->jk", jacobian, slopes, jacobian)
    by_part = np.zeros((_ACROSS * _DOWN, 4))
    np.add.at(by_part, found.parts, weights[:, None] * np.einsum("nij,ni->nj", jacobian, residuals))
    n_parts = len(np.unique(found.parts[squares < 1.0]))
    inverse = np.linalg.pinv(bread)
    few = n_parts / max(n_parts - 4, 1)  # four of them are fitted whatever their errors are
    covariance = few * inverse @ (by_part.T @ by_part) @ inverse
    return _Fit(motion, covariance, squares < 1.0, near_px)


def _derivatives(
    function: Callable[[NDArray[np.float64]], NDArray[np.float64]], motion: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the derivatives (N, 2, 4) of pixels (N, 2) by a motion."""
    steps = 1e-5 * np.eye(4)
    return np.stack(
        [(function(motion + step) - function(motion - step)) / 2e-5 for step in steps], axis=-1
    )


def _shifts(
    found: _Found, fit: _Fit, places: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the room's shifts (K, 2) at pixels (K, 2), and their covariances (K, 2, 2)."""
    rays = rays_of(found.lens, places)
    seen = np.isfinite(rays).all(axis=1)
    pixels, rays = places[seen], rays[seen]
    jacobian = _derivatives(lambda at: _imaged(found.lens, rays, at), fit.motion)
    return (
        _imaged(found.lens, rays, fit.motion) - pixels,
        jacobian @ fit.covariance @ np.swapaxes(jacobian, 1, 2) + _LEAST_SE_PX**2 * np.eye(2),
    )
