"""``hybridve detect``: collisions of a recording with CAD, frame by frame, into a report."""

import sys
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

import click

from hybridve.cli import options
from hybridve.cli.progress import StageProgress, progress_bar

if TYPE_CHECKING:
    from hybridve.hull.capture.recording import FrameRange


@click.command(short_help="Find what the recording touched, into a report.")
@options.session_arg
@options.scene_option
@options.output_option("The report to write, REPORT.h5.")
@click.option(
    "--viewport",
    type=click.IntRange(1, 65_535),
    help="Samples along every triangle's edge; more find smaller contacts and take longer. "
    "Default: 10, as in the paper.",
)
@click.option(
    "--accuracy-mm",
    type=click.FloatRange(0, min_open=True),
    help="Instead of --viewport: sample every edge at most this far apart.",
)
@click.option(
    "--open-at-mm",
    type=click.FloatRange(0),
    default=0.1,
    show_default=True,
    help="Certify every verdict, down to contacts this wide at their widest; 0: samples only.",
)
@options.engine_option
@options.frames_option
@click.option("--resume", is_flag=True, help="Take up a run that was cut off.")
@options.overwrite_option
@click.option("--fail-on-clash", is_flag=True, help="Leave with status 3 if something clashes.")
@options.quiet_progress
def detect(
    session: Path,
    scene: Path,
    output: Path,
    viewport: int | None,
    accuracy_mm: float | None,
    open_at_mm: float,
    engine: options.EngineName,
    frames: "FrameRange",
    resume: bool,
    overwrite: bool,
    fail_on_clash: bool,
    progress: bool,
) -> None:
    r"""Find for each frame of SESSION which CAD objects the real things touched, and where.

    The collision points of every object and frame, counts, verdicts and timings go to the report.
    Beside what the samples say stands what is certain: "colliding" with a witness point, "free",
    or "open" below --open-at-mm.

    \b
    Example:
      hybridve detect data/horseman --scene data/horseman/scene.toml -o report.h5
      hybridve detect my_session --scene scene.toml -o report.h5 --accuracy-mm 2
    """
    if viewport is not None and accuracy_mm is not None:
        raise click.UsageError("give either --viewport or --accuracy-mm, not both")
    import cv2

    from hybridve.cli.summary import print_summary
    from hybridve.hull.capture.session import load_session
    from hybridve.hull.contact.scene import load_scene
    from hybridve.hull.evaluate import (
        EvaluateSettings,
        about_objects,
        about_rig,
        computed_parts,
        count_frames,
        evaluate,
        make_chain,
        resolved_settings,
    )
    from hybridve.hull.query.choose import open_engine
    from hybridve.hull.report.machine import machine_text, software_versions
    from hybridve.hull.report.read import read_report
    from hybridve.hull.report.schema import ReportHeader
    from hybridve.hull.report.write import ReportWriter, refuse_existing

    # Cameras run side by side in threads of their own; threads inside each would fight them.
    cv2.setNumThreads(1)
    refuse_existing(output, overwrite=overwrite)
    settings = EvaluateSettings(
        frames=frames,
        viewport=None if accuracy_mm is not None else viewport or 10,
        accuracy_m=None if accuracy_mm is None else accuracy_mm / 1000.0,
        open_at_m=open_at_mm / 1000.0 or None,
    )
    chain = make_chain(load_session(session), load_scene(scene), settings)
    with open_engine(engine) as query:
        header = ReportHeader(
            command=" ".join(["hybridve", *sys.argv[1:]]),
            objects=about_objects(chain),
            settings=resolved_settings(chain),
            rig=about_rig(chain),
            engine=query.name,
            renderer=query.renderer,
            parts=computed_parts(settings),
            cameras=chain.views.names,
            versions=software_versions(),
            machine=machine_text(),
        )
        with ReportWriter(output, header, resume=resume, overwrite=overwrite) as writer:
            total = count_frames(chain)
            evaluation = evaluate(
                chain,
                query,
                skip=writer.n_done,
                write_s=writer.take_write_s,
                progress=StageProgress(enabled=progress),
            )
            with (
                closing(evaluation) as results,
                progress_bar("detect", total, done=writer.n_done, enabled=progress) as advance,
            ):
                for result in results:
                    writer.append(result)
                    advance()
            if progress:
                click.echo(f"writing {output}", err=True)
            writer.finish()
    report = read_report(output)
    print_summary(report)
    if fail_on_clash and any(
        (rows.collides | (rows.certificate == "colliding")).any()
        for rows in report.objects.values()
    ):
        sys.exit(3)
