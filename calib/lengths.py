"""Lengths in metres as people read them: in millimetres."""

import math


def mm(length_m: float | None, form: str = ".2f") -> str:
    """Return a length in mm, without the unit, as `form` has it; "-" where there is none.

    Examples
    --------
    >>> mm(0.01234), mm(0.01234, ".1f"), mm(None)
    ('12.34', '12.3', '-')
    """
    return "-" if length_m is None else f"{1e3 * length_m:{form}}"


def millimetres(length_m: float) -> str:
    """Return a length in mm to two digits, as people write it: 0.33, 7.7, 56000."""
    return f"{float(mm(length_m, '.2g')):.15g}"


#: Decimals of a millimetre that are told at most.
_MOST_DECIMALS = 3


def bounds_mm(lower_m: float, upper_m: float) -> str:
    """Return what two finite bounds say in mm: a value, and how far off it may be, rounded up.

    The value keeps the digits that mean something, and what is told holds both bounds.

    Examples
    --------
    >>> bounds_mm(0.46438, 0.46447), bounds_mm(0.0, 0.0), bounds_mm(0.012, 0.0174)
    ('464.4 +-0.1', '0', '15 +-3')
    >>> bounds_mm(-0.03695, -0.03688)
    '-36.9 +-0.1'
    """
    lower, upper = 1e3 * lower_m, 1e3 * upper_m
    half = 0.5 * (upper - lower)
    if half <= 0.5 * 10.0**-_MOST_DECIMALS:
        return f"{round(lower, _MOST_DECIMALS) + 0.0:.15g}"
    decimals = min(max(math.floor(-math.log10(half)), 0), _MOST_DECIMALS)
    value = round(0.5 * (lower + upper), decimals)
    scale = 10.0**decimals
    # A hair less than is told is rounding, not a wider bound.
    off = math.ceil(scale * max(upper - value, value - lower) - 1e-6) / scale
    return f"{value + 0.0:.{decimals}f} +-{off:.{decimals}f}"


def at_least_mm(length_m: float, bound_m: float) -> str:
    """Return an estimate from below in mm, rounded down as far as it is off a bound.

    Examples
    --------
    >>> at_least_mm(0.44565, 0.46438), at_least_mm(0.0153, 0.0155), at_least_mm(-0.0412, -0.036)
    ('445', '15.3', '-42')
    >>> at_least_mm(0.0, 0.0)
    '0'
    """
    decimals = 0 if length_m == 0.0 or bound_m - length_m >= 2e-3 else 1
    scale = 10.0**decimals
    return f"{math.floor(1e3 * length_m * scale + 1e-6) / scale + 0.0:.{decimals}f}"
