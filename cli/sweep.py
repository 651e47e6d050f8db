"""``hybridve sweep``: accuracy against time, over viewports and engines; of simulations too."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import click

from hybridve.calib.lengths import mm
from hybridve.cli import options
from hybridve.cli.progress import Terminal

if TYPE_CHECKING:
    from hybridve.hull.capture.recording import FrameRange
    from hybridve.hull.report.simulation_sweep import SimulationSweep
    from hybridve.hull.report.sweep_data import Sweep
    from hybridve.hull.sweep.simulation import Over

_ENGINES: tuple[options.EngineName, ...] = tuple(
    name for name in get_args(options.EngineName) if name != "auto"
)


class _Viewports(click.ParamType[tuple[int, ...]]):
    name = "N,N,..."

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[int, ...]:
        if isinstance(value, tuple):
            return value
        try:
            viewports = tuple(int(part) for part in value.split(","))
        except ValueError:
            self.fail(f"{value!r} is not a list of numbers; expected 4,8,16", param, ctx)
        if min(viewports) < 1 or max(viewports) > 65_535:
            self.fail(f"{value!r}: viewports are 1 to 65535", param, ctx)
        if list(viewports) != sorted(set(viewports)):
            self.fail(f"{value!r} is not ascending; expected 4,8,16", param, ctx)
        return viewports


class _Steps(click.ParamType[tuple[float, ...]]):
    name = "MS,MS,..."

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, ...]:
        if isinstance(value, tuple):
            return value
        try:
            steps = tuple(float(part) for part in value.split(","))
        except ValueError:
            self.fail(f"{value!r} is not a list of numbers; expected 0.5,1,2", param, ctx)
        if not all(0 < step <= 100 for step in steps):
            self.fail(f"{value!r}: steps are above 0 and at most 100 ms", param, ctx)
        if list(steps) != sorted(set(steps)):
            self.fail(f"{value!r} is not ascending; expected 0.5,1,2", param, ctx)
        return steps


class _CommaOption(click.Option):
    """An option that may be given several times, or once with commas."""

    def type_cast_value(self, ctx: click.Context, value: Any) -> Any:
        parts = [part for one in value or () for part in one.split(",")]
        return super().type_cast_value(ctx, list(dict.fromkeys(parts)))


def _files(values: dict[str, Any]) -> options.Files:
    picture = values["picture"] or values["output"].with_suffix(".png")
    return options.Files(
        reads=options.given(values["session"], values["scene"]),
        writes=options.given(values["output"], picture),
    )


@click.command(
    cls=options.Command,
    files=_files,
    short_help="Measure accuracy against time, over viewports and engines.",
)
@options.session_arg
@options.scene_option
@options.output_option("The sweep to write, SWEEP.h5.")
@click.option(
    "--viewport",
    "viewports",
    type=_Viewports(),
    default="4,8,16,32,64",
    show_default=True,
    help="Samples along every triangle's edge, ascending.",
)
@click.option(
    "--engine",
    "engines",
    cls=_CommaOption,
    multiple=True,
    type=click.Choice(_ENGINES),
    help="Which engines, as native,stencil. Default: all that this machine can open; reference "
    "only where it takes no more than some minutes.",
)
@click.option(
    "--over",
    type=click.Choice(["step", "viewport"]),
    help="Sweep a simulation of the scene's effects instead: over the lengths of --step-ms, or the "
    "viewports.",
)
@click.option(
    "--step-ms",
    "steps_ms",
    type=_Steps(),
    default="0.5,1,2,4,8",
    show_default=True,
    help="With --over step: the longest steps, ascending. With --over viewport each is 2 ms.",
)
@click.option(
    "--frames",
    type=options.Frames(),
    help="Which frames, as a Python range: 0:100, 100:, 0:400:10, or one: 7. Default: at most 20, "
    "spread over the recording; of a simulation all.",
)
@click.option(
    "--repeats",
    type=click.IntRange(1, 1000),
    default=5,
    show_default=True,
    help="How often each engine answers each viewport with the clock running, after once without.",
)
@click.option(
    "--open-at-mm",
    type=click.FloatRange(0, min_open=True),
    default=0.1,
    show_default=True,
    help="The truth may lack collisions smaller than a disc of this diameter.",
)
@click.option(
    "--accuracy-mm",
    type=click.FloatRange(0, min_open=True),
    help="Mark the point where each triangle takes the smallest viewport that samples its edges "
    "at most this far apart. Default: what the middle viewport predicts.",
)
@click.option(
    "--picture",
    type=click.Path(path_type=Path),
    help="The picture to draw, a .png, .svg or .pdf. Default: the output's name with .png.",
)
@options.json_option
@options.overwrite_option
@options.quiet_progress
def sweep(
    session: Path,
    scene: Path,
    output: Path,
    viewports: tuple[int, ...],
    engines: tuple[options.EngineName, ...],
    over: "Over | None",
    steps_ms: tuple[float, ...],
    frames: "FrameRange | None",
    repeats: int,
    open_at_mm: float,
    accuracy_mm: float | None,
    picture: Path | None,
    as_json: bool,
    overwrite: bool,
    progress: bool,
) -> None:
    r"""Measure what each viewport and engine costs on SESSION, and what it misses.

    Truth comes from certificates and from dense samples, not from the largest viewport. Times are
    medians over repeats in which viewports and engines take turns.

    \b
    Example:
      hybridve sweep data/horseman --scene data/horseman/scene.toml -o sweep.h5
      hybridve sweep my_session --scene scene.toml --viewport 4,8,16 --engine native -o sweep.h5
      hybridve sweep my_session --scene scene.toml --over step --step-ms 1,2,4 -o sweep.h5
    """
    import cv2

    from hybridve.calib.errors import ask_all
    from hybridve.hull.cad.scene import load_scene
    from hybridve.hull.capture.inspection import opened_session
    from hybridve.hull.report.sweep_file import read_sweep, sweep_as_dict, write_sweep
    from hybridve.hull.report.write import refuse_existing
    from hybridve.hull.sweep.picture import write_picture_of
    from hybridve.hull.sweep.session import SweepRequest, sweep_session

    cv2.setNumThreads(1)
    terminal = Terminal(enabled=progress)
    picture = output.with_suffix(".png") if picture is None else picture
    options.refuse_suffix(picture)
    if picture == output:
        raise click.UsageError(f"{output} cannot be both sweep and picture; give --picture a name")
    for path in (output, picture):
        refuse_existing(path, overwrite=overwrite)
    if over is not None:
        if len(engines) > 1:
            raise click.UsageError("a simulation is swept with one engine; give one --engine")
        values = tuple(ms / 1e3 for ms in steps_ms) if over == "step" else viewports
        swept = _sweep_simulation(session, scene, over, values, frames, repeats, engines, terminal)
        _tell_simulation(output, picture, swept, as_json=as_json)
        return

    asked = SweepRequest(
        viewports=viewports,
        engines=engines,
        frames=frames,
        repeats=repeats,
        open_at_m=open_at_mm / 1e3,
        accuracy_m=None if accuracy_mm is None else accuracy_mm / 1e3,
    )
    opened, layout = ask_all(lambda: opened_session(session), lambda: load_scene(scene))
    measured = sweep_session(opened, layout, asked, options.command_line(), terminal)
    write_sweep(output, measured)
    written = read_sweep(output)
    write_picture_of(picture, written)
    if not written.frames.triangles_colliding.any():
        options.tell(
            f"nothing collides in the frames {written.settings['frames']}: accuracy cannot be "
            "measured there, only time; choose others with --frames",
            err=True,
        )
    if as_json:
        names = {"sweep": str(output), "picture": str(picture)}
        options.tell(json.dumps({**names, **sweep_as_dict(written)}))
    else:
        _print_table(output, picture, written)


def _sweep_simulation(
    session: Path,
    scene: Path,
    over: "Over",
    values: tuple[float, ...],
    frames: "FrameRange | None",
    repeats: int,
    engines: tuple[options.EngineName, ...],
    terminal: Terminal,
) -> "SimulationSweep":
    """Return what each value costs a simulation."""
    from hybridve.calib.errors import ask_all
    from hybridve.hull.cad.scene import load_scene
    from hybridve.hull.capture.inspection import opened_session
    from hybridve.hull.capture.recording import FrameRange
    from hybridve.hull.chain import EvaluateSettings
    from hybridve.hull.simulate import SimulateSettings
    from hybridve.hull.sweep.simulation import SimulationSweepRequest, sweep_simulation

    if len(values) < 2:
        raise click.UsageError("one value makes no sweep; give several, as --step-ms 1,2,4")
    evaluation = EvaluateSettings(frames=frames or FrameRange())
    settings = SimulateSettings(evaluation, engine=engines[0] if engines else "auto")
    asked = SimulationSweepRequest(over, tuple(map(float, values)), settings, repeats)
    opened, layout = ask_all(lambda: opened_session(session), lambda: load_scene(scene))
    return sweep_simulation(opened, layout, asked, options.command_line(), terminal)


def _tell_simulation(
    output: Path, picture: Path, swept: "SimulationSweep", *, as_json: bool
) -> None:
    """Write what a simulation costs, draw it and print it."""
    from hybridve.hull.report.simulation_sweep import (
        simulation_sweep_as_dict,
        write_simulation_sweep,
    )
    from hybridve.hull.sweep.picture import write_simulation_picture

    write_simulation_sweep(output, swept)
    write_simulation_picture(picture, swept)
    found = simulation_sweep_as_dict(swept)
    if as_json:
        options.tell(json.dumps({"sweep": str(output), "picture": str(picture), **found}))
        return
    effects = ", ".join(swept.settings["effects"])
    frames = options.counted(swept.settings["n_frames"], "frame")
    options.tell(f"{output}, {picture}: {frames}, {effects}, by {found['over']}")
    lines = [
        (
            f"{found['over']}{', ms' if found['over'] == 'step' else ''}",
            "ms a frame (IQR)",
            "deepest after a step, mm",
            "energy nothing real put in, %",
            "mm from the finest, median",
            "largest",
            "front",
        )
    ]
    scale = 1e3 if found["over"] == "step" else 1.0
    for row in found["rows"]:
        lines.append(
            (
                f"{scale * row['value']:g}" + (" *" if row["value"] == found["chosen"] else ""),
                f"{row['ms_median']:.3g} ({row['ms_iqr']:.2g})",
                mm(row["penetration_m"], ".3g"),
                f"{100 * row['excess_share']:.3g}",
                mm(row["distance_median_m"], ".3g"),
                mm(row["distance_max_m"], ".3g"),
                "+" if row["on_front"] else "",
            )
        )
    options.print_table(lines)
    chosen = "the step of `hybridve simulate`" if scale > 1 else "the paper's viewport"
    options.tell(f"  *: {chosen}; + on the Pareto front of time and largest distance")


def _print_table(output: Path, picture: Path, sweep: "Sweep") -> None:
    from hybridve.hull.report.sweep_file import sweep_as_dict

    found = sweep_as_dict(sweep)
    truth = found["truth"]
    options.tell(f"{output}, {picture}: {len(found['frames'])} frames {sweep.settings['frames']}")
    finest = f"sampled every {mm(truth['spacing_m'], '.3g')} mm"
    if (truth["spacing_m"] or 0.0) > (truth["spacing_wanted_m"] or 0.0):
        finest += f" ({mm(truth['spacing_wanted_m'], '.3g')} were wanted, but are too many)"
    left_open = "none is left open"
    if truth["triangles_open"]:
        left_open = (
            f"{truth['triangles_open']} are left open "
            f"(no disc of {mm(truth['open_most_m'], '.3g')} mm)"
        )
    options.tell(
        f"  truth: {truth['triangles_colliding']} of {truth['triangles_asked']} triangles asked "
        f"collide, {left_open}"
        + (f"; distances from {truth['points']} points, {finest}" if truth["points"] else "")
    )
    lines = [
        (
            "engine",
            "viewport",
            "ms a frame (IQR)",
            "query",
            "place",
            "points",
            "missed triangles",
            "objects",
            "distance mm, largest",
            "99 %",
            "median",
            "predicted",
            "within",
            "front",
        )
    ]
    for engine in found["engines"]:
        for row in engine["rows"]:
            missed = row["triangles_missed_share"]
            lines.append(
                (
                    engine["name"],
                    row["label"],
                    f"{row['ms_median']:.3g} ({row['ms_iqr']:.2g})",
                    f"{row['query_ms_median']:.3g}",
                    f"{row['place_ms_median']:.3g}",
                    f"{row['points']:.0f}",
                    "-" if missed is None else f"{row['triangles_missed']} ({100 * missed:.2g} %)",
                    "-" if missed is None else f"{row['objects_missed']}",
                    mm(row["distance_max_m"], ".3g"),
                    mm(row["distance_p99_m"], ".3g"),
                    mm(row["distance_median_m"], ".3g"),
                    mm(row["predicted_near_m"], ".3g"),
                    _share(row["within_predicted"]),
                    "*" if row["on_front"] else "",
                )
            )
    options.print_table(lines)
    for engine in found["engines"]:
        options.tell(f"  {engine['name']}: {_cost_text(engine['name'], engine['cost'])}")
    stages = ", ".join(
        f"{stage} {ms['median']:.2f} ({ms['iqr']:.2g})" for stage, ms in found["stage_ms"].items()
    )
    options.tell(f"  once a frame, ms, median over the frames (IQR): {stages}")


def _share(share: float | None) -> str:
    """Return a share in percent, "all" only if it is."""
    return "-" if share is None else "all" if share == 1.0 else f"{min(100 * share, 99.99):.2f} %"


def _cost_text(engine: str, cost: dict[str, Any] | None) -> str:
    if cost is None:
        return "the cost model needs three viewports and an object near the hull"
    text = (
        f"{1e3 * cost['fixed_s']:.3g} ms a frame (at most {1e9 * cost['transform_most_s']:.3g} ns "
        f"a transform) + {1e9 * cost['fill_s_per_px']:.3g} ns a pixel filled + "
        f"{1e9 * cost['read_back_s_per_px']:.3g} ns a {cost['read_back']} read back"
    )
    text += (
        f"; off by {100 * cost['residual_rms']:.2g} % rms, {100 * cost['residual_most']:.2g} % "
        "at most"
    )
    if cost["holds"] is None:
        text += " (as many terms as viewports: that proves nothing)"
    elif not cost["holds"]:
        text += ": the paper's model does not hold here"
        if engine in ("native", "compute"):
            text += ", the engine rejects before it samples"
    if cost["condition"] > 100:
        text += "; fill and read-back grow alike and are hardly told apart"
    return text
