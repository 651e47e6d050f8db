"""The paper's curtain, parted by two hands: how long a frame of 1/60 s takes, and how deep it is.

The preset "curtain": two panels of 720 triangles together, four cameras of 640 x 480 without lens
distortion, two hands whose silhouettes are drawn exactly, 60 frames a second, steps of 2 ms. The
hulls between frames are interpolated beforehand, as the driver of effects does, and not timed; the
cloth is, with all its volume queries (10 x 10 viewports). In one run:

* ``direction``: pushed out along V_rec, to its side; ``nearest``: the shortest way out;
* ``still``: the same without a hull near;
* ``swing``: one sheet of 720 triangles and 399 vertices swings from 40 degrees, without damping or
  a hull: ``ours``, and in ``mujoco`` alone (a flex with stretch as an equality of its edges,
  conjugate gradients, Euler).

The paper's ran at 6 frames a second, detection and response, on its machine of 2003: 167 ms.

Run: python tests/benchmarks/bench_cloth.py [--frames 115]
"""

import argparse
import itertools
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parent.parent))

from helpers.effect_cloth import STEP_S, make_cloth, thing

from hybridve.hull.contact.between import interpolated_hull
from hybridve.hull.effects.cloth import Cloths
from hybridve.hull.effects.effect import Instant
from hybridve.hull.query.choose import open_engine
from hybridve.hull.query.engine import Engine
from hybridve.hull.query.silhouettes import Hull, Views, make_hull, make_views
from hybridve.hull.synth import render
from hybridve.hull.synth.meshes import sheet_mesh
from hybridve.hull.synth.presets import PRESETS
from hybridve.hull.synth.stage import Stage

_FRAMES, _FPS = 115, 60.0
#: Steps of a frame, and hulls: a hand goes some 5 mm between two.
_STEPS, _HULLS = 8, 4
_PAPER_MS = 1000.0 / 6.0


def main(arguments: Sequence[str] | None = None) -> dict[str, float]:
    """Print a line for each way, and return the numbers."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=_FRAMES)
    parser.add_argument("--smallest", action="store_true", help="few frames")
    asked = parser.parse_args(arguments)
    n_frames = 3 if asked.smallest else asked.frames
    stage = PRESETS["curtain"].make_stage()
    views, hulls = _hulls(stage, n_frames)
    nothing = make_hull(views, [np.zeros((h, w), np.uint8) for w, h in views.sizes_px.tolist()])
    measured: dict[str, float] = {"frames": n_frames, "paper.frame_ms": _PAPER_MS}
    with open_engine("native") as engine:
        for name, recovery, seen in (
            ("direction", "direction", hulls),
            ("nearest", "nearest", hulls),
            ("still", "direction", [nothing] * len(hulls)),
        ):
            _run(_cloth(stage, views, engine, recovery), seen[:_HULLS])  # compiles
            times_ms, deepest_m, contacts = _run(_cloth(stage, views, engine, recovery), seen)
            measured |= _summary(name, times_ms)
            measured[f"{name}.penetration_mm"] = 1000.0 * deepest_m
            measured[f"{name}.contacts"] = contacts
            print(  # noqa: T201
                f"{name}: {contacts} contacts, at most {1000 * deepest_m:.3f} mm deep after a step"
            )
        measured |= _swing(views, engine, n_frames)
    return measured


def _summary(name: str, times_ms: NDArray[np.float64]) -> dict[str, float]:
    middle, late = np.percentile(times_ms, [50, 95]).tolist()
    print(  # noqa: T201
        f"{name}: {middle:.2f} ms a frame of {_STEPS} steps, p95 {late:.2f}; "
        f"{_PAPER_MS / middle:.0f} times the paper's"
    )
    return {f"{name}.median_ms": middle, f"{name}.p95_ms": late}


def _hulls(stage: Stage, n_frames: int) -> tuple[Views, list[Hull]]:
    """Return the hulls of all instants, `_HULLS` a frame."""
    cameras = []
    for camera in stage.cameras:
        params = camera.params.copy()
        params[4:] = 0.0
        cameras.append(replace(camera, params=params))
    projections = np.array([camera.pinhole @ camera.cam_from_world for camera in cameras])
    sizes = np.array([[camera.width_px, camera.height_px] for camera in cameras])
    views = make_views(tuple(camera.name for camera in cameras), sizes, projections)
    seen = [render.make_view(camera) for camera in cameras]
    shapes = [real.shape for real in stage.shapes]
    frames = []
    for moment in np.linspace(0.0, 1.0, n_frames + 1):
        poses = stage.poses(float(moment))
        masks = [render.true_silhouette(view, shapes, poses) for view in seen]
        frames.append(make_hull(views, masks))
    hulls = [
        interpolated_hull(before, after, part / _HULLS)
        for before, after in itertools.pairwise(frames)
        for part in range(1, _HULLS + 1)
    ]
    return views, hulls


def _cloth(stage: Stage, views: Views, engine: Engine, recovery: str) -> Cloths:
    panels = [
        thing(
            part.name,
            (part.mesh.vertices_mm + np.array(part.translate_mm)) / 1000.0,
            part.mesh.faces,
            part.recovery_direction,
        )
        for part in stage.parts
        if part.effect
    ]
    names = [one.name for one in panels]
    return make_cloth(views, panels, engine=engine, names=names, recovery=recovery)


def _run(cloth: Cloths, hulls: Sequence[Hull]) -> tuple[NDArray[np.float64], float, int]:
    """Return what each frame takes, how deep it ever is, and how many contacts there are."""
    times_ms, deepest_m, contacts = [], 0.0, 0
    before: Hull | None = None
    per_hull = _STEPS // _HULLS
    for frame in range(len(hulls) // _HULLS):
        begin_s = time.perf_counter()
        for step in range(_STEPS):
            hull = hulls[frame * _HULLS + step // per_hull]
            told = before if step % per_hull == 0 else hull
            time_s = (frame * _STEPS + step + 1) * STEP_S
            cloth.advance(Instant(time_s, hull, told, per_hull * STEP_S, frame), STEP_S)
            before = hull
        times_ms.append(1000.0 * (time.perf_counter() - begin_s))
        for values in cloth.values(None).values():
            deepest_m = max(deepest_m, float(values["penetration_m"]))
            contacts += int(values["n_contacts"])
    return np.array(times_ms), deepest_m, contacts


def _swing(views: Views, engine: Engine, n_frames: int) -> dict[str, float]:
    """Return what each solver makes of a sheet that swings from 40 degrees without damping.

    Its time; how much the energy is at most off, as a share of the largest kinetic; and how long
    its edges become, as a share of their length.
    """
    mesh = sheet_mesh((760.0, 840.0), (18, 20), 12.0, 3)
    vertices, faces = mesh.vertices_mm / 1000.0, mesh.faces
    angle, top_m = np.radians(40.0), vertices[:, 2].max()
    down = vertices[:, 2] - top_m
    places = vertices.copy()
    places[:, 1] = np.cos(angle) * vertices[:, 1] - np.sin(angle) * down
    places[:, 2] = top_m + np.sin(angle) * vertices[:, 1] + np.cos(angle) * down
    pinned = np.flatnonzero(down > -1e-4)
    rest_m = _longest_edges(places, faces)
    pins = [[*(1000.0 * places[pin]).tolist()] for pin in pinned]
    cloth = make_cloth(
        views,
        [thing("sheet", places, faces)],
        engine=engine,
        pin=pins,
        damping_per_s=0.0,
        inner_damping=0.0,
    )
    nothing = make_hull(views, [np.zeros((h, w), np.uint8) for w, h in views.sizes_px.tolist()])
    model, data = _mujoco_sheet(places, faces, pinned)
    mujoco.mj_forward(model, data)
    start_j = float(data.energy.sum())
    measured: dict[str, float] = {}
    for name in ("ours", "mujoco"):
        times_ms, energies_j, kinetic_j, stretch = [], [], 0.0, 0.0
        for frame in range(n_frames):
            begin_s = time.perf_counter()
            for step in range(_STEPS):
                if name == "ours":
                    time_s = (frame * _STEPS + step + 1) * STEP_S
                    cloth.advance(Instant(time_s, nothing, nothing, STEP_S, frame), STEP_S)
                else:
                    mujoco.mj_step(model, data)
            times_ms.append(1000.0 * (time.perf_counter() - begin_s))
            if name == "ours":
                told = cloth.values(None)["sheet"]
                energies_j.append(float(told["kinetic_j"] + told["potential_j"]))
                kinetic_j = max(kinetic_j, float(told["kinetic_j"]))
                at = np.asarray(told["vertices_m"])
            else:
                energies_j.append(float(data.energy.sum()) - start_j)
                kinetic_j = max(kinetic_j, float(data.energy[1]))
                at = data.flexvert_xpos.copy()
            stretch = max(stretch, float((_longest_edges(at, faces) / rest_m).max()))
        measured |= _summary(f"swing.{name}", np.array(times_ms))
        off = float(np.abs(energies_j).max()) / kinetic_j
        measured[f"swing.{name}.energy_off_share"] = off
        measured[f"swing.{name}.longest_edge"] = stretch
        print(f"swing.{name}: energy off by {100 * off:.2f} %, edges {stretch:.3f} times as long")  # noqa: T201
    return measured


def _longest_edges(places: NDArray[np.float64], faces: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the lengths of all sides of all triangles, (3 T,) metres."""
    corners = places[faces]
    return np.asarray(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).ravel())


def _mujoco_sheet(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], pinned: NDArray[np.int64]
) -> tuple[mujoco.MjModel, mujoco.MjData]:
    places = " ".join(f"{value:.9g}" for value in vertices.ravel())
    elements = " ".join(str(number) for number in faces.ravel())
    pins = " ".join(str(number) for number in pinned)
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><option timestep="{STEP_S}" solver="CG" integrator="Euler"
        gravity="0 0 -9.80665"><flag energy="enable"/></option>
        <worldbody><body name="rod"><flexcomp name="sheet" type="direct" dim="2"
        mass="{0.2 * 0.76 * 0.84}" point="{places}" element="{elements}">
        <edge equality="true"/><pin id="{pins}"/>
        <contact selfcollide="none" contype="0" conaffinity="0"/>
        </flexcomp></body></worldbody></mujoco>"""
    )
    return model, mujoco.MjData(model)


if __name__ == "__main__":
    main()
