"""Whether a rig agrees with pictures of boards that several of its cameras saw at once.

Boards of known squares tell the scale of a rig. Calibrated from the boards anew, with its lenses as
they are, the rig shows which cameras stand elsewhere than it says: the two are compared up to what
boards cannot tell (where the world is, and the rig's scale), in the metric of what the boards tell
about the cameras. Cameras are set aside one by one, each time the one without which the others
agree best, until the rest agrees.

Where the rig knows its own errors (its covariance), these and the noise of the corners say how
large a disagreement may be; else fixed tolerances do.

Cameras that agree may still be turned about a board that looks the same when turned
(`hybridve.calib.judging.turns`). A rig of which that cannot be told is neither trustworthy nor
refuted.

What cameras saw together is in `hybridve.calib.judging.common_views`, whether some of them agree
in `hybridve.calib.judging.case`, and who is set aside in `hybridve.calib.judging.accused`.

This work is based on: Koch, *Parameter estimation and hypothesis testing in linear models*, 2nd
ed., 1999 (section 4.5, tests for single shifts).
"""

from collections.abc import Sequence

from hybridve.calib.boards.board import Board, Observations
from hybridve.calib.judging.accused import examine
from hybridve.calib.judging.case import Case
from hybridve.calib.judging.exchanged import exchange, exchangeable, misses_far
from hybridve.calib.judging.turns import Turns
from hybridve.calib.judging.twins import find_twins
from hybridve.calib.judging.wording import read_out
from hybridve.calib.rig import Rig
from hybridve.calib.verdict import RigCheck


def check_rig(rig: Rig, boards: Sequence[Board], observations: Sequence[Observations]) -> RigCheck:
    """Check a rig against boards that several of its cameras saw at once.

    Each board at each moment is placed in the rig's world by position and orientation, all at one
    scale, so that its corners are reprojected best: the scale tells the rig's, what remains tells
    whether the cameras agree with one another. Which way round a symmetric board was seen follows
    from the rig.

    Parameters
    ----------
    rig : Rig
        The rig to be checked. Cameras that are mounted on trackers are not tested.
    boards : sequence of Board
        The boards, with their true squares; `Sighting.board` counts them.
    observations : sequence of Observations
        What cameras saw of them; what was seen at no common instant is not used. Their pictures of
        a clip in which boards lie still tell whether cameras are turned about one.

    Raises
    ------
    NotTestableError
        If fewer than two cameras of the rig see a board at once.
    CalibrationError
        If a lens cannot have seen what its camera did.
    """
    sightings = {seen.name: seen.sightings for seen in observations}
    case = Case.of(rig, boards, sightings)
    found = examine(case)
    exchanged = None
    if not found.agrees and misses_far(case, found):
        for first, second in exchangeable(case, found):
            other = examine(Case.of(rig, boards, exchange(sightings, first, second)))
            if other.agrees:
                found, exchanged = other, (first, second)
                break
    turns = Turns({}, (), ())
    if found.agrees and exchanged is None:
        turns = found.case.turns(found.kept.placed, {seen.name: seen for seen in observations})
    return read_out(found, boards, exchanged, turns, find_twins(rig))
