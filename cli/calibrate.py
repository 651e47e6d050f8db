"""``hybridve calibrate``: from pictures of boards to a rig, and to a verdict on it."""

import json
import math
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from hybridve.calib.lengths import millimetres
from hybridve.cli import options
from hybridve.cli.progress import Terminal

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from hybridve.calib.judging.account import Calibration
    from hybridve.calib.judging.certificate import Certificate, Volume
    from hybridve.calib.record import CalibrationRecord, CameraRecord
    from hybridve.calib.rig import Rig
    from hybridve.calib.verdict import RigCheck
    from hybridve.hull.capture.session import Session

    Box = tuple[NDArray[np.float64], NDArray[np.float64]]

#: Exit status where the rig is not as good as --max-error-mm asks, or --check finds it wrong.
NOT_GOOD_ENOUGH = 4


class BoxMillimetres(click.ParamType["Box"]):
    """Two corners of a box, in millimetres."""

    name = "X,Y,Z:X,Y,Z"

    def convert(
        self, value: str, param: click.Parameter | None, ctx: click.Context | None
    ) -> "Box":
        """Return the lowest and the highest corner in metres, or fail with what was expected."""
        import numpy as np

        if not isinstance(value, str):
            return value
        try:
            low, high = (
                np.array([float(part) for part in corner.split(",")]) / 1000.0
                for corner in value.split(":")
            )
        except ValueError:
            low = high = np.zeros(0)
        if low.shape != (3,) or high.shape != (3,) or not (low < high).all():
            self.fail(
                f"{value!r} is not a box; expected its lowest and its highest corner in mm, as "
                "-500,-500,0:500,500,1500",
                param,
                ctx,
            )
        return low, high


def _folder(session: Path, output: Path | None) -> Path:
    """Return the folder of the rig."""
    return output or (session if session.is_dir() else session.parent) / "rig"


def _files(values: dict[str, Any]) -> options.Files:
    reads = options.given(values["session"], values["checked"])
    if values["checked"] is not None:
        return options.Files(reads)
    folder = _folder(values["session"], values["output"])
    # The folder need not be there yet, so it is held, and not the file in it.
    return options.Files(reads, writes=[folder], keeps=[folder / "rig.json"])


@click.command(
    cls=options.Command,
    files=_files,
    short_help="Find where the cameras stand, from pictures of boards, and how surely.",
)
@options.session_arg
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    help="The folder to write the rig into. Default: rig/ beside the session.toml.",
)
@click.option(
    "--max-error-mm",
    type=click.FloatRange(min=0, min_open=True),
    help=f"Leave with exit status {NOT_GOOD_ENOUGH} if points in the working volume may be off by "
    "more than this (95 %).",
)
@click.option(
    "--volume-mm",
    "box_world",
    type=BoxMillimetres(),
    help="The working volume in the rig's world. Default: what all cameras see about the point "
    "that they look at, above the floor.",
)
@click.option(
    "--check",
    "checked",
    type=click.Path(path_type=Path),
    metavar="RIG",
    help="Calibrate nothing: test this rig, of any format, against the boards of SESSION, and name "
    f"the camera that is wrong. Exit status {NOT_GOOD_ENOUGH} if it does not fit, or nothing "
    "tells.",
)
@click.option(
    "--rig-unit",
    type=click.Choice(["m", "cm", "mm", "in", "ft", "squares"]),
    help="Unit of RIG's lengths, where its format has none; squares are those of SESSION's target.",
)
@click.option(
    "--pixel-centre",
    type=click.Choice(["0", "0.5"]),
    help="Where RIG has the centre of the top-left pixel: 0 (OpenCV) or 0.5 (COLMAP). Default: "
    "where its format usually has it.",
)
@click.option("--no-page", is_flag=True, help="Write no certificate.html, which takes seconds.")
@options.overwrite_option
@options.json_option
@options.quiet_progress
def calibrate(
    session: Path,
    output: Path | None,
    max_error_mm: float | None,
    box_world: "Box | None",
    checked: Path | None,
    rig_unit: str | None,
    pixel_centre: str | None,
    no_page: bool,
    overwrite: bool,
    as_json: bool,
    progress: bool,
) -> None:
    r"""Find lenses and places of SESSION's cameras from its pictures of the target.

    Writes rig.json (with its covariance), a COLMAP model, and the certificate: how far points in
    the working volume may be off, what limits that and what to record, as certificate.json and as
    a page with pictures, certificate.html. What was found in pictures is kept in rig/corners and
    not searched again.

    A rig that the session names (rig = ...) is taken instead, and tested against the session's
    boards, if there are any.

    \b
    Example:
      hybridve calibrate data/horseman --max-error-mm 10
      hybridve calibrate --check yesterday/rig/rig.json today
    """
    from hybridve.calib.errors import ask_all
    from hybridve.hull.capture.inspection import opened_session
    from hybridve.hull.report.write import refuse_existing_in

    terminal = Terminal(enabled=progress)
    if checked is not None:
        _check(opened_session(session), checked, rig_unit, pixel_centre, terminal, as_json=as_json)
        return
    for option, value in (("--rig-unit", rig_unit), ("--pixel-centre", pixel_centre)):
        if value is not None:
            raise click.UsageError(f"{option} goes with --check")
    folder = _folder(session, output)
    loaded, _ = ask_all(
        lambda: opened_session(session),
        lambda: refuse_existing_in(folder, "rig.json", overwrite=overwrite),
    )
    _calibrate(
        loaded,
        folder,
        terminal,
        box_world=box_world,
        max_error_m=None if max_error_mm is None else max_error_mm / 1000.0,
        with_page=not no_page,
        as_json=as_json,
    )


# --- A rig that is checked --------------------------------------------------------------------


def _check(
    session: "Session",
    source: Path,
    unit: str | None,
    pixel_centre: str | None,
    terminal: Terminal,
    *,
    as_json: bool,
) -> None:
    from hybridve.calib.formats.rigs import read_any_rig
    from hybridve.calib.plain import to_json
    from hybridve.hull.capture.rig import board_sizes
    from hybridve.hull.capture.rig_check import check_session

    rig = read_any_rig(
        source,
        unit=unit,
        square_m=None if session.target is None else session.target.unit_m,
        pixel_centre=None if pixel_centre is None else float(pixel_centre),
        image_sizes=board_sizes(session),
        names=[camera.name for camera in session.cameras],
    )
    check = check_session(session, rig, terminal.stage)
    if as_json:
        options.tell(json.dumps(to_json({"rig": str(source), **asdict(check)})))
    else:
        _print_check(source, check)
    if not check.is_trustworthy:
        sys.exit(NOT_GOOD_ENOUGH)


def _print_check(source: Path, check: "RigCheck") -> None:
    options.tell(f"{source}: {check.message}")
    missed = ", ".join(f"{name} {rms_px:.2f}" for name, rms_px in check.rms_px.items())
    options.tell(f"  boards are missed by, px rms: {missed}")
    options.tell(f"  scale: {check.scale:.4f}")


# --- A rig that is made -----------------------------------------------------------------------


def _calibrate(
    session: "Session",
    folder: Path,
    terminal: Terminal,
    *,
    box_world: "Box | None",
    max_error_m: float | None,
    with_page: bool,
    as_json: bool,
) -> None:
    from hybridve.calib.formats.rig_json import write_rig
    from hybridve.calib.judging.certificate import certify, working_volume
    from hybridve.calib.plain import to_json
    from hybridve.hull.capture.rig import calibrate_session, take_elsewhere

    path = folder / "rig.json"
    certificate = page = None
    if session.rig_file is not None:
        rig = take_elsewhere(session, terminal.stage)
        _make(folder)
    else:
        calibration = calibrate_session(session, terminal.stage, box_world)
        rig = calibration.rig
        volume = working_volume(rig, calibration.boards_world, box_world)
        certificate = certify(
            rig, calibration.record, calibration.seen, volume, calibration.boards_world
        )
        _make(folder)
        page = _write_certificate(
            folder, session, calibration, certificate, volume, max_error_m, with_page
        )
    no_colmap = _write_colmap(folder / "colmap", rig)
    write_rig(path, rig)
    if as_json:
        numbers = _numbers(path, rig, certificate) | {"no_colmap_model": no_colmap}
        numbers["page"] = None if page is None else str(page)
        options.tell(json.dumps(to_json(numbers)))
    else:
        _print(path, rig, certificate)
        if page is not None:
            options.tell(f"  the certificate, with pictures: {page}")
        if no_colmap is not None:
            options.tell(f"  {no_colmap}")
    if max_error_m is not None:
        _gate(certificate, max_error_m)


def _make(folder: Path) -> None:
    """Make the folder of a rig, once there is one to be written."""
    from hybridve.calib.errors import CalibrationError

    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CalibrationError(f"{folder}: cannot be made ({error.strerror})") from error


def _write_colmap(folder: Path, rig: "Rig") -> str | None:
    """Write the COLMAP model of a rig; where there can be none, say why."""
    from hybridve.calib.formats import colmap

    reasons = ((camera.name, colmap.refusal(camera)) for camera in rig.cameras)
    held_back = {name: why for name, why in reasons if why is not None}
    if not held_back:
        colmap.write_colmap_model(folder, rig)
        return None
    colmap.remove_colmap_model(folder)  # one of an older rig would be believed
    name, why = next(iter(held_back.items()))
    others = f" ({len(held_back)} cameras are so)" if len(held_back) > 1 else ""
    return f"no COLMAP model is written: camera {name!r} has {why}{others}; rig.json holds all"


def _write_certificate(
    folder: Path,
    session: "Session",
    calibration: "Calibration",
    certificate: "Certificate",
    volume: "Volume",
    max_error_m: float | None,
    with_page: bool,
) -> Path | None:
    """Write the certificate; return its page, None without one."""
    from hybridve.calib.errors import CalibrationError
    from hybridve.calib.files import write_whole

    text = json.dumps(certificate.to_dict(), indent=1, allow_nan=False) + "\n"
    path = folder / "certificate.json"
    try:
        write_whole(path, text)
    except OSError as error:
        raise CalibrationError(f"{path}: cannot be written: {error}") from error
    page = folder / "certificate.html"
    if not with_page:
        page.unlink(missing_ok=True)  # one of an older rig would be believed
        return None
    from hybridve.calib.plain import to_plain
    from hybridve.hull.view.certificate_page import write_certificate_page
    from hybridve.hull.world_photo import world_photo

    write_certificate_page(
        page,
        calibration.rig,
        certificate,
        calibration.seen,
        volume,
        title=session.name,
        details=to_plain(calibration.record),
        max_error_m=max_error_m,
        photo=world_photo(session, calibration.rig, calibration.record),
    )
    return page


#: Distances between cameras that are told one by one: of five cameras.
_MOST_DISTANCES = 10


def _gate(certificate: "Certificate | None", max_error_m: float) -> None:
    """Leave with a status of its own if the error is not proved to be small enough."""
    error_m = math.nan if certificate is None or certificate.doubts else certificate.error95_m
    if error_m <= max_error_m:
        return
    found = f"{millimetres(error_m)} mm" if math.isfinite(error_m) else "an unknown error"
    options.tell(
        f"error: the rig is good to {found}, not to {1000 * max_error_m:g} mm as --max-error-mm "
        "asks; it was written all the same",
        err=True,
    )
    sys.exit(NOT_GOOD_ENOUGH)


def _numbers(path: Path, rig: "Rig", certificate: "Certificate | None") -> dict[str, Any]:
    """Return what to tell of a rig, as plain JSON values."""
    from hybridve.calib.plain import to_plain

    record = _record_of(rig)
    told: dict[str, Any] = {} if record is None else to_plain(record)
    numbers: dict[str, Any] = {
        "rig": str(path),
        "cameras": [
            {
                "name": camera.name,
                "model": camera.model,
                "center_m": camera.center_world.tolist(),
                **told.get("cameras", {}).get(camera.name, {}),
            }
            for camera in rig.cameras
        ],
        "distances_m": _distances_m(rig),
        **{
            key: told[key]
            for key in ("world", "rms_px", "labelling", "clocks", "adjustment")
            if key in told
        },
    }
    if rig.check is not None:
        numbers["check"] = rig.check.to_dict()
    if certificate is not None:
        numbers["certificate"] = certificate.to_dict()
    return numbers


def _record_of(rig: "Rig") -> "CalibrationRecord | None":
    """Return what is known of a rig's calibration; None where it was made elsewhere."""
    from hybridve.calib.record import CalibrationRecord

    return rig.provenance if isinstance(rig.provenance, CalibrationRecord) else None


def _distances_m(rig: "Rig") -> dict[str, float]:
    """Return the distance of each two cameras, "cam1 cam2"."""
    centers = rig.centers_world
    return {
        f"{rig.cameras[i].name} {rig.cameras[j].name}": math.dist(centers[i], centers[j])
        for i, j in combinations(range(len(centers)), 2)
    }


def _print(path: Path, rig: "Rig", certificate: "Certificate | None") -> None:
    from hybridve.calib.judging.certificate import opinion_text

    record = _record_of(rig)
    if certificate is not None:
        options.tell(certificate.verdict)
    options.tell(f"{path}: {len(rig.cameras)} cameras")
    if certificate is not None:
        options.tell(f"  {_volume_text(certificate)}")
    certified = {} if certificate is None else {one.name: one for one in certificate.cameras}
    for camera in rig.cameras:
        x, y, z = camera.center_world
        place = f"at ({x:.3f}, {y:.3f}, {z:.3f}) m"
        if camera.name in certified:
            place += f" +- {millimetres(certified[camera.name].place_std_m)} mm"
        told = None if record is None else record.cameras.get(camera.name)
        options.tell("; ".join([f"  {camera.name}: {camera.model}, {place}", *_views_of(told)]))
        if told is not None:
            if told.model_chosen is not None:
                options.tell(f"    {told.model_chosen.reason}")
            for remark in (*told.warnings, *_counted(told.notes)):
                options.tell(f"    {remark}")
    distances_m = sorted(_distances_m(rig).items(), key=lambda one: one[1])
    if len(distances_m) > _MOST_DISTANCES:  # of 20 cameras there are 190
        near, far = (
            ", ".join(f"{pair} {metres:.3f}" for pair, metres in part)
            for part in (distances_m[:3], distances_m[-3:])
        )
        options.tell(f"  {len(distances_m)} distances, m: {near}, .. {far}; --json has all")
    elif distances_m:
        pairs = ", ".join(f"{pair} {metres:.3f}" for pair, metres in _distances_m(rig).items())
        options.tell(f"  distances, m: {pairs}")
    if record is not None:
        outliers = 0 if record.adjustment is None else record.adjustment.outliers
        left_out = f", {outliers} outliers left out" if outliers else ""
        options.tell(f"  joint adjustment: {record.rms_px:.3f} px rms over all views{left_out}")
        _print_decisions(record)
    if rig.check is not None:
        options.tell(f"  {rig.check.message}")
    if certificate is not None:
        if certificate.second_opinion is not None:
            options.tell(f"  {opinion_text(certificate.second_opinion)}")
        for warning in certificate.warnings:
            options.tell(f"  {warning}")


def _volume_text(certificate: "Certificate") -> str:
    """Return where the working volume lies that a verdict speaks of."""
    sides = ", ".join(
        f"{axis} {low:.2f} to {high:.2f}"
        for axis, low, high in zip(
            "xyz", certificate.volume_low_m, certificate.volume_high_m, strict=True
        )
    )
    about = " about the boards, far from where the axes meet"
    text = (
        f"the working volume: {sides} m, as far as {certificate.volume_min_cameras} cameras see it"
        f"{about if certificate.volume_about == 'boards' else ''}"
    )
    if math.isfinite(certificate.boards_error95_m):
        text += f"; where boards were: good to {millimetres(certificate.boards_error95_m)} mm"
    return text


def _views_of(told: "CameraRecord | None") -> list[str]:
    """Return what is to be told of the views of one camera."""
    if told is None:
        return []
    parts = []
    for found, what in ((told.intrinsics, "stills"), (told.extrinsics, "board clip")):
        if found.rms_px is not None:
            parts.append(f"{what} {found.rms_px:.3f} px rms of {found.views_used} views")
    dropped, without = told.intrinsics.views_dropped, told.intrinsics.views_without_board
    if dropped or without:
        parts.append(f"{len(dropped)} views dropped, {len(without)} without a board")
    return parts


def _counted(notes: Sequence[str]) -> list[str]:
    """Return what is unusual about boards in pictures, each once: "IMAGE: what" by what."""
    counts = Counter(note.partition(": ")[2] for note in notes)
    return [f"{count} views: {what}" for what, count in sorted(counts.items())]


def _print_decisions(record: "CalibrationRecord") -> None:
    """Tell what was decided on the way: the world, symmetric boards, clocks."""
    if record.world is not None:
        options.tell(f"  the world: {record.world.text}")
    labelling = record.labelling
    if labelling is not None and labelling.weakest_sigma is not None:
        options.tell(
            "  the board looks the same turned; which way round each camera saw it was decided by "
            f"{labelling.decided_by}, by {labelling.weakest_sigma:.1f} standard deviations "
            f"or more{' (weak: compare a distance you know)' if labelling.is_weak else ''}"
        )
    clocks = record.clocks
    if clocks is not None:
        late = ", ".join(
            f"{name} {offset:+.2f} +- {clocks.std_frames[name]:.2f}"
            if offset is not None
            else f"{name} unknown"
            for name, offset in clocks.offset_frames.items()
            if name != clocks.reference
        )
        options.tell(f"  clocks, frames late against {clocks.reference}: {late}")
