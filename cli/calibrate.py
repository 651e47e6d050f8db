"""``hybridve calibrate``: from pictures of a board to a rig."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from hybridve.cli import options
from hybridve.cli.progress import StageProgress

if TYPE_CHECKING:
    from hybridve.calib.rig import Rig


@click.command(short_help="Find where the cameras stand, from pictures of a board.")
@options.session_arg
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    help="The folder to write the rig into. Default: rig/ beside the session.toml.",
)
@options.overwrite_option
@options.json_option
@options.quiet_progress
def calibrate(
    session: Path, output: Path | None, overwrite: bool, as_json: bool, progress: bool
) -> None:
    r"""Find lenses and places of SESSION's cameras from its pictures of the target.

    Writes rig.json and a COLMAP model. A rig that the session names (rig = ...) is taken instead,
    and tested against the session's board, if there is one.

    \b
    Example:
      hybridve calibrate data/horseman
    """
    from hybridve.calib.colmap_io import write_colmap_model
    from hybridve.calib.rig_io import write_rig
    from hybridve.hull.calibration import calibrate_session
    from hybridve.hull.capture.session import load_session
    from hybridve.hull.report.write import refuse_existing

    loaded = load_session(session)
    folder = output or loaded.folder / "rig"
    folder.parent.mkdir(parents=True, exist_ok=True)
    folder.mkdir(exist_ok=True)
    path = folder / "rig.json"
    refuse_existing(path, overwrite=overwrite)
    rig = calibrate_session(loaded, progress=StageProgress(enabled=progress))
    write_colmap_model(folder / "colmap", rig)
    write_rig(path, rig)
    numbers = _numbers(path, rig)
    if as_json:
        click.echo(json.dumps(numbers))
    else:
        _print(numbers)


def _numbers(path: Path, rig: "Rig") -> dict[str, Any]:
    return {"rig": str(path)}


def _print(numbers: dict[str, Any]) -> None:
    click.echo(numbers["rig"])
