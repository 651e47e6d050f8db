"""Lengths in metres as people read them: in millimetres."""


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
