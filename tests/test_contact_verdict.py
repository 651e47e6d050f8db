"""A verdict answers the question that was asked, and only what is proved is kept."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybridve.hull.contact.verdict import VERDICTS, Facts, judge, worst

#: Far from everything, wholly in sight, and proved to be.
FAR = Facts(False, False, True, "free", clearance_m=(1.0, 1.0001), share_seen=1.0)


def of(**changes: object) -> tuple[str, str]:
    return judge(replace(FAR, **changes))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("changes", "verdict", "why"),
    [
        ({}, "kept", ""),
        ({"touches": True, "certificate": "colliding", "clearance_m": (0.0, 0.0)}, "clash", ""),
        ({"touches": True, "certificate": ""}, "clash", ""),
        ({"is_inside": True, "clearance_m": (0.0, 0.0)}, "inside", "beneath its surface"),
        ({"required_m": 1.5}, "too near", "at most 1000.10 mm away, 1500.00 mm are required"),
        ({"required_m": 1.00005}, "open", "between 1000.00 and 1000.10 mm away"),
        ({"required_m": 1.0}, "kept", ""),
        ({"share_seen": 0.0}, "not seen", "outside what the cameras can tell"),
        # A hull that is certainly too near is real, wherever the rest of the object lies.
        ({"share_seen": 0.0, "required_m": 1.5}, "too near", "at most"),
        ({"share_seen": 0.25}, "kept", "75 % of its surface lies outside"),
        ({"certificate": "open", "open_at_m": 1e-4}, "open", "less than 0.10 mm wide may hide"),
        ({"certificate": "", "clearance_m": (np.nan, np.nan)}, "open", "between them"),
        ({"clearance_m": (np.nan, np.nan), "required_m": 0.01}, "open", "was not measured"),
        ({"clearance_m": (np.nan, np.nan)}, "open", "wholly inside was not asked"),
        ({"clearance_m": (np.nan, np.nan), "is_closed": False}, "kept", ""),
        ({"clearance_m": (0.0, 5e-5)}, "open", "perhaps not at all"),
        ({"clearance_m": (15.0, np.inf), "rests_on": "cam2 saw nothing"}, "kept", "cam2"),
    ],
)
def test_the_verdict_and_its_reason(changes: dict[str, object], verdict: str, why: str) -> None:
    found, reason = of(**changes)

    assert found == verdict
    assert why in reason
    assert bool(reason) == bool(why)


certificates = st.sampled_from(["colliding", "free", "open", ""])
lengths_m = st.one_of(st.just(np.nan), st.just(0.0), st.floats(0.0, 10.0))


@given(
    touches=st.booleans(),
    is_inside=st.booleans(),
    is_closed=st.booleans(),
    certificate=certificates,
    lower_m=lengths_m,
    wider_m=st.one_of(st.just(0.0), st.floats(0.0, 1.0), st.just(np.inf)),
    required_m=st.one_of(st.just(0.0), st.floats(0.0, 10.0)),
    share_seen=st.one_of(st.just(np.nan), st.floats(0.0, 1.0)),
)
def test_kept_is_said_only_where_it_is_proved(
    touches: bool,
    is_inside: bool,
    is_closed: bool,
    certificate: str,
    lower_m: float,
    wider_m: float,
    required_m: float,
    share_seen: float,
) -> None:
    facts = Facts(
        touches,
        is_inside,
        is_closed,
        certificate,
        1e-4,
        (lower_m, lower_m + wider_m),
        required_m,
        share_seen,
    )

    verdict, _ = judge(facts)

    assert verdict in VERDICTS
    if verdict == "kept":
        assert not touches
        assert not is_inside
        assert certificate == "free"
        assert share_seen != 0.0
        if required_m > 0 or is_closed:
            assert lower_m >= required_m
            assert lower_m > 0
    if touches:
        assert verdict == "clash"


@given(st.sets(st.sampled_from(VERDICTS)))
def test_the_worst_of_several_is_the_first_in_order(verdicts: set[str]) -> None:
    found = worst(verdicts)

    if verdicts:
        assert found in verdicts
        assert all(VERDICTS.index(found) <= VERDICTS.index(one) for one in verdicts)
    else:
        assert found == "unknown"
