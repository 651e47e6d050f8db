"""``hybridve board``: the board of a session, to be printed."""

import json
from pathlib import Path
from typing import Any

import click

from hybridve.cli import options

#: Sheets by their names, in mm, the smallest first.
_PAPERS = (
    ("A4", 210, 297),
    ("A3", 297, 420),
    ("A2", 420, 594),
    ("A1", 594, 841),
    ("A0", 841, 1189),
)

_ADVICE = """\
print at 100 %, never "fit to page", and measure the scale bar and a row of squares: write what you
measure into session.toml (square_mm), not what you meant to print. Glue it flat: a board bent by a
millimetre costs more than any lens model gains.
intrinsics: in each camera alone some 30 pictures, the board at all places of the picture, in its
corners too, near and far, tilted by 30 degrees to all sides; sharp, so hold it still.
extrinsics: all cameras see it at once. Move it slowly through the whole volume in which the task
will be, tilted as well as upright, where two cameras or more see it; or lay it still on the floor,
where all see it, which makes the floor the world's plane z = 0.
Light it evenly, without gloss; leave the white margin on."""


def _files(values: dict[str, Any]) -> options.Files:
    return options.Files(
        reads=options.given(values["session"]),
        writes=options.given(values["output"]),
    )


@click.command(
    cls=options.Command,
    files=_files,
    short_help="Print a session's board, to scale.",
)
@options.session_arg
@options.output_option("The PDF to write: a page for each board, in its true size.")
@options.overwrite_option
@options.json_option
def board(session: Path, output: Path, overwrite: bool, as_json: bool) -> None:
    r"""Write the board that SESSION describes as a PDF to print, a scale bar of 100 mm with it.

    Only its [target] is needed: no file that the session names has to be there yet. The page is as
    large as the board and a white margin: choose paper of at least that size, and print at 100 %.

    \b
    Example:
      hybridve board my_session -o board.pdf
    """
    from hybridve.calib.boards.named import make_board
    from hybridve.hull.capture.session import load_targets
    from hybridve.hull.report.write import refuse_existing
    from hybridve.hull.view.board_sheet import write_boards

    if output.suffix.lower() != ".pdf":
        raise click.UsageError(f"{output}: boards are written as .pdf")
    refuse_existing(output, overwrite=overwrite)
    boards = [make_board(target.table()) for target in load_targets(session)]
    pages = write_boards(output, boards)
    if as_json:
        told = [
            {
                "board": str(one),
                "width_mm": page.width_mm,
                "height_mm": page.height_mm,
                "bar_mm": page.bar_mm,
            }
            for one, page in zip(boards, pages, strict=True)
        ]
        options.tell(json.dumps({"file": str(output), "pages": told}))
        return
    for number, (one, page) in enumerate(zip(boards, pages, strict=True), start=1):
        size = f"{page.width_mm:.0f} x {page.height_mm:.0f} mm"
        options.tell(f"{output}: page {number}: {one}")
        options.tell(f"  {size}, {_paper_for(page.width_mm, page.height_mm)}")
    options.tell(_ADVICE)


def _paper_for(width_mm: float, height_mm: float) -> str:
    """Return on which paper a page fits.

    Examples
    --------
    >>> _paper_for(280.0, 200.0), _paper_for(1115.0, 900.0)
    ('fits on A4', 'larger than A0: to be printed on a roll')
    """
    for name, short_mm, long_mm in _PAPERS:
        if min(width_mm, height_mm) <= short_mm and max(width_mm, height_mm) <= long_mm:
            return f"fits on {name}"
    return "larger than A0: to be printed on a roll"
