"""``hybridve summary``: what a report found, as text, JSON or curves."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from hybridve.calib.lengths import at_least_mm, bounds_mm, mm
from hybridve.cli import options
from hybridve.cli.clashes import counted_clashes, sure_text, worst_text

if TYPE_CHECKING:
    from hybridve.hull.report.clashes import Clash
    from hybridve.hull.report.read import Report

#: Beginnings of contact that are told of each object; the report and --json have all.
_MOST_ENTRIES = 5

#: Reasons that are told of each object.
_MOST_WHY = 3

#: Names in a list of objects, and numbers in one of frames.
_MOST_NAMES = 8

#: Names of objects in the first line.
_MOST_FIRST = 3


def _files(values: dict[str, Any]) -> options.Files:
    return options.Files(
        reads=options.given(values["report"]),
        writes=options.given(values["picture"]),
    )


@click.command(
    cls=options.Command,
    files=_files,
    short_help="Tell what a report found.",
)
@options.report_arg
@options.json_option
@click.option(
    "--picture",
    type=click.Path(path_type=Path),
    help="Draw the clearance of each object against time, into a .png, .svg or .pdf.",
)
@options.overwrite_option
def summary(report: Path, as_json: bool, picture: Path | None, overwrite: bool) -> None:
    r"""Tell what REPORT found: what was touched or came near, when, and how sure that is.

    Of a simulation, SIM.h5, what every effect met and did.

    \b
    Example:
      hybridve summary report.h5 --picture curves.png
      hybridve summary report.h5 --json | jq '.objects[] | select(.frames_colliding > 0).name'
    """
    from hybridve.hull.report.read import read_report
    from hybridve.hull.report.result_file import format_of
    from hybridve.hull.report.summarize import summarize

    if picture is not None:
        _refuse_picture(picture, overwrite=overwrite)
    if format_of(report) == "simulation":
        from hybridve.cli.simulate import tell_simulation

        tell_simulation(report, picture, as_json=as_json)
        return
    loaded = read_report(report)
    if picture is not None:
        from hybridve.hull.curves import write_curves

        write_curves(picture, loaded)
    if as_json:
        named = {} if picture is None else {"picture": str(picture)}
        options.tell(json.dumps({**summarize(loaded), **named}))
        return
    print_summary(loaded)
    if picture is not None:
        options.tell(f"  clearance against time: {picture}")


def _refuse_picture(picture: Path, *, overwrite: bool) -> None:
    from hybridve.hull.report.write import refuse_existing

    options.refuse_suffix(picture)
    refuse_existing(picture, overwrite=overwrite)


def print_summary(report: "Report") -> None:
    """Print a report's summary: the answer in one line, then what it rests on."""
    from hybridve.hull.report.clashes import gather_clashes
    from hybridve.hull.report.summarize import summarize

    numbers = summarize(report)
    clashes = gather_clashes(report, rules=()).clashes
    options.tell(_overall_text(numbers, clashes))
    about = f"{numbers['report']}: {numbers['frames']} frames, {numbers['seconds']:.2f} s"
    if clashes:
        about += f"; `hybridve clashes` tells of {counted_clashes(len(clashes))}"
    options.tell(about)
    _print_causes(numbers["causes"])
    if numbers["frames_invalid"]:
        invalid = options.counted(numbers["frames_invalid"], "frame")
        options.tell(f"  {invalid} could not be evaluated:")
        for reason, count in numbers["reasons"].items():
            frames = numbers["reason_frames"][reason]
            shown = ", ".join(map(str, frames[:_MOST_NAMES]))
            more = ", ..." if count > _MOST_NAMES else ""
            options.tell(f"    {count} x {reason} (frame {shown}{more})")
    if numbers["frames_without_hull"]:
        empty = options.counted(numbers["frames_without_hull"], "frame")
        options.tell(f"  {empty} without a hull near any object, in which nothing can be touched")
    for why, count in numbers["rests_on"].items():
        options.tell(f"    {count} x {why}")
    rows = [("object", "verdict", "frames", "certain", "when", *_MOST_OF_A_FRAME)]
    for found in numbers["objects"]:
        rows.append(
            (
                found["name"],
                found["verdict"],
                _frames_text(found["frames_by_verdict"]),
                _certain_text(found),
                _spans_text(found["spans"]),
                f"{found['points_most']}",
                f"{found['triangles_most']}",
                f"{found['patches_most']}",
            )
        )
    options.print_table(rows)
    if any(found["clearance"] is not None for found in numbers["objects"]):
        _print_clearances(numbers["objects"])
    for found in numbers["objects"]:
        _print_entries(found)
        for line in _warnings(found):
            options.tell(f"  {found['name']}: {line}")
    is_open = [
        found["name"]
        for found in numbers["objects"]
        if found["closed"] is False and found["clearance"] is not None
    ]
    if is_open:
        more = f" and {len(is_open) - _MOST_NAMES} more" if len(is_open) > _MOST_NAMES else ""
        options.tell(
            "  not closed, so that nobody can tell whether something is wholly inside: "
            f"{', '.join(is_open[:_MOST_NAMES])}{more}"
        )
    if numbers["sample_spacing_m"] is not None:
        smallest, largest = numbers["viewports"]
        viewports = f"viewport {largest}" if smallest == largest else f"{smallest} to {largest}"
        options.tell(
            f"  sampled at most {numbers['sample_spacing_m'] * 1e3:.3g} mm apart along edges: "
            f"{viewports}, {numbers['samples']} samples"
        )
    stages = ", ".join(f"{stage} {ms:.2f}" for stage, ms in numbers["stage_ms_mean"].items())
    options.tell(f"  ms of work a frame, mean: {stages}; engine {numbers['engine']}")


def _print_causes(causes: list[dict[str, Any]]) -> None:
    """Print what is wrong with the cameras; of many single frames of one, only which."""
    alone: dict[str, list[dict[str, Any]]] = {}
    for cause in causes:
        if cause["kind"] == "frames":
            alone.setdefault(cause["cameras"][0], []).append(cause)
        else:
            options.tell(f"  {cause['message']}")
    for camera, runs in alone.items():
        if len(runs) == 1:
            options.tell(f"  {runs[0]['message']}")
            continue
        spans = [(run["first_frame"], run["last_frame"]) for run in runs]
        shown = ", ".join(f"{a}" if a == b else f"{a}-{b}" for a, b in spans[:_MOST_NAMES])
        more = ", ..." if len(spans) > _MOST_NAMES else ""
        options.tell(
            f"  {camera}'s silhouettes fit none of the others in {len(runs)} runs of frames "
            f"({shown}{more}); look at them (`hybridve render --view agreement`)"
        )


def _overall_text(numbers: dict[str, Any], clashes: "Sequence[Clash]") -> str:
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
        of = f"{count} of {options.counted(every, 'object')}" if not parts else f"{count}"
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


def _frames_text(frames_by_verdict: dict[str, int]) -> str:
    return ", ".join(f"{count} {one}" for one, count in frames_by_verdict.items()) or "-"


#: Columns of the largest number in any frame.
_MOST_OF_A_FRAME = ("points, most", "triangles, most", "patches, most")


def _print_clearances(objects: list[dict[str, Any]]) -> None:
    """Print how near each object was come to, and how deep it was reached into."""
    rows = [
        (
            "object",
            "smallest clearance, mm (bounds)",
            "at",
            "at 95 %, mm (estimate)",
            "required, mm",
            "frames below",
            "deepest, mm (bounds)",
            "D_rec, mm",
        )
    ]
    for found in objects:
        nearest, depth, recovery = found["clearance"], found["depth"], found["recovery"]
        rows.append(
            (
                found["name"],
                "-" if nearest is None else _bounds_text(nearest["lower_m"], nearest["upper_m"]),
                "-" if nearest is None else f"{nearest['time_s']:.2f} s",
                "-"
                if nearest is None or nearest["at_least_95_m"] is None
                else f"at least {at_least_mm(nearest['at_least_95_m'], nearest['lower_m'])}",
                mm(found["required_clearance_m"], "g") if found["required_clearance_m"] else "-",
                _below_text(found),
                "-" if depth is None else _bounds_text(depth["lower_m"], depth["upper_m"]),
                _recovery_text(recovery),
            )
        )
    options.print_table(rows)


def _recovery_text(recovery: dict[str, Any] | None) -> str:
    """Return the longest D_rec in millimetres, and in how many frames V_rec has no exit."""
    if recovery is None:
        return "-"
    no_exit = f"no exit in {options.counted(recovery['frames_no_exit'], 'frame')}"
    if recovery["d_rec_m"] is None:
        return no_exit
    longest = mm(recovery["d_rec_m"], ".1f")
    return f"{longest}, {no_exit}" if recovery["frames_no_exit"] else longest


def _print_entries(found: dict[str, Any]) -> None:
    """Print when and how fast contact began."""
    spans = found["spans"]
    for span in spans[:_MOST_ENTRIES]:
        first_s, doubt_s = span.get("first_contact_s"), span.get("first_contact_uncertainty_s")
        if first_s is None:
            continue
        text = f"touched at {first_s:.3f} s"
        if doubt_s is not None:
            text += f", {1e3 * doubt_s:.0f} ms either way at most"
        if status := span.get("first_contact_status"):
            text += f" ({status})"
        text += _speed_text(*span.get("approach_m_s", (None, None)))
        options.tell(f"  {found['name']}: {text}")
    if len(spans) > _MOST_ENTRIES and "first_contact_s" in spans[0]:
        options.tell(
            f"  {found['name']}: {len(spans) - _MOST_ENTRIES} more times; --json tells all"
        )


def _warnings(found: dict[str, Any]) -> list[str]:
    """Return what a reader must know before trusting an object's rows."""
    told = (
        (
            found["frames_colliding"] - found["frames_sampled_colliding"],
            "no sample collides, but a certified point does; --viewport or --accuracy-mm finds "
            "more points",
        ),
        (found["frames_inside"], "something is wholly inside, without touching the surface"),
        (
            found["frames_hinging"],
            f"the verdict hinges on a single camera: {', '.join(found['hinges_on'])}",
        ),
        (
            found["frames_unsure"],
            "what touches may hold nothing real: other volumes of the hull explain all its pixels "
            "(elsewhere its volume holds something real somewhere, perhaps not where it touches)",
        ),
    )
    lines = [f"in {options.counted(count, 'frame')} {text}" for count, text in told if count]
    recovery = found["recovery"]
    if recovery is not None and recovery["frames_asked_to_free"]:
        asked, shift_m = recovery["frames_asked_to_free"], recovery["free_shift_m"]
        whole = (
            f"{mm(shift_m, '.1f')} mm along V_rec do in all" if shift_m is not None else "none does"
        )
        if recovery["frames_freed"] < asked:
            lines.append(
                f"moving it by D_rec frees all of it in {recovery['frames_freed']} of "
                f"{options.counted(asked, 'frame')}; {whole}"
            )
    told_of = [(why, count) for why, count in found["why"].items() if why]
    lines += [f"in {options.counted(count, 'frame')}: {why}" for why, count in told_of[:_MOST_WHY]]
    return lines


def _speed_text(lower_m_s: float | None, upper_m_s: float | None) -> str:
    """Return the bounds of a speed in words; None where it has none."""
    if lower_m_s is None:
        return ""
    if upper_m_s is None:
        return f", coming at {lower_m_s:.2f} m/s or more"
    lower, upper = f"{lower_m_s:.2f}", f"{upper_m_s:.2f}"
    return f", coming at {lower} m/s" if lower == upper else f", coming at {lower}-{upper} m/s"


def _bounds_text(lower_m: float, upper_m: float | None) -> str:
    """Return bounds in millimetres; None above stands for no hull anywhere near."""
    if upper_m is None:
        return f"beyond {mm(lower_m, '.1f')}"
    return bounds_mm(lower_m, upper_m)


def _below_text(found: dict[str, Any]) -> str:
    """Return in how many frames the required clearance is not kept."""
    if not found["required_clearance_m"] or found["frames_below_required"] is None:
        return "-"
    text = f"{found['frames_below_required']}"
    if perhaps := found["frames_perhaps_below_required"]:
        text += f", {perhaps} more perhaps"
    return text


def _certain_text(found: dict[str, Any]) -> str:
    """Return how many frames have which certificate, in words."""
    parts = [
        f"{found[key]} {word}"
        for key, word in (
            ("frames_with_witness", "hit"),
            ("frames_inside", "inside"),
            ("frames_proved_free", "free"),
        )
        if found[key]
    ]
    if found["frames_open"]:
        parts.append(f"{found['frames_open']} open below {found['open_at_m'] * 1e3:.3g} mm")
    return ", ".join(parts) or "-"


def _spans_text(spans: list[dict[str, Any]]) -> str:
    if not spans:
        return "-"
    first, more = spans[0], len(spans) - 1
    text = f"{first['start_s']:.2f}-{first['stop_s']:.2f} s"
    return f"{text} and {more} more" if more else text
