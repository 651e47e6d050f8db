"""Compiles all that commands need, before it is needed: at set-up, or by ``doctor --prepare``.

The code is run on the tiniest input, and what was compiled is kept where every later start looks
(see `hybridve.hull.jit`). numba compiles in one thread at a time.
"""

import gc
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.agreement.causes import diagnose
from hybridve.hull.agreement.frame import coherence, judge_frame
from hybridve.hull.agreement.others import meets_others
from hybridve.hull.agreement.outlines import outline_of, table_of
from hybridve.hull.agreement.sight import sight_of
from hybridve.hull.agreement.trials import Trial
from hybridve.hull.cad.scene import SceneObject, load_scene
from hybridve.hull.capture.background import learn_background
from hybridve.hull.capture.segment import Segmenter, SegmentSettings
from hybridve.hull.contact.between import interpolated_hull
from hybridve.hull.contact.clearance import ClearanceMeter
from hybridve.hull.contact.components import connected_volumes
from hybridve.hull.contact.detect import Body, detect_contacts, make_body
from hybridve.hull.contact.patches import contact_patches
from hybridve.hull.contact.respond import collision_point
from hybridve.hull.effects.effect import Setting
from hybridve.hull.effects.instants import instants
from hybridve.hull.effects.kinds import make_effects, read_entries
from hybridve.hull.jit import folder
from hybridve.hull.query.certify import Certifier
from hybridve.hull.query.native import Native
from hybridve.hull.query.silhouettes import Views, make_hull, make_views
from hybridve.hull.query.walk import spans_in_hull
from hybridve.hull.synth.meshes import box_mesh, sheet_mesh, write_stl

#: Side in pixels of the images that are compiled with.
_SIDE_PX = 64

#: Of a camera a metre before the world's origin.
_MATRIX = np.array([[50.0, 0, 32, 32], [0, 50, 32, 32], [0, 0, 1, 1]])

#: Quads along an edge of the sheet that is compiled with: enough triangles for clusters.
_QUADS = 48

#: The file that says that all is compiled, and names the files that hold it, a line each.
_SIGN = "complete"


def is_prepared() -> bool:
    """Tell whether all is compiled and kept."""
    kept = folder()
    return kept is not None and (kept / _SIGN).exists()


def prepare_kernels() -> bool:
    """Compile all that commands need and keep it; tell whether it is kept."""
    kept = folder()
    if kept is not None and not is_prepared():
        # The compiler leaves little that only a collection would free: a tenth of the time.
        collects = gc.isenabled()
        gc.disable()
        try:
            _run_kernels()
            _run_effects()
        finally:
            if collects:
                gc.enable()
        held = sorted(str(path.relative_to(kept)) for path in kept.rglob("*.nbc"))
        (kept / _SIGN).write_text("\n".join(held) + "\n", encoding="utf-8")
    return is_prepared()


def _run_kernels() -> None:
    """Run everything that is compiled, on little."""
    empty = np.full((_SIDE_PX, _SIDE_PX, 3), 100, np.uint8)
    Segmenter(learn_background([empty]), SegmentSettings()).segment(
        np.where(_mask()[..., None] == 1, np.uint8(200), empty)
    )
    views, sheet = _views(), _sheet()
    with Native(1) as engine, Certifier(0.1, 1) as certifier:
        for _ in range(2):  # clusters are made for the second frame
            hull = make_hull(views, [_mask()])
            (contact,) = detect_contacts(hull, [sheet], engine)
            certifier.certify_mesh(hull, sheet.triangles)
    mesh = sheet.triangles
    meter = ClearanceMeter(mesh.vertices_world, mesh.faces, is_closed=False)
    for shift_world in (np.zeros(3), np.array([3.0, 0.0, 1.0])):  # touched, and far beside
        meter.measure(hull, shift_world)
    nowhere = np.zeros(3)
    contact_patches(hull, meter, contact, required_m=0.0, reference_point_world=nowhere)
    collision_point(contact, nowhere)
    contact.points()
    ClearanceMeter(*_tetrahedron(), is_closed=True).measure(hull)
    interpolated_hull(hull, make_hull(views, [np.roll(_mask(), 4, axis=1)]), 0.5)
    spans_in_hull(hull, np.zeros(3), np.array([0.0, 0.0, 1.0]), 1.0)
    connected_volumes(hull)
    trio = make_hull(_views(3), [_mask()] * 3)
    judge_frame(trio)
    coherence(trio, 0)
    meets_others(trio, 0)
    views = replace(trio.views, img_from_local=_apart(trio.views.img_from_local))
    diagnose(Trial.of(views, table_of([[outline_of(_mask())] * 3] * 12)))
    sight_of(trio.views, mesh.vertices_world, mesh.faces)


#: One object for each kind of effect, about the edge of what the cameras see, and a ground.
_SCENE = """\
format = "hybridve-scene"
version = 1
object = [
  { name = "box", mesh = "box.stl", unit = "mm", translate_mm = [320, 0, 0] },
  { name = "door", mesh = "box.stl", unit = "mm", translate_mm = [-320, 0, 0] },
  { name = "sheet", mesh = "sheet.stl", unit = "mm", translate_mm = [0, 250, 0] },
  { name = "ground", mesh = "box.stl", unit = "mm", translate_mm = [0, 0, -240] },
  { name = "cart", mesh = "box.stl", unit = "mm", poses = "cart.csv" },
]
effect = [
  { kind = "rigid", object = "box", mass_kg = 0.5 },
  { kind = "hinge", object = "door", mass_kg = 0.5, axis = [0, 0, 1], anchor_mm = [0, 100, 0] },
  { kind = "cloth", object = "sheet" },
  { kind = "particles", count = 50, source_mm = [200, -200, -100, 400, 200, 100] },
  { kind = "light", lamp_mm = [0, -300, 900], power_lm = 800, objects = ["ground"] },
  { kind = "shadow", lamp_mm = [0, 300, 900], radius_mm = 20, objects = ["ground"] },
  { kind = "proximity", object = "ground", zones_mm = [400, 150] },
]
"""


def _run_effects() -> None:
    """Run what effects compile: each meets a hull that comes by, and CAD that moves."""
    with tempfile.TemporaryDirectory() as name, Native(1) as engine:
        folder = Path(name)
        write_stl(folder / "box.stl", box_mesh((160.0, 160.0, 160.0), 90.0), "box")
        write_stl(folder / "sheet.stl", sheet_mesh((200.0, 200.0), (4, 4), 5.0, 1), "sheet")
        rows = [f"{frame},{0.3 * frame},0,0.3,1,0,0,0" for frame in range(2)]
        (folder / "cart.csv").write_text("\n".join(["frame,x,y,z,qw,qx,qy,qz", *rows]) + "\n")
        (folder / "scene.toml").write_text(_SCENE)
        scene = load_scene(folder / "scene.toml")
        found = read_entries(scene)
        views = make_views(
            ("camera",) * 3,
            np.full((3, 2), _SIDE_PX, np.int64),
            np.array([_MATRIX] * 3),
            origin_world=np.zeros(3),
        )
        claimed = frozenset(name for entry, _ in found for name in entry.table.claimed)
        setting = Setting(scene, claimed, views, engine, step_s=0.002, frame_s=0.02)
        effects = [effect for effect, _ in make_effects(found, setting)]
        before, after = (
            make_hull(views, [np.roll(_mask(), shift_px, axis=1)] * 3) for shift_px in (0, 4)
        )
        way = instants(
            before,
            after,
            start_s=0.0,
            elapsed_s=0.02,
            frame=1,
            step_s=0.002,
            mode="interpolate",
            motions={one.name: one.motion for one in scene.objects if one.motion is not None},
            since=0,
        )
        for steps in way:
            for instant in steps:
                for effect in effects:
                    effect.advance(instant, instant.elapsed_s / len(steps))
        for effect in effects:
            effect.values(after)


def _views(count: int = 1) -> Views:
    sizes = np.full((count, 2), _SIDE_PX, np.int64)
    return make_views(("camera",) * count, sizes, np.array([_MATRIX] * count), "carve", 1)


def _apart(matrices: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the projections of cameras that stand beside each other."""
    beside = matrices.copy()
    beside[:, 0, 3] += 10.0 * np.arange(len(matrices))
    return beside


def _mask() -> NDArray[np.uint8]:
    """Return a square in the middle."""
    mask = np.zeros((_SIDE_PX, _SIDE_PX), np.uint8)
    mask[16:48, 16:48] = 1
    return mask


def _tetrahedron() -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Return the smallest solid there is, which has an inside."""
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]], np.int32)
    return np.eye(4, 3, dtype=np.float64), faces


def _sheet() -> Body:
    """Return a square that is larger than what the camera sees."""
    x, y = np.meshgrid(*[np.linspace(-1.0, 1.0, _QUADS + 1)] * 2)
    corner = (np.arange(_QUADS) + (_QUADS + 1) * np.arange(_QUADS)[:, None]).ravel()
    below = corner + _QUADS + 1
    faces = np.concatenate(
        [np.stack([corner, corner + 1, below], 1), np.stack([below, corner + 1, below + 1], 1)]
    )
    vertices = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    sheet = SceneObject("sheet", Path(), vertices, faces.astype(np.int32), 0.0, np.zeros(3), None)
    return make_body(sheet, viewport=10)
