"""What a report found, in sentences: the same on screen and on a page."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from hybridve.calib.lengths import at_least_mm, bounds_mm, mm

if TYPE_CHECKING:
    from hybridve.hull.report.clashes import Clash

#: Names of objects in the first line.
_MOST_FIRST = 3


def counted(count: int, what: str) -> str:
    """Return "1 frame", "2 frames"."""
    return f"{count} {what}" if count == 1 else f"{count} {what}s"


def counted_clashes(count: int) -> str:
    """Return "1 clash", "2 clashes"."""
    return "1 clash" if count == 1 else f"{count} clashes"


def sentence(clash: "Clash") -> str:
    """Return in words what a clash is, where to look, and how sure it is."""
    lower_m, upper_m = clash.worst.clearance_m
    if clash.kind == "too near":
        what = (
            f"something real comes within {bounds_mm(lower_m, upper_m)} mm of {clash.name}, "
            f"where {mm(clash.required_m, 'g')} mm are required"
        )
    elif upper_m < 0.0 or clash.kind == "inside":
        into = "is wholly inside" if clash.kind == "inside" else "reaches into"
        what = f"something real {into} {clash.name}, {bounds_mm(-upper_m, -lower_m)} mm deep"
    else:
        what = f"something real touches {clash.name}"
    return f"{what} (frame {clash.worst.frame}, {clash.worst.time_s:.2f} s); {sure_text(clash)}"


def sure_text(clash: "Clash") -> str:
    """Return how sure a clash is, in words."""
    return "sure" if clash.is_sure else "not sure: " + ", ".join(clash.doubts)


def worst_text(clash: "Clash") -> str:
    """Return the clearance of a clash in its worst frame, in mm."""
    lower_m, upper_m = clash.worst.clearance_m
    if lower_m > 0.0:
        return f"{bounds_mm(lower_m, upper_m)} away"
    if upper_m < 0.0:
        return f"{bounds_mm(-upper_m, -lower_m)} deep"
    if lower_m == 0.0 or lower_m == float("-inf"):
        return "touches" if upper_m == 0.0 else f"at most {mm(upper_m, '.1f')} away"
    return f"at most {mm(-lower_m, '.1f')} deep"


def at_95_text(clash: "Clash") -> str:
    """Return what the clearance is at least at 95 %, in mm."""
    at_least_m, lower_m = clash.worst.at_least_m, clash.worst.clearance_m[0]
    if at_least_m != at_least_m:
        return "-"
    text = at_least_mm(at_least_m, lower_m)
    return f"at most {text.removeprefix('-')} deep" if at_least_m < 0.0 else f"at least {text}"


def overall_text(numbers: dict[str, Any], clashes: "Sequence[Clash]") -> str:
    """Return the answer in one line: who clashes, how surely, where to look."""
    text = _verdict_text(numbers, clashes)
    if not numbers["trusted"]:
        return f"not to be trusted: the cameras contradict each other ({text})"
    return text


#: What is said of objects by the worst verdict on them: of one, and of several.
_SAID = {
    "clash": ("is touched", "are touched"),
    "inside": ("has something real wholly inside", "have something real wholly inside"),
    "too near": ("has less room than it requires", "have less room than they require"),
    "unknown": ("is not known about", "are not known about"),
    "open": (
        "may not keep its distance: nothing is proved",
        "may not keep their distance: nothing is proved",
    ),
    "not seen": ("stands where the cameras cannot tell", "stand where the cameras cannot tell"),
}


def _verdict_text(numbers: dict[str, Any], clashes: "Sequence[Clash]") -> str:
    verdict, every = numbers["verdict"], len(numbers["objects"])
    kept = numbers["objects_by_verdict"].get("kept", 0)
    is_any_kept = any("kept" in found["frames_by_verdict"] for found in numbers["objects"])
    rests_on = numbers["kept_rests_on"] if is_any_kept else ""
    rests = f"; what is kept rests on {rests_on}" if rests_on else ""
    if kept == every:
        whom = "the object keeps" if every == 1 else f"all {every} objects keep"
        return f"kept: {whom} the distance, which is proved{_at_95_text(numbers)}{rests}"
    parts: list[str] = []
    for one, count in numbers["objects_by_verdict"].items():
        if one == "kept":
            continue
        of = f"{count} of {counted(every, 'object')}" if not parts else f"{count}"
        text = f"{of} {_SAID[one][count > 1]}"
        names = [found["name"] for found in numbers["objects"] if found["verdict"] == one]
        worst = next((clash for clash in clashes if clash.name in names), None)
        if worst is not None and one == worst.kind:
            text += f", {_where_text(worst, names, clashes)}"
        elif one == verdict:
            text += f" ({_names_text(names)})"
        parts.append(text)
    if kept:
        parts.append(f"{kept} {'keeps' if kept == 1 else 'keep'} the distance")
    return f"{verdict}: {'; '.join(parts)}{rests}"


def _where_text(worst: "Clash", names: list[str], clashes: "Sequence[Clash]") -> str:
    """Return the worst clash in words, and which other objects are as bad."""
    required = (
        f" where {mm(worst.required_m, 'g')} are required" if worst.kind == "too near" else ""
    )
    ordered = dict.fromkeys(clash.name for clash in clashes if clash.name in names)
    others = [name for name in ordered if name != worst.name]
    then = f", then {_names_text(others)}" if others else ""
    which = f"{worst.name} worst" if len(names) > 1 else worst.name
    value = worst_text(worst).replace(" away", " mm away").replace(" deep", " mm deep")
    return (
        f"{which}: {value}{required} at {worst.worst.time_s:.2f} s (frame {worst.worst.frame}), "
        f"{sure_text(worst)}{then}"
    )


def _names_text(names: list[str]) -> str:
    more = len(names) - _MOST_FIRST
    shown = ", ".join(names[:_MOST_FIRST])
    return f"{shown} and {more} more" if more > 0 else shown


def _at_95_text(numbers: dict[str, Any]) -> str:
    """Return which objects might not keep it if outlines are off, in words; else empty."""
    weak = [
        found["name"]
        for found in numbers["objects"]
        if found["clearance"] is not None
        and found["clearance"]["at_least_95_m"] is not None
        and found["required_clearance_m"] > found["clearance"]["at_least_95_m"]
    ]
    return f"; if outlines are off, {_names_text(weak)} might not (at 95 %)" if weak else ""
