"""``hybridve synth``: a generated recording whose truth is known."""

from pathlib import Path

import click

from hybridve.cli import options
from hybridve.cli.progress import StageProgress


@click.command(short_help="Generate a recording with known truth.")
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
@options.overwrite_option
@options.quiet_progress
def synth(
    preset: str, output: Path, seed: int, n_frames: int | None, overwrite: bool, progress: bool
) -> None:
    r"""Generate a recording of simple things moving through CAD, with the truth beside it.

    PRESET is one of: boxes. The folder gets a session.toml, a scene.toml, the cameras' pictures of
    the board, of the empty scene and of the task, meshes, and truth.h5.

    \b
    Example:
      hybridve synth boxes -o my_session
    """
    from hybridve.hull.capture.synth import write_session

    write_session(
        preset,
        output,
        seed=seed,
        n_frames=n_frames,
        overwrite=overwrite,
        progress=StageProgress(enabled=progress),
    )
    click.echo(f"{output / 'session.toml'}")
