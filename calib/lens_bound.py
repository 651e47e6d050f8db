"""How far an undistorted silhouette can answer beside the place that was asked.

A camera's lens distortion is removed from its silhouettes once a frame: each pixel of a pinhole
image takes the value of one recorded pixel (`hybridve.calib.lens.undistortion`, nearest
neighbour). This file says what that can change, as a bound.

**What is answered.** Let d map the pinhole image into the recorded image, both in pixels, and let
M(y) be the recorded silhouette at the pixel floor(y), background outside the recorded image. A
point in space that projects to x in the pinhole image should be answered M(d(x)). It is answered
M(y) with ``|y - d(c)| <= e`` per axis, where c is the centre of the pixel that holds x, and e the
rounding of d(c) to float32: at most 2^-24 of the image's size. (OpenCV rounds half to even where
floor would round up; that concerns only a y on an edge of two pixels, and both touch y.)

**In the recorded image.** ``|x - c| <= 1/2`` per axis, and the straight line from c to x stays in
the pixel. By the mean value theorem, for either axis i of the recorded image,

    |d_i(x) - d_i(c)|  <=  sup over the pixel of  (|dd_i/dx| + |dd_i/dy|) / 2.

s is the largest of these over both axes and all pixels that have a source or lie within two of one
that has, plus e. So an answer can differ from the exact one only at points for which the square of
half side s about d(x) touches recorded pixels of both values: s is a distance per axis (Chebyshev),
like the pixels' own shape. Nothing else can change, and in particular:

* The border of the recorded image counts as a border of the silhouette: beyond is background. Where
  the pinhole image reaches further than the recorded one, its pixels are background that is seen,
  also to a session that lets a camera abstain from what it does not see.
* Where the pinhole image is coarser than the recorded one (a derivative above 1), recorded pixels
  are left out. A lone object pixel can vanish, and so can anything narrower than a pinhole pixel:
  its points lie within s of the background that is answered in its place.
* Where the map folds, or leads nowhere, the pinhole pixel is background as a whole. In pixels that
  lie on such a rim, s says nothing about the rim itself; the statement about space holds.
* Beyond the pinhole image nothing is seen. It holds what the camera sees up to 70 degrees off axis
  (each way, not along the diagonal); where a lens folds inside the recorded image, that rim is
  found to a 64th of the image's size.

**In space.** x and c are half a pixel apart in the *pinhole* image. The answer at a point X at
depth z (along the optical axis) is therefore the exact answer at a point X' of the same depth, at
most ``z / (2 fx)`` beside it and ``z / (2 fy)`` above or below: together
``z * hypot(1 / fx, 1 / fy) / 2``, with the lens's own focal lengths, whatever the distortion and
however far off the axis (obliquity is in z: along a ray at an angle a to the axis, a range r has
z = r cos a). The rounding e adds ``e z / f`` over the smallest stretch of d, some 1e-4 of it.
Silhouettes of a camera without distortion are used as they are: s = 0.

**Why it is a bound.** The derivatives are bounded over whole pixels by interval arithmetic on
COLMAP's formulas, not sampled. The formulas are written again here, as pycolmap answers only for
single points; a test holds them against pycolmap for every model. What is not bounded is the
calibration: d is the lens as it was calibrated.

References
----------
Moore, Kearfott and Cloud, *Introduction to Interval Analysis*, SIAM, 2009, chapters 5 and 9.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.camera import Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.lens import Undistortion

Array = NDArray[np.float64]

#: The bound is at most this much above what the derivatives reach, or as close as single pixels
#: allow: a hundredth of a pixel is nobody's concern.
_TIGHTNESS = 1.01

#: float64 rounding of the intervals' ends, which are not rounded outwards, and of the map: 1e-12
#: of an image of 10,000 pixels, with room.
_ROUNDING_PX = 1e-7

#: Boxes along the longer side of the image that the search starts with.
_COARSE_BOXES = 64

#: Below this atan(sqrt t) / sqrt t is taken from its series, whose next term is below 1e-15.
_SMALL_SQUARE = 1e-4

#: Below this square of its parameter COLMAP evaluates the FOV model by a series.
_COLMAP_SMALL_SQUARE = 1e-4

#: How far beyond the last pixel with a source pixels still count, in pixels: some of their points
#: may have one.
_RIM_PX = 2


def lens_shift_px(camera: Camera, undistortion: Undistortion) -> float:
    """Return how far off an undistorted silhouette's answers can be, in recorded pixels.

    Parameters
    ----------
    camera : Camera
        The camera.
    undistortion : Undistortion
        How its silhouettes are undistorted.

    Returns
    -------
    float
        The bound s of this file's head, per axis of the recorded image; 0 without distortion.
        Infinite if the lens's formula has a pole where the image is.
    """
    if undistortion.map_x is None:
        return 0.0
    sourced = (undistortion.map_x >= -0.5).astype(np.uint8)
    reach = np.ones((2 * _RIM_PX + 1, 2 * _RIM_PX + 1), np.uint8)
    levels = [cv2.dilate(sourced, reach).astype(np.bool_)]
    while max(levels[-1].shape) > _COARSE_BOXES:
        levels.append(_halve(levels[-1]))

    reached, bound = 0.0, 0.0
    rows, columns = np.nonzero(levels[-1])
    for level in reversed(range(len(levels))):
        at_least, at_most = _stretch_px(
            camera, undistortion, rows << level, columns << level, level
        )
        reached = max(reached, float(at_least.max(initial=0.0)))
        settled = at_most <= _TIGHTNESS * reached
        if level == 0:
            settled[:] = True
        bound = max(bound, float(at_most[settled].max(initial=0.0)))
        if settled.all():
            break
        rows, columns = _quarters(rows[~settled], columns[~settled], levels[level - 1])
    map_rounding_px = 2.0**-24 * max(camera.width_px, camera.height_px)
    # Rounded up, so that it stays a bound and reads the same from every machine.
    return float(np.ceil((bound + map_rounding_px + _ROUNDING_PX) * 1e6) / 1e6)


def _halve(domain: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Tell which squares of 2 x 2 hold anything."""
    height, width = domain.shape
    even = np.pad(domain, ((0, height % 2), (0, width % 2)))
    return np.asarray(even[::2, ::2] | even[1::2, ::2] | even[::2, 1::2] | even[1::2, 1::2])


def _quarters(
    rows: NDArray[np.int64], columns: NDArray[np.int64], finer: NDArray[np.bool_]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the quarters of boxes, (N,) rows and columns each, that hold anything."""
    quarter_rows = (2 * rows[:, None] + [0, 0, 1, 1]).ravel()
    quarter_columns = (2 * columns[:, None] + [0, 1, 0, 1]).ravel()
    within = (quarter_rows < finer.shape[0]) & (quarter_columns < finer.shape[1])
    quarter_rows, quarter_columns = quarter_rows[within], quarter_columns[within]
    holds = finer[quarter_rows, quarter_columns]
    return quarter_rows[holds], quarter_columns[holds]


def _stretch_px(
    camera: Camera,
    undistortion: Undistortion,
    rows: NDArray[np.int64],
    columns: NDArray[np.int64],
    level: int,
) -> tuple[Array, Array]:
    """Bound half of |dd_i/dx| + |dd_i/dy|, the larger i, over boxes of 2^level pixels a side.

    Returns
    -------
    at_least, at_most : (N,) float64
        Everywhere in the box it is between these, in recorded pixels.
    """
    matrix = undistortion.img_from_cam
    focal_x, focal_y = matrix[0, 0], matrix[1, 1]
    side = 1 << level
    u = Interval(columns - matrix[0, 2], columns + side - matrix[0, 2]) * (1.0 / focal_x)
    v = Interval(rows - matrix[1, 2], rows + side - matrix[1, 2]) * (1.0 / focal_y)
    with np.errstate(all="ignore"):  # at a pole; NaN and infinity are taken for "no bound"
        x, y = distorted(camera.model, camera.params, u, v)
        ratio = focal_x / focal_y  # of a step in u to a step in v, by a pixel each
        sums = [
            (x.du.magnitude(), x.dv.magnitude(), ratio),
            (y.dv.magnitude(), y.du.magnitude(), 1.0 / ratio),
        ]
        least = [0.5 * (along[0] + across[0] * scale) for along, across, scale in sums]
        most = [0.5 * (along[1] + across[1] * scale) for along, across, scale in sums]
        at_least = np.nan_to_num(np.maximum(*least), nan=0.0, posinf=0.0)
        at_most = np.nan_to_num(np.maximum(*most), nan=np.inf, posinf=np.inf)
    return at_least, at_most


@dataclass(frozen=True, slots=True, eq=False)
class Interval:
    """Numbers known to lie between two: (N,) float64 each, ends included."""

    low: Array
    high: Array

    def __add__(self, other: "Interval | float") -> "Interval":
        if isinstance(other, Interval):
            return Interval(self.low + other.low, self.high + other.high)
        return Interval(self.low + other, self.high + other)

    def __mul__(self, other: "Interval | float") -> "Interval":
        if isinstance(other, Interval):
            ends = [a * b for a in (self.low, self.high) for b in (other.low, other.high)]
        else:
            ends = [self.low * other, self.high * other]
        return Interval(np.minimum.reduce(ends), np.maximum.reduce(ends))

    def square(self) -> "Interval":
        """Return the squares: tighter than the product with itself, of which it knows nothing."""
        least, most = self.magnitude()
        return Interval(least**2, most**2)

    def magnitude(self) -> tuple[Array, Array]:
        """Return the smallest and the largest absolute value."""
        most = np.maximum(np.abs(self.low), np.abs(self.high))
        least = np.maximum(np.maximum(self.low, -self.high), 0.0)
        return least, most


@dataclass(frozen=True, slots=True, eq=False)
class Jet:
    """A function of a ray (u, v) over a box of rays: its value and both derivatives, bounded."""

    value: Interval
    du: Interval
    dv: Interval

    def __add__(self, other: "Jet | float") -> "Jet":
        if isinstance(other, Jet):
            return Jet(self.value + other.value, self.du + other.du, self.dv + other.dv)
        return Jet(self.value + other, self.du, self.dv)

    def __mul__(self, other: "Jet | float") -> "Jet":
        if isinstance(other, Jet):
            return Jet(
                self.value * other.value,
                self.du * other.value + self.value * other.du,
                self.dv * other.value + self.value * other.dv,
            )
        return Jet(self.value * other, self.du * other, self.dv * other)

    def square(self) -> "Jet":
        """Return the square."""
        return Jet(self.value.square(), self.value * self.du * 2.0, self.value * self.dv * 2.0)

    def chain(self, value: Interval, slope: Interval) -> "Jet":
        """Return a function of this one, of which value and slope are known."""
        return Jet(value, slope * self.du, slope * self.dv)

    def inverse(self) -> "Jet":
        """Return 1 / self; without bounds where that has a pole."""
        low, high = self.value.low, self.value.high
        pole = (low <= 0) & (high >= 0)
        value = Interval(np.where(pole, -np.inf, 1.0 / high), np.where(pole, np.inf, 1.0 / low))
        return self.chain(value, value.square() * -1.0)

    def sqrt(self) -> "Jet":
        """Return the root; NaN where it does not exist."""
        value = Interval(np.sqrt(self.value.low), np.sqrt(self.value.high))
        return self.chain(value, Interval(0.5 / value.high, 0.5 / value.low))

    def atan_ratio(self) -> "Jet":
        """Return g(t) = atan(sqrt t) / sqrt t, the shortening of a ray by an even fisheye.

        g(t) is the integral of 1 / (1 + t q^2) over q in 0..1: it falls, and its slope rises.
        """
        low, high = self.value.low, self.value.high
        value = Interval(_atan_ratio(high), _atan_ratio(low))
        return self.chain(value, Interval(_atan_ratio_slope(low), _atan_ratio_slope(high)))

    def polynomial(self, coefficients: Sequence[float]) -> "Jet":
        """Return 1 + c1 t + c2 t^2 + ... by Horner's rule."""
        result = self * 0.0
        for coefficient in reversed(coefficients):
            result = (result + float(coefficient)) * self
        return result + 1.0


def _atan_ratio(square: Array) -> Array:
    root = np.sqrt(np.maximum(square, _SMALL_SQUARE))
    series = 1.0 - square * (1.0 / 3.0 - square * (1.0 / 5.0 - square / 7.0))
    return np.where(square < _SMALL_SQUARE, series, np.arctan(root) / root)


def _atan_ratio_slope(square: Array) -> Array:
    safe = np.maximum(square, _SMALL_SQUARE)
    series = -1.0 / 3.0 + square * (2.0 / 5.0 - square * (3.0 / 7.0 - square * 4.0 / 9.0))
    slope = 0.5 * (1.0 / (1.0 + safe) - _atan_ratio(safe)) / safe
    return np.where(square < _SMALL_SQUARE, series, slope)


def distorted(model: str, params: Array, u: Interval, v: Interval) -> tuple[Jet, Jet]:
    """Bound where a lens images boxes of rays, in units of its focal lengths.

    Parameters
    ----------
    model : str
        A COLMAP camera model.
    params : (P,) float64
        Its parameters, focal lengths and principal point included.
    u, v : Interval
        N boxes of rays (u, v, 1), camera frame.

    Returns
    -------
    x, y : Jet
        ``(column - cx) / fx`` and ``(row - cy) / fy`` in the recorded image, and their derivatives
        by u and v.

    References
    ----------
    COLMAP, ``sensor/models.h``.
    """
    one = Interval(np.ones_like(u.low), np.ones_like(u.low))
    none = one * 0.0
    x, y = Jet(u, one, none), Jet(v, none, one)
    squared = x.square() + y.square()
    match model, [float(value) for value in params]:
        case "SIMPLE_RADIAL", [_, _, _, *k]:
            return _scaled(x, y, squared.polynomial(k))
        case "RADIAL", [_, _, _, *k]:
            return _scaled(x, y, squared.polynomial(k))
        case "OPENCV", [_, _, _, _, k1, k2, p1, p2]:
            return _bent(x, y, [k1, k2], p1, p2)
        case "FULL_OPENCV", [_, _, _, _, k1, k2, p1, p2, k3, k4, k5, k6]:
            return _bent(x, y, [k1, k2, k3], p1, p2, below=[k4, k5, k6])
        case "FOV", [_, _, _, _, omega] if omega**2 < _COLMAP_SMALL_SQUARE:
            # COLMAP's own series for narrow fields of view; the solver and the maps use it too.
            return _scaled(x, y, squared * (omega**2 / 3.0) + (1.0 - omega**2 / 12.0))
        case "FOV", [_, _, _, _, omega]:
            # atan(2 r tan(omega / 2)) / (r omega)
            slope = 2.0 * np.tan(omega / 2.0)
            return _scaled(x, y, (squared * slope**2).atan_ratio() * (slope / omega))
        case "SIMPLE_DIVISION" | "DIVISION", [*_, k]:
            return _scaled(x, y, ((squared * (-4.0 * k) + 1.0).sqrt() + 1.0).inverse() * 2.0)
        case "EUCM", [_, _, _, _, alpha, beta]:
            across = (squared * beta + 1.0).sqrt() * alpha
            return _scaled(x, y, (across + (1.0 - alpha)).inverse())

    x, y = _scaled(x, y, squared.atan_ratio())  # an even fisheye, bent further by most
    squared = x.square() + y.square()
    match model, [float(value) for value in params]:
        case (("SIMPLE_FISHEYE" | "FISHEYE"), _):
            return x, y
        case (("SIMPLE_RADIAL_FISHEYE" | "RADIAL_FISHEYE"), [_, _, _, *k]):
            return _scaled(x, y, squared.polynomial(k))
        case "OPENCV_FISHEYE", [_, _, _, _, *k]:
            return _scaled(x, y, squared.polynomial(k))
        case "THIN_PRISM_FISHEYE", [_, _, _, _, k1, k2, p1, p2, k3, k4, sx, sy]:
            bent_x, bent_y = _bent(x, y, [k1, k2, k3, k4], p1, p2)
            return bent_x + squared * sx, bent_y + squared * sy
        case "RAD_TAN_THIN_PRISM_FISHEYE", [_, _, _, _, *k, p0, p1, s0, s1, s2, s3]:
            # The prism acts on rays that were scaled already, and p0 bends along x.
            x, y = _scaled(x, y, squared.polynomial(k))
            squared = x.square() + y.square()
            bent_x, bent_y = _bent(x, y, [], p1, p0)
            return (
                bent_x + squared * s0 + squared.square() * s1,
                bent_y + squared * s2 + squared.square() * s3,
            )
    raise CalibrationError(f"camera model {model!r}: how far it shifts a silhouette is not known")


def _scaled(x: Jet, y: Jet, scale: Jet) -> tuple[Jet, Jet]:
    return x * scale, y * scale


def _bent(
    x: Jet, y: Jet, k: list[float], p1: float, p2: float, below: Sequence[float] = ()
) -> tuple[Jet, Jet]:
    """Return radial distortion, over that of `below`, and tangential distortion as OpenCV's."""
    squared = x.square() + y.square()
    radial = squared.polynomial(k)
    if below:
        radial = radial * squared.polynomial(below).inverse()
    product = x * y
    return (
        x * radial + product * (2.0 * p1) + (squared + x.square() * 2.0) * p2,
        y * radial + product * (2.0 * p2) + (squared + y.square() * 2.0) * p1,
    )
