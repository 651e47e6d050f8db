"""``hybridve simulate``: what virtual things do when the real ones of a recording meet them."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from hybridve.calib.lengths import mm
from hybridve.cli import options
from hybridve.cli.progress import Terminal

if TYPE_CHECKING:
    from hybridve.hull.capture.recording import FrameRange
    from hybridve.hull.effects.instants import HullMode


def _files(values: dict[str, Any]) -> options.Files:
    return options.Files(
        reads=options.given(values["session"], values["scene"]),
        writes=options.given(values["output"], values["picture"]),
    )


@click.command(
    cls=options.Command,
    files=_files,
    short_help="Simulate the effects that a scene names, beside a recording.",
)
@options.session_arg
@options.scene_option
@options.output_option("The file to write, SIM.h5.")
@click.option(
    "--step-ms",
    type=click.FloatRange(0, 100, min_open=True),
    default=2.0,
    show_default=True,
    help="The longest step; between two frames there are as many equal ones as it takes.",
)
@click.option(
    "--hull",
    type=click.Choice(["interpolate", "hold"]),
    default="interpolate",
    show_default=True,
    help="What is real between two frames: an estimate from both, as often as it moves by 8 mm; "
    "or that of the second all along.",
)
@click.option(
    "--viewport",
    type=click.IntRange(1, 65_535),
    default=10,
    show_default=True,
    help="Samples along every triangle's edge that are asked whether they are in the hull.",
)
@click.option(
    "--seed", type=click.IntRange(0), default=0, show_default=True, help="Of what is drawn."
)
@options.engine_option
@options.frames_option
@options.drop_camera_option
@click.option(
    "--picture",
    type=click.Path(path_type=Path),
    help="Draw energy and penetration of every effect against time, into a .png, .svg or .pdf.",
)
@click.option("--resume", is_flag=True, help="Take up a run that was cut off.")
@options.overwrite_option
@options.json_option
@options.quiet_progress
def simulate(
    session: Path,
    scene: Path,
    output: Path,
    step_ms: float,
    hull: "HullMode",
    viewport: int,
    seed: int,
    engine: options.EngineName,
    frames: "FrameRange",
    drop_cameras: tuple[str, ...],
    picture: Path | None,
    resume: bool,
    overwrite: bool,
    as_json: bool,
    progress: bool,
) -> None:
    r"""Simulate what the real things of SESSION do to the scene's effects, into SIM.h5.

    Only what the scene names in its [[effect]] tables is simulated. Real things push virtual ones;
    nothing pushes back. Time goes on from frame to frame; a frame without a hull is a pause.

    \b
    Example:
      hybridve simulate my_session --scene scene.toml -o sim.h5 --picture energy.png
      hybridve render my_session --scene scene.toml --sim sim.h5 -o sim.mp4
    """
    import cv2

    from hybridve.hull.chain import EvaluateSettings
    from hybridve.hull.report.simulation_file import read_simulation
    from hybridve.hull.report.write import refuse_existing
    from hybridve.hull.simulate import SimulateSettings, simulate_one

    cv2.setNumThreads(1)
    if picture is not None:
        options.refuse_suffix(picture)
        if picture == output:
            raise click.UsageError(f"{output} cannot be both simulation and picture")
        refuse_existing(picture, overwrite=overwrite)
    settings = SimulateSettings(
        EvaluateSettings(frames=frames, viewport=viewport, drop_cameras=drop_cameras),
        step_s=step_ms / 1e3,
        hull=hull,
        seed=seed,
        engine=engine,
        resume=resume,
        overwrite=overwrite,
        command=options.command_line(),
    )
    simulate_one(session, scene, output, settings, Terminal(enabled=progress))
    tell_simulation(output, picture, as_json=as_json)
    if stopped := read_simulation(output).stopped:
        from hybridve.calib.errors import ReportError

        raise ReportError(f"{output}: the simulation was stopped: {stopped}")


def tell_simulation(path: Path, picture: Path | None, *, as_json: bool) -> None:
    """Print what a simulation found, and draw it where a picture is asked for."""
    from hybridve.hull.report.simulation_file import read_simulation
    from hybridve.hull.report.summarize_simulation import summarize_simulation

    simulation = read_simulation(path)
    if picture is not None:
        from hybridve.hull.curves import write_simulation_curves

        write_simulation_curves(picture, simulation)
    numbers = summarize_simulation(simulation)
    if as_json:
        named = {} if picture is None else {"picture": str(picture)}
        options.tell(json.dumps({**numbers, **named}))
        return
    _print(numbers)
    if picture is not None:
        options.tell(f"  energy and penetration against time: {picture}")


def _print(numbers: dict[str, Any]) -> None:
    options.tell(
        f"{numbers['simulation']}: {options.counted(numbers['frames'], 'frame')}, "
        f"{numbers['seconds']:.2f} s, {options.counted(numbers['steps'], 'step')}"
        + ("" if numbers["trusted"] else "; not to be trusted: the cameras contradict each other")
    )
    for cause in numbers["causes"]:
        options.tell(f"  {cause['message']}")
    if numbers["frames_paused"]:
        options.tell(f"  paused in {options.counted(numbers['frames_paused'], 'frame')}:")
        for reason, count in numbers["reasons"].items():
            options.tell(f"    {count} x {reason}")
    rows = [
        (
            "effect",
            "kind",
            "met in frames",
            "deepest after a step, mm",
            "energy, J: first, most, last",
            "from real things, J",
            "ms a frame",
        )
    ]
    for found in numbers["effects"]:
        energy = found["energy_j"]
        rows.append(
            (
                found["name"],
                found["kind"],
                f"{found['frames_met']}",
                mm(found["penetration_m"]),
                "-" if energy is None else " ".join(f"{one:.4g}" for one in energy),
                f"{found['hull_work_j']:.4g}",
                f"{found['ms_median']:.2f} (95 % {found['ms_p95']:.2f})",
            )
        )
    options.print_table(rows)
    for found in numbers["effects"]:
        for line in found["notes"]:
            options.tell(f"  {found['name']}: {line}")
    stages = ", ".join(f"{stage} {ms:.2f}" for stage, ms in numbers["stage_ms_mean"].items())
    options.tell(f"  ms of work a frame besides, mean: {stages}")
    if numbers["stopped"]:
        options.tell(f"  stopped: {numbers['stopped']}")
