"""Inputs that are nearly right, for every reader: what may come of them is a value or one line."""

import random
import resource
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from helpers import mesh_files
from helpers.clash_reports import Spot, write_clash_report
from helpers.sessions import write_ball_session, write_cube_scene
from hybridve.calib.boards.corner_files import read_corners
from hybridve.calib.camera import Camera
from hybridve.calib.errors import HybridveError
from hybridve.calib.formats.rig_export import export_rig
from hybridve.calib.formats.rigs import read_any_rig
from hybridve.calib.formats.tracker import read_angles, read_poses
from hybridve.calib.image_io import read_image, read_raw
from hybridve.calib.provenance import MadeElsewhere
from hybridve.calib.rig import Rig
from hybridve.hull.cad.mesh import read_cad
from hybridve.hull.cad.scene import load_scene
from hybridve.hull.capture.session import load_session
from hybridve.hull.capture.silhouette_io import SilhouetteReader, SilhouetteWriter
from hybridve.hull.report.ledger import read_ledger
from hybridve.hull.report.read import read_report
from hybridve.hull.report.summarize import summarize
from hybridve.hull.units import load_batch

#: Numbers that break what trusts them.
_MAGIC = (
    *(b"\0\0\0\0", b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f", b"\0\0\0\x80", b"\1\0\0\0"),
    *(b"nan", b"inf", b"1e308", b"-1e308", b"1e-320", b"-1", b"0", b"4294967296", b"9" * 400),
    *(b"{", b"}", b"[", b"]", b'"', b"'", b"<", b"/>", b"\n", b"\r", b"\0", b"\xff", b"\\"),
    *(b"../", b"/etc/passwd", b"${HOME}", b"%s", b"\xc3\x28", b"\x1b[2J", b"&a *a", b"!!python"),
)


@dataclass(frozen=True)
class Reader:
    """What reads a kind of file.

    Attributes
    ----------
    name : str
        The file's name: readers go by suffixes.
    read : callable
        Reads it.
    seed : bytes
        A file that is right.
    in_libraries : bool
        Whether libraries read it that may crash: such are asked in a process that may die.
    """

    name: str
    read: Callable[[Path], object]
    seed: bytes
    in_libraries: bool = False


def mutated(content: bytes, rng: random.Random) -> bytes:
    """Return a file that differs in a few places."""
    found = bytearray(content)
    for _ in range(1 + int(rng.expovariate(0.7))):
        at = rng.randrange(len(found) + 1)
        what = rng.randrange(7)
        if what == 0 and found:
            found[at % len(found)] ^= 1 << rng.randrange(8)
        elif what == 1 and found:
            found[at % len(found)] = rng.randrange(256)
        elif what == 2:
            found[at:at] = rng.choice(_MAGIC)
        elif what == 3:
            magic = rng.choice(_MAGIC)
            found[at : at + len(magic)] = magic
        elif what == 4:
            del found[at : at + rng.choice((1, 2, 8, 64, 1024))]
        elif what == 5:
            length = rng.choice((1, 8, 64, 512))
            begin = rng.randrange(len(found) + 1)
            found[at:at] = found[begin : begin + length]
        else:
            del found[at:]
    return bytes(found)


def readers(folder: Path) -> list[Reader]:
    """Return all readers, with what they need beside them, in a folder."""
    session = write_ball_session(folder, np.zeros((1, 3)), n_cameras=2)
    scene = write_cube_scene(folder, {"cube": (0.0, 0.0, 0.0)})
    pose = np.column_stack([np.eye(3), [0.1, 0.2, 3.0]])
    lens = np.array([500.0, 500.0, 320.0, 240.0, 0.1, 0.01, 0.0, 0.0])
    rig = Rig(
        tuple(Camera(f"cam{number}", "OPENCV", 640, 480, lens, pose) for number in range(2)),
        MadeElsewhere({"method": "drawn"}),
    )
    found = [
        Reader("session.toml", load_session, session.read_bytes()),
        Reader("scene.toml", load_scene, scene.read_bytes()),
        Reader(
            "night.toml",
            load_batch,
            b'format = "hybridve-batch"\nversion = 1\nsessions = ["s*"]\nscenes = ["scene.toml"]\n'
            b'output = "out"\n[options]\nviewport = 4\n[[exception]]\nsession = "*"\n',
        ),
        Reader(
            "r.clashes.toml", read_ledger, b'format = "hybridve-clashes"\nversion = 1\n[runs]\n'
        ),
        Reader(
            "poses.csv", read_poses, b"frame,x,y,z,qw,qx,qy,qz\n0,1,2,3,1,0,0,0\n1,1,2,3,0,1,0,0\n"
        ),
        Reader("angles.csv", read_angles, b"frame,angle_deg\n0,1\n1,2.5\n"),
        Reader("corners.csv", read_corners, b"x,y\n1.5,2.5\n3,4\n"),
    ]

    def any_rig(path: Path) -> object:
        return read_any_rig(path, unit="m", image_sizes=(640, 480), square_m=0.1)

    for to, name in (
        *(("json", "rig.json"), ("csv", "rig_rows.csv"), ("caliscope", "caliscope.toml")),
        *(("aniposelib", "anipose.toml"), ("kalibr", "chain.yaml"), ("multical", "multical.json")),
    ):
        plain = rig
        if to == "csv":
            plain = Rig(
                tuple(Camera(c.name, "PINHOLE", 640, 480, lens[:4], pose) for c in rig.cameras),
                rig.provenance,
            )
        export_rig(plain, to, folder / "seed", unit="m")
        found.append(Reader(name, any_rig, (folder / "seed").read_bytes()))
    for suffix in ("xml", "yml", "json"):
        export_rig(rig.only(["cam0"]), "opencv", folder / f"seed.{suffix}", unit="m")
        content = (folder / f"seed.{suffix}").read_bytes()
        found.append(Reader(f"storage.{suffix}", any_rig, content, in_libraries=True))
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    faces = [(0, 2, 1), (0, 1, 3), (1, 2, 3), (2, 0, 3)]
    found += [
        Reader(name, read_cad, write(vertices, faces))
        for name, write in (
            *(("a.obj", mesh_files.obj), ("t.stl", mesh_files.text_stl)),
            *(("b.stl", mesh_files.binary_stl), ("a.off", mesh_files.off)),
            *(("t.ply", mesh_files.text_ply), ("b.ply", mesh_files.little_ply)),
            *(("a.dae", mesh_files.polylist_dae), ("t.fbx", mesh_files.text_fbx)),
            *(("b.fbx", mesh_files.fbx_7500), ("a.3mf", mesh_files.packed_3mf)),
        )
    ]
    picture = np.arange(48 * 64 * 3, dtype=np.uint8).reshape(48, 64, 3)
    for suffix in ("png", "jpg", "bmp", "tif", "pgm", "webp"):
        shown = picture[..., 0] if suffix == "pgm" else picture
        content = cv2.imencode(f".{suffix}", shown)[1].tobytes()
        found.append(Reader(f"1.{suffix}", read_image, content, in_libraries=True))
        found.append(Reader(f"mask.{suffix}", read_raw, content, in_libraries=True))
    write_clash_report(folder / "seed.h5", [[Spot((0.1, 0.2, 0.3))], []])
    found.append(
        Reader(
            "report.h5",
            lambda path: summarize(read_report(path)),
            (folder / "seed.h5").read_bytes(),
            in_libraries=True,
        )
    )
    with SilhouetteWriter(folder / "seed2.h5", ["a"], [(16, 8)], "stamp") as writer:
        writer.append([np.ones((8, 16), np.uint8)])

    def silhouettes(path: Path) -> object:
        with SilhouetteReader(path) as stored:
            return [stored.frame(index) for index in range(min(stored.n_frames, 4))]

    content = (folder / "seed2.h5").read_bytes()
    found.append(Reader("silhouettes.h5", silhouettes, content, in_libraries=True))
    return found


def complaint(reader: Reader, path: Path) -> str:
    """Return what is wrong with how a file is read; empty if nothing is."""
    started = time.monotonic()
    try:
        reader.read(path)
    except HybridveError as error:
        if not error.lines or any("\n" in line or not line for line in error.lines):
            return f"not in lines: {error.args!r}"
    except Exception as error:  # a traceback, for whoever gave the file
        return f"{type(error).__name__}: {error}"[:300]
    took_s = time.monotonic() - started
    return f"took {took_s:.1f} s" if took_s > 5.0 else ""


def tried(reader: Reader, folder: Path, count: int, seed: int) -> Iterator[tuple[bytes, str]]:
    """Yield files that are nearly right, each with what is wrong with how it is read."""
    rng = random.Random(f"{reader.name} {seed}")
    place = folder / reader.name
    before = place.read_bytes() if place.exists() else None
    try:
        for _ in range(count):
            content = mutated(reader.seed, rng)
            place.write_bytes(content)
            with np.errstate(all="ignore"):
                yield content, complaint(reader, place)
    finally:
        if before is not None:
            place.write_bytes(before)


def bound_memory(most_b: int) -> None:
    """Take no more memory than that from here on."""
    resource.setrlimit(resource.RLIMIT_AS, (most_b, most_b))
