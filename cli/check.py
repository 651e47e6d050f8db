"""``hybridve check``: a look at a session before a long run, in seconds."""

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from hybridve.cli import options
from hybridve.cli.progress import Terminal

if TYPE_CHECKING:
    from hybridve.hull.capture.inspection import SourceCheck
    from hybridve.hull.check import Cost, SessionCheck


#: What is known of a rig, in words; see `hybridve.calib.verdict.Verdict`.
_RIGS = {
    "agrees": "the session's board agrees with it",
    "made here": "made from this session's own board",
    "no board": "given; there is no board in the session to test it with",
    "off": "given, and not tested (rig_check)",
    "not looked at": "there is one, for a recording to come",
    "open": "given; the session's board leaves open whether it is right",
    "not tested": "given; the session's board could not be read",
}


def _files(values: dict[str, Any]) -> options.Files:
    return options.Files(
        reads=options.given(values["session"], values["scene"]),
        writes=options.given(values["picture"]),
    )


@click.command(
    cls=options.Command, files=_files, short_help="Look a session over before a long run."
)
@options.session_arg
@click.option(
    "--scene",
    type=click.Path(path_type=Path),
    help="The scene.toml with the CAD objects: their sizes, places, and what a run would take.",
)
@click.option(
    "--picture",
    type=click.Path(path_type=Path),
    help="A .png or .jpg: the first and the middle frame of each camera, silhouettes outlined.",
)
@click.option("--strict", is_flag=True, help="Leave with status 1 for a note, too.")
@options.overwrite_option
@options.json_option
@options.quiet_progress
def check(
    session: Path,
    scene: Path | None,
    picture: Path | None,
    strict: bool,
    overwrite: bool,
    as_json: bool,
    progress: bool,
) -> None:
    r"""Look at all that SESSION names, and at a few frames of it, before a long run.

    Told are each camera's files: sizes, depth, rates, counts, what is missing or damaged, how masks
    are read; what share of the pictures is object in a few frames spread over the recording; what
    the cameras say about each other in these frames, once there is a rig; with a scene the size and
    place of each object, how much of it the cameras see, which effects it names; and what a run
    over all frames will take, roughly.

    A problem makes a run impossible. A note is worth a look: a run would go through, and its
    result may not be what was wanted. Leaves with status 1 if there is a problem; with --strict,
    for a note too.

    \b
    Example:
      hybridve check my_session
      hybridve check my_session --scene scene.toml --picture look.png
    """
    import cv2

    from hybridve.calib.plain import to_json
    from hybridve.hull.check import check_session
    from hybridve.hull.report.write import refuse_existing

    cv2.setNumThreads(1)  # each camera has a thread of its own; more would fight
    if picture is not None:
        if picture.suffix.lower() not in (".png", ".jpg", ".jpeg"):
            raise click.UsageError(f"{picture}: pictures are .png or .jpg")
        refuse_existing(picture, overwrite=overwrite)
    settings = options.evaluation_of(
        clearance_mm=0.1,
        response=True,
        abc_deg=10.0,
        abc_mm=50.0,
        abc_window=400,
        backtrack=False,
        doubt=True,
        mask_std_px=None,
    )
    found, look = check_session(
        session, scene, settings, Terminal(enabled=progress and sys.stderr.isatty())
    )
    if picture is not None and look.session is not None and look.masks:
        from hybridve.hull.check_sheet import write_check_sheet

        write_check_sheet(picture, look.session, look.masks)
    if as_json:
        told = {**to_json(found), "good": not found.problems}
        options.tell(json.dumps(told))
    else:
        _tell(found)
    if found.problems or (strict and found.notes):
        sys.exit(1)


def _tell(found: "SessionCheck") -> None:
    if found.cameras:
        rate = "" if found.fps is None else f", {found.fps:g} frames a second"
        options.tell(f"{found.session}: {options.counted(len(found.cameras), 'camera')}{rate}")
    _tell_files(found)
    _tell_looks(found)
    _tell_rig(found)
    _tell_scene(found)
    if found.cost is not None:
        _tell_cost(found.cost)
    for text in found.problems:
        options.tell(f"problem: {text}")
    for text in found.notes:
        options.tell(f"note: {text}")
    if not found.problems and not found.notes:
        options.tell("nothing is wrong, as far as a look can tell")


def _tell_files(found: "SessionCheck") -> None:
    rows = [("camera", "what", "files", "size", "depth", "frames", "per second", "tags")]
    for camera in found.cameras:
        for one in camera.sources:
            masks = f", {camera.masks}" if one.key == "masks" and camera.masks else ""
            rows.append(
                (
                    camera.name,
                    one.key,
                    one.label,
                    f"{one.width_px}x{one.height_px}",
                    f"{one.bits} bit{masks}",
                    _frames_text(one),
                    "-" if one.rate_hz is None else f"{one.rate_hz:g}",
                    one.orientation or "-",
                )
            )
    if len(rows) > 1:
        options.print_table(rows)
    if found.cameras and all(camera.recording is None for camera in found.cameras):
        options.tell("no recording is named yet: there is nothing that detect could look at")


def _frames_text(one: "SourceCheck") -> str:
    parts = [str(one.n_frames)]
    for count, what in (
        (one.n_missing, "missing"),
        (one.n_lost, "lost"),
        (one.n_damaged, "damaged"),
    ):
        if count:
            parts.append(f"{count} {what}")
    return ", ".join(parts)


def _tell_looks(found: "SessionCheck") -> None:
    if not found.looks:
        return
    options.tell("share of object pixels")
    rows = [("frame", *map(str, found.frames))]
    for one in found.looks:
        shares = ("-" if share is None else f"{share:.1%}" for share in one.object_share)
        rows.append((one.name, *shares))
    options.print_table(rows)
    step = found.frames[-1] - found.frames[-2] if len(found.frames) > 1 else 1
    if found.cost is not None and found.cost.n_frames > found.frames[-1] + 2 * step:
        options.tell(f"  what comes after frame {found.frames[-1]} was not looked at")


def _tell_rig(found: "SessionCheck") -> None:
    if found.rig == "none":
        if not found.problems:
            has_board = any(camera.source("extrinsics") for camera in found.cameras)
            way = (
                "`hybridve calibrate` comes first"
                if has_board
                else "name one with rig =, or record a board (extrinsics) and calibrate"
            )
            options.tell(f"there is no rig yet: {way}")
        return
    options.tell(f"rig: {_RIGS.get(found.rig, found.rig)}")
    if found.rig == "not looked at":
        return
    frames = options.counted(len(found.frames), "frame")
    if not found.agreement.is_told:
        options.tell(f"on {frames} the cameras say too little about each other")
    elif not found.agreement.causes:
        options.tell(f"on {frames} the cameras agree about each other")
    else:
        told = "; ".join(cause.short for cause in found.agreement.causes)
        options.tell(f"on {frames} the cameras say: {told}")


def _tell_scene(found: "SessionCheck") -> None:
    if not found.objects:
        return
    rows = [("object", "size, mm", "from, mm", "to, mm", "triangles", "closed", "seen")]
    for one in found.objects:
        rows.append(
            (
                one.name,
                " x ".join(f"{value:.1f}" for value in one.size_mm),
                ", ".join(f"{value:.0f}" for value in one.low_mm),
                ", ".join(f"{value:.0f}" for value in one.high_mm),
                str(one.n_triangles),
                "yes" if one.is_closed else "no",
                "?" if one.seen_share is None else f"{one.seen_share:.0%}",
            )
        )
    options.print_table(rows)
    if found.effects:
        options.tell(f"effects: {', '.join(found.effects)} (`hybridve simulate`; detect has none)")


def _tell_cost(cost: "Cost") -> None:
    parts = [f"reading {_time_text(cost.read_s)}"]
    if cost.engine:
        parts.append(f"evaluating {_time_text(cost.evaluate_s)} on the processor")
    if cost.memory_bytes is not None:
        parts.append(f"memory {cost.memory_bytes / 1e9:.1f} GB")
    if cost.disk_bytes is not None:
        parts.append(f"report {max(cost.disk_bytes / 1e6, 0.1):.1f} MB")
    frames = options.counted(cost.n_frames, "frame")
    options.tell(f"a run over {frames} will take, roughly: {', '.join(parts)}")


def _time_text(seconds: float) -> str:
    if seconds < 90.0:
        return f"{max(seconds, 1.0):.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 5400.0 else f"{seconds / 3600.0:.1f} h"
