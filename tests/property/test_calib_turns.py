"""Of random rigs around symmetric boards, with any of their cameras turned: nobody is mistaken."""

from collections import Counter

import pytest
from helpers.thorough import asked
from helpers.turned_rigs import BOARDS, around, turned
from hypothesis import event, given, settings
from hypothesis import strategies as st

from hybridve.calib.boards.target import Chessboard
from hybridve.calib.judging.check import check_rig


@pytest.mark.slow
@settings(max_examples=asked(10))
@given(
    board=st.sampled_from(BOARDS),
    looks=st.lists(st.integers(0, 3), min_size=2, max_size=4),
    is_textured=st.sampled_from([True, True, True, False]),
)
def test_turned_cameras_are_named_or_said_to_be_open_and_others_never_refused(
    board: Chessboard, looks: list[int], is_textured: bool
) -> None:
    cameras, seen = around(board, 0, 4, is_textured)
    cameras, seen = cameras[: len(looks)], seen[: len(looks)]
    looks = [look % len(board.looks) for look in looks]
    is_right = len(set(looks)) == 1  # all alike: another world, which no board tells

    check = check_rig(turned(cameras, board, looks), [board], seen)

    assert max(check.rms_px.values()) < 0.3  # by the corners alone it always agrees
    assert check.is_trustworthy <= is_right
    assert check.is_refuted <= (not is_right)
    assert is_textured or check.undecided
    event("refuted" if check.is_refuted else "agrees" if check.is_trustworthy else "open")
    if check.is_refuted:
        counts = Counter(looks).most_common()
        most = {look for look, count in counts if count == counts[0][1]}
        guilty = {
            camera.name
            for camera, look in zip(cameras, looks, strict=True)
            if len(most) > 1 or look not in most
        }
        assert set(check.turned) | set(check.undecided) >= guilty
        assert set(check.turned) <= guilty
        assert all(f"{name!r}" in check.message for name in check.turned)
