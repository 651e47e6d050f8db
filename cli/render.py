"""``hybridve render``: one frame as a picture, a recording or a simulation as a film."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from hybridve.cli import options
from hybridve.cli.progress import Terminal

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from hybridve.hull.agreement.record import NamedCause
    from hybridve.hull.capture.recording import FrameRange
    from hybridve.hull.chain import Chain
    from hybridve.hull.report.clashes import Clash
    from hybridve.hull.report.read import Report
    from hybridve.hull.show import Heat, Image, Look, Shot
    from hybridve.hull.show_film import Span, View
    from hybridve.hull.watcher import Advance

#: Sizes of a picture and of a film's.
_PICTURE_PX, _FILM_PX = (1600, 1000), (1280, 800)

_PICTURES = (".png", ".jpg", ".jpeg")

#: How far the heat map looks, mm.
_HEAT_MM = 250.0

#: A heat map looks at so many frames of a recording, about, unless it is told which.
_HEAT_FRAMES = 150


def _files(values: dict[str, Any]) -> options.Files:
    return options.Files(
        reads=options.given(values["session"], values["scene"], values["report"], values["sim"]),
        writes=options.given(values["output"]),
    )


@click.command(
    cls=options.Command,
    files=_files,
    short_help="Draw one frame, or a film: cameras, hull, CAD, collisions in red.",
)
@options.session_arg
@options.scene_option
@options.output_option("The picture to write, a .png or .jpg; or a film, .mp4.")
@click.option(
    "--report",
    type=click.Path(path_type=Path),
    help="Choose the frame that this report's verdict rests on, and draw the clearances that it "
    "states; of a film, the worst seconds of each of its clashes. For --view agreement the middle "
    "of the worst that it says of the cameras, if it says any.",
)
@click.option(
    "--sim",
    type=click.Path(path_type=Path),
    help="Draw what this simulation made of the scene: the frame in which most is touched, or "
    "--frame; all of them into an .mp4.",
)
@click.option("--frame", type=click.IntRange(0), help="Which frame. Default: the report's, or 0.")
@click.option(
    "--frames",
    type=options.Frames(),
    help="Which frames a film shows, as a Python range: 100:400, or 0:400:2. Of --show heat in a "
    "picture those that it looks at.",
)
@click.option(
    "--view",
    type=click.Choice(["scene", "cameras", "agreement"]),
    default="scene",
    show_default=True,
    help="The scene from outside; what each camera saw with the CAD drawn in; or what each saw "
    "beside the hull of all others as it would see it, and where they differ.",
)
@click.option(
    "--from",
    "place",
    metavar="PLACE",
    default="outside",
    show_default=True,
    help="From where the scene is seen: outside; orbit, going around (of films); the name of a "
    "camera, over what it recorded; or a .csv of a head's poses "
    "(frame,x,y,z,qw,qx,qy,qz, as of a moving camera).",
)
@click.option(
    "--texture/--plain",
    "textured",
    default=None,
    help="Draw the hull as it looked in the cameras' pictures, or in one colour. Default: as it "
    "looked, in films.",
)
@click.option(
    "--focus",
    metavar="OBJECT",
    default="",
    help="Look at this object, and take the frame that is worst for it; * for any letters.",
)
@click.option(
    "--zoom",
    type=click.FloatRange(0.1, 1000.0),
    default=1.0,
    help="So many times as large, at the point that is nearest.",
)
@click.option(
    "--show",
    "shown",
    type=click.Choice(["heat", "paths", "arrows"]),
    multiple=True,
    help="heat: the CAD by how near something real came, over the session, with its scale in mm; "
    "paths: the way of the nearest point, of the report; arrows: its V_rec and N_hull. May be "
    "given several times.",
)
@click.option(
    "--heat-mm",
    type=click.FloatRange(1.0, 10_000.0),
    default=_HEAT_MM,
    show_default=True,
    help="How far the heat map looks.",
)
@click.option(
    "--size",
    "size_px",
    type=options.Size(16, 8192),
    help="Width and height. Default: 1600x1000; of films 1280x800.",
)
@options.engine_option
@options.overwrite_option
@options.quiet_progress
def render(
    session: Path,
    scene: Path,
    output: Path,
    report: Path | None,
    sim: Path | None,
    frame: int | None,
    frames: "FrameRange | None",
    view: str,
    engine: options.EngineName,
    overwrite: bool,
    progress: bool,
    **asked: Any,
) -> None:
    r"""Draw SESSION with SCENE: cameras, the hull of the real things, the CAD, collisions in red.

    \b
    Example:
      hybridve render my_session --scene scene.toml --report report.h5 -o worst.png
      hybridve render my_session --scene scene.toml --report report.h5 -o worst.mp4
      hybridve render my_session --scene scene.toml --frame 120 --view cameras -o seen.png
      hybridve render my_session --scene scene.toml --from cam2 --frames 100:300 -o cam2.mp4
      hybridve render my_session --scene scene.toml --report report.h5 --show heat -o heat.png
      hybridve render my_session --scene scene.toml --report report.h5 --view agreement -o who.png
      hybridve render my_session --scene scene.toml --sim sim.h5 -o sim.mp4
    """
    import cv2

    from hybridve.hull.report.read import read_report
    from hybridve.hull.report.write import refuse_existing
    from hybridve.hull.view.film import FILMS

    cv2.setNumThreads(1)
    refuse_existing(output, overwrite=overwrite)
    is_film = output.suffix.lower() in FILMS
    if not is_film and output.suffix.lower() not in _PICTURES:
        raise click.UsageError(f"{output}: pictures are .png or .jpg, films .mp4")
    if is_film and frame is not None:
        raise click.UsageError("--frame is of one picture; choose a film's with --frames")
    if sim is not None:
        if report is not None or view != "scene" or _is_any(asked) or frames is not None:
            raise click.UsageError(
                "--sim is drawn from outside, as it is; drop --report, --view, --frames, --from, "
                "--texture, --focus, --zoom, --show and --size"
            )
        _render_simulation(session, scene, sim, output, frame)
        return
    _refuse_together(view, asked, is_film=is_film)
    loaded = None if report is None else read_report(report)
    job = _Job(loaded, engine, Terminal(enabled=progress), **asked)
    if is_film:
        job.film(session, scene, output, frames)
    else:
        job.picture(session, scene, output, view, frame, frames)


def _is_any(asked: dict[str, Any]) -> bool:
    """Tell whether anything is asked for beyond what stands without it."""
    usual = {
        "place": "outside",
        "textured": None,
        "focus": "",
        "zoom": 1.0,
        "shown": (),
        "heat_mm": _HEAT_MM,
        "size_px": None,
    }
    return asked != usual


def _refuse_together(view: str, asked: dict[str, Any], *, is_film: bool) -> None:
    if is_film and view != "scene":
        raise click.UsageError(
            "a film is of the scene; drop --view, or see it as a camera did with --from CAMERA"
        )
    if view != "scene" and (asked["place"] != "outside" or asked["textured"] is not None):
        raise click.UsageError("--from and --texture are of --view scene")
    if not is_film and asked["place"] == "orbit":
        raise click.UsageError("--from orbit goes around; it is of films, -o FILM.mp4")


class _Job:
    """What was asked for, and what it is drawn from."""

    def __init__(
        self,
        report: "Report | None",
        engine: options.EngineName,
        terminal: Terminal,
        *,
        place: str,
        textured: bool | None,
        focus: str,
        zoom: float,
        shown: tuple[str, ...],
        heat_mm: float,
        size_px: tuple[int, int] | None,
    ) -> None:
        self._report, self._engine, self._terminal = report, engine, terminal
        self._place, self._textured, self._focus, self._zoom = place, textured, focus, zoom
        self._shown, self._heat_m, self._size_px = shown, heat_mm / 1e3, size_px
        if report is None and {"paths", "arrows"} & set(shown):
            raise click.UsageError("--show paths and arrows are of a report; name it with --report")

    def picture(
        self,
        session: Path,
        scene: Path,
        output: Path,
        view: str,
        frame: int | None,
        frames: "FrameRange | None",
    ) -> None:
        """Draw one frame."""
        from hybridve.hull.contact.outline_errors import DoubtSettings
        from hybridve.hull.query.choose import open_engine
        from hybridve.hull.report.moment import moment_of, named_objects, worst_frame
        from hybridve.hull.show import draw_agreement, draw_cameras, take_shot
        from hybridve.hull.view.picture import write_picture

        report = self._report
        names = named_objects(report, self._focus) if report is not None and self._focus else None
        causes = () if report is None else report.agreement.causes
        if frame is None and report is not None:
            if view == "agreement" and causes:
                frame = _middle_frame(report, causes)
            else:
                frame = worst_frame(report, names)
        index = frame or 0
        doubt = DoubtSettings() if view == "agreement" else None
        chain = self._chain(session, scene, None, doubt)
        if view == "agreement":
            write_picture(output, draw_agreement(chain, index, causes))
            options.tell(f"{output}: frame {index}")
            return
        with open_engine(self._engine) as query:
            shot = take_shot(chain, index, query)
        told = None if report is None else moment_of(report, index)
        look = self._look(chain, told, index, frames)
        sheet = view == "cameras"
        picture = draw_cameras(shot, look) if sheet else self._drawn(chain, shot, look)
        write_picture(output, picture)
        said = "" if told is None else f"; {told.text()}"
        options.tell(f"{output}: frame {index}{said}")

    def film(self, session: Path, scene: Path, output: Path, frames: "FrameRange | None") -> None:
        """Draw many frames, one after another."""
        from itertools import chain as joined

        from hybridve.hull.capture.recording import FrameRange
        from hybridve.hull.query.choose import open_engine
        from hybridve.hull.show_film import Span, draw_span
        from hybridve.hull.view.film import write_film
        from hybridve.hull.view.picture import Painter

        report = self._report
        chain = self._chain(session, scene, frames)
        if frames is not None or report is None or len(report.index) == 0:
            spans = [Span(frames or FrameRange())]
        else:
            spans = self._worst_spans(chain, report)
        view = self._view(chain)
        textured = self._is_textured(chain, usually=True)
        look = self._look(chain, None, None, frames)
        step = spans[0].frames.step
        with open_engine(self._engine) as query, Painter(samples=1) as painter:
            pictures = joined.from_iterable(
                draw_span(
                    chain,
                    span,
                    query,
                    painter,
                    self._size_px or _FILM_PX,
                    look=look,
                    view=view,
                    textured=textured,
                    report=report,
                    paths="paths" in self._shown,
                )
                for span in spans
            )
            total = sum(_count(chain, span.frames) for span in spans)
            with self._terminal.steps("film", total) as advance:
                told = _told(pictures, advance)
                count = write_film(output, told, chain.session.fps / step)
        said = "; ".join(
            f"{span.heading or 'frames'} {span.frames.start}:{span.frames.stop or ''}"
            for span in spans
        )
        options.tell(f"{output}: {options.counted(count, 'frame')} ({said})")

    def _chain(
        self, session: Path, scene: Path, frames: "FrameRange | None", doubt: Any = None
    ) -> "Chain":
        from hybridve.calib.errors import SceneError
        from hybridve.hull.cad.scene import load_scene
        from hybridve.hull.capture.recording import FrameRange
        from hybridve.hull.capture.session import load_session
        from hybridve.hull.chain import EvaluateSettings, make_chain
        from hybridve.hull.report.moment import means

        loaded = load_scene(scene)
        names = [one.name for one in loaded.objects]
        if self._focus and not any(means(self._focus, name) for name in names):
            raise SceneError(
                f"{scene}: there is no object {self._focus!r} to look at; it has {', '.join(names)}"
            )
        settings = EvaluateSettings(frames=frames or FrameRange(), doubt=doubt)
        return make_chain(load_session(session), loaded, settings)

    def _worst_spans(self, chain: "Chain", report: "Report") -> "list[Span]":
        from hybridve.hull.report.ledger import ledger_path, look_up, read_ledger
        from hybridve.hull.show_film import worst_spans

        def ids(clashes: "Sequence[Clash]") -> list[str]:
            _, listed = look_up(read_ledger(ledger_path(report.path)), tuple(clashes), report)
            named = {id(one.clash): one.entry.id for one in listed}
            return [named[id(clash)] for clash in clashes]

        return worst_spans(report, chain.session.fps, ids, self._focus)

    def _is_textured(self, chain: "Chain", *, usually: bool) -> bool:
        """Tell whether the hull is drawn as it looked; refuse where no camera has a picture."""
        from hybridve.calib.errors import SessionError
        from hybridve.hull.show import has_pictures

        if self._textured is False or (self._textured is None and not usually):
            return False
        session = chain.session
        if any(has_pictures(session, camera) for camera in session.cameras):
            return True
        if self._textured is None:
            return False
        raise SessionError(
            f"{session.path}: its cameras have masks and no pictures, so nobody knows how things "
            "looked; draw it with --plain"
        )

    def _look(
        self, chain: "Chain", told: Any, index: int | None, frames: "FrameRange | None"
    ) -> "Look":
        """Return what is shown besides hull and CAD; of a picture if `index` is a frame."""
        from hybridve.hull.capture.recording import FrameRange
        from hybridve.hull.show import Look, pinhole_images
        from hybridve.hull.show_film import nearest_paths

        report = self._report
        images: list[Image | None] = []
        paths: tuple[NDArray[np.float64], ...] = ()
        if index is not None:
            is_camera = self._place in [camera.name for camera in chain.session.cameras]
            if self._is_textured(chain, usually=False) or is_camera:
                images = next(pinhole_images(chain, FrameRange(index, index + 1)))
            if report is not None and "paths" in self._shown:
                paths = nearest_paths(report, None, self._focus)
        heat = self._heat(chain, frames) if "heat" in self._shown else None
        return Look(
            told,
            self._focus,
            zoom=self._zoom,
            images=images,
            heat=heat,
            paths_world=paths,
            arrows="arrows" in self._shown,
        )

    def _heat(self, chain: "Chain", frames: "FrameRange | None") -> "Heat":
        from dataclasses import replace

        from hybridve.hull.capture.recording import FrameRange
        from hybridve.hull.chain import count_frames
        from hybridve.hull.report.moment import means
        from hybridve.hull.show_film import heat_of

        if frames is None:
            whole = replace(chain, settings=replace(chain.settings, frames=FrameRange()))
            frames = FrameRange(0, None, max(1, count_frames(whole) // _HEAT_FRAMES))
        chosen = replace(chain, settings=replace(chain.settings, frames=frames))
        names = tuple(
            one.name
            for one in chain.scene.objects
            if not self._focus or means(self._focus, one.name)
        )
        return heat_of(chosen, self._heat_m, names, self._terminal.stage)

    def _view(self, chain: "Chain") -> "View":
        """Return from where the scene is seen."""
        from hybridve.calib.errors import SessionError
        from hybridve.calib.formats.tracker import read_poses
        from hybridve.hull.show_film import Head, Orbit, Outside, ThroughCamera

        names = [camera.name for camera in chain.session.cameras]
        if self._place in names:
            return ThroughCamera(names.index(self._place))
        if self._place == "outside":
            return Outside()
        if self._place == "orbit":
            return Orbit()
        if self._place.endswith(".csv"):
            return Head(read_poses(Path(self._place)))
        raise SessionError(
            f"{chain.session.path}: there is no camera {self._place!r} to see from; it has "
            f"{', '.join(names)}; or take outside, orbit, or a .csv of a head's poses"
        )

    def _drawn(self, chain: "Chain", shot: "Shot", look: "Look") -> "Image":
        from hybridve.calib.errors import SessionError
        from hybridve.hull.show import draw_scene, draw_through_camera
        from hybridve.hull.show_film import Head, ThroughCamera
        from hybridve.hull.view.picture import Painter

        size_px, view = self._size_px or _PICTURE_PX, self._view(chain)
        with Painter() as painter:
            if isinstance(view, ThroughCamera):
                return draw_through_camera(shot, view.number, size_px, look, painter)
            viewpoint = None
            if isinstance(view, Head):
                viewpoint = view.viewpoint(shot.index)
                if viewpoint is None:
                    raise SessionError(f"{self._place}: has no pose of frame {shot.index}")
            return draw_scene(shot, size_px, look, viewpoint, painter)


def _told(pictures: "Iterator[Image]", advance: "Advance") -> "Iterator[Image]":
    """Yield pictures, telling of each."""
    for picture in pictures:
        yield picture
        advance(1)


def _count(chain: "Chain", frames: "FrameRange") -> int:
    """Return about how many frames a range has."""
    from dataclasses import replace

    from hybridve.hull.chain import count_frames

    return count_frames(replace(chain, settings=replace(chain.settings, frames=frames)))


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

    simulation = read_simulation(sim)
    frames = options.Frames().convert(simulation.settings["frames"], None, None)
    chain = make_chain(load_session(session), load_scene(scene), EvaluateSettings(frames=frames))
    refuse_other(chain, simulation)
    if output.suffix.lower() in FILMS:
        fps = chain.session.fps / frames.step
        count = write_film(output, draw_film(chain, simulation, _FILM_PX), fps)
        options.tell(f"{output}: {options.counted(count, 'frame')}")
        return
    if frame is None:
        met = np.sum([one.values["n_contacts"] for one in simulation.groups.values()], axis=0)
        frame = int(simulation.index[int(np.argmax(met))])
    rows = np.flatnonzero(simulation.index == frame)
    if not len(rows):
        raise ReportError(f"{sim}: has no frame {frame}")
    write_picture(output, draw_frame(chain, simulation, int(rows[0]), _PICTURE_PX))
    options.tell(f"{output}: frame {frame}")


def _middle_frame(report: "Report", causes: "Sequence[NamedCause]") -> int:
    """Return the frame in the midst of the first cause that could be read."""
    import numpy as np

    middle = (causes[0].first_frame + causes[0].last_frame) // 2
    read = np.flatnonzero(report.state != "unread")
    if len(read) == 0:
        return int(report.index[0])
    apart = np.abs(report.index[read].astype(np.int64) - middle)
    return int(report.index[read[int(np.argmin(apart))]])
