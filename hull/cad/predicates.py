"""On which side of a line or a plane a point lies: never wrong, whatever rounding does.

A determinant is computed in double precision first, beside a bound of its rounding. Where the bound
leaves the sign open, the determinant is summed once more without any rounding: the product of two
doubles is the sum of two, and a sum of doubles is carried along as several that do not overlap, the
last of which has the sign of all.

Exact as long as no product overflows or underflows: coordinates are 0 or between 2^-300 and 2^300
in magnitude (`within_range`). The filters take that for granted too.

References
----------
J. R. Shewchuk, Adaptive Precision Floating-Point Arithmetic and Fast Robust Geometric Predicates,
Discrete and Computational Geometry 18, 1997: two_sum (theorem 7), two_product (theorem 18),
grow_expansion (theorem 10), and the bounds of the first, rounded determinants (section 4).
"""

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.jit import compiled, inlined

#: Smaller coordinates count as 0, so that no part of a product of three underflows.
LEAST = 2.0**-300

#: The largest coordinate that a product of three, and what splits it, can be made of.
MOST = 2.0**300

_UNIT = 2.0**-53

#: What a rounded determinant may be off by, in sums of the magnitudes that it is made of.
_LINE_ERROR = (3.0 + 16.0 * _UNIT) * _UNIT
_PLANE_ERROR = (7.0 + 56.0 * _UNIT) * _UNIT

#: It cuts a double into two halves of 26 bits.
_SPLITTER = 2.0**27 + 1.0


def within_range(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return points (..., 3) with coordinates nearer to 0 than 2^-300 taken as 0.

    Raises
    ------
    ValueError
        If a coordinate is larger than 2^300, or is no number.
    """
    if not (np.abs(points) <= MOST).all():
        raise ValueError(f"found {np.abs(points).max()} among coordinates, expected at most {MOST}")
    return np.where(np.abs(points) < LEAST, 0.0, points)


@inlined
def _two_product(a: float, b: float) -> tuple[float, float]:
    """Return a b as the sum of its rounded value and of what rounding took."""
    product = a * b
    wide = _SPLITTER * a
    a_high = wide - (wide - a)
    a_low = a - a_high
    wide = _SPLITTER * b
    b_high = wide - (wide - b)
    b_low = b - b_high
    rest = a_low * b_low - (((product - a_high * b_high) - a_low * b_high) - a_high * b_low)
    return product, rest


@inlined
def _sign(value: float) -> int:
    return 1 if value > 0.0 else (-1 if value < 0.0 else 0)


@compiled
def sign_of_sum(terms: NDArray[np.float64]) -> int:
    """Return the sign of a sum of doubles (N,), which is not rounded; they are overwritten.

    What was summed so far stands at their beginning, as parts that do not overlap, smallest first.
    """
    n_parts = 0
    for term in range(len(terms)):
        more, n_kept = terms[term], 0
        for k in range(n_parts):
            part = terms[k]
            larger = more + part
            of_part = larger - more
            rest = (more - (larger - of_part)) + (part - of_part)
            more = larger
            if rest != 0.0:
                terms[n_kept] = rest
                n_kept += 1
        if more != 0.0:
            terms[n_kept] = more
            n_kept += 1
        n_parts = n_kept
    return _sign(terms[n_parts - 1]) if n_parts > 0 else 0


@compiled
def _exact_side_of_line(
    a_y: float, a_z: float, b_y: float, b_z: float, p_y: float, p_z: float
) -> int:
    terms = np.zeros(12)
    factors = (a_y, b_z, -a_z, b_y, b_y, p_z, -b_z, p_y, p_y, a_z, -p_z, a_y)
    for k in range(6):
        terms[2 * k], terms[2 * k + 1] = _two_product(factors[2 * k], factors[2 * k + 1])
    return sign_of_sum(terms)


@inlined
def side_of_line(a_y: float, a_z: float, b_y: float, b_z: float, p_y: float, p_z: float) -> int:
    """Return 1 where a, b, p turn left in the plane of y and z, -1 where right, 0 on a line."""
    left = (a_y - p_y) * (b_z - p_z)
    right = (a_z - p_z) * (b_y - p_y)
    turn = left - right
    if abs(turn) >= _LINE_ERROR * (abs(left) + abs(right)):
        return _sign(turn)
    return _exact_side_of_line(a_y, a_z, b_y, b_z, p_y, p_z)


@compiled
def _exact_side_of_plane(
    a: NDArray[np.float64], b: NDArray[np.float64], c: NDArray[np.float64], p: NDArray[np.float64]
) -> int:
    """Sum the determinant of the rows (x, y, z, 1) of four points, term by term."""
    terms, n_terms = np.zeros(96), 0
    rows = np.zeros((4, 3))
    for axis in range(3):
        rows[0, axis], rows[1, axis] = a[axis], b[axis]
        rows[2, axis], rows[3, axis] = c[axis], p[axis]
    # Every choice of three rows in every order. Of the column of ones the row that is left out
    # is taken, which has the sign of (-1)^row, as the other way round is asked for.
    for x in range(4):
        for y in range(4):
            for z in range(4):
                if x == y or y == z or z == x:
                    continue
                n_swaps = (6 - x - y - z) + int(x > y) + int(y > z) + int(x > z)
                product, rest = _two_product(rows[x, 0], rows[y, 1])
                factor = -rows[z, 2] if n_swaps % 2 == 0 else rows[z, 2]
                terms[n_terms], terms[n_terms + 1] = _two_product(product, factor)
                terms[n_terms + 2], terms[n_terms + 3] = _two_product(rest, factor)
                n_terms += 4
    return sign_of_sum(terms)


@compiled
def side_of_plane(
    a: NDArray[np.float64], b: NDArray[np.float64], c: NDArray[np.float64], p: NDArray[np.float64]
) -> int:
    """Return the sign of (a - p) . ((b - p) x (c - p)): 1 where a, b, c turn right seen from p."""
    a_x, a_y, a_z = a[0] - p[0], a[1] - p[1], a[2] - p[2]
    b_x, b_y, b_z = b[0] - p[0], b[1] - p[1], b[2] - p[2]
    c_x, c_y, c_z = c[0] - p[0], c[1] - p[1], c[2] - p[2]
    bc, cb = b_x * c_y, c_x * b_y
    ca, ac = c_x * a_y, a_x * c_y
    ab, ba = a_x * b_y, b_x * a_y
    value = a_z * (bc - cb) + b_z * (ca - ac) + c_z * (ab - ba)
    size = (
        abs(a_z) * (abs(bc) + abs(cb))
        + abs(b_z) * (abs(ca) + abs(ac))
        + abs(c_z) * (abs(ab) + abs(ba))
    )
    if abs(value) > _PLANE_ERROR * size:
        return _sign(value)
    return _exact_side_of_plane(a, b, c, p)
