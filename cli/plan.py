"""``hybridve plan``: what a rig that is only drawn will be able to tell."""

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from hybridve.cli import options
from hybridve.cli.progress import Terminal

if TYPE_CHECKING:
    from hybridve.hull.plan.account import PlanAccount, Spread


class _Vary(click.ParamType[tuple[str, tuple[str, ...]]]):
    name = "KEY=V,V,..."

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[str, tuple[str, ...]]:
        if isinstance(value, tuple):
            return value
        key, _, values = value.partition("=")
        found = tuple(part.strip() for part in values.split(",") if part.strip())
        if not key.strip() or not found:
            self.fail(f"{value!r} names no values; expected ring.cameras=2,3,4,6", param, ctx)
        return key.strip(), found


@click.command(short_help="Tell what a rig that is only drawn will see, and how exactly.")
@click.argument("plan", type=click.Path(path_type=Path), required=False)
@click.option(
    "--vary",
    type=_Vary(),
    help="A row for each of several values of one key of the plan, as ring.cameras=2,3,4,6.",
)
@click.option("--example", is_flag=True, help="Print a plan.toml to begin with, and do no more.")
@options.json_option
@options.quiet_progress
def plan(
    plan: Path | None,
    vary: tuple[str, tuple[str, ...]] | None,
    example: bool,
    as_json: bool,
    progress: bool,
) -> None:
    r"""Tell what the cameras of PLAN will see, before anything is bought or hung up.

    A plan.toml draws cameras, the volume where hands will work, and the board. Told are what each
    camera sees, how exactly a calibration will place points, and what will be told of a clearance
    that is known: a ball, as large as a fist or a finger, is put at places all over the volume, a
    plate beside it, and clearance and doubt are worked out as `hybridve detect` does. The hull that
    cameras see is larger than the ball, and outlines and rig err; a part must be farther away by
    both to be told to keep its distance at 95 %.

    \b
    Example:
      hybridve plan --example > plan.toml
      hybridve plan plan.toml
      hybridve plan plan.toml --vary ring.cameras=2,3,4,6,8
    """
    from hybridve.calib.plain import to_json
    from hybridve.hull.plan.account import account_of
    from hybridve.hull.plan.example import EXAMPLE
    from hybridve.hull.plan.tables import read_plan

    if example:
        click.echo(EXAMPLE, nl=False)
        return
    if plan is None:
        raise click.UsageError("name a plan.toml, or ask for one: hybridve plan --example")
    terminal = Terminal(enabled=progress and sys.stderr.isatty())
    key, values = vary if vary is not None else ("", ("",))
    accounts = []
    # All are read before the first is worked out, so that a value that cannot be costs no wait.
    for asked in [read_plan(plan, {key: value} if key else None) for value in values]:
        accounts.append(account_of(str(plan), *asked, terminal))
    if as_json:
        told: Any = to_json(accounts[0])
        if key:
            told = [
                {"key": key, "value": value, **to_json(account)}
                for value, account in zip(values, accounts, strict=True)
            ]
        options.tell(json.dumps(told))
    elif key:
        _tell_rows(key, values, accounts)
    else:
        _tell(accounts[0])


def _tell(found: "PlanAccount") -> None:
    options.tell(f"{found.plan}: {options.counted(len(found.cameras), 'camera')}")
    rows = [("camera", "at, m", "to the middle, m", "mm a pixel", "volume seen", "square, px")]
    for one in found.cameras:
        rows.append(
            (
                one.name,
                ", ".join(f"{value:.2f}" for value in one.at_m),
                f"{one.distance_m:.2f}",
                f"{one.mm_per_px:.2f}",
                f"{one.seen_share:.0%}",
                f"{one.square_px:.1f}" if one.square_px else "not seen",
            )
        )
    options.print_table(rows)
    options.tell(
        f"of the volume {found.seen_by_all:.0%} is seen by all cameras, {found.seen_by_two:.0%} by "
        "two or more"
    )
    options.tell(
        f"a ball of {found.ball_radius_mm:g} mm radius beside a plate, all over the volume:"
    )
    options.print_table(
        [
            ("mm", "median", "95 % of places", "most"),
            ("the rig alone: error of a point, at 95 %", *_texts(found.calibration_mm)),
            ("the hull is nearer than the ball by", *_texts(found.hull_mm)),
            ("outlines and rig take off more, at 95 %", *_texts(found.doubt_mm)),
            ("both: what a part must be farther away", *_texts(found.total_mm)),
        ]
    )
    options.tell(
        f"a hand moves {found.blur_mm:.1f} mm while the shutter is open, "
        f"{found.out_of_step_mm:.1f} mm between cameras, {found.between_frames_mm:.0f} mm from "
        "frame to frame"
    )
    for note in found.notes:
        options.tell(f"note: {note}")


def _tell_rows(key: str, values: tuple[str, ...], accounts: list["PlanAccount"]) -> None:
    """Print a row for each value of a key."""
    rows = [(key, "seen by all", "rig, mm", "hull, mm", "doubt, mm", "both, mm", "at 95 %, mm")]
    for value, found in zip(values, accounts, strict=True):
        rows.append(
            (
                value,
                f"{found.seen_by_all:.0%}",
                _texts(found.calibration_mm)[0],
                _texts(found.hull_mm)[0],
                _texts(found.doubt_mm)[0],
                _texts(found.total_mm)[0],
                _texts(found.total_mm)[1],
            )
        )
    options.print_table(rows)
    options.tell("medians over the volume; the last column holds for 95 % of places and sides")
    for note in dict.fromkeys(note for found in accounts for note in found.notes):
        options.tell(f"note: {note}")


def _texts(spread: "Spread") -> tuple[str, str, str]:
    return _mm(spread.median), _mm(spread.at_95_percent), _mm(spread.most)


def _mm(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}"
