"""``hybridve summary``: what a report found, as text, JSON or curves."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from hybridve.calib.lengths import at_least_mm, bounds_mm, mm
from hybridve.cli import options
from hybridve.hull.report.wording import counted_clashes, overall_text

if TYPE_CHECKING:
    from hybridve.hull.report.read import Report

#: Beginnings of contact that are told of each object; the report and --json have all.
_MOST_ENTRIES = 5

#: Reasons that are told of each object.
_MOST_WHY = 3

#: Names in a list of objects, and numbers in one of frames.
_MOST_NAMES = 8


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
    options.tell(overall_text(numbers, clashes))
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
