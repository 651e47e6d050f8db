"""``hybridve render``: one frame as a picture."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from hybridve.cli import options

if TYPE_CHECKING:
    from hybridve.hull.agreement.record import NamedCause
    from hybridve.hull.report.read import Report


@click.command(short_help="Draw one frame: cameras, hull, CAD, collisions in red.")
@options.session_arg
@options.scene_option
@options.output_option("The picture to write, a .png or .jpg.")
@click.option(
    "--report",
    type=click.Path(path_type=Path),
    help="Choose the frame in which this report has most collision points; for --view agreement "
    "the middle of the worst that it says of the cameras, if it says any.",
)
@click.option("--frame", type=click.IntRange(0), help="Which frame. Default: the report's, or 0.")
@click.option(
    "--view",
    type=click.Choice(["scene", "cameras", "agreement"]),
    default="scene",
    show_default=True,
    help="The scene from outside; what each camera saw with the CAD drawn in; or what each saw "
    "beside the hull of all others as it would see it, and where they differ.",
)
@options.engine_option
@options.overwrite_option
def render(
    session: Path,
    scene: Path,
    output: Path,
    report: Path | None,
    frame: int | None,
    view: str,
    engine: options.EngineName,
    overwrite: bool,
) -> None:
    r"""Draw one frame of SESSION: cameras, the hull of the real things, the CAD, collisions in red.

    \b
    Example:
      hybridve render my_session --scene scene.toml --report report.h5 -o worst.png
      hybridve render my_session --scene scene.toml --frame 120 --view cameras -o seen.png
      hybridve render my_session --scene scene.toml --report report.h5 --view agreement -o who.png
    """
    import cv2

    from hybridve.hull.cad.scene import load_scene
    from hybridve.hull.capture.session import load_session
    from hybridve.hull.chain import EvaluateSettings, make_chain
    from hybridve.hull.contact.outline_errors import DoubtSettings
    from hybridve.hull.query.choose import open_engine
    from hybridve.hull.report.read import read_report
    from hybridve.hull.report.write import refuse_existing
    from hybridve.hull.show import draw_agreement, draw_cameras, draw_scene, take_shot
    from hybridve.hull.view.picture import write_picture

    cv2.setNumThreads(1)
    refuse_existing(output, overwrite=overwrite)
    if output.suffix.lower() not in (".png", ".jpg", ".jpeg"):
        raise click.UsageError(f"{output}: pictures are .png or .jpg")
    loaded = None if report is None else read_report(report)
    causes = () if loaded is None else loaded.agreement.causes
    if frame is None and loaded is not None:
        frame = _chosen_frame(loaded, causes if view == "agreement" else ())
    settings = EvaluateSettings(doubt=DoubtSettings() if view == "agreement" else None)
    chain = make_chain(load_session(session), load_scene(scene), settings)
    if view == "agreement":
        picture = draw_agreement(chain, frame or 0, causes)
    else:
        with open_engine(engine) as query:
            shot = take_shot(chain, frame or 0, query)
        picture = draw_scene(shot, (1600, 1000)) if view == "scene" else draw_cameras(shot)
    write_picture(output, picture)
    click.echo(f"{output}: frame {frame or 0}")


def _chosen_frame(report: "Report", causes: "Sequence[NamedCause]") -> int:
    """Return the middle frame of the first cause; without one, that with most collision points."""
    import numpy as np

    from hybridve.calib.errors import ReportError

    if causes:
        middle = (causes[0].first_frame + causes[0].last_frame) // 2
        read = np.flatnonzero(report.state != "unread")
        if len(read):
            apart = np.abs(report.index[read].astype(np.int64) - middle)
            return int(report.index[read[int(np.argmin(apart))]])
    if not report.objects:
        raise ReportError(f"{report.path}: has no object")
    points = np.sum([rows.n_points for rows in report.objects.values()], axis=0)
    return int(report.index[int(np.argmax(points))])
