"""``hybridve diff``: what clashes in one report and not in another, or more, or less."""

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from hybridve.calib.lengths import bounds_mm, mm
from hybridve.cli import options
from hybridve.hull.report.wording import counted_clashes, worst_text

if TYPE_CHECKING:
    from hybridve.hull.report.changes import Compared, Comparison

_path = click.Path(path_type=Path)


@click.command(short_help="Tell what changed from one report to another.")
@click.argument("old", type=_path)
@click.argument("new", type=_path)
@options.json_option
def diff(old: Path, new: Path, as_json: bool) -> None:
    r"""Tell which clashes of report NEW are not in OLD, are gone, got better or worse.

    Only what is beyond what both reports say that they may be off by is a change: two recordings of
    one layout show none. Both may be folders, of which reports of the same name are compared.

    Leaves with status 6 if something appeared or got worse, with 0 otherwise.

    \b
    Example:
      hybridve diff before.h5 after.h5
      hybridve diff reports_monday reports_friday --json | jq '.comparisons[].counts'
    """
    from hybridve.hull.report.changes import compare_paths, told_of_comparison

    compared, alone = compare_paths(old, new)
    if as_json:
        told = {
            "worse": any(one.is_worse for one in compared),
            "comparisons": [told_of_comparison(one) for one in compared],
            "not_compared": [str(path) for path in alone],
        }
        options.tell(json.dumps(told))
    else:
        for one in compared:
            _print(one)
        for path in alone:
            options.tell(f"{path}: the other folder has no such report")
    if any(one.is_worse for one in compared):
        sys.exit(6)


def _print(comparison: "Comparison") -> None:
    options.tell(_first_line(comparison))
    options.tell(f"{comparison.old} -> {comparison.new}: {_basis(comparison)}")
    for path in comparison.distrusted:
        options.tell(f"  {path} is not to be trusted: its cameras contradict each other")
    rows: list[tuple[str, ...]] = [
        ("id", "change", "object", "by, mm", "counts beyond, mm", "before, mm", "now, mm")
    ]
    rows += [_row(one) for one in comparison.clashes]
    if comparison.clashes:
        options.print_table(rows)


def _first_line(comparison: "Comparison") -> str:
    counts = [
        f"{comparison.count(change)} {change}"
        for change in ("appeared", "worse", "vanished", "better")
        if comparison.count(change)
    ]
    unclear = comparison.count("unclear")
    same = comparison.count("same")
    stated = [f"{counted_clashes(same)} the same"] if same else []
    if unclear:
        stated.append(f"{unclear} in one report only, by no more than it may be off")
    told = f" ({', '.join(stated)})" if stated else ""
    if not counts:
        return f"no change{told}"
    first = comparison.clashes[0]
    was, now = (
        "none" if one is None else f"{worst_text(one)} (mm, frame {one.worst.frame})"
        for one in (first.old, first.new)
    )
    return (
        f"{'worse' if comparison.is_worse else 'better'}: {', '.join(counts)}{told}; "
        f"look first at {first.id}: {was} before, {now} now"
    )


def _basis(comparison: "Comparison") -> str:
    """Return what the comparison rests on, in words."""
    text = "silhouettes of their own, which may be off"
    if comparison.same_silhouettes:
        text = "the same silhouettes, so that only bounds count"
    if comparison.n_frames is not None:
        text += f"; in the {options.counted(comparison.n_frames, 'frame')} that both have"
    return text


def _row(one: "Compared") -> tuple[str, ...]:
    name = (one.new or one.old).name  # type: ignore[union-attr]
    by = "-"
    if one.change_m is not None and all(abs(value) < float("inf") for value in one.change_m):
        by = bounds_mm(*one.change_m)
    beyond = "-" if one.beyond_m == float("inf") else mm(one.beyond_m, ".1f")
    return (
        one.id,
        one.change,
        name,
        by,
        beyond,
        "-" if one.old is None else worst_text(one.old),
        "-" if one.new is None else worst_text(one.new),
    )
