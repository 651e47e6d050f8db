"""Arguments and options that commands share: the same thing has the same name everywhere."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar, get_args

import click

EngineName = Literal["auto", "compute", "native", "stencil", "reference"]

if TYPE_CHECKING:
    from hybridve.hull.capture.recording import FrameRange

FC = TypeVar("FC", bound=Callable[..., Any] | click.Command)

_path = click.Path(path_type=Path)


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


session_arg = click.argument("session", type=_path)
report_arg = click.argument("report", type=_path)
scene_option = click.option(
    "--scene", required=True, type=_path, help="The scene.toml with the CAD objects."
)
overwrite_option = click.option(
    "--overwrite", is_flag=True, help="Replace what stands under the output's name."
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
