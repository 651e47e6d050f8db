"""Frames per second of the whole chain on the horseman recording: decode, segment, query.

Each round evaluates the same hundred frames, from learning the backgrounds to the last result.
The robot arm of ``data/horseman`` is subdivided to the number of triangles. The aim is 30 frames a
second on two cores, of contacts and their certificates. ``bench_parts`` adds what `detect` asks for
besides, one after the other.
"""

import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from hybridve.calib.rig import Rig
from hybridve.hull.cad.scene import SceneObject, load_scene
from hybridve.hull.capture.recording import FrameRange
from hybridve.hull.capture.rig import calibrate_session
from hybridve.hull.capture.session import Session, load_session
from hybridve.hull.chain import Chain, EvaluateSettings, rig_views
from hybridve.hull.contact.detect import Body, make_body
from hybridve.hull.contact.respond import ResponseSettings
from hybridve.hull.contact.uncertainty import DoubtSettings
from hybridve.hull.evaluate import evaluate
from hybridve.hull.query.choose import open_engine

PROJECT = Path(__file__).parent.parent.parent
N_FRAMES = 100


@pytest.fixture(scope="module")
def horseman(recordings: Path) -> tuple[Session, Rig]:
    os.environ.setdefault("HYBRIDVE_DATA", str(recordings))
    session = load_session(PROJECT / "data" / "horseman")
    return session, calibrate_session(session).rig


def subdivided(part: SceneObject, times: int) -> SceneObject:
    """Return the object with every triangle cut into four, `times` times."""
    vertices, faces = part.vertices_world, part.faces
    for _ in range(times):
        corners = vertices[faces]  # (T, 3, 3)
        middles = (corners + np.roll(corners, -1, axis=1)) / 2
        a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
        ab, bc, ca = middles[:, 0], middles[:, 1], middles[:, 2]
        parts = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        vertices = np.concatenate([np.stack(part, axis=1) for part in parts]).reshape(-1, 3)
        faces = np.arange(len(vertices), dtype=np.int32).reshape(-1, 3)
    return SceneObject(
        part.name, part.mesh_path, vertices, faces, 0.0, part.reference_point_world, None
    )


@pytest.mark.recording
@pytest.mark.parametrize(
    ("engine", "times"),
    [("native", 0), ("native", 1), ("native", 2), ("native", 3), ("compute", 1)],
    ids=["native-5k", "native-21k", "native-85k", "native-341k", "compute-21k"],
)
def bench_detect_horseman(
    benchmark: Any, horseman: tuple[Session, Rig], engine: str, times: int
) -> None:
    cv2.setNumThreads(1)
    session, rig = horseman
    scene = load_scene(PROJECT / "data" / "horseman" / "scene.toml")
    bodies: list[Body] = [make_body(subdivided(o, times), viewport=10) for o in scene.objects]
    views, lenses = rig_views(session, rig)
    settings = EvaluateSettings(frames=FrameRange(0, N_FRAMES))
    chain = Chain(session, rig, scene, settings, lenses, views, bodies, None)
    with open_engine(engine) as query:

        def run() -> int:
            return sum(1 for _ in evaluate(chain, query))

        done = benchmark.pedantic(run, rounds=3, warmup_rounds=1)
        benchmark.extra_info["renderer"] = query.renderer
    benchmark.extra_info["triangles"] = sum(len(body.triangles) for body in bodies)
    benchmark.extra_info["frames_per_second"] = round(done / benchmark.stats["median"], 1)


PARTS: dict[str, dict[str, Any]] = {
    "contacts": {},
    "clearance": {"clearance_m": 1e-4},
    "response": {"clearance_m": 1e-4, "response": ResponseSettings()},
    "doubt": {"clearance_m": 1e-4, "response": ResponseSettings(), "doubt": DoubtSettings()},
}


@pytest.mark.recording
@pytest.mark.parametrize("parts", list(PARTS))
def bench_parts(benchmark: Any, horseman: tuple[Session, Rig], parts: str) -> None:
    """Frames per second with more and more asked of each; 7 links, 3 of which are reached into."""
    cv2.setNumThreads(1)
    session, rig = horseman
    scene = load_scene(PROJECT / "data" / "horseman" / "scene.toml")
    bodies = [make_body(one, viewport=10) for one in scene.objects]
    views, lenses = rig_views(session, rig)
    settings = EvaluateSettings(frames=FrameRange(0, N_FRAMES), **PARTS[parts])
    chain = Chain(session, rig, scene, settings, lenses, views, bodies, None)
    with open_engine("native") as query:

        def run() -> int:
            return sum(1 for _ in evaluate(chain, query))

        done = benchmark.pedantic(run, rounds=3, warmup_rounds=1)
    benchmark.extra_info["frames_per_second"] = round(done / benchmark.stats["median"], 1)
