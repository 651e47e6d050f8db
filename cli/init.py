"""``hybridve init``: a session.toml and a scene.toml begun from what lies in a folder."""

from pathlib import Path

import click

from hybridve.cli import options


@click.command(short_help="Begin a session from what lies in a folder.")
@click.argument("folder", type=click.Path(path_type=Path))
def init(folder: Path) -> None:
    r"""Write a commented session.toml and scene.toml into FOLDER from what is found there.

    Names say which camera and what for: cam1/background.avi, background/cam1.avi and
    cam1_background.avi are one to it; words for the board, the empty scene, the task, stills of the
    lens and masks are known, and pictures of two values are masks. What is not known stands as a
    comment with what belongs there; the board and the units of CAD, which are never guessed, stand
    as FILL IN, and nothing can be loaded until they are filled in. Nothing is written over.

    \b
    Example:
      hybridve init my_recording
    """
    from hybridve.hull.draft import FILL_IN, write_drafts

    found, files = write_drafts(folder)
    for path in files:
        options.tell(str(path))
    for name, table in found.cameras.items():
        keys = (key or f"{find.pattern} (what for?)" for key, find in table.items())
        options.tell(f"  camera {name}: {', '.join(keys)}")
    options.tell(f"  {options.counted(len(found.cad), 'CAD file')}")
    if found.left:
        options.tell(f"  not known what for: {', '.join(find.pattern for find in found.left)}")
    open_keys = [
        f"{path.name}:{number}"
        for path in files
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1)
        if f'"{FILL_IN}"' in line
    ]
    if open_keys:
        options.tell(f"to be filled in: {', '.join(open_keys)}")
    options.tell(f"then: hybridve check {folder}")
