"""``hybridve segment``: silhouettes of a recording, stored beside the session."""

import json
from contextlib import closing
from pathlib import Path
from typing import Any

import click

from hybridve.cli import options
from hybridve.cli.progress import Terminal


def _folder(session: Path) -> Path:
    return session if session.is_dir() else session.parent


def _files(values: dict[str, Any]) -> options.Files:
    session = values["session"]
    return options.Files(reads=[session], keeps=[_folder(session) / "silhouettes.h5"])


@click.command(
    cls=options.Command, files=_files, short_help="Cut the real things out of the recording."
)
@options.session_arg
@click.option(
    "--unconfirmed/--no-unconfirmed",
    default=False,
    help="Keep pieces that no other camera confirms. By default they are dropped where the session "
    "has a rig; the hull is the same either way.",
)
@options.overwrite_option
@options.json_option
@options.quiet_progress
def segment(
    session: Path,
    unconfirmed: bool,
    overwrite: bool,
    as_json: bool,
    progress: bool,
) -> None:
    r"""Cut the real things out of every frame of SESSION and keep their silhouettes.

    They are kept in silhouettes.h5 beside the session.toml; detect takes them from there as long
    as neither the recordings nor the settings nor the rig change. Without this command, detect cuts
    them out as it goes.

    \b
    Example:
      hybridve segment my_session
    """
    import cv2

    from hybridve.calib.errors import ask_all
    from hybridve.calib.plain import to_json
    from hybridve.hull.agreement.blank import BlankLooks
    from hybridve.hull.agreement.record import SessionAgreement
    from hybridve.hull.capture.inspection import opened_session
    from hybridve.hull.capture.recording import (
        FrameRange,
        check_lengths,
        claimed_length,
        recorded_sizes,
        segmented_frames,
        silhouette_stamp,
    )
    from hybridve.hull.capture.rig import has_rig, load_rig, rig_digest
    from hybridve.hull.capture.room_check import check_room
    from hybridve.hull.capture.silhouette_io import SilhouetteWriter
    from hybridve.hull.report.write import refuse_existing_in
    from hybridve.hull.trust import Desk, blank_causes

    cv2.setNumThreads(1)  # each camera has a thread of its own; more would fight
    terminal = Terminal(enabled=progress)
    folder = _folder(session)
    output = folder / "silhouettes.h5"
    loaded, _ = ask_all(
        lambda: opened_session(session),
        lambda: refuse_existing_in(folder, output.name, overwrite=overwrite),
    )
    sizes_px = recorded_sizes(loaded)
    check_lengths(loaded, FrameRange())
    digest, desk = None, None
    if not unconfirmed and has_rig(loaded):
        rig = load_rig(loaded, terminal.stage)
        room = check_room(loaded, rig, terminal.stage)  # said before the work, and once
        digest, desk = rig_digest(rig), Desk.of(loaded, rig, room)

    names = [camera.name for camera in loaded.cameras]
    looks = BlankLooks()
    n_frames, n_invalid = 0, 0
    recording = segmented_frames(loaded, FrameRange(), progress=terminal.stage)
    with (
        closing(recording) as frames,
        SilhouetteWriter(output, names, sizes_px, silhouette_stamp(loaded, digest)) as writer,
        terminal.steps("segment", claimed_length(loaded)) as advance,
    ):
        for frame in frames:
            masks = frame.masks
            if desk is not None:
                masks = desk.take(frame.index, masks)
            writer.append(masks, frame.reason)
            n_frames += 1
            if masks is None:
                n_invalid += 1
            else:
                looks.take(frame.index, masks)
            advance()
    agreement = SessionAgreement()
    if desk is not None:
        agreement = desk.judge()
    elif looks.index:
        span = (looks.index[0], looks.index[-1])
        causes = blank_causes(loaded, looks.shares, looks.is_same, span)
        agreement = SessionAgreement(causes=causes)
    means = looks.shares.mean(axis=0).tolist() if looks.index else [0.0] * len(names)
    shares = dict(zip(names, means, strict=True))
    if as_json:
        options.tell(
            json.dumps(
                {
                    "silhouettes": str(output),
                    "frames": n_frames,
                    "frames_invalid": n_invalid,
                    "unconfirmed_dropped": desk is not None,
                    "trusted": agreement.is_trusted,
                    "causes": to_json(agreement.causes),
                    "mean_object_share": shares,
                    "bytes": output.stat().st_size,
                }
            )
        )
        return
    options.tell(
        f"{output}: {n_frames} frames, {n_invalid} without all cameras, "
        f"{output.stat().st_size / 1e6:.1f} MB"
    )
    for name, share in shares.items():
        options.tell(f"  {name}: {share:.1%} of the picture is object, on average")
    trust = "" if agreement.is_trusted else "not to be trusted: "
    for cause in agreement.causes:
        options.tell(f"  {trust if cause.is_gross else ''}{cause.message}")
