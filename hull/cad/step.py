"""STEP files through OpenCASCADE (cascadio): parts in metres, and how far off their surface.

A STEP file is made of curved surfaces, which become triangles here. OpenCASCADE takes a tolerance
for that and does not keep it: on free-form faces triangles were found 0.22 mm off where 0.1 mm was
asked for, and 0.06 mm where 0.0125 mm was; on some faces it keeps the angle of chords alone. So it
is asked for half, and each part is measured both ways against itself at a quarter of that tolerance
and of that angle; if it is still not as close as it should be, once more finer. What is measured is
an *estimate*, not a bound: distances are taken at many points, and from triangles too, not from the
surface itself. The distance of those from the surface is a third of what is measured, if
OpenCASCADE is as far off in both as their tolerances are apart; that third is added. A part that
had to be made finer counts as half as far off as it was before at least: on faces whose edges do
not lie on them, triangles come no closer however fine they are, and differ less than they are off.

OpenCASCADE leaves out what it cannot understand, now and then without a word: a damaged face, a
part without geometry. So a file is refused that names what is not in it, of which a part came out
empty, about which OpenCASCADE speaks of errors, or that has lost faces and a gap where they were.
Of a product that is placed several times each copy counts; where faces are then missing among what
is different, that is no proof, and is said.
"""

import dataclasses
import json
import math
import re
import subprocess
import sys
import tempfile
from importlib.metadata import version
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.cad.gltf import parse_gltf
from hybridve.hull.cad.part import Contents, Part, join_parts
from hybridve.hull.cad.topology import examine_topology, widest_gap

#: Chords of an arc turn by this at most, whatever the tolerance: a small hole stays round.
ANGLE_RAD = 0.5

#: Shares of the tolerance and of the angle that OpenCASCADE is asked for, until all parts are close
#: enough.
_SHARES = ((1 / 2, 1.0), (1 / 8, 1 / 2))

#: How much finer a part is, in tolerance and angle, that another is measured against.
_FINER = 4

#: What is added to a measured distance, as a share of it: see the head of this file.
_LEFT_OUT = 1 / 3

#: How many points of each part are measured at most, about.
_N_MEASURED = 50_000

#: Runs by itself, because OpenCASCADE talks on stdout, where our results go, and because a damaged
#: file may end the process that reads it. cascadio would import trimesh, for nothing we need.
_CONVERT = """
import json, sys
sys.modules["trimesh"] = None
import cascadio
source, jobs = sys.argv[1], json.loads(sys.argv[2])
for target, linear_mm, angle_rad, merge in jobs:
    if cascadio.step_to_glb(source, target, linear_mm, angle_rad, False, merge, False):
        sys.exit(1)
"""


def parse_step(content: bytes, tessellation_m: float) -> Contents:
    """Return the parts of a STEP file in metres, named after their products, not their places.

    Each says by `Part.off_by_m` how far it is from its surface: an estimate, at most
    `tessellation_m` unless OpenCASCADE comes no closer, which `Contents.notes` says then.

    Raises
    ------
    ValueError
        If the file is damaged, or something in it did not become triangles.
    """
    version("cascadio")  # raises here, where the package can be named, if it is not there
    n_faces = _count_faces(content)
    parts: tuple[Part, ...] = ()
    worst = np.inf
    for share, angle_share in _SHARES:
        asked_m, angle_rad = share * tessellation_m, angle_share * ANGLE_RAD
        merged = [(asked_m, angle_rad, True), (asked_m / _FINER, angle_rad / _FINER, True)]
        found, finer = (_parts(glb) for glb in _convert(content, merged))
        parts = _not_much_better(_measured(found, finer), parts)
        worst = max((part.off_by_m for part in parts), default=0.0)
        if worst <= tessellation_m:
            break
    notes: tuple[str, ...] = ()
    if not all(examine_topology(part.vertices, part.faces).closed for part in parts):
        parts, notes = _without_lost_faces(parts, content, n_faces, tessellation_m)
    if worst > tessellation_m:
        notes += (
            f"OpenCASCADE comes no closer to its surfaces than {worst * 1000:.3g} mm, where "
            f"{tessellation_m * 1000:g} mm was asked for",
        )
    return Contents(parts, "of the file", 1.0, "z", notes=notes)


def _count_faces(content: bytes) -> int:
    """Return how many faces the shells of a file have.

    Raises
    ------
    ValueError
        If it names an entity that is not in it.
    """
    text = re.sub(rb"/\*.*?\*/", b"", re.sub(rb"'(?:[^']|'')*'", b"''", content), flags=re.DOTALL)
    data = text.partition(b"DATA")[2]
    there = set(re.findall(rb"#(\d+)\s*=", data))
    missing = set(re.findall(rb"#(\d+)", data)) - there
    if there and missing:
        first = min(int(name) for name in missing)
        raise ValueError(f"it names #{first}, and there is no such entity; export it again")
    shells = re.findall(rb"=\s*(?:CLOSED|OPEN)_SHELL\s*\([^(]*\(([^)]*)\)", data)
    return sum(shell.count(b"#") for shell in shells)


def _convert(content: bytes, jobs: list[tuple[float, float, bool]]) -> list[bytes]:
    """Return a GLB for each tolerance in metres and radians, parts in one piece or face by face."""
    with tempfile.TemporaryDirectory(prefix="hybridve-") as folder:
        source = Path(folder, "part.step")
        source.write_bytes(content)
        targets = [Path(folder, f"{number}.glb") for number in range(len(jobs))]
        rows = [
            (str(target), linear_m * 1000.0, angle_rad, merge)
            for target, (linear_m, angle_rad, merge) in zip(targets, jobs, strict=True)
        ]
        done = subprocess.run(
            [sys.executable, "-P", "-c", _CONVERT, str(source), json.dumps(rows)],
            capture_output=True,
            text=True,
            errors="replace",
            check=False,
        )
        converted = [target.read_bytes() if target.is_file() else b"" for target in targets]
    talk = done.stdout + done.stderr
    if done.returncode != 0 or not all(converted) or re.search(r"\bERR\b", talk):
        raise ValueError(f"OpenCASCADE says: {_complaint(talk)}")
    skipped = re.search(r"skipped node '([^']*)' without geometry", talk)
    if skipped is not None and any(parse_gltf(glb, {}).parts for glb in converted):
        raise ValueError(
            f"its part {skipped[1]!r} came out of OpenCASCADE without geometry; it is damaged, or "
            "holds no surface: export it again without that part"
        )
    return converted


def _complaint(talk: str) -> str:
    """Return what OpenCASCADE found wrong, in one line."""
    lines = [re.sub(r"\x1b\[[0-9;]*m|\*{2,}|\s+", " ", line).strip() for line in talk.splitlines()]
    errors = [line for line in lines if "ERR" in line] or [line for line in lines if line]
    return re.sub(r"^ERR\s*", "", errors[0]) if errors else "it gives no reason; export it again"


def _parts(glb: bytes) -> tuple[Part, ...]:
    contents = parse_gltf(glb, {}, name_by_mesh=True)
    # Colours come as materials without names, which the conversion numbers. What single precision
    # leaves of coordinates is part of what is measured.
    return tuple(dataclasses.replace(part, material="", rounding=0.0) for part in contents.parts)


def _without_lost_faces(
    parts: tuple[Part, ...], content: bytes, n_faces: int, tessellation_m: float
) -> tuple[tuple[Part, ...], tuple[str, ...]]:
    """Return parts that are not all closed, and a sentence on faces that are missing.

    OpenCASCADE leaves out faces that are too narrow for it. Where the gap is no wider than the
    tolerance, it belongs to what a part is off by.

    Raises
    ------
    ValueError
        If faces are missing and leave a wider gap.
    """
    (glb,) = _convert(content, [(tessellation_m, ANGLE_RAD, False)])
    document = json.loads(glb[20 : 20 + int.from_bytes(glb[12:16], "little")])
    meshes = [(mesh.get("name"), mesh["primitives"]) for mesh in document.get("meshes", [])]
    n_found = sum(len(primitives) for _, primitives in meshes)
    if n_found >= n_faces:
        bounds = [str(accessor.get("max")) for accessor in document["accessors"]]
        alike = {
            (name, *(bounds[entry["attributes"]["POSITION"]] for entry in primitives))
            for name, primitives in meshes
        }
        n_alike = sum(len(key) - 1 for key in alike)
        if n_alike >= n_faces:
            return parts, ()
        return parts, (
            f"{n_alike} of its {n_faces} faces are different ones among its triangles, and it is "
            "not closed: look whether a face is missing",
        )
    gaps_m = [widest_gap(part.vertices, part.faces, tessellation_m) for part in parts]
    lost = f"{n_faces - n_found} of its {n_faces} faces did not become triangles"
    if max(gaps_m) > tessellation_m:
        raise ValueError(f"{lost}, and it is not closed without them; export it again")
    parts = tuple(
        dataclasses.replace(part, off_by_m=max(part.off_by_m, gap_m))
        for part, gap_m in zip(parts, gaps_m, strict=True)
    )
    return parts, (f"{lost}, and leave a gap of {max(gaps_m) * 1000:.2g} mm",)


def _measured(parts: tuple[Part, ...], finer: tuple[Part, ...]) -> tuple[Part, ...]:
    """Return parts that say how far they are from the surface they stand for."""
    if len(parts) != len(finer):  # one of them fell apart otherwise
        off_by_m = _off_by(join_parts(parts), join_parts(finer)) if parts and finer else np.inf
        return tuple(dataclasses.replace(part, off_by_m=off_by_m) for part in parts)
    return tuple(
        dataclasses.replace(part, off_by_m=_off_by(part, other))
        for part, other in zip(parts, finer, strict=True)
    )


def _not_much_better(parts: tuple[Part, ...], before: tuple[Part, ...]) -> tuple[Part, ...]:
    """Return parts that are at least half as far off as they were before they were made finer."""
    if not before:
        return parts
    if len(parts) == len(before):
        least = [part.off_by_m / 2 for part in before]
    else:
        least = [max(part.off_by_m for part in before) / 2] * len(parts)
    return tuple(
        dataclasses.replace(part, off_by_m=max(part.off_by_m, off_by_m))
        for part, off_by_m in zip(parts, least, strict=True)
    )


def _off_by(part: Part, finer: Part) -> float:
    """Return an estimate of how far a part is from its surface, in metres."""
    # Vertices of the finer one lie on the surface; of the other, what lies between its vertices
    # is farthest off.
    apart = max(_farthest(_points_between(part), finer), _farthest(finer.vertices, part))
    # The conversion writes single precision: coordinates are off by half a unit in the last place.
    rounding = float(np.abs(part.vertices).max()) * 2.0**-24 * math.sqrt(3.0)
    return (1.0 + _LEFT_OUT) * apart + 2.0 * rounding


def _points_between(part: Part) -> NDArray[np.float64]:
    """Return points (N, 3) on the triangles of a part and on their edges, but not their corners."""
    triangles = part.vertices[part.faces]
    # Chords are farthest off in their middles, which an even number of steps along an edge meets.
    steps = 4 if 12 * len(triangles) <= _N_MEASURED else 2
    weights = np.array(
        [
            (i, j, steps - i - j)
            for i in range(steps)
            for j in range(min(steps, steps + 1 - i))
            if i + j
        ]
    )
    points: NDArray[np.float64] = np.einsum("wi,tij->wtj", weights / steps, triangles)
    return points.reshape(-1, 3)


def _farthest(points: NDArray[np.float64], part: Part) -> float:
    """Return the farthest that one of the points (N, 3) is from the triangles of a part."""
    from hybridve.hull.cad.distance import SurfaceDistance  # late: it brings compiled code

    surface = SurfaceDistance(part.vertices, part.faces, is_closed=False)
    distance, _, _ = surface.closest(points[:: 1 + len(points) // _N_MEASURED])
    return float(distance.max(initial=0.0))
