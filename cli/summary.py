"""``hybridve summary``: what a report found, as text or JSON."""

import json
from pathlib import Path
from typing import TYPE_CHECKING

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
    rows = [("object", "verdict", "frames", "when", "points, most", "triangles, most")]
    for found in numbers["objects"]:
        rows.append(
            (
                found["name"],
                found["verdict"],
                f"{found['frames_colliding']}",
                _spans_text(found["spans"]),
                f"{found['points_most']}",
                f"{found['triangles_most']}",
            )
        )
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    for row in rows:
        cells = (cell.ljust(width) for cell, width in zip(row, widths, strict=True))
        click.echo("  " + "  ".join(cells).rstrip())
    stages = ", ".join(f"{stage} {ms:.2f}" for stage, ms in numbers["stage_ms_mean"].items())
    click.echo(f"  ms of work a frame, mean: {stages}; engine {numbers['engine']}")


def _spans_text(spans: list[dict[str, float]]) -> str:
    if not spans:
        return "-"
    first, more = spans[0], len(spans) - 1
    text = f"{first['start_s']:.2f}-{first['stop_s']:.2f} s"
    return f"{text} and {more} more" if more else text
