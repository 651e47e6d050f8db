"""A session.toml and a scene.toml begun from what lies in a folder.

Names decide: folders and files called ``cam2/background.avi``, ``masks/left/*.png`` or
``left_calib_*.jpg`` say which camera and what for; pictures of two values are masks. What names do
not say stands in the file as a comment, with what belongs there. What nobody can know from files,
the board and the units of CAD, stands as a word that no session and no scene takes: loading fails
by that key until it is filled in.
"""

import fnmatch
import glob
import json
import re
import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from hybridve.calib.errors import SessionError
from hybridve.calib.files import write_whole
from hybridve.calib.image_io import FrameSource, natural_order, read_raw
from hybridve.hull.cad.readers import FORMATS, WITH_UNIT

#: Endings of pictures and videos that are looked for.
_IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".webp")
_VIDEOS = (".avi", ".mp4", ".mov", ".mkv", ".m4v", ".mpg", ".mpeg", ".webm", ".mts")

#: Folders below the one that is searched.
_DEEPEST = 4

#: Words in names, by what they stand for; the first that a name has decides.
_WORDS = {
    "intrinsics": ("intrinsics", "intrinsic", "intr", "lens", "stills"),
    "masks": ("masks", "mask", "silhouettes", "silhouette", "sil", "matte", "seg", "fg"),
    "background": ("background", "backgrounds", "bg", "bgd", "empty", "clean", "plate"),
    "extrinsics": (
        *("extrinsics", "extrinsic", "extr", "board", "boards", "checkerboard", "chessboard"),
        *("charuco", "aprilgrid", "april", "calib", "calibration", "cal", "target"),
    ),
    "video": ("video", "videos", "take", "task", "recording", "rec", "clip", "motion", "action"),
}

#: Words that say nothing.
_EMPTY_WORDS = ("frames", "frame", "images", "image", "img", "pictures", "picture", "rgb", "data")

#: What belongs under each key that was not found.
_WANTED = {
    "intrinsics": "the board in this camera alone: stills (a pattern with *) or a clip; optional",
    "extrinsics": "the board, seen by all cameras at once: a clip, or stills numbered alike",
    "background": "the empty scene, recorded as the task is",
    "video": 'the task; or masks = "..." for ready silhouettes',
}

#: What stands where only the user knows.
FILL_IN = "FILL IN"


@dataclass(frozen=True, slots=True)
class Find:
    """Pictures or a video that belong together.

    Attributes
    ----------
    pattern : str
        As a session names them, relative to the folder.
    paths : tuple of Path
        The files.
    camera : str
        What their names leave for the camera's; "" if nothing.
    role : str
        The key that they belong under; "" where nothing tells.
    """

    pattern: str
    paths: tuple[Path, ...]
    camera: str
    role: str

    @property
    def is_video(self) -> bool:
        """Whether it is a video."""
        return self.paths[0].suffix.lower() in _VIDEOS


@dataclass(frozen=True, slots=True)
class Survey:
    """What lies in a folder.

    Attributes
    ----------
    folder : Path
        Which.
    cameras : dict of str to dict of str to Find
        By camera and key; under "" pictures of which nothing tells what they are for.
    left : tuple of Find
        What belongs to no camera, or is one too many.
    cad : tuple of Path
        CAD files.
    rig : str
        A rig that lies there; "" if none does.
    rate_hz : float or None
        Frames a second of the recordings, if they say.
    """

    folder: Path
    cameras: dict[str, dict[str, Find]] = field(default_factory=dict)
    left: tuple[Find, ...] = ()
    cad: tuple[Path, ...] = ()
    rig: str = ""
    rate_hz: float | None = None


def write_drafts(folder: Path) -> tuple[Survey, tuple[Path, Path]]:
    """Write a session.toml and a scene.toml from what lies in a folder; return it and the files.

    Raises
    ------
    SessionError
        If there is no such folder, one of the files is there already, or they cannot be written.
    """
    if not folder.is_dir():
        raise SessionError(f"{folder}: there is no such folder; name one that holds a recording")
    session, scene = folder / "session.toml", folder / "scene.toml"
    for path in (session, scene):
        if path.exists():
            raise SessionError(
                f"{path}: exists already, and init writes over nothing; edit it, or move it away"
            )
    found = survey(folder)
    try:
        for path, text in ((session, session_text(found)), (scene, scene_text(found))):
            write_whole(path, text)
    except OSError as error:
        raise SessionError(f"{path}: cannot be written: {error.strerror}") from error
    return found, (session, scene)


# --- What lies there --------------------------------------------------------------------------


def survey(folder: Path) -> Survey:
    """Return what lies in a folder and those below it."""
    files = _files_below(folder)
    named = [(_words_of(folder, paths), paths) for paths in _sets_of(files)]
    # Where folders have names of their own, they are the cameras'; else those of files are.
    by_folder = len({words.folder for words, _ in named if words.folder}) > 1
    finds = [
        Find(
            _pattern(folder, paths, files),
            tuple(paths),
            (by_folder and words.folder) or words.file or words.folder,
            _role(words.role, paths),
        )
        for words, paths in named
    ]
    cameras: dict[str, dict[str, Find]] = {}
    left = []
    for find in sorted(finds, key=lambda one: natural_order(one.pattern)):
        table = cameras.setdefault(find.camera or "camera", {})
        if find.role in table or {find.role, *table} >= {"video", "masks"}:
            left.append(find)
        else:
            table[find.role] = find
    for name in [name for name in cameras if _is_no_camera(name, cameras)]:
        left += cameras.pop(name).values()
    own = folder / "rig" / "rig.json"
    rigs = [path for path in files if path.name in ("rig.json", "rig.csv") and path != own]
    return Survey(
        folder,
        cameras,
        tuple(left),
        tuple(path for path in files if path.suffix.lower() in FORMATS),
        rigs[0].relative_to(folder).as_posix() if rigs else "",
        _rate(cameras.values()),
    )


def _is_no_camera(name: str, cameras: dict[str, dict[str, Find]]) -> bool:
    """Tell whether what looks like a camera has nothing of what any of several others has."""
    others = [keys for other, keys in cameras.items() if other != name]
    return len(others) > 1 and not any(set(cameras[name]) & set(keys) for keys in others)


def _files_below(folder: Path) -> list[Path]:
    """Return files, as people count, without hidden ones and what hybridve itself leaves."""
    found = []
    for path in folder.rglob("*"):
        parts = path.relative_to(folder).parts
        if len(parts) > _DEEPEST + 1 or any(part.startswith(".") for part in parts):
            continue
        if path.is_file():
            found.append(path)
    return sorted(found, key=lambda path: natural_order(path.relative_to(folder).as_posix()))


def _sets_of(files: Sequence[Path]) -> list[list[Path]]:
    """Return videos one by one, and images by folder, ending and name without its last number."""
    sets: dict[tuple[Path, str, str], list[Path]] = {}
    for path in files:
        ending = path.suffix.lower()
        if ending in _VIDEOS:
            sets[path, "", ""] = [path]
        elif ending in _IMAGES:
            sets.setdefault((path.parent, _without_counter(path.stem), ending), []).append(path)
    return list(sets.values())


def _without_counter(stem: str) -> str:
    """Return a name without the number at its end.

    Examples
    --------
    >>> _without_counter("left_007"), _without_counter("12"), _without_counter("empty")
    ('left_', '', 'empty')
    """
    return re.sub(r"\d+$", "", stem)


@dataclass(frozen=True, slots=True)
class _Words:
    """What names say: a key, and what is left of those of the folders and of the file."""

    role: str
    folder: str
    file: str


def _words_of(folder: Path, paths: list[Path]) -> _Words:
    first = paths[0].relative_to(folder)
    name = first.stem if len(paths) == 1 else _without_counter(first.stem)
    known = {word: role for role, words in _WORDS.items() for word in words}

    def tokens(text: str) -> list[str]:
        return [token for token in re.split(r"[_\-. /]+", text) if token]

    def own(text: str) -> str:
        return "_".join(
            token for token in tokens(text) if token.lower() not in (*known, *_EMPTY_WORDS)
        )

    said = {known.get(token.lower()) for token in tokens(f"{first.parent.as_posix()}/{name}")}
    role = next((role for role in _WORDS if role in said), "")
    return _Words(role, own(first.parent.as_posix()), own(name))


def _role(said: str, paths: list[Path]) -> str:
    """Return the key that files belong under, by what their names say and what they hold."""
    is_video = paths[0].suffix.lower() in _VIDEOS
    if said in ("", "video") and not is_video and _are_masks(paths):
        return "masks"
    return said or ("video" if is_video else "")


def _pattern(folder: Path, paths: list[Path], files: Sequence[Path]) -> str:
    """Return what a session says to mean these files, and no others beside them."""
    first = paths[0].relative_to(folder)
    if len(paths) == 1:
        return first.as_posix()
    beside = [path for path in files if path.parent == paths[0].parent]
    start = glob.escape(_without_counter(first.stem))
    for middle in ("*", "[0-9]*"):
        last = f"{start}{middle}{first.suffix}"
        meant = [path for path in beside if fnmatch.fnmatchcase(path.name, last)]
        if len(meant) <= len(paths):
            break
    return (Path(glob.escape(first.parent.as_posix())) / last).as_posix()


def _are_masks(paths: list[Path]) -> bool:
    """Tell whether the first and the middle picture have two values at most, and together two."""
    values: set[int] = set()
    for path in {paths[0], paths[len(paths) // 2]}:
        try:
            image = read_raw(path)
        except SessionError:
            return False
        values.update(np.unique(image if image.ndim == 2 else image[..., :3].max(axis=2)).tolist())
    return len(values) == 2


def _rate(tables: Iterable[dict[str, Find]]) -> float | None:
    rates = []
    for table in tables:
        find = table.get("video") or table.get("masks")
        if find is not None and find.is_video:
            try:
                rates.append(FrameSource(find.pattern, find.paths, is_video=True).rate())
            except SessionError:
                continue
    known = [rate for rate in rates if rate is not None]
    return statistics.median(known) if known else None


# --- What is written --------------------------------------------------------------------------


def session_text(found: Survey) -> str:
    """Return the session.toml."""
    lines = [
        "# Begun by `hybridve init` from the names of what lies here: read it through.",
        "# What only you know stands as FILL IN; `hybridve check` looks at the rest.",
        'format = "hybridve-session"',
        "version = 1",
        'root = "."                     # where the paths below start',
    ]
    if found.rate_hz is None:
        lines.append("# fps = 50                     # frames a second: pictures do not say")
    else:
        lines.append(f"# fps = {found.rate_hz:g}    # frames a second, as the videos say")
    has_boards = any({"extrinsics", "intrinsics"} & set(one) for one in found.cameras.values())
    lines += ["", *_calibration(found, has_boards=has_boards)]
    for name, table in found.cameras.items():
        lines += ["", "[[camera]]", f"name = {_quoted(name)}"]
        if "" in table:
            find = table[""]
            lines.append(
                f"# extrinsics = {_quoted(find.pattern)}    # or intrinsics, background, video, "
                f"masks? {_counted(len(find.paths), 'picture')}"
            )
        for key in ("intrinsics", "extrinsics", "background", "video", "masks"):
            if key in table:
                find = table[key]
                kind = "a video" if find.is_video else _counted(len(find.paths), "picture")
                lines.append(f"{key} = {_quoted(find.pattern)}    # {kind}")
            elif key in _WANTED and not _is_needless(key, table, found):
                lines.append(f'# {key} = ""    # {_WANTED[key]}')
    if not found.cameras:
        lines += [
            "",
            "# No camera's pictures or videos were found. For each camera:",
            "# [[camera]]",
            '# name = "cam1"',
            *(f'# {key} = ""    # {what}' for key, what in _WANTED.items()),
        ]
    if found.left:
        lines += ["", "# Found as well, and not known what for:"]
        lines += [
            f"#   {find.pattern}    "
            + ("a video" if find.is_video else _counted(len(find.paths), "picture"))
            for find in found.left
        ]
    return "\n".join(lines) + "\n"


def _calibration(found: Survey, *, has_boards: bool) -> list[str]:
    """Return the lines on where the cameras' places come from: a rig, or a board."""
    if found.rig and not has_boards:
        unit = [] if found.rig.endswith("rig.json") else [f'rig_unit = "{FILL_IN}"    # m, mm, ...']
        return [f"rig = {_quoted(found.rig)}    # made elsewhere", *unit]
    if not has_boards:
        return [
            "# Where the cameras stand comes from a rig made elsewhere:",
            '# rig = ""          # rig.json, a COLMAP model, OpenCV files, rows of matrices',
            '# rig_unit = "m"    # unless it is a rig.json',
            "# or from a board: a [target], and extrinsics for each camera.",
        ]
    return [
        "[target]                       # the board; count and measure it",
        f'kind = "{FILL_IN}"               # chessboard, charuco or aprilgrid',
        "# columns = 8                  # chessboard: corners inside; charuco: squares; aprilgrid:",
        "# rows = 6                     #   tags",
        "# square_mm = 100              # side of a square, measured on the print",
        '# marker_mm = 75               # charuco alone, and dictionary = "DICT_4X4_1000"',
        "# tag_mm = 80                  # aprilgrid alone, with gap_mm in place of square_mm",
    ]


def _is_needless(key: str, table: dict[str, Find], found: Survey) -> bool:
    """Tell whether a camera lacks nothing where it lacks a key."""
    if key in ("background", "video") and "masks" in table:
        return True
    return key in ("intrinsics", "extrinsics") and bool(found.rig)


def scene_text(found: Survey) -> str:
    """Return the scene.toml."""
    lines = [
        "# Begun by `hybridve init`: the CAD, and where it stands in the world of the cameras.",
        "# `hybridve check --scene` tells each part's size, and whether the cameras see it.",
        'format = "hybridve-scene"',
        "version = 1",
    ]
    taken: set[str] = set()
    for path in found.cad:
        name = re.sub(r"[/\\\"'\x00-\x1f]", "_", path.stem).strip(" .") or "part"
        while name in taken:
            name += "_2"
        taken.add(name)
        has_unit = FORMATS[path.suffix.lower()] in WITH_UNIT
        lines += [
            "",
            "[[object]]",
            f"name = {_quoted(name)}",
            f"mesh = {_quoted(path.relative_to(found.folder).as_posix())}",
            '# unit = "mm"                  # the file says its unit itself'
            if has_unit
            else f'unit = "{FILL_IN}"                # m, cm, mm, in or ft: the file does not say',
            "# translate_mm = [0, 0, 0]     # where it stands",
            "# rotate_deg = [0, 0, 0]       # turned about x, then y, then z",
            "# required_clearance_mm = 5    # how far real things are to keep away",
        ]
    if not found.cad:
        lines += [
            "",
            "# No CAD file was found. For each:",
            "# [[object]]",
            '# name = "part"',
            f'# mesh = "part.stl"            # {", ".join(dict.fromkeys(FORMATS.values()))}',
            '# unit = "mm"',
        ]
    return "\n".join(lines) + "\n"


def _quoted(text: str) -> str:
    """Return a text as TOML quotes it."""
    return json.dumps(text, ensure_ascii=False)


def _counted(count: int, what: str) -> str:
    return f"{count} {what}" if count == 1 else f"{count} {what}s"
