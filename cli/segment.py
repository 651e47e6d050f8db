"""``hybridve segment``: silhouettes of a recording, stored beside the session."""

import json
from pathlib import Path

import click

from hybridve.cli import options
from hybridve.cli.progress import StageProgress, progress_bar


@click.command(short_help="Cut the real things out of the recording.")
@options.session_arg
@options.overwrite_option
@options.json_option
@options.quiet_progress
def segment(
    session: Path,
    overwrite: bool,
    as_json: bool,
    progress: bool,
) -> None:
    r"""Cut the real things out of every frame of SESSION and keep their silhouettes.

    They are kept in silhouettes.h5 beside the session.toml; detect takes them from there as long
    as neither the recordings nor the settings change. Without this command, detect cuts them out
    as it goes.

    \b
    Example:
      hybridve segment my_session
    """
    import cv2

    from hybridve.hull.capture.recording import (
        FrameRange,
        check_lengths,
        check_recording,
        claimed_length,
        segmented_frames,
        silhouette_stamp,
    )
    from hybridve.hull.capture.session import load_session
    from hybridve.hull.capture.silhouette_io import SilhouetteWriter
    from hybridve.hull.report.write import refuse_existing

    cv2.setNumThreads(1)  # each camera has a thread of its own; more would fight
    loaded = load_session(session)
    output = loaded.folder / "silhouettes.h5"
    refuse_existing(output, overwrite=overwrite)
    sizes_px = check_recording(loaded)
    check_lengths(loaded, FrameRange())

    names = [camera.name for camera in loaded.cameras]
    object_pixels = [0] * len(names)
    n_frames, n_invalid = 0, 0
    frames = segmented_frames(loaded, FrameRange(), progress=StageProgress(enabled=progress))
    with (
        SilhouetteWriter(output, names, sizes_px, silhouette_stamp(loaded)) as writer,
        progress_bar("segment", claimed_length(loaded), enabled=progress) as advance,
    ):
        for frame in frames:
            writer.append(frame.masks, frame.reason)
            n_frames += 1
            if frame.masks is None:
                n_invalid += 1
            else:
                for camera, mask in enumerate(frame.masks):
                    object_pixels[camera] += int(mask.sum())
            advance()
    shares = {
        name: pixels / (size[0] * size[1] * max(n_frames - n_invalid, 1))
        for name, pixels, size in zip(names, object_pixels, sizes_px, strict=True)
    }
    if as_json:
        click.echo(
            json.dumps(
                {
                    "silhouettes": str(output),
                    "frames": n_frames,
                    "frames_invalid": n_invalid,
                    "mean_object_share": shares,
                    "bytes": output.stat().st_size,
                }
            )
        )
        return
    click.echo(
        f"{output}: {n_frames} frames, {n_invalid} without all cameras, "
        f"{output.stat().st_size / 1e6:.1f} MB"
    )
    for name, share in shares.items():
        click.echo(f"  {name}: {share:.1%} of the picture is object, on average")
