"""``hybridve export``: a report as a page, as tables, as meshes, for other programs."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from hybridve.cli import options
from hybridve.cli.progress import Terminal

if TYPE_CHECKING:
    from hybridve.hull.recorded import Recorded
    from hybridve.hull.report.clashes import Clashes
    from hybridve.hull.report.ledger import Listed
    from hybridve.hull.report.read import Report

#: What a report can be exported as: the option, what it is, and what it needs besides.
_TARGETS = (
    ("--html PAGE.html", "one page: the answer, clashes, all frames; better with --session", ""),
    (
        "--csv FOLDER",
        "tables: a row a frame and object, and a row a clash",
        "",
    ),
)

_path = click.Path(path_type=Path)


def _files(values: dict[str, Any]) -> options.Files:
    targets = ("html", "csv", "bcf", "rerun", "hull_mesh", "vtk")
    return options.Files(
        reads=options.given(values["report"], values["session"], values["ledger_file"]),
        writes=options.given(*(values[target] for target in targets)),
    )


@click.command(
    cls=options.Command,
    files=_files,
    short_help="Write a report as a page, or for other programs.",
)
@click.argument("report", type=_path, required=False)
@click.option(
    "--html",
    type=_path,
    help="One page that needs nothing else, for any browser: the answer, the clashes with "
    "pictures, clearance over time, and the scene in 3D frame by frame.",
)
@click.option(
    "--csv",
    type=_path,
    help="Tables: a folder for frames.csv (a row a frame and object) and clashes.csv (a row a "
    "clash); or a .csv for the first, beside which FILE.clashes.csv is put.",
)
@click.option(
    "--bcf",
    type=_path,
    help="The clashes for BIM tools, BCF 3.0: a topic each, with its status, a picture and from "
    "where it is seen. A clash has the same identity in every file.",
)
@click.option(
    "--rerun",
    type=_path,
    help="A .rrd for the Rerun viewer: cameras, CAD, collision points, nearest ways and "
    "clearances over time; with --session the hull. Needs the extra hybridve[rerun].",
)
@click.option(
    "--hull-mesh",
    type=_path,
    help="A folder for the hull of each frame as a closed mesh; of --session.",
)
@click.option(
    "--mesh-format",
    type=click.Choice(["ply", "glb"]),
    default="ply",
    show_default=True,
    help="What these are: .ply has double precision, .glb is glTF.",
)
@click.option(
    "--cell-mm",
    type=click.FloatRange(0, min_open=True),
    default=10.0,
    show_default=True,
    help="Cells of the grid that the hull's surface is found on, for --hull-mesh and --vtk: what "
    "is thinner may be lost.",
)
@click.option(
    "--vtk",
    type=_path,
    help="A .vtkhdf for ParaView: CAD where it stood, collision points, the shortest way between "
    "each object and the hull, by name; with --session the hull, too. (The report itself opens "
    "there as well, with CAD and points.)",
)
@click.option(
    "--session",
    type=_path,
    help="The session that the report was made from: pictures of its cameras, and the hull.",
)
@click.option(
    "--ledger",
    "ledger_file",
    type=_path,
    help="Where ids of clashes and decisions are kept; as of `hybridve clashes`.",
)
@click.option("--list", "as_list", is_flag=True, help="Tell what a report can be exported as.")
@options.overwrite_option
@options.quiet_progress
def export(
    report: Path | None,
    html: Path | None,
    csv: Path | None,
    bcf: Path | None,
    rerun: Path | None,
    hull_mesh: Path | None,
    mesh_format: str,
    cell_mm: float,
    vtk: Path | None,
    session: Path | None,
    ledger_file: Path | None,
    as_list: bool,
    overwrite: bool,
    progress: bool,
) -> None:
    r"""Write REPORT as a page, or for other programs.

    \b
    Example:
      hybridve export report.h5 --html report.html --session my_session
      hybridve export report.h5 --csv tables
      hybridve export report.h5 --hull-mesh hulls --mesh-format glb --session my_session
      hybridve export --list
    """
    if as_list:
        rows = [("option", "what it is", "needs")]
        options.print_table([*rows, *_TARGETS])
        return
    if report is None:
        raise click.UsageError("name the report to export")
    targets = (html, csv, bcf, rerun, hull_mesh, vtk)
    if all(one is None for one in targets):
        raise click.UsageError("say as what: " + ", ".join(one[0] for one in _TARGETS))
    _refuse_wrong_usage(html, bcf, rerun, hull_mesh, vtk, session)
    from hybridve.hull.report.read import read_report
    from hybridve.hull.report.write import refuse_existing

    for path in (html, bcf, rerun, vtk):
        if path is not None:
            refuse_existing(path, overwrite=overwrite)
    tables = None if csv is None else _table_paths(csv, overwrite=overwrite)
    if hull_mesh is not None:
        _refuse_meshes(hull_mesh, f".{mesh_format}", overwrite=overwrite)
    loaded = read_report(report)
    if not len(loaded.index):
        from hybridve.calib.errors import ReportError

        raise ReportError(f"{report}: has no frames to export")
    terminal = Terminal(enabled=progress)
    recorded, missing = _recorded(loaded, session, terminal)
    if any(one is not None for one in (html, tables, bcf)):
        found, listed = _clashes(loaded, ledger_file)
    if tables is not None:
        _write_tables(*tables, loaded, listed)
    if bcf is not None:
        from hybridve.hull.export_bcf import write_clashes_bcf

        why = write_clashes_bcf(bcf, loaded, listed, recorded=recorded, progress=terminal.stage)
        without = f", without pictures: {why}" if why else ""
        options.tell(f"{bcf}: {options.counted(len(listed), 'topic')}{without}")
    if hull_mesh is not None:
        from hybridve.hull.export_hulls import write_hull_meshes

        assert recorded is not None
        hull_mesh.mkdir(parents=True, exist_ok=True)
        count = write_hull_meshes(
            hull_mesh,
            f".{mesh_format}",
            loaded,
            recorded,
            cell_m=cell_mm / 1e3,
            progress=terminal.stage,
        )
        meshes = "1 mesh" if count == 1 else f"{count} meshes"
        options.tell(f"{hull_mesh}: {meshes} of {options.counted(len(loaded.index), 'frame')}")
    if vtk is not None:
        from hybridve.hull.export_hulls import write_paraview

        write_paraview(
            vtk, loaded, recorded=recorded, cell_m=cell_mm / 1e3, progress=terminal.stage
        )
        options.tell(f"{vtk}: {options.counted(len(loaded.index), 'frame')}")
    if rerun is not None:
        from hybridve.hull.export_hulls import hull_surfaces
        from hybridve.hull.export_rerun import write_rerun
        from hybridve.hull.recorded import rig_of

        surfaces = None
        if recorded is not None:
            surfaces = hull_surfaces(loaded, recorded, cell_mm / 1e3, terminal.stage)
        write_rerun(rerun, loaded, rig_of(loaded, recorded), surfaces)
        options.tell(f"{rerun}: {options.counted(len(loaded.index), 'frame')}")
    if html is not None:
        from hybridve.hull.page import write_page

        size = write_page(
            html,
            loaded,
            found,
            listed,
            recorded=recorded,
            missing=missing,
            progress=terminal.stage,
        )
        options.tell(f"{html}: {size / 1e6:.1f} MB, {options.counted(len(loaded.index), 'frame')}")


def _refuse_wrong_usage(
    html: Path | None,
    bcf: Path | None,
    rerun: Path | None,
    hull_mesh: Path | None,
    vtk: Path | None,
    session: Path | None,
) -> None:
    """Refuse names that say of nothing that can be written, and options that need each other."""
    if html is not None and html.suffix.lower() not in (".html", ".htm"):
        raise click.UsageError(f"{html}: pages are .html")
    if vtk is not None and vtk.suffix.lower() != ".vtkhdf":
        raise click.UsageError(f"{vtk}: files for ParaView are .vtkhdf")
    if bcf is not None and bcf.suffix.lower() not in (".bcf", ".bcfzip"):
        raise click.UsageError(f"{bcf}: BCF files are .bcf or .bcfzip")
    if rerun is not None and rerun.suffix.lower() != ".rrd":
        raise click.UsageError(f"{rerun}: recordings for Rerun are .rrd")
    if hull_mesh is not None and session is None:
        raise click.UsageError("--hull-mesh needs --session SESSION: a report holds no hull")
    if session is not None and all(one is None for one in (html, bcf, rerun, hull_mesh, vtk)):
        raise click.UsageError(
            "--session is of --html, --bcf, --rerun, --hull-mesh and --vtk; give one of them"
        )


def _refuse_meshes(folder: Path, suffix: str, *, overwrite: bool) -> None:
    """Refuse a folder for meshes that cannot be made, or in which there are some."""
    from hybridve.hull.report.write import refuse_existing_in

    there = sorted(folder.glob(f"hull_*{suffix}")) if folder.is_dir() else []
    name = there[0].name if there else f"hull_000000{suffix}"
    refuse_existing_in(folder, name, overwrite=overwrite)


def _recorded(
    report: "Report", session: Path | None, terminal: Terminal
) -> "tuple[Recorded | None, list[str]]":
    """Return the recordings that a report is of, and what speaks against these being them."""
    if session is None:
        return None, []
    import cv2

    from hybridve.hull.recorded import open_recorded

    cv2.setNumThreads(1)
    recorded, doubt = open_recorded(report, session)
    if not doubt:
        return recorded, []
    terminal.warn(doubt)
    return recorded, [doubt]


def _table_paths(csv: Path, *, overwrite: bool) -> tuple[Path, Path]:
    """Return where the tables of frames and of clashes go, which may be written."""
    from hybridve.hull.report.write import refuse_existing, refuse_existing_in

    if csv.suffix.lower() == ".csv":
        paths = csv, csv.with_suffix(".clashes.csv")
        for path in paths:
            refuse_existing(path, overwrite=overwrite)
        return paths
    for name in ("frames.csv", "clashes.csv"):
        refuse_existing_in(csv, name, overwrite=overwrite)
    return csv / "frames.csv", csv / "clashes.csv"


def _write_tables(
    frames: Path, clashes: Path, report: "Report", listed: "tuple[Listed, ...]"
) -> None:
    from hybridve.hull.report.tables import write_tables

    frames.parent.mkdir(parents=True, exist_ok=True)
    write_tables(frames, clashes, report, listed)
    n_rows = len(report.index) * len(report.objects)
    options.tell(f"{frames}: {options.counted(n_rows, 'row')}, a frame and object each")
    options.tell(f"{clashes}: {options.counted(len(listed), 'row')}, a clash each")


def _clashes(report: "Report", ledger_file: Path | None) -> "tuple[Clashes, tuple[Listed, ...]]":
    """Return the clashes of a report, and what the ledger calls them; new ones are kept there."""
    from hybridve.cli.clashes import keep_ledger
    from hybridve.hull.report.clashes import gather_clashes
    from hybridve.hull.report.ledger import ledger_path, look_up, read_ledger, write_ledger

    found = gather_clashes(report)
    before = read_ledger(ledger_file or ledger_path(report.path))
    ledger, listed = look_up(before, found.clashes, report)
    if ledger != before:
        keep_ledger(ledger, write_ledger, must_be=False)
    return found, listed
