"""``hybridve render``: one frame as a picture, or a simulation as a film."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from hybridve.cli import options

if TYPE_CHECKING:
    from hybridve.hull.agreement.record import NamedCause
    from hybridve.hull.report.read import Report


def _files(values: dict[str, Any]) -> options.Files:
    return options.Files(
        reads=options.given(values["session"], values["scene"], values["report"], values["sim"]),
        writes=options.given(values["output"]),
    )


@click.command(
    cls=options.Command,
    files=_files,
    short_help="Draw one frame: cameras, hull, CAD, collisions in red; or a simulation.",
)
@options.session_arg
@options.scene_option
@options.output_option("The picture to write, a .png or .jpg; of a simulation also a film, .mp4.")
@click.option(
    "--report",
    type=click.Path(path_type=Path),
    help="Choose the frame in which this report has most collision points; for --view agreement "
    "the middle of the worst that it says of the cameras, if it says any.",
)
@click.option(
    "--sim",
    type=click.Path(path_type=Path),
    help="Draw what this simulation made of the scene: the frame in which most is touched, or "
    "--frame; all of them into an .mp4.",
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
    sim: Path | None,
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
      hybridve render my_session --scene scene.toml --sim sim.h5 -o sim.mp4
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
    if sim is not None:
        if report is not None or view != "scene":
            raise click.UsageError("--sim is drawn from outside; drop --report and --view")
        _render_simulation(session, scene, sim, output, frame)
        return
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


#: Sizes of a picture and of a film's.
_PICTURE_PX, _FILM_PX = (1600, 1000), (1280, 800)


def _render_simulation(
    session: Path, scene: Path, sim: Path, output: Path, frame: int | None
) -> None:
    """Draw one frame of a simulation, or all as a film."""
    import numpy as np

    from hybridve.calib.errors import ReportError
    from hybridve.hull.cad.scene import load_scene
    from hybridve.hull.capture.session import load_session
    from hybridve.hull.chain import EvaluateSettings, make_chain
    from hybridve.hull.report.simulation_file import read_simulation
    from hybridve.hull.show_simulation import draw_film, draw_frame, refuse_other
    from hybridve.hull.view.film import FILMS, write_film
    from hybridve.hull.view.picture import write_picture

    is_film = output.suffix.lower() in FILMS
    if not is_film and output.suffix.lower() not in (".png", ".jpg", ".jpeg"):
        raise click.UsageError(f"{output}: pictures are .png or .jpg, films .mp4")
    if is_film and frame is not None:
        raise click.UsageError("--frame is of one picture; a film has them all")
    simulation = read_simulation(sim)
    frames = options.Frames().convert(simulation.settings["frames"], None, None)
    chain = make_chain(load_session(session), load_scene(scene), EvaluateSettings(frames=frames))
    refuse_other(chain, simulation)
    if is_film:
        fps = chain.session.fps / frames.step
        count = write_film(output, draw_film(chain, simulation, _FILM_PX), fps)
        click.echo(f"{output}: {options.counted(count, 'frame')}")
        return
    if frame is None:
        met = np.sum([one.values["n_contacts"] for one in simulation.groups.values()], axis=0)
        frame = int(simulation.index[int(np.argmax(met))])
    rows = np.flatnonzero(simulation.index == frame)
    if not len(rows):
        raise ReportError(f"{sim}: has no frame {frame}")
    write_picture(output, draw_frame(chain, simulation, int(rows[0]), _PICTURE_PX))
    click.echo(f"{output}: frame {frame}")


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
