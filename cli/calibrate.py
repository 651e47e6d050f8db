"""``hybridve calibrate``: from pictures of a board to a rig."""

import json
import math
from itertools import combinations
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
    from hybridve.hull.capture.rig import calibrate_session
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
    """Return what to tell of a rig, as plain JSON values."""
    centers = rig.centers_world
    return {
        "rig": str(path),
        "cameras": [
            {
                "name": camera.name,
                "model": camera.model,
                "center_m": camera.center_world.tolist(),
                **rig.provenance.get("cameras", {}).get(camera.name, {}),
            }
            for camera in rig.cameras
        ],
        "distances_m": {
            f"{rig.cameras[i].name} {rig.cameras[j].name}": math.dist(centers[i], centers[j])
            for i, j in combinations(range(len(centers)), 2)
        },
        **{
            key: rig.provenance[key]
            for key in ("world", "rms_px", "labelling", "check")
            if key in rig.provenance
        },
    }


def _print(numbers: dict[str, Any]) -> None:
    click.echo(f"{numbers['rig']}: {len(numbers['cameras'])} cameras")
    for camera in numbers["cameras"]:
        x, y, z = camera["center_m"]
        parts = [f"  {camera['name']}: {camera['model']}, at ({x:.3f}, {y:.3f}, {z:.3f}) m"]
        for kind, what in (("intrinsics", "stills"), ("extrinsics", "board clip")):
            found = camera.get(kind, {})
            if found.get("rms_px") is not None:
                parts.append(f"{what} {found['rms_px']:.3f} px rms of {found['views_used']} views")
        dropped = camera.get("intrinsics", {}).get("views_dropped", {})
        without = camera.get("intrinsics", {}).get("views_without_board", {})
        if dropped or without:
            parts.append(f"{len(dropped)} views dropped, {len(without)} without a board")
        click.echo("; ".join(parts))
    pairs = ", ".join(f"{pair} {metres:.3f}" for pair, metres in numbers["distances_m"].items())
    click.echo(f"  distances, m: {pairs}")
    if "rms_px" in numbers:
        click.echo(f"  joint adjustment: {numbers['rms_px']:.3f} px rms over all views")
    labelling = numbers.get("labelling", {})
    if "weakest_sigma" in labelling:
        click.echo(
            "  the board looks the same turned; which way round each camera saw it was decided by "
            f"{labelling['decided_by']}, by {labelling['weakest_sigma']:.1f} standard deviations "
            f"or more{' (weak: compare a distance you know)' if labelling.get('is_weak') else ''}"
        )
    if "check" in numbers:
        click.echo(f"  {numbers['check']['message']}")
