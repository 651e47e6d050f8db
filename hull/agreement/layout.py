"""Whether the sizes and places of a scene's parts go with what the cameras see.

What a file's numbers mean is told by a unit that somebody wrote, and where they lie by coordinates
that may be another system's. A part that is a thousand times too large or too small, or far outside
of what the cameras see, is told; it is no error, as there are halls and pins.
"""

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.agreement.common_view import CommonView
from hybridve.hull.agreement.sight import sight_of
from hybridve.hull.cad.scene import UNITS_M, Scene, SceneObject
from hybridve.hull.query.silhouettes import Views

#: How large a file's parts are together, in distances from the cameras to what they look at: below
#: the first and above the second its unit is asked for. A part of 6 mm in a room of 3 m is the
#: smallest that passes, a hall of 90 m the largest; of parts between 90 mm and 6 m all are told
#: that are a thousand times too large or too small.
_TINY, _HUGE = 1.0 / 500.0, 30.0

#: So many of those distances from where the cameras look is far outside.
_FAR = 10.0

#: Between these a size is what a part may have in such a room, the likelier the nearer to the last.
_FITS = (0.01, 3.0)
_LIKELY = 0.3

_Box = tuple[NDArray[np.float64], NDArray[np.float64]]


def odd_parts(scene: Scene, views: Views, common: CommonView) -> dict[str, str]:
    """Return by file of the scene, if its size or place is odd, one line that says so.

    Parameters
    ----------
    scene : Scene
        The parts; those that move where they are tracked first.
    views : Views
        Cameras that stand still.
    common : CommonView
        What they see in common. Nothing is said where that is not known.
    """
    if common.kind != "common":
        return {}
    centers_world = views.centers_local() + views.origin_world
    reach_m = float(np.median(np.linalg.norm(centers_world - common.point_world, axis=1)))
    files: dict[str, list[SceneObject]] = {}
    for one in scene.objects:
        files.setdefault(str(one.about.get("object", one.name)), []).append(first_seen(one))
    moving = {str(one.about.get("object", one.name)) for one in scene.objects if one.motion}
    notes = {}
    for name, parts in files.items():
        low, high = _box_of(parts)
        size_m = float((high - low).max())
        where = f"{scene.path}: object {name!r}"
        if not _TINY * reach_m <= size_m <= _HUGE * reach_m:
            notes[name] = (
                f"{where} is {_mm(size_m)} large, where the cameras are {_mm(reach_m)} from what "
                f"they look at; {_unit_question(parts[0], size_m, reach_m)}"
            )
            continue
        outside = np.maximum(low - common.point_world, common.point_world - high)
        away_m = float(np.linalg.norm(np.maximum(0.0, outside)))
        if name in moving or away_m <= _FAR * reach_m:
            continue
        if not any(sight_of(views, one.vertices_world, one.faces).share for one in parts):
            notes[name] = (
                f"{where} is {_mm(away_m)} from where the cameras look, and {_mm(size_m)} large, "
                f"where the cameras are {_mm(reach_m)} from what they look at: far outside of what "
                "they see; are unit and translate_mm right?"
            )
    return notes


def first_seen(one: SceneObject) -> SceneObject:
    """Return an object that moves where it is tracked first; others as they are."""
    if one.motion is None:
        return one
    pose = one.motion.world_from_rest(min(one.motion.poses))
    return one if pose is None else one.at(pose)


def _box_of(parts: list[SceneObject]) -> _Box:
    boxes = [one.box_world for one in parts]
    low = np.min([corner for corner, _ in boxes], axis=0)
    high = np.max([corner for _, corner in boxes], axis=0)
    return low, high


def _unit_question(one: SceneObject, size_m: float, reach_m: float) -> str:
    """Ask for the unit of a file, and say which would go with the room."""
    unit_m = float(one.about.get("unit_m") or 1.0)
    sizes_m = {unit: size_m * other_m / unit_m for unit, other_m in UNITS_M.items()}
    low, high = (share * reach_m for share in _FITS)
    fitting = [unit for unit, value_m in sizes_m.items() if low <= value_m <= high]
    if one.about.get("tessellation_m") is not None:  # STEP: no key of the scene says its unit
        fitting = []
    if not fitting:
        return "is its unit right?"
    # Files are in millimetres or metres, as a rule.
    usual = [unit for unit in fitting if unit in ("mm", "m")] or fitting
    likely = min(usual, key=lambda unit: abs(np.log(sizes_m[unit] / (_LIKELY * reach_m))))
    return (
        f'is its unit right? With unit = "{likely}" it would be {_mm(sizes_m[likely])} large; here '
        f'it is "{one.about.get("unit")}"'
    )


def _mm(length_m: float) -> str:
    value = 1000.0 * length_m
    return f"{value:,.0f} mm" if value >= 100.0 else f"{value:.3g} mm"
