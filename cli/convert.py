"""``hybridve convert``: a rig from one program's files to another's."""

import json
from pathlib import Path
from typing import Any, Literal, get_args

import click

from hybridve.cli import options

#: The formats, as `hybridve.calib.formats.rigs.FORMATS` has them: help must not wait for what reads
#: them.
FormatName = Literal[
    "json", "colmap", "opencv", "csv", "caliscope", "aniposelib", "kalibr", "multical"
]
_UNITS = ("m", "cm", "mm", "in", "ft")


def _files(values: dict[str, Any]) -> options.Files:
    return options.Files(
        reads=options.given(values["rig"]),
        writes=options.given(values["output"]),
    )


@click.command(
    cls=options.Command,
    files=_files,
    short_help="Take a rig from one program's files to another's.",
)
@click.argument("rig", type=click.Path(path_type=Path))
@options.output_option(
    "The file to write; for colmap a folder; for opencv a path with {camera} in it."
)
@click.option(
    "--to",
    type=click.Choice(get_args(FormatName)),
    required=True,
    help="The format to write; json is hybridve's own rig.json.",
)
@click.option(
    "--from-unit",
    type=click.Choice(_UNITS),
    help="Unit of RIG's lengths; needed where neither its format nor the file says.",
)
@click.option(
    "--unit", type=click.Choice(_UNITS), help="Unit of the lengths to write. Default: metres."
)
@click.option(
    "--from-pixel-centre",
    type=click.Choice(["0", "0.5"]),
    help="Where RIG has the centre of the top-left pixel, if it is OpenCV's (usually 0) or rows of "
    "matrices (usually 0.5); the other formats fix it.",
)
@click.option(
    "--image-size", type=options.Size(), help="Size of RIG's images, where its files do not say."
)
@click.option(
    "--camera",
    "cameras",
    multiple=True,
    metavar="NAME",
    help="Only this camera; several in the order wanted. Default: all.",
)
@click.option(
    "--approximate",
    is_flag=True,
    help="Where the format has not a camera's lens model, take the nearest that it has, and tell "
    "how far off it is.",
)
@options.overwrite_option
@options.json_option
def convert(
    rig: Path,
    output: Path,
    to: FormatName,
    from_unit: str | None,
    unit: str | None,
    from_pixel_centre: str | None,
    image_size: tuple[int, int] | None,
    cameras: tuple[str, ...],
    approximate: bool,
    overwrite: bool,
    as_json: bool,
) -> None:
    r"""Read RIG in any of the formats that --to writes, or of EasyMocap, MC-Calib or NeRF.

    RIG is a file, the folder of a COLMAP model, or a path with {camera} in it: one file a camera.
    Its format is recognised by its content. What the new format has no place for is told; what
    would come out wrong is refused.

    \b
    Example:
      hybridve convert rig/rig.json --to kalibr -o camchain.yaml
      hybridve convert '{camera}/config.xml' --from-unit mm --to colmap -o sparse
    """
    from hybridve.calib.formats.rig_export import export_rig, output_files
    from hybridve.calib.formats.rigs import read_any_rig
    from hybridve.hull.places import Inputs
    from hybridve.hull.report.write import refuse_existing

    found = read_any_rig(
        rig,
        unit=from_unit,
        pixel_centre=None if from_pixel_centre is None else float(from_pixel_centre),
        image_sizes=image_size,
        names=cameras,
    )
    inputs = Inputs.of([rig])
    for path in output_files(found, to, output):
        if path.parent.is_dir() or to not in {"colmap", "opencv"}:  # those make folders
            refuse_existing(path, overwrite=overwrite)
        inputs.refuse(path)
    written = export_rig(found, to, output, unit=unit, approximate_lenses=approximate)
    if as_json:
        numbers = {
            "files": [str(path) for path in written.files],
            "format": to,
            "from_format": found.provenance.format,
            "cameras": [camera.name for camera in found.cameras],
            "approximated": written.approximated,
            "lost": list(written.lost),
        }
        options.tell(json.dumps(numbers))
        return
    count = options.counted(len(found.cameras), "camera")
    options.tell(f"{output}: {count} as {to}, {options.counted(len(written.files), 'file')}")
    for name, lens in written.approximated.items():
        options.tell(f"  {name}: {lens['model']} instead, up to {lens['error_px']:.3g} px off")
    for what in written.lost:
        options.tell(f"  left behind: {what}")
