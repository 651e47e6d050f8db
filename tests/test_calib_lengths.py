"""Lengths as people read them keep the digits that mean something, and no promise is lost."""

from hypothesis import given
from hypothesis import strategies as st

from hybridve.calib.lengths import at_least_mm, bounds_mm


@given(lower_m=st.floats(-5.0, 5.0), width_m=st.floats(0.0, 0.05))
def test_what_is_told_holds_both_bounds_and_is_as_fine_as_they_are(
    lower_m: float, width_m: float
) -> None:
    upper_m = lower_m + width_m
    value, _, off = bounds_mm(lower_m, upper_m).partition(" +-")

    off_mm = float(off or 0.0)
    hair = 1e-3
    assert float(value) - off_mm <= 1e3 * lower_m + hair
    assert float(value) + off_mm >= 1e3 * upper_m - hair
    # At most a digit of its own wider than it must be.
    assert off_mm <= max(11.0 * 1e3 * width_m, 2 * hair)
    assert len(off.partition(".")[2]) == len(value.partition(".")[2]) or not off


@given(length_m=st.floats(-1.0, 1.0), above_m=st.floats(0.0, 0.1))
def test_what_is_at_least_is_never_rounded_up(length_m: float, above_m: float) -> None:
    told_mm = float(at_least_mm(length_m, length_m + above_m))

    assert told_mm <= 1e3 * length_m + 1e-5
    assert 1e3 * length_m - told_mm <= (1.0 if above_m >= 2e-3 else 0.1) + 1e-5
