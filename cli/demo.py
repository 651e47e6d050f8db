"""``hybridve demo``: the whole job on a generated recording, told command by command."""

from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import click

from hybridve.cli import options
from hybridve.cli.calibrate import calibrate
from hybridve.cli.detect import detect
from hybridve.cli.render import render
from hybridve.cli.segment import segment
from hybridve.cli.summary import summary
from hybridve.cli.synth import synth


def _files(values: dict[str, Any]) -> options.Files:
    return options.Files(
        reads=options.given(),
        writes=options.given(values["output"]),
    )


@click.command(
    cls=options.Command, files=_files, short_help="The whole job on a generated recording."
)
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    default=Path("demo"),
    show_default=True,
    help="The folder to work in.",
)
@options.overwrite_option
@options.quiet_progress
@click.pass_context
def demo(context: click.Context, output: Path, overwrite: bool, progress: bool) -> None:
    r"""Generate a recording, calibrate, segment, detect, and draw what was found.

    Each step is a command that you can run by hand; they are told as they start.

    \b
    Example:
      hybridve demo -o demo
    """
    session, report = output / "session", output / "report.h5"
    scene = session / "scene.toml"
    picture, seen = output / "picture.png", output / "cameras.png"
    curves = output / "curves.png"
    output.mkdir(parents=True, exist_ok=True)

    def step(text: str, command: click.Command, **values: Any) -> None:
        options.tell(f"$ hybridve {text}", err=True)
        context.invoke(command, **values)

    again: dict[str, Any] = {"overwrite": overwrite, "progress": progress}
    step(f"synth boxes -o {session}", synth, preset="boxes", output=session, **again)
    step(f"calibrate {session}", calibrate, session=session, **again)
    step(f"segment {session}", segment, session=session, **again)
    step(
        f"detect {session} --scene {scene} -o {report}",
        detect,
        sessions=(session,),
        scenes=(scene,),
        output=report,
        **again,
    )
    with redirect_stdout(StringIO()):  # detect has told the same a moment ago
        step(
            f"summary {report} --picture {curves}",
            summary,
            report=report,
            picture=curves,
            overwrite=overwrite,
        )
    drawn = {"session": session, "scene": scene, "report": report, "overwrite": overwrite}
    shown = f"render {session} --scene {scene} --report {report}"
    step(f"{shown} -o {picture}", render, output=picture, **drawn)
    step(f"{shown} --view cameras -o {seen}", render, output=seen, view="cameras", **drawn)
    options.tell(f"report   {report}\ncurves   {curves}\npicture  {picture}\ncameras  {seen}")
