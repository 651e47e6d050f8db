"""Arguments and options that commands share: the same thing has the same name everywhere."""

import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar, get_args

import click

from hybridve.calib.bounded import printable
from hybridve.hull.report.wording import counted as counted

EngineName = Literal["auto", "compute", "native", "stencil", "reference"]

if TYPE_CHECKING:
    from hybridve.hull.capture.recording import FrameRange
    from hybridve.hull.chain import EvaluateSettings
    from hybridve.hull.contact.outline_errors import DoubtSettings

FC = TypeVar("FC", bound=Callable[..., Any] | click.Command)

_path = click.Path(path_type=Path)


class Size(click.ParamType[tuple[int, int]]):
    """Width and height in pixels, each within bounds."""

    name = "WIDTHxHEIGHT"

    def __init__(self, least: int = 1, most: int | None = None) -> None:
        self._least, self._most = least, most

    def convert(
        self, value: str, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[int, int]:
        """Return the size, or fail with what was expected."""
        if not isinstance(value, str):
            return value
        width, _, height = value.lower().partition("x")
        if not (width.isdecimal() and height.isdecimal() and min(int(width), int(height)) > 0):
            self.fail(f"{value!r} is not a size; expected 1920x1080", param, ctx)
        size = (int(width), int(height))
        if min(size) < self._least or (self._most is not None and max(size) > self._most):
            self.fail(f"{value!r}: each side is {self._least} to {self._most} pixels", param, ctx)
        return size


class Frames(click.ParamType["FrameRange"]):
    """A range of frames, written as Python does."""

    name = "START:STOP[:STEP]"

    def convert(
        self, value: str, param: click.Parameter | None, ctx: click.Context | None
    ) -> "FrameRange":
        """Return the range, or fail with what was expected."""
        from hybridve.calib.errors import SessionError
        from hybridve.hull.capture.recording import FrameRange

        if not isinstance(value, str):
            return value
        parts = value.split(":")
        try:
            numbers = [int(part) if part else None for part in parts]
            if len(numbers) == 1 and numbers[0] is not None:
                return FrameRange(numbers[0], numbers[0] + 1)
            if len(numbers) not in (2, 3):
                raise ValueError(value)
            start, stop, step = [*numbers, None][:3]
            return FrameRange(start or 0, stop, 1 if step is None else step)
        except (ValueError, SessionError):
            self.fail(
                f"{value!r} is not a range of frames; expected one frame (7), 0:100, 100: or "
                "0:400:10",
                param,
                ctx,
            )


@dataclass(frozen=True, slots=True)
class Files:
    """What a command reads and writes, by its arguments.

    Attributes
    ----------
    reads : list of Path
        Sessions, scenes, rigs, reports and folders of them.
    writes : list of Path
        Files and folders; each is held while the command runs, so that no other run writes it.
    keeps : list of Path
        Those that the session itself keeps, as its rig, which a command makes anew.
    held : list of Path
        Those that are read, changed and written in a moment: who comes second waits for them.
    """

    reads: list[Path] = field(default_factory=list)
    writes: list[Path] = field(default_factory=list)
    keeps: list[Path] = field(default_factory=list)
    held: list[Path] = field(default_factory=list)


#: How long one waits for a file that another run changes in a moment, in seconds.
_PATIENCE_S = 10.0


class Command(click.Command):
    """A command that never writes over what it reads, nor what another run is writing.

    Parameters
    ----------
    files : callable
        Returns what it reads and writes, asked for the values of its parameters by their names.
    """

    def __init__(
        self, *args: Any, files: Callable[[dict[str, Any]], Files] | None = None, **kwargs: Any
    ) -> None:
        super().__init__(*args, **kwargs)
        self._files = files

    def invoke(self, ctx: click.Context) -> Any:
        """Run it, its outputs held."""
        if self._files is None:
            return super().invoke(ctx)
        from hybridve.calib.holding import holding
        from hybridve.hull.places import Inputs

        files = self._files(ctx.params)
        inputs = Inputs.of(files.reads)
        with ExitStack() as held:
            # Without --overwrite nothing that stands is written over.
            may_overwrite = ctx.params.get("overwrite", True)
            for path in files.writes if may_overwrite else ():
                inputs.refuse(path)
            for path in files.keeps if may_overwrite else ():
                inputs.refuse(path, is_kept_here=True)
            for path in dict.fromkeys([*files.writes, *files.keeps]):
                held.enter_context(holding(path, command_line()))
            for path in files.held:
                held.enter_context(holding(path, command_line(), patience_s=_PATIENCE_S))
            return super().invoke(ctx)


def given(*paths: Path | Sequence[Path] | None) -> list[Path]:
    """Return those paths that are given."""
    found: list[Path] = []
    for path in paths:
        if isinstance(path, Path):
            found.append(path)
        elif path is not None:
            found.extend(path)
    return found


class GroupedOption(click.Option):
    """An option that help shows under a heading of its own; see `GroupedCommand`."""

    def __init__(self, *args: Any, heading: str, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.heading = heading


class GroupedCommand(Command):
    """A command whose help shows its options under headings, in the order in which they come."""

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options, those without a heading first."""
        records: dict[str, list[tuple[str, str]]] = {"Options": []}
        for param in self.get_params(ctx):
            record = param.get_help_record(ctx) if isinstance(param, click.Option) else None
            if record is not None:
                heading = param.heading if isinstance(param, GroupedOption) else "Options"
                records.setdefault(heading, []).append(record)
        for heading, lines in records.items():
            with formatter.section(heading):
                formatter.write_dl(lines)


session_arg = click.argument("session", type=_path)
sessions_arg = click.argument("sessions", metavar="SESSION...", nargs=-1, required=True, type=_path)
report_arg = click.argument("report", type=_path)
scene_option = click.option(
    "--scene", required=True, type=_path, help="The scene.toml with the CAD objects."
)
scenes_option = click.option(
    "--scene",
    "scenes",
    required=True,
    multiple=True,
    type=_path,
    help="The scene.toml with the CAD objects; several to compare layouts.",
)
overwrite_option = click.option(
    "--overwrite", is_flag=True, help="Replace what stands under the output's name."
)
drop_camera_option = click.option(
    "--drop-camera",
    "drop_cameras",
    metavar="NAME",
    multiple=True,
    help="Evaluate as if the session had not this camera; may be given several times.",
)

fail_on_doubt_option = click.option(
    "--fail-on-doubt",
    is_flag=True,
    help="Leave with status 5 where the cameras contradict each other, so that the session is not "
    "to be trusted.",
)

frames_option = click.option(
    "--frames",
    type=Frames(),
    default=":",
    help="Which frames, as a Python range: 0:100, 100:, 0:400:10, or one: 7. Default: all.",
)
engine_option = click.option(
    "--engine",
    type=click.Choice(get_args(EngineName)),
    default="auto",
    show_default=True,
    help=(
        "What answers the volume query: compute (OpenGL 4.3), native (CPU), stencil (the method as "
        "published in 2003, to compare with), reference (slow)."
    ),
)
json_option = click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
quiet_progress = click.option(
    "--progress/--no-progress", default=True, help="Show progress on stderr."
)


def output_option(what: str) -> Callable[[FC], FC]:
    """Return the option ``-o/--output`` for the file or folder described by `what`."""
    return click.option("-o", "--output", required=True, type=_path, help=what)


def response_options(command: FC) -> FC:
    """Add the options of clearance, response and doubt; see `evaluation_of`."""
    clearance, response = "Clearance", "Response"
    added = (
        click.option(
            "--clearance-mm",
            cls=GroupedOption,
            heading=clearance,
            type=click.FloatRange(0),
            default=0.1,
            show_default=True,
            help="Measure how far every object is from the real things, between two bounds at most "
            "this far apart; 0: do not.",
        ),
        click.option(
            "--response/--no-response",
            cls=GroupedOption,
            heading=response,
            default=True,
            help="Find which way, and how far, an object that is touched must give. Default: do.",
        ),
        click.option(
            "--abc-deg",
            cls=GroupedOption,
            heading=response,
            type=click.FloatRange(0, 180, min_open=True, max_open=True),
            default=10.0,
            show_default=True,
            help="The paper's triangle ABC: its angle at CP_obj.",
        ),
        click.option(
            "--abc-mm",
            cls=GroupedOption,
            heading=response,
            type=click.FloatRange(0, 2000, min_open=True),
            default=50.0,
            show_default=True,
            help="Its height; contacts deeper than this are not resolved by the paper's form.",
        ),
        click.option(
            "--abc-window",
            cls=GroupedOption,
            heading=response,
            type=click.IntRange(1, 65_535),
            default=400,
            show_default=True,
            help="Samples along its height.",
        ),
        click.option(
            "--backtrack",
            cls=GroupedOption,
            heading=response,
            is_flag=True,
            help="When a contact begins, take the point of first contact for CP_obj instead of the "
            "collision point farthest from RP_obj.",
        ),
        doubt_options(
            "Tell what outlines, calibration and single cameras do to every clearance and verdict; "
            "needs the clearance. Default: do."
        ),
    )
    for option in reversed(added):
        command = option(command)
    return command


def doubt_options(what: str) -> Callable[[FC], FC]:
    """Return the options of doubt, which tells what `what` says; see `doubt_of`."""

    def added(command: FC) -> FC:
        command = click.option(
            "--mask-std-px",
            cls=GroupedOption,
            heading="Doubt",
            type=click.FloatRange(0),
            help="Standard deviation of the silhouettes' outlines, pixels. Default: 1.5.",
        )(command)
        return click.option(
            "--doubt/--no-doubt", cls=GroupedOption, heading="Doubt", default=True, help=what
        )(command)

    return added


def doubt_of(*, doubt: bool, mask_std_px: float | None) -> "DoubtSettings | None":
    """Return what the options of `doubt_options` ask to assume of outlines; None for no doubt."""
    if not doubt:
        return None
    from hybridve.hull.contact.outline_errors import DoubtSettings

    return DoubtSettings() if mask_std_px is None else DoubtSettings(segmentation_px=mask_std_px)


def evaluation_of(
    *,
    clearance_mm: float,
    response: bool,
    abc_deg: float,
    abc_mm: float,
    abc_window: int,
    backtrack: bool,
    doubt: bool,
    mask_std_px: float | None,
    **others: Any,
) -> "EvaluateSettings":
    """Return the settings that the options of `response_options` ask for, and `others` besides.

    Raises
    ------
    UsageError
        If --backtrack is given with --no-response.
    """
    from math import radians

    from hybridve.hull.chain import EvaluateSettings
    from hybridve.hull.contact.respond import ResponseSettings

    if backtrack and not response:
        raise click.UsageError("--backtrack says where the response begins; drop --no-response")
    return EvaluateSettings(
        clearance_m=clearance_mm / 1000.0 or None,
        response=ResponseSettings(radians(abc_deg), abc_mm / 1000.0, abc_window)
        if response
        else None,
        backtrack=backtrack,
        doubt=doubt_of(doubt=doubt and clearance_mm > 0, mask_std_px=mask_std_px),
        **others,
    )


def refuse_suffix(picture: Path) -> None:
    """Refuse a picture's name that says of no kind that can be drawn."""
    from hybridve.hull.view.chart import SUFFIXES

    if picture.suffix.lower() not in SUFFIXES:
        raise click.UsageError(f"{picture}: pictures are {', '.join(SUFFIXES)}")


def command_line() -> str:
    """Return what was called, for the files that it makes."""
    return " ".join(["hybridve", *sys.argv[1:]])


def tell(text: str = "", *, err: bool = False) -> None:
    """Print a text, with nothing in it that a terminal would obey: names come from strangers."""
    click.echo(printable(text), err=err)


def print_table(rows: Sequence[Sequence[str]]) -> None:
    """Print rows of cells in columns, indented; the first row is the heading."""
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    for row in rows:
        cells = (cell.ljust(width) for cell, width in zip(row, widths, strict=True))
        tell("  " + "  ".join(cells).rstrip())
