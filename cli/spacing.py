"""``hybridve spacing``: how far an object must be moved for a recorded task to have room."""

import json
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from hybridve.calib.lengths import mm
from hybridve.cli import options
from hybridve.cli.progress import Terminal

if TYPE_CHECKING:
    from hybridve.hull.capture.recording import FrameRange
    from hybridve.hull.contact.spacing import Move
    from hybridve.hull.report.spacing_file import SessionSpacing, Spacing


class _Numbers(click.ParamType[tuple[float, ...]]):
    """So many numbers with something between them."""

    def __init__(self, name: str, between: str, count: int, example: str) -> None:
        self.name = name
        self._between, self._count, self._example = between, count, example

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, ...]:
        if isinstance(value, tuple):
            return value
        try:
            numbers = tuple(float(part) for part in value.split(self._between))
        except ValueError:
            numbers = ()
        if len(numbers) != self._count or not all(map(math.isfinite, numbers)):
            self.fail(f"{value!r} is not {self.name}; expected as {self._example}", param, ctx)
        return numbers


def _files(values: dict[str, Any]) -> options.Files:
    return options.Files(
        reads=options.given(values["sessions"], values["scene"]),
        writes=options.given(values["output"], values["picture"]),
    )


@click.command(
    cls=options.GroupedCommand,
    files=_files,
    short_help="Find how far to move an object for a recorded task to have room.",
)
@options.sessions_arg
@options.scene_option
@click.option(
    "--move",
    "moved",
    required=True,
    multiple=True,
    metavar="OBJECT",
    help="The object to move; several times for a group that moves rigidly together.",
)
@click.option(
    "--along",
    required=True,
    type=_Numbers("X,Y,Z", ",", 3, "1,0,0"),
    help="Where it is moved to: a direction in the world's frame, of any length.",
)
@click.option(
    "--range-mm",
    required=True,
    type=_Numbers("A:B", ":", 2, "0:300"),
    help="From which shift to which; they may be negative.",
)
@click.option(
    "--clearance-mm",
    type=float,
    help="How far real things must stay away from what is moved. Default: what the scene says.",
)
@click.option(
    "--tolerance-mm",
    type=click.FloatRange(0.01),
    default=1.0,
    show_default=True,
    help="How narrowly the smallest shift is wanted.",
)
@click.option(
    "--grow-px",
    type=click.IntRange(0, 100),
    default=0,
    show_default=True,
    help="Grow all silhouettes by so many pixels, for room to spare: the answer then holds for "
    "outlines that are off by less.",
)
@options.doubt_options(
    "Tell the shift that suffices at 95 %, as outlines and calibration err, too. Default: do."
)
@options.frames_option
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), help="The file to write, SPACING.h5."
)
@click.option(
    "--picture",
    type=click.Path(path_type=Path),
    help="The picture to draw, a .png, .svg or .pdf: frames that violate, against the shift.",
)
@click.option(
    "--step-mm",
    type=click.FloatRange(0, min_open=True),
    help="Steps of that curve. Default: a two hundredth of the range.",
)
@options.drop_camera_option
@options.fail_on_doubt_option
@options.json_option
@options.overwrite_option
@options.quiet_progress
def spacing(
    sessions: tuple[Path, ...],
    scene: Path,
    moved: tuple[str, ...],
    along: tuple[float, float, float],
    range_mm: tuple[float, float],
    clearance_mm: float | None,
    tolerance_mm: float,
    grow_px: int,
    doubt: bool,
    mask_std_px: float | None,
    frames: "FrameRange",
    output: Path | None,
    picture: Path | None,
    step_mm: float | None,
    drop_cameras: tuple[str, ...],
    fail_on_doubt: bool,
    as_json: bool,
    overwrite: bool,
    progress: bool,
) -> None:
    r"""Find the smallest shift of an object at which the whole recording keeps clear of it.

    The shift found is proved to keep the required clearance in every frame, and that the smallest
    one is "at least" so much is proved too; as a rule less than the tolerance lies between. Both
    hold for the silhouettes as they are. The shift that "suffices at 95 %" is an estimate that
    reckons with the errors of outlines and cameras: it is what to build by. Each recording is
    replayed once, for all shifts. Several SESSIONs are columns of the table.

    \b
    Example:
      hybridve spacing p1 p2 p3 --scene payload.toml --move payload_a --along 1,0,0 --range-mm 0:150
      hybridve spacing data/horseman --scene data/horseman/scene.toml --move forearm --along 0,1,0 \
        --range-mm 0:600 --clearance-mm 20 --picture spacing.png
    """
    import cv2

    from hybridve.calib.errors import SessionError
    from hybridve.hull.chain import EvaluateSettings
    from hybridve.hull.report.compare import distinct_names
    from hybridve.hull.report.spacing_file import spacing_as_dict, write_spacing
    from hybridve.hull.report.write import refuse_existing
    from hybridve.hull.spacing import SpacingRequest, find_spacing
    from hybridve.hull.spacing_picture import write_picture_of

    cv2.setNumThreads(1)
    terminal = Terminal(enabled=progress)
    if picture is not None:
        options.refuse_suffix(picture)
        if picture == output:
            raise click.UsageError(f"{output} cannot be both spacing and picture")
    for path in (output, picture):
        if path is not None:
            refuse_existing(path, overwrite=overwrite)
    asked = SpacingRequest(
        moved,
        _move_of(along, range_mm, clearance_mm, tolerance_mm),
        clearance_m=None if clearance_mm is None else clearance_mm / 1e3,
        grow_px=grow_px,
        step_m=None if step_mm is None else step_mm / 1e3,
        evaluation=EvaluateSettings(
            frames=frames,
            doubt=options.doubt_of(doubt=doubt, mask_std_px=mask_std_px),
            drop_cameras=drop_cameras,
        ),
    )
    try:
        named = dict(zip(distinct_names(sessions, "session.toml"), sessions, strict=True))
    except ValueError as error:
        raise SessionError(f"{error}; each session is a column of its own, name it once") from None
    result = find_spacing(named, scene, asked, options.command_line(), terminal)
    if output is not None:
        write_spacing(output, result)
    if picture is not None:
        write_picture_of(picture, result)
    if as_json:
        files = {
            "spacing": None if output is None else str(output),
            "picture": None if picture is None else str(picture),
        }
        options.tell(json.dumps({**files, **spacing_as_dict(result)}))
    else:
        _print_result(result)
    if fail_on_doubt and not all(one.agreement.is_trusted for one in result.sessions):
        sys.exit(5)


def _move_of(
    along: tuple[float, float, float],
    range_mm: tuple[float, float],
    clearance_mm: float | None,
    tolerance_mm: float,
) -> "Move":
    """Return the move that the options ask for, or say in one line what is wrong with them."""
    import numpy as np

    from hybridve.calib.errors import SceneError
    from hybridve.hull.contact.spacing import Move

    start_mm, stop_mm = range_mm
    if stop_mm <= start_mm:
        kind = "is empty" if stop_mm == start_mm else "goes backwards"
        raise SceneError(
            f"--range-mm {start_mm:g}:{stop_mm:g} {kind}; expected A:B with A below B, and --along "
            "turned around for the other way"
        )
    if clearance_mm is not None and not 0 <= clearance_mm < math.inf:
        raise SceneError(
            f"--clearance-mm {clearance_mm:g}: expected 0 or more, how far real things must stay "
            "away"
        )
    length = math.hypot(*along)
    if length == 0:
        raise SceneError("--along 0,0,0 points nowhere; give a direction")
    return Move(np.array(along) / length, start_mm / 1e3, stop_mm / 1e3, tolerance_mm / 1e3)


def _print_result(found: "Spacing") -> None:
    settings = found.settings
    direction = ", ".join(f"{value:.3g}" for value in settings["direction"])
    required = dict.fromkeys(f"{1e3 * one:g}" for one in settings["required_m"])
    options.tell(
        f"{', '.join(settings['move'])} moved along ({direction}), {1e3 * settings['start_m']:g} "
        f"to {1e3 * settings['stop_m']:g} mm, to keep {', '.join(required)} mm"
        + (f", silhouettes grown by {settings['grow_px']} px" if settings["grow_px"] else "")
    )
    for one in found.sessions:
        trust = "" if one.agreement.is_trusted else "not to be trusted: "
        for cause in one.agreement.causes:
            options.tell(f"{one.name}: {trust if cause.is_gross else ''}{cause.message}")
    columns = [_column(one) for one in found.sessions]
    labels = [label for label in columns[0] if any(column[label] for column in columns)]
    rows = [("mm", *(one.name for one in found.sessions))]
    rows += [(label, *(column[label] for column in columns)) for label in labels]
    options.print_table(rows)
    standing = _standing_text(found)
    if standing:
        options.tell(standing)


def _column(one: "SessionSpacing") -> dict[str, str]:
    """Return what the table says of one session."""
    frames, curve, binding = one.frames, one.curve, one.binding
    start_m, stop_m = (float(curve.shift_m[end]) for end in (0, -1))
    text = {
        "smallest shift": _answer(one.shift_m, start_m, stop_m),
        "it is at least": "-" if math.isnan(one.at_least_m) else mm(one.at_least_m, ".1f"),
        "suffices at 95 %": "",
        "at 95 % decided by": "",
        "kept at": _ranges(one),
        "decided by frame": "-",
        "time": "-",
        "at object": "-",
        "hull point": "-",
        "object point": "-",
        "clearance there": "-",
    }
    if binding is not None:
        low_m, high_m = binding.clearance_m.tolist()
        text |= {
            "decided by frame": f"{binding.frame}",
            "time": f"{binding.time_s:.2f} s",
            "at object": binding.object_name,
            "hull point": _point(binding.on_hull_world),
            "object point": _point(binding.on_object_world),
            "clearance there": f"{mm(low_m, '.1f')} to {mm(high_m, '.1f')}",
        }
        if math.isnan(one.shift_m):
            text["clearance there"] += f", at {1e3 * stop_m:g}"
    if one.doubt is not None:
        text["suffices at 95 %"] = _answer(one.doubt.shift_m, start_m, stop_m)
        if one.doubt.frame is not None:
            text["at 95 % decided by"] = (
                f"frame {one.doubt.frame}, there known to +- {mm(one.doubt.std_m, '.1f')}"
            )
    n_valid = frames.n_valid
    ends = ((0, start_m), (-1, stop_m))
    text |= {
        f"frames violated at {1e3 * shift_m:g}": _count(
            int(curve.violated[end]), int(curve.undecided[end]), n_valid
        )
        for end, shift_m in ends
    }
    if one.at_zero is not None:
        text["frames violated at 0"] = _count(*one.at_zero, n_valid)
    text["rests on"] = one.agreement.rests_on
    left_out = len(frames.index) - n_valid
    text["frames left out"] = f"{left_out}" if left_out else ""
    return text


def _answer(shift_m: float, start_m: float, stop_m: float) -> str:
    """Return a shift that was sought in a range, or that there is none."""
    if math.isnan(shift_m):
        return f"none up to {1e3 * stop_m:g}"
    return mm(shift_m, ".1f") + (" (the first)" if shift_m == start_m else "")


def _ranges(one: "SessionSpacing") -> str:
    """Return where the clearance is kept, in ascending order."""
    ranges = [f"{mm(low, '.1f')} to {mm(high, '.1f')}" for low, high in one.free_m.tolist()]
    if len(ranges) > _MOST_RANGES:
        ranges = [*ranges[:_MOST_RANGES], f"{len(one.free_m) - _MOST_RANGES} more"]
    return "; ".join(ranges) or "-"


#: Ranges in a cell of the table.
_MOST_RANGES = 3


def _standing_text(found: "Spacing") -> str:
    """Return which objects that were not moved are violated all the same."""
    parts = []
    for one in found.sessions:
        for name, (violated, undecided) in one.standing.items():
            if violated or undecided:
                count = _count(violated, undecided, one.frames.n_valid)
                parts.append(f"{name} in {count} frames of {one.name}")
    return f"not moved, and violated all the same: {'; '.join(parts)}" if parts else ""


def _count(violated: int, undecided: int, total: int) -> str:
    may = f" to {violated + undecided}" if undecided else ""
    return f"{violated}{may} of {total}"


def _point(point_world: Any) -> str:
    return "(" + ", ".join(f"{1e3 * value:.0f}" for value in point_world.tolist()) + ")"
