"""``hybridve render``: one frame as a picture."""

from pathlib import Path

import click

from hybridve.cli import options


@click.command(short_help="Draw one frame: cameras, hull, CAD, collisions in red.")
@options.session_arg
@options.scene_option
@options.output_option("The picture to write, a .png or .jpg.")
@click.option(
    "--report",
    type=click.Path(path_type=Path),
    help="Choose the frame in which this report has most collision points.",
)
@click.option("--frame", type=click.IntRange(0), help="Which frame. Default: the report's, or 0.")
@click.option(
    "--view",
    type=click.Choice(["scene", "cameras"]),
    default="scene",
    show_default=True,
    help="The scene from outside, or what each camera saw with the CAD drawn in.",
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
    """
    import cv2
    import numpy as np

    from hybridve.calib.errors import ReportError
    from hybridve.hull.cad.scene import load_scene
    from hybridve.hull.capture.session import load_session
    from hybridve.hull.chain import EvaluateSettings, make_chain
    from hybridve.hull.query.choose import open_engine
    from hybridve.hull.report.read import read_report
    from hybridve.hull.report.write import refuse_existing
    from hybridve.hull.show import draw_cameras, draw_scene, take_shot
    from hybridve.hull.view.picture import write_picture

    cv2.setNumThreads(1)
    refuse_existing(output, overwrite=overwrite)
    if output.suffix.lower() not in (".png", ".jpg", ".jpeg"):
        raise click.UsageError(f"{output}: pictures are .png or .jpg")
    if frame is None and report is not None:
        loaded = read_report(report)
        if not loaded.objects:
            raise ReportError(f"{report}: has no object")
        points = np.sum([rows.n_points for rows in loaded.objects.values()], axis=0)
        frame = int(loaded.index[int(np.argmax(points))])
    chain = make_chain(load_session(session), load_scene(scene), EvaluateSettings())
    with open_engine(engine) as query:
        shot = take_shot(chain, frame or 0, query)
    picture = draw_scene(shot, (1600, 1000)) if view == "scene" else draw_cameras(shot)
    write_picture(output, picture)
    click.echo(f"{output}: frame {shot.index}")
