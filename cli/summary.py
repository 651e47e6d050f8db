"""``hybridve summary``: what a report found, as text or JSON."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from hybridve.cli import options

if TYPE_CHECKING:
    from hybridve.hull.report.read import Report


@click.command(short_help="Tell what a report found.")
@options.report_arg
@options.json_option
def summary(report: Path, as_json: bool) -> None:
    r"""Tell what REPORT found: which objects were touched, when, and how far that can be trusted.

    \b
    Example:
      hybridve summary report.h5
      hybridve summary report.h5 --json | jq '.objects[] | select(.frames_colliding > 0).name'
    """
    from hybridve.hull.report.read import read_report
    from hybridve.hull.report.summarize import summarize

    loaded = read_report(report)
    if as_json:
        click.echo(json.dumps(summarize(loaded)))
    else:
        print_summary(loaded)


def print_summary(report: "Report") -> None:
    """Print a report's summary as a table."""
    from hybridve.hull.report.summarize import summarize

    numbers = summarize(report)
    click.echo(f"{numbers['report']}: {numbers['frames']} frames, {numbers['seconds']:.2f} s")
    if numbers["frames_invalid"]:
        click.echo(f"  {numbers['frames_invalid']} frames could not be evaluated:")
        for reason, count in numbers["reasons"].items():
            click.echo(f"    {count} x {reason}")
    rows = [("object", "verdict", "frames", "certain", "when", "points, most", "triangles, most")]
    for found in numbers["objects"]:
        rows.append(
            (
                found["name"],
                found["verdict"],
                f"{found['frames_colliding']}",
                _certain_text(found),
                _spans_text(found["spans"]),
                f"{found['points_most']}",
                f"{found['triangles_most']}",
            )
        )
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    for row in rows:
        cells = (cell.ljust(width) for cell, width in zip(row, widths, strict=True))
        click.echo("  " + "  ".join(cells).rstrip())
    for found in numbers["objects"]:
        if missed := found["frames_colliding"] - found["frames_sampled_colliding"]:
            frames = "1 frame" if missed == 1 else f"{missed} frames"
            click.echo(
                f"  {found['name']}: in {frames} no sample collides, but a certified point does; "
                "--viewport or --accuracy-mm finds more points"
            )
    if numbers["sample_spacing_m"] is not None:
        smallest, largest = numbers["viewports"]
        viewports = f"viewport {largest}" if smallest == largest else f"{smallest} to {largest}"
        click.echo(
            f"  sampled at most {numbers['sample_spacing_m'] * 1e3:.3g} mm apart along edges: "
            f"{viewports}, {numbers['samples']} samples"
        )
    stages = ", ".join(f"{stage} {ms:.2f}" for stage, ms in numbers["stage_ms_mean"].items())
    click.echo(f"  ms of work a frame, mean: {stages}; engine {numbers['engine']}")


def _certain_text(found: dict[str, Any]) -> str:
    """Return how many frames have which certificate, in words."""
    parts = [
        f"{found[key]} {word}"
        for key, word in (("frames_with_witness", "hit"), ("frames_proved_free", "free"))
        if found[key]
    ]
    if found["frames_open"]:
        parts.append(f"{found['frames_open']} open below {found['open_at_m'] * 1e3:.3g} mm")
    return ", ".join(parts) or "-"


def _spans_text(spans: list[dict[str, float]]) -> str:
    if not spans:
        return "-"
    first, more = spans[0], len(spans) - 1
    text = f"{first['start_s']:.2f}-{first['stop_s']:.2f} s"
    return f"{text} and {more} more" if more else text
