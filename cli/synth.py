"""``hybridve synth``: a generated recording whose truth is known."""

from pathlib import Path
from typing import Any

import click

from hybridve.cli import options
from hybridve.cli.progress import Terminal


def _files(values: dict[str, Any]) -> options.Files:
    return options.Files(
        reads=options.given(),
        writes=options.given(values["output"]),
    )


@click.command(
    cls=options.Command, files=_files, short_help="Generate a recording with known truth."
)
@click.argument("preset")
@options.output_option("The folder to write the session into.")
@click.option(
    "--seed",
    type=int,
    default=0,
    show_default=True,
    help="Other noise and textures; the motion stays the preset's.",
)
@click.option(
    "--n-frames", type=click.IntRange(1), help="Length of the recording; the preset's by default."
)
@click.option(
    "--participant",
    type=int,
    help="payload: whose hands, 1 to 4; the first uses no tool. Default: 1.",
)
@click.option(
    "--gap-mm",
    type=float,
    help="payload: how far payload_a hangs above the PMT. Default: 150.",
)
@options.overwrite_option
@options.quiet_progress
def synth(
    preset: str,
    output: Path,
    seed: int,
    n_frames: int | None,
    participant: int | None,
    gap_mm: float | None,
    overwrite: bool,
    progress: bool,
) -> None:
    r"""Generate a recording of simple things moving through CAD, with the truth beside it.

    The folder gets a session.toml, a scene.toml, the cameras' pictures of the board, of the empty
    scene and of the task, meshes, and truth.h5. PRESET is one of:

    \b
      boxes    an arm, a ball and a carton among four parts
      payload  a pipe and a cord between two payloads: how much room do they need?
      ball     blocks about a virtual ball
      curtain  two hands that part a curtain in a window
      bounce   a virtual ball among real blocks

    \b
    Example:
      hybridve synth boxes -o my_session
      hybridve synth payload -o with_tongs --participant 2 --gap-mm 150
    """
    from hybridve.hull.synth import write_session

    chosen = (("participant", participant), ("gap_mm", gap_mm))
    write_session(
        preset,
        output,
        seed=seed,
        n_frames=n_frames,
        options={name: value for name, value in chosen if value is not None},
        overwrite=overwrite,
        progress=Terminal(enabled=progress).stage,
    )
    options.tell(f"{output / 'session.toml'}")
