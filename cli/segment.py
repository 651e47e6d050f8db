"""``hybridve segment``: silhouettes of a recording, stored, and how good they are."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from hybridve.cli import options
from hybridve.cli.progress import Terminal

if TYPE_CHECKING:
    from collections.abc import Sequence

    from hybridve.hull.cut_out import Segmented
    from hybridve.hull.quality import Scored


def _folder(session: Path) -> Path:
    return session if session.is_dir() else session.parent


def _files(values: dict[str, Any]) -> options.Files:
    session = values["session"]
    mine = _folder(session) / "silhouettes.h5"
    return options.Files(
        reads=[session],
        keeps=[mine, mine.with_suffix(".html")],
        writes=options.given(values["film"]),
    )


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
@click.option(
    "--page/--no-page",
    default=True,
    help="Write silhouettes.html beside them: frames to look at first, curves, pictures. The "
    "default.",
)
@click.option(
    "--film",
    type=click.Path(path_type=Path),
    metavar="OUT.mp4",
    help="A film of what all cameras saw, with outlines.",
)
@click.option(
    "--evaluate",
    metavar="MASKS",
    help="Score the silhouettes against masks made by hand: a path with {camera} (its name) or "
    "{number} (1, 2, ...) and {frame} (the number of the picture; without it frame 0).",
)
@click.option(
    "--ignore",
    "ignored",
    type=click.IntRange(0, 255),
    multiple=True,
    help="With --evaluate: a grey level of MASKS whose pixels do not count. May be repeated.",
)
@options.overwrite_option
@options.json_option
@options.quiet_progress
def segment(
    session: Path,
    unconfirmed: bool,
    page: bool,
    film: Path | None,
    evaluate: str | None,
    ignored: tuple[int, ...],
    overwrite: bool,
    as_json: bool,
    progress: bool,
) -> None:
    r"""Cut the real things out of every frame of SESSION and keep their silhouettes.

    They are kept in silhouettes.h5 beside the session.toml; detect takes them from there as long
    as neither the recordings nor the settings nor the rig change. Without this command, detect cuts
    them out as it goes. Beside them silhouettes.html tells how good they are.

    \b
    Example:
      hybridve segment my_session --film outlines.mp4
      hybridve segment my_session --evaluate 'by_hand/{camera}/{frame}.png'
    """
    import cv2

    from hybridve.calib.errors import ask_all
    from hybridve.hull.capture.inspection import opened_session
    from hybridve.hull.capture.scoring import find_hand_masks
    from hybridve.hull.cut_out import segment_session
    from hybridve.hull.quality import score_silhouettes, write_outline_film, write_page
    from hybridve.hull.report.write import refuse_existing, refuse_existing_in
    from hybridve.hull.view.film import refuse_no_film

    cv2.setNumThreads(1)  # each camera has a thread of its own; more would fight
    terminal = Terminal(enabled=progress)
    if ignored and evaluate is None:
        raise click.UsageError("--ignore goes with --evaluate")
    folder = _folder(session)
    output = folder / "silhouettes.h5"
    loaded, *_ = ask_all(
        lambda: opened_session(session),
        lambda: refuse_existing_in(folder, output.name, overwrite=overwrite),
        *([] if film is None else [lambda: refuse_no_film(film)]),
        *([] if film is None else [lambda: refuse_existing(film, overwrite=overwrite)]),
    )
    if evaluate is not None:
        find_hand_masks(loaded, evaluate)  # said before the work
    found = segment_session(loaded, output, terminal, unconfirmed=unconfirmed)
    n_looks = None
    html = output.with_suffix(".html")
    if page:
        n_looks = write_page(html, loaded, found)
    else:
        html.unlink(missing_ok=True)  # one of other silhouettes would be believed
    if film is not None:
        write_outline_film(film, loaded, found, terminal)
    scored = score_silhouettes(loaded, output, evaluate, ignored) if evaluate is not None else []
    if as_json:
        _print_json(found, html if page else None, n_looks, film, scored)
    else:
        _print(found, html if page else None, n_looks, film)
        _print_scores(scored)


def _shares(found: "Segmented") -> dict[str, float]:
    """Return the share of each camera's pictures that is object, on average."""
    import numpy as np

    read = [not why for why in found.reasons]
    means = found.shares[read].mean(axis=0) if any(read) else np.zeros(len(found.names))
    return dict(zip(found.names, means.tolist(), strict=True))


def _print_json(
    found: "Segmented",
    page: Path | None,
    n_looks: int | None,
    film: Path | None,
    scored: "Sequence[Scored]",
) -> None:
    from hybridve.calib.plain import to_json

    told: dict[str, Any] = {
        "silhouettes": str(found.path),
        "frames": len(found.reasons),
        "frames_invalid": sum(bool(why) for why in found.reasons),
        "unconfirmed_dropped": found.is_confirmed,
        "trusted": found.agreement.is_trusted,
        "causes": to_json(found.agreement.causes),
        "mean_object_share": _shares(found),
        "bytes": found.path.stat().st_size,
        "page": None if page is None else str(page),
        "frames_to_look_at": n_looks,
        "film": None if film is None else str(film),
    }
    if scored:
        told["masks"] = [
            {"camera": one.camera, "frame": one.frame, "mask": str(one.path), **_numbers(one)}
            for one in scored
        ]
        told["scores"] = {name: _numbers(one) for name, one in _by_camera(scored).items()} | {
            "mean_iou": sum(one.score.iou for one in scored) / len(scored)
        }
    options.tell(json.dumps(told))


def _print(found: "Segmented", page: Path | None, n_looks: int | None, film: Path | None) -> None:
    n_invalid = sum(bool(why) for why in found.reasons)
    options.tell(
        f"{found.path}: {len(found.reasons)} frames, {n_invalid} without all cameras, "
        f"{found.path.stat().st_size / 1e6:.1f} MB"
    )
    for name, share in _shares(found).items():
        options.tell(f"  {name}: {share:.1%} of the picture is object, on average")
    trust = "" if found.agreement.is_trusted else "not to be trusted: "
    for cause in found.agreement.causes:
        options.tell(f"  {trust if cause.is_gross else ''}{cause.message}")
    if page is not None:
        first = f": {n_looks} frames to look at first" if n_looks else ""
        options.tell(f"{page}{first}")
    if film is not None:
        options.tell(f"{film}")


def _by_camera(scored: "Sequence[Scored]") -> dict[str, "Scored"]:
    """Return the scores of each camera's masks together, and of all where there are several."""
    from dataclasses import replace

    from hybridve.hull.capture.scoring import Score

    names = dict.fromkeys(one.camera for one in scored)
    groups = {name: [one for one in scored if one.camera == name] for name in names}
    if len(groups) > 1:
        groups["all"] = list(scored)
    return {
        name: replace(group[0], score=Score.total(one.score for one in group))
        for name, group in groups.items()
    }


def _numbers(one: "Scored") -> dict[str, float]:
    score = one.score
    return {"iou": score.iou, "f1": score.f1, "precision": score.precision, "recall": score.recall}


def _print_scores(scored: "Sequence[Scored]") -> None:
    if not scored:
        return
    options.tell(f"against {len(scored)} masks made by hand:")
    for name, one in _by_camera(scored).items():
        score = one.score
        options.tell(
            f"  {name}: IoU {score.iou:.3f}, F1 {score.f1:.3f}, precision {score.precision:.3f}, "
            f"recall {score.recall:.3f}"
        )
    mean = sum(one.score.iou for one in scored) / len(scored)
    options.tell(f"  mean IoU of the masks: {mean:.3f}")
