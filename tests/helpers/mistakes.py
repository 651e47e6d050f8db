"""Mistakes that users make, each with the command that meets it and the line that comes.

A mistake spoils a small session that is good: three cameras with three ready masks each, a rig in
``rig.csv``, a scene with one cube. In a command, S stands for the session's folder, SCENE for its
scene, OUT for a file that may be written beside it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from helpers.sessions import write_ball_session, write_cube_scene

Spoil = Callable[[Path], object]

DETECT = "detect S --scene SCENE -o OUT --no-progress"
SIMULATE = "simulate S --scene SCENE -o OUT"
SPACING = "spacing S --scene SCENE --move cube --along 0,0,1 --range-mm 0:50"

#: Where the ball is in the three frames.
CENTERS = np.array([[0.2, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0]])

#: Exit status of a problem that a user can fix, and of wrong usage.
PROBLEM, USAGE = 1, 2


@dataclass(frozen=True)
class Mistake:
    """One mistake.

    Attributes
    ----------
    what : str
        In words.
    command : str
        What meets it; see the module.
    says : tuple of str
        What the line must hold: which thing, what was found and expected, what to do.
    spoil : callable
        Makes it, in the session's folder.
    status : int
        The exit status.
    keeps : str
        The folder in which something may be kept all the same: what was found in pictures.
    """

    what: str
    command: str
    says: tuple[str, ...]
    spoil: Spoil = lambda _: None
    status: int = PROBLEM
    keeps: str = ""


def write_good(folder: Path) -> None:
    """Write the session that is spoilt."""
    write_ball_session(folder, CENTERS, n_cameras=3)
    write_cube_scene(folder, {"cube": (0.0, 0.0, 0.0)})


# --- Ways to spoil it -------------------------------------------------------------------------


def edit(name: str, *changes: tuple[str, str]) -> Spoil:
    """Replace text in a file, each wherever it stands."""

    def spoil(folder: Path) -> None:
        text = (folder / name).read_text(encoding="utf-8")
        for old, new in changes:
            assert old in text, f"{name} has no {old!r}"
            text = text.replace(old, new)
        (folder / name).write_text(text, encoding="utf-8")

    return spoil


def session(*changes: tuple[str, str]) -> Spoil:
    return edit("session.toml", *changes)


def scene(*changes: tuple[str, str]) -> Spoil:
    return edit("scene.toml", *changes)


def head(text: str) -> Spoil:
    """Add keys to the head of the session."""
    return session(("fps = 25\n", f"fps = 25\n{text}\n"))


def camera(text: str) -> Spoil:
    """Add keys to the second camera."""
    return session(('name = "cam1"\n', f'name = "cam1"\n{text}\n'))


def added(name: str, text: str) -> Spoil:
    """Add text to the end of a file."""

    def spoil(folder: Path) -> None:
        with (folder / name).open("a", encoding="utf-8") as file:
            file.write(text)

    return spoil


def written(name: str, content: str | bytes) -> Spoil:
    """Write a file."""

    def spoil(folder: Path) -> None:
        path = folder / name
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(content.encode() if isinstance(content, str) else content)

    return spoil


def removed(*names: str) -> Spoil:
    def spoil(folder: Path) -> None:
        for name in names:
            (folder / name).unlink()

    return spoil


def renamed(*pairs: tuple[str, str]) -> Spoil:
    def spoil(folder: Path) -> None:
        for old, new in pairs:
            (folder / old).rename(folder / new)

    return spoil


def drawn(name: str, picture: np.ndarray) -> Spoil:
    def spoil(folder: Path) -> None:
        (folder / name).parent.mkdir(exist_ok=True)
        assert cv2.imwrite(str(folder / name), picture)

    return spoil


def filmed(name: str, *, rate: float = 25.0, size_px: tuple[int, int] = (64, 48)) -> Spoil:
    """Write a video of six frames of noise."""

    def spoil(folder: Path) -> None:
        fourcc = cv2.VideoWriter.fourcc(*"MJPG")
        path = str(folder / name)
        video = cv2.VideoWriter(path, cv2.CAP_OPENCV_MJPEG, fourcc, rate, size_px)
        rng = np.random.default_rng(0)
        for _ in range(6):
            video.write(rng.integers(100, 110, (size_px[1], size_px[0], 3)).astype(np.uint8))
        video.release()

    return spoil


def both(*spoils: Spoil) -> Spoil:
    """Do one after the other."""

    def spoil(folder: Path) -> None:
        for one in spoils:
            one(folder)

    return spoil


def videos(background: str = "empty.avi", video: str = "video.avi") -> Spoil:
    """Have the second camera record a video in place of masks."""
    return session(('masks = "cam1/*.png"', f'background = "{background}"\nvideo = "{video}"'))


def grey(value: int, shape: tuple[int, ...] = (120, 160)) -> np.ndarray:
    return np.full(shape, value, np.uint8)


def third(first: int, second: int, rest: int) -> np.ndarray:
    """Return a mask of three values."""
    picture = grey(rest)
    picture[:40], picture[40:80] = first, second
    return picture


TARGET = '[target]\nkind = "chessboard"\ncolumns = 8\nrows = 6\nsquare_mm = 30\n'
BOARD = (("[[camera]]", f"{TARGET}[[camera]]"),)


def target(*changes: tuple[str, str]) -> Spoil:
    """Describe a board, with changes, in place of the rig."""
    text = TARGET
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    return both(session(('rig = "rig.csv"\nrig_unit = "m"\n', "")), _before_cameras(text))


def _before_cameras(text: str) -> Spoil:
    def spoil(folder: Path) -> None:
        path = folder / "session.toml"
        before, mark, after = path.read_text(encoding="utf-8").partition("[[camera]]")
        path.write_text(before + text + mark + after, encoding="utf-8")

    return spoil


def effect(text: str) -> Spoil:
    return added("scene.toml", f"\n[[effect]]\n{text}\n")


STILLS = both(
    session(
        *((f'name = "cam{n}"', f'name = "cam{n}"\nextrinsics = "board{n}.png"') for n in range(3))
    ),
    *(drawn(f"board{n}.png", grey(90)) for n in range(3)),
)

_PLAIN_CUBE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"


# --- The table --------------------------------------------------------------------------------

MISTAKES = (
    # What a command is given.
    Mistake("no such folder of a session", "segment S/no/where", ("no/where", "no such session")),
    Mistake("no such session", "segment S/nowhere", ("nowhere", "there is no such session")),
    Mistake(
        "a scene in place of the session",
        "detect S/scene.toml --scene SCENE -o OUT",
        ("scene.toml: is a scene", "expected a session", "exchanged?"),
    ),
    Mistake("no such scene", "detect S --scene S/no.toml -o OUT", ("no.toml", "no such scene")),
    Mistake("no scene at all", "detect S -o OUT", ("--scene", "--help"), status=USAGE),
    Mistake(
        "frames as people write them",
        f"{DETECT} --frames 10-20",
        ("'10-20' is not a range of frames", "expected one frame (7), 0:100"),
        status=USAGE,
    ),
    Mistake(
        "frames backwards",
        f"{DETECT} --frames 2:1",
        ("'2:1' is not a range of frames", "0:100"),
        status=USAGE,
    ),
    Mistake(
        "frames that there are not",
        f"{DETECT} --frames 100:",
        ("session.toml", "none of the frames 100::1", "it has 3", "--frames"),
    ),
    Mistake(
        "two ways to say how fine",
        f"{DETECT} --viewport 4 --accuracy-mm 2",
        ("either --viewport or --accuracy-mm",),
        status=USAGE,
    ),
    Mistake(
        "a camera to leave out that there is not",
        f"{DETECT} --drop-camera cam9",
        ("no camera 'cam9' to leave out", "it has cam0, cam1, cam2"),
    ),
    Mistake(
        "one session twice",
        "detect S S --scene SCENE -o S/reports",
        ("given twice",),
        status=USAGE,
    ),
    Mistake("a mistyped command", "detcet S", ("No such command 'detcet'", "detect"), status=USAGE),
    Mistake(
        "an option that there is not",
        f"{DETECT} --viewports 4",
        ("--viewports", "--viewport"),
        status=USAGE,
    ),
    # Where results go.
    Mistake(
        "a report that stands there",
        DETECT,
        ("out.h5", "exists already", "--overwrite"),
        written("out.h5", "precious"),
    ),
    Mistake(
        "a report into no folder",
        "detect S --scene SCENE -o S/no/r.h5",
        ("no/r.h5", "there is no folder", "make it first"),
    ),
    Mistake(
        "a report that is a folder",
        "detect S --scene SCENE -o S/cam0",
        ("cam0", "is a folder; name a file"),
    ),
    Mistake(
        "silhouettes that stand there",
        "segment S",
        ("silhouettes.h5", "exists already", "--overwrite"),
        written("silhouettes.h5", "precious"),
    ),
    Mistake(
        "a rig that stands there",
        "calibrate S",
        ("rig.json", "exists already", "--overwrite"),
        written("rig/rig.json", "precious"),
    ),
    Mistake(
        "a rig into a file",
        "calibrate S -o S/rig.csv",
        ("rig.csv", "is a file; name a folder"),
    ),
    Mistake(
        "a run that was cut off",
        DETECT,
        ("out.h5.parts", "cut off", "--resume", "--overwrite"),
        lambda folder: (folder / "out.h5.parts").mkdir(),
    ),
    Mistake(
        "a run cut off, taken up with other settings",
        f"{DETECT} --resume --viewport 3",
        ("out.h5.parts", "had other settings", "--overwrite"),
        written("out.h5.parts/settings.json", "{}"),
    ),
    Mistake(
        "one file for several reports",
        "detect S --scene SCENE --scene S/other.toml -o S/cube.obj",
        ("cube.obj", "is a file", "folder"),
        lambda folder: (folder / "other.toml").write_text((folder / "scene.toml").read_text()),
    ),
    Mistake(
        "one of several runs that was cut off",
        "detect S --scene SCENE --scene S/other.toml -o S/reports",
        ("session__session.h5.parts", "cut off", "--resume", "--overwrite"),
        both(
            lambda folder: (folder / "other.toml").write_text((folder / "scene.toml").read_text()),
            lambda folder: (folder / "reports" / "session__session.h5.parts").mkdir(parents=True),
        ),
    ),
    Mistake(
        "a picture of no kind",
        "summary S/r.h5 --picture S/curves.xyz",
        ("curves.xyz", ".png"),
        status=USAGE,
    ),
    # The session.
    Mistake(
        "no TOML", DETECT, ("session.toml", "not valid TOML", "line"), added("session.toml", "[[[")
    ),
    Mistake(
        "a folder as Windows writes it",
        DETECT,
        ("session.toml", "write folders with /"),
        head('root = "C:\\users"'),
    ),
    Mistake(
        "text that is not UTF-8",
        DETECT,
        ("session.toml", "not UTF-8", "save it as UTF-8"),
        written("session.toml", b"# Stra\xdfe\n"),
    ),
    Mistake(
        "no format",
        DETECT,
        ("session.toml", "format: this key is missing"),
        session(('format = "hybridve-session"\n', "")),
    ),
    Mistake(
        "a version of tomorrow",
        DETECT,
        ("version", "found 9"),
        session(("version = 1", "version = 9")),
    ),
    Mistake(
        "a mistyped key",
        DETECT,
        ("fsp: there is no such key", "did you mean fps?"),
        session(("fps", "fsp")),
    ),
    Mistake(
        "a mistyped key of a camera",
        DETECT,
        ("camera.2.modle", "did you mean model?"),
        camera('modle = "OPENCV"'),
    ),
    Mistake(
        "a number in words",
        DETECT,
        ("fps", "number", "'fast'"),
        session(("fps = 25", 'fps = "fast"')),
    ),
    Mistake(
        "a lens that there is not",
        DETECT,
        ("camera.2", "unknown camera model 'FISHY'", "one of"),
        camera('model = "FISHY"'),
    ),
    Mistake(
        "one name twice",
        DETECT,
        ("camera.2.name", "'cam0' is the name of camera.1 too", "its own"),
        session(('name = "cam1"', 'name = "cam0"')),
    ),
    Mistake(
        "no such folder",
        DETECT,
        ("root: there is no folder", "elsewhere"),
        head('root = "elsewhere"'),
    ),
    Mistake(
        "a variable that is not set",
        DETECT,
        ("root", "NO_SUCH_VARIABLE is not set"),
        head('root = "${NO_SUCH_VARIABLE}"'),
    ),
    Mistake(
        "a pattern that matches nothing",
        DETECT,
        ("camera.2.masks", "no file matches 'cam1/*.tif'", "3 files", ".png"),
        session(("cam1/*.png", "cam1/*.tif")),
    ),
    Mistake(
        "a pattern in no folder",
        DETECT,
        ("camera.2.masks", "no file matches 'cma1/*.png'", "did you mean 'cam1'"),
        session(("cam1/*.png", "cma1/*.png")),
    ),
    Mistake(
        "a mistyped file",
        DETECT,
        ("camera.2.corners", "no file 'cornres.csv'", "did you mean 'corners.csv'?"),
        both(camera('corners = "cornres.csv"'), written("corners.csv", "")),
    ),
    Mistake(
        "a picture that is none",
        DETECT,
        ("camera.2.masks", "0.png", "not an image", "copy it again"),
        written("cam1/0.png", b""),
    ),
    Mistake(
        "a video that is none",
        DETECT,
        ("camera.2.background", "empty.avi", "not a video"),
        both(videos(), written("empty.avi", "no"), filmed("video.avi")),
    ),
    Mistake(
        "a video and masks",
        DETECT,
        ("camera.2: has both video and masks",),
        camera('video = "video.avi"'),
    ),
    Mistake(
        "a video without the empty scene",
        DETECT,
        ("camera.2: has a video but no background",),
        session(('masks = "cam1/*.png"', 'video = "video.avi"')),
    ),
    Mistake(
        "an empty scene of another size",
        DETECT,
        ("camera.2.background", "'empty.avi' is 80x48", "'video.avi' is 64x48", "same settings"),
        both(videos(), filmed("empty.avi", size_px=(80, 48)), filmed("video.avi")),
    ),
    Mistake(
        "an empty scene that was turned",
        DETECT,
        ("camera.2.background", "48x64", "turned when it was saved", "as the camera wrote them"),
        both(videos(), filmed("empty.avi", size_px=(48, 64)), filmed("video.avi")),
    ),
    Mistake(
        "cameras of two rates",
        DETECT,
        ("'cam1' recorded 25", "'cam2' 50", "ffmpeg"),
        both(
            videos(),
            session(('masks = "cam2/*.png"', 'background = "empty.avi"\nvideo = "quick.avi"')),
            filmed("empty.avi"),
            filmed("video.avi"),
            filmed("quick.avi", rate=50.0),
        ),
    ),
    Mistake(
        "pictures that are missing, and no numbers",
        DETECT,
        ("camera.2.masks", "has 2 frames", "3", "number the pictures"),
        renamed(
            ("cam1/0.png", "cam1/a.png"), ("cam1/1.png", "cam1/b.png"), ("cam1/2.png", "c.png")
        ),
    ),
    Mistake(
        "each camera counts from elsewhere",
        DETECT,
        ("pictures are missing", "cam1/*.png 7 to 8", "number the pictures of one instant alike"),
        renamed(
            ("cam1/0.png", "cam1/7.png"), ("cam1/1.png", "cam1/8.png"), ("cam1/2.png", "c.png")
        ),
    ),
    Mistake(
        "masks of three values",
        DETECT,
        ("'cam1'", "values 0, 128 and 255", "mask_threshold"),
        both(*(drawn(f"cam1/{n}.png", third(0, 128, 255)) for n in range(3))),
    ),
    Mistake(
        "masks that are all one grey",
        DETECT,
        ("'cam1'", "every pixel", "value 90", "mask_threshold"),
        both(*(drawn(f"cam1/{n}.png", grey(90)) for n in range(3))),
    ),
    # The rig.
    Mistake(
        "a rig without a unit",
        DETECT,
        ("rig needs rig_unit", "never guessed"),
        session(('rig_unit = "m"\n', "")),
    ),
    Mistake(
        "a unit that there is not",
        DETECT,
        ("rig_unit", "'furlong'", "'mm'"),
        session(('rig_unit = "m"', 'rig_unit = "furlong"')),
    ),
    Mistake("no such rig", DETECT, ("rig.csv", "there is no such rig file"), removed("rig.csv")),
    Mistake(
        "a rig without a camera",
        DETECT,
        ("rig.csv", "there is no camera 'cam1'", "it has cam0, camera1, cam2"),
        edit("rig.csv", ("cam1,", "camera1,")),
    ),
    Mistake(
        "a row that is cut off",
        DETECT,
        ("rig.csv", "line 2", "expected 12"),
        lambda folder: (folder / "rig.csv").write_text(
            "\n".join(
                line[:40] if line.startswith("cam1") else line
                for line in (folder / "rig.csv").read_text().splitlines()
            )
        ),
    ),
    Mistake(
        "no rig yet",
        DETECT,
        ("session.toml", "there is no rig", "hybridve calibrate", "rig ="),
        session(('rig = "rig.csv"\nrig_unit = "m"\n', "")),
    ),
    Mistake(
        "a rig with y upwards",
        DETECT,
        ("rig.csv", "cam1", "mirrored picture", "flip the pictures"),
        lambda folder: _change_camera(folder, np.diag([1.0, -1.0, 1.0])),
    ),
    Mistake(
        "a camera that looks away",
        DETECT,
        ("nothing can be in the hull", "cam1"),
        lambda folder: _change_camera(folder, np.diag([-1.0, 1.0, -1.0])),
    ),
    # The board.
    Mistake(
        "to calibrate without a board",
        "calibrate S",
        ("session.toml", "neither a [target]", "describe the board"),
        session(('rig = "rig.csv"\nrig_unit = "m"\n', "")),
    ),
    Mistake(
        "a board of no kind",
        "calibrate S",
        ("target.kind", "one of chessboard, charuco, aprilgrid", "'cardboard'"),
        target(("chessboard", "cardboard")),
    ),
    Mistake(
        "a board without its count",
        "calibrate S",
        ("target.columns: this key is missing",),
        target(("columns = 8\n", "")),
    ),
    Mistake(
        "squares in metres", "calibrate S", ("0.03", "mm"), both(target(("= 30", "= 0.03")), STILLS)
    ),
    Mistake(
        "a board that no clip shows",
        "calibrate S",
        ("camera.1", "has no extrinsics", "all cameras see the board at once"),
        target(),
    ),
    Mistake(
        "pictures without a board",
        "calibrate S",
        ("cam0", "8x6 inner corners", "check columns and rows"),
        both(target(), STILLS),
        keeps="rig",
    ),
    Mistake(
        "to check a rig without a board",
        "calibrate S --check S/rig.csv --rig-unit m",
        ("session.toml", "[target]"),
    ),
    Mistake(
        "a board to print that is not described",
        "board S -o S/board.pdf",
        ("session.toml", "target: this table is missing"),
    ),
    Mistake("a board as a picture", "board S -o S/board.png", ("board.png", ".pdf"), status=USAGE),
    # The scene.
    Mistake(
        "no object",
        DETECT,
        ("scene.toml", "object"),
        written("scene.toml", 'format = "hybridve-scene"\nversion = 1\n'),
    ),
    Mistake(
        "an object twice",
        DETECT,
        ("object.2.name", "'cube' is the name of object.1 too", "its own"),
        added("scene.toml", '\n[[object]]\nname = "cube"\nmesh = "cube.obj"\nunit = "mm"\n'),
    ),
    Mistake(
        "no unit",
        DETECT,
        ("object.1.unit", "this key is missing", "OBJ", "never guessed", "m, cm, mm"),
        scene(('unit = "mm"\n', "")),
    ),
    Mistake(
        "a mistyped key of an object",
        DETECT,
        ("object.1.translate: there is no such key", "did you mean translate_mm?"),
        scene(("translate_mm", "translate")),
    ),
    Mistake(
        "no such mesh",
        DETECT,
        ("object.1.mesh", "cbue.obj", "did you mean 'cube.obj'?"),
        scene(("cube.obj", "cbue.obj")),
    ),
    Mistake(
        "a mesh of no kind",
        DETECT,
        ("object.1.mesh", "cube.xyz", ".stl"),
        both(scene(("cube.obj", "cube.xyz")), written("cube.xyz", "1 2 3")),
    ),
    Mistake(
        "a mesh without a triangle",
        DETECT,
        ("object.1.mesh", "cube.obj", "no"),
        written("cube.obj", _PLAIN_CUBE),
    ),
    Mistake(
        "a mesh that is cut off",
        DETECT,
        ("object.1.mesh", "cube.obj", "line"),
        written("cube.obj", f"{_PLAIN_CUBE}f 1 2 9\n"),
    ),
    Mistake(
        "a place that is no number",
        DETECT,
        ("object.1.translate_mm", "finite"),
        scene(("[0.0, 0.0, 0.0]", "[0.0, nan, 0.0]")),
    ),
    Mistake(
        "a clearance below zero",
        DETECT,
        ("required_clearance_mm", "greater than or equal to 0", "-5"),
        scene(('unit = "mm"', 'unit = "mm"\nrequired_clearance_mm = -5')),
    ),
    Mistake(
        "a direction of no length",
        DETECT,
        ("recovery_direction",),
        scene(('unit = "mm"', 'unit = "mm"\nrecovery_direction = [0, 0, 0]')),
    ),
    Mistake(
        "poses without a column",
        DETECT,
        ("object.1.poses", "poses.csv", "qw"),
        both(
            scene(('unit = "mm"', 'unit = "mm"\nposes = "poses.csv"')),
            written("poses.csv", "frame,x,y,z\n0,0,0,0\n"),
        ),
    ),
    Mistake(
        "a quaternion that is none",
        DETECT,
        ("object.1.poses", "poses.csv", "line 2", "length"),
        both(
            scene(('unit = "mm"', 'unit = "mm"\nposes = "poses.csv"')),
            written("poses.csv", "frame,x,y,z,qw,qx,qy,qz\n0,0,0,0,2,0,0,0\n"),
        ),
    ),
    # Effects.
    Mistake("nothing to simulate", SIMULATE, ("scene.toml", "names no effect", "[[effect]]")),
    Mistake(
        "an effect that there is not",
        SIMULATE,
        ("effect.1.kind", "no effect 'rigidd'", "rigid"),
        effect('kind = "rigidd"'),
    ),
    Mistake(
        "an effect on an object that there is not",
        SIMULATE,
        ("effect.1.object", "'door'", "cube"),
        effect('kind = "rigid"\nobject = "door"\nmass_kg = 1'),
    ),
    Mistake(
        "a body without a mass",
        SIMULATE,
        ("effect.1", "mass_kg", "density_kg_m3"),
        effect('kind = "rigid"\nobject = "cube"'),
    ),
    Mistake(
        "two effects on one object",
        SIMULATE,
        ("cube", "effect"),
        both(
            effect('kind = "rigid"\nobject = "cube"\nmass_kg = 1'),
            effect('kind = "rigid"\nobject = "cube"\nname = "again"\nmass_kg = 1'),
        ),
    ),
    Mistake(
        "zones that ascend",
        SIMULATE,
        ("effect.1.zones_mm", "does not descend", "outermost zone first"),
        effect('kind = "proximity"\nobject = "cube"\nzones_mm = [50, 100]'),
    ),
    # Other commands.
    Mistake(
        "to move an object that there is not",
        "spacing S --scene SCENE --move door --along 0,0,1 --range-mm 0:50",
        ("no object 'door' to move", "the scene has cube"),
    ),
    Mistake(
        "a range backwards",
        "spacing S --scene SCENE --move cube --along 0,0,1 --range-mm 50:0",
        ("--range-mm 50:0 goes backwards", "A below B"),
    ),
    Mistake(
        "a direction that points nowhere",
        "spacing S --scene SCENE --move cube --along 0,0,0 --range-mm 0:50",
        ("--along 0,0,0 points nowhere", "direction"),
    ),
    Mistake(
        "a direction of two numbers",
        "spacing S --scene SCENE --move cube --along 0,1 --range-mm 0:50",
        ("'0,1' is not X,Y,Z", "1,0,0"),
        status=USAGE,
    ),
    Mistake("no such report", "summary S/no.h5", ("no.h5", "there is no such report")),
    Mistake(
        "no such report to export",
        "export S/no.h5 --html S/p.html",
        ("no.h5", "there is no such report"),
    ),
    Mistake(
        "a report to export that is none",
        "export SCENE --csv S/tables",
        ("scene.toml", "not a readable report"),
    ),
    Mistake(
        "a page that exists",
        "export S/no.h5 --html S/p.html",
        ("p.html", "exists already", "--overwrite"),
        written("p.html", "mine"),
    ),
    Mistake(
        "a page of another kind",
        "export S/no.h5 --html S/p.pdf",
        ("p.pdf", "pages are .html"),
        status=USAGE,
    ),
    Mistake(
        "a hull to export without its session",
        "export S/no.h5 --hull-mesh S/hulls",
        ("--hull-mesh needs --session SESSION", "a report holds no hull"),
        status=USAGE,
    ),
    Mistake("a report that is none", "summary SCENE", ("scene.toml", "not a readable report")),
    Mistake(
        "silhouettes that are damaged",
        DETECT,
        ("silhouettes.h5", "hybridve segment --overwrite"),
        written("silhouettes.h5", "no"),
    ),
    Mistake(
        "a picture that render cannot write",
        "render S --scene SCENE -o S/p.gif",
        ("p.gif", ".png or .jpg"),
        status=USAGE,
    ),
    Mistake(
        "a rig without a unit to convert",
        "convert S/rig.csv --to json --image-size 160x120 -o S/rig.json",
        ("rig.csv", "csv does not say the unit", "one of m, cm, mm"),
    ),
    Mistake(
        "a rig without image sizes to convert",
        "convert S/rig.csv --from-unit m --to json -o S/rig.json",
        ("rig.csv", "image size of camera 'cam0'", "width x height in pixels"),
    ),
    Mistake(
        "no such rig to convert",
        "convert S/no.json --to csv -o S/r.csv",
        ("no.json", "there is no such rig file"),
    ),
    Mistake(
        "a preset that there is not", "synth castle -o S/castle", ("no preset 'castle'", "boxes")
    ),
    Mistake(
        "a sweep that descends",
        "sweep S --scene SCENE --viewport 8,4 -o OUT",
        ("'8,4' is not ascending", "4,8,16"),
        status=USAGE,
    ),
    Mistake(
        "to begin where a session stands",
        "init S",
        ("session.toml", "exists already", "move it away"),
    ),
    Mistake(
        "to begin in no folder",
        "init S/nowhere",
        ("nowhere", "there is no such folder", "name one"),
    ),
)


def _change_camera(folder: Path, turn: np.ndarray) -> None:
    """Turn what the second camera of the rig sees, (3, 3), about its centre."""
    path = folder / "rig.csv"
    pinhole = np.array([[150.0, 0, 80], [0, 150.0, 60], [0, 0, 1]])
    rows = []
    for line in path.read_text(encoding="utf-8").splitlines():
        name, *numbers = line.split(",")
        matrix = np.array([float(number) for number in numbers]).reshape(3, 4)
        if name == "cam1":
            matrix = pinhole @ turn @ np.linalg.inv(pinhole) @ matrix
        rows.append(",".join([name, *map(repr, map(float, matrix.ravel()))]))
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")
