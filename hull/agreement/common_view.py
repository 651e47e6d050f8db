"""What the cameras of a rig see in common, whatever stands there.

With ``unseen = "carve"`` only points in the images of all cameras can be in a hull, with "keep"
those in the images of `min_cameras`. Where there are none, every hull is empty and every part is
"free" for no reason but the rig: cameras that look away, poses turned around, mirrored pictures.

The cones of vision are those of images all of whose pixels are object pixels, so that
`hybridve.hull.agreement.search` finds a common point, or proves that there is none.
"""

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.pose import nearest_to_axes
from hybridve.hull.agreement.search import (
    EMPTY,
    FARTHEST_M,
    FOUND,
    Rule,
    make_pencils,
    search_hull,
)
from hybridve.hull.query.silhouettes import Views, make_hull

#: Side in pixels of the images that stand for the real ones; their pixels do not matter.
_SIDE_PX = 32

#: Condition number from which on the cameras' axes are called parallel: all within some 6 degrees.
_PARALLEL = 100.0


@dataclass(frozen=True, slots=True, eq=False)
class CommonView:
    """What the cameras of a rig see in common.

    Attributes
    ----------
    kind : "common", "none" or "open"
        Whether a common point was found, it is proved that there is none, or neither.
    point_world : (3,) float64
        A point that so many cameras see as are needed, metres; NaN without.
    needed : int
        How many cameras must see a point.
    facing_away : tuple of str
        Cameras that have the place where all optical axes come together behind them. Where axes
        are parallel there is no such place.
    apart : tuple of (str, str)
        Pairs of cameras that are proved to see nothing in common, where all must see a point and
        no point is common.
    """

    kind: Literal["common", "none", "open"]
    point_world: NDArray[np.float64] = field(default_factory=lambda: np.full(3, np.nan))
    needed: int = 1
    facing_away: tuple[str, ...] = ()
    apart: tuple[tuple[str, str], ...] = ()

    @property
    def reason(self) -> str:
        """What is wrong, in words; empty where there is a common view."""
        if self.kind == "common":
            return ""
        found = "no point of space" if self.kind == "none" else "no point that was found"
        text = f"{found} within {FARTHEST_M:.0f} m is seen by {self.needed} cameras"
        if self.facing_away:
            them = ", ".join(self.facing_away)
            turn = "turns" if len(self.facing_away) == 1 else "turn"
            text += f": {them} {turn} away from where all optical axes come together"
        elif self.apart:
            pairs = ", ".join(" and ".join(pair) for pair in self.apart[:3])
            text += f": {pairs} see nothing in common"
        return text + "; check the rig's poses, and whether its pictures are mirrored"


def common_view(views: Views) -> CommonView:
    """Tell whether any point within `FARTHEST_M` is seen by as many cameras as a hull needs."""
    count = len(views)
    # The same cones, in images of another size.
    scaled = views.img_from_local.copy()
    scaled[:, :2] *= _SIDE_PX / views.sizes_px[:, :, None]
    small = replace(views, sizes_px=np.full((count, 2), _SIDE_PX, np.int64), img_from_local=scaled)
    hull = make_hull(small, [np.ones((_SIDE_PX, _SIDE_PX), np.uint8)] * count)
    pencils = make_pencils(small)
    rule = Rule.of(small)
    found = search_hull(hull, pencils, rule)
    away = facing_away(views)
    if found.verdict == FOUND:
        return CommonView("common", found.point_world, rule.needed, away)
    apart = []
    if rule.needed == count:
        for first in range(count):
            for second in range(first + 1, count):
                others = [camera for camera in range(count) if camera not in (first, second)]
                if search_hull(hull, pencils, rule.without(*others)).verdict == EMPTY:
                    apart.append((views.names[first], views.names[second]))
    kind: Literal["none", "open"] = "none" if found.verdict == EMPTY else "open"
    return CommonView(kind, needed=rule.needed, facing_away=away, apart=tuple(apart))


def facing_away(views: Views) -> tuple[str, ...]:
    """Return the cameras behind which all optical axes come together; none if they are parallel."""
    matrices = views.img_from_local
    meeting = nearest_to_axes(views.centers_local(), matrices[:, 2, :3], _PARALLEL)
    if meeting is None:
        return ()
    depths_m = matrices[:, 2, :3] @ meeting + matrices[:, 2, 3]
    return tuple(views.names[camera] for camera in np.flatnonzero(depths_m < 0))
