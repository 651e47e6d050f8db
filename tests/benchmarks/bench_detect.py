"""Frames per second of the whole chain on the horseman recording: decode, segment, query.

Each round evaluates the same hundred frames, from learning the backgrounds to the last result.
The robot arm of ``data/horseman`` is subdivided to the number of triangles. The aim is 30 frames a
second on two cores, of contacts and their certificates. ``bench_parts`` adds what `detect` asks for
besides, one after the other.
"""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from hybridve.calib.rig import Rig
from hybridve.hull.cad.scene import SceneObject, load_scene
from hybridve.hull.capture.recording import FrameRange
from hybridve.hull.capture.session import Session
from hybridve.hull.chain import Chain, EvaluateSettings, rig_views
from hybridve.hull.contact.detect import Body, make_body
from hybridve.hull.contact.outline_errors import DoubtSettings
from hybridve.hull.contact.respond import ResponseSettings
from hybridve.hull.evaluate import evaluate
from hybridve.hull.query.choose import open_engine
from hybridve.hull.query.engine import EngineName

SCENE = Path(__file__).parent.parent.parent / "data" / "horseman" / "scene.toml"


@pytest.fixture(scope="module")
def frames(is_full: bool) -> FrameRange:
    return FrameRange(0, 100 if is_full else 2)


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
@pytest.mark.smallest(engine="native", times=0)
def bench_detect_horseman(
    benchmark: Any,
    horseman: tuple[Session, Rig],
    frames: FrameRange,
    engine: EngineName,
    times: int,
) -> None:
    cv2.setNumThreads(1)
    session, rig = horseman
    scene = load_scene(SCENE)
    bodies: list[Body] = [make_body(subdivided(o, times), viewport=10) for o in scene.objects]
    views, lenses = rig_views(session, rig)
    settings = EvaluateSettings(frames=frames)
    chain = Chain(session, rig, scene, settings, lenses, views, bodies, None)
    with open_engine(engine) as query:

        def run() -> int:
            return sum(1 for _ in evaluate(chain, query))

        benchmark.extra_info["frames"] = benchmark.pedantic(run, rounds=3, warmup_rounds=1)
        benchmark.extra_info["renderer"] = query.renderer
    benchmark.extra_info["triangles"] = sum(len(body.triangles) for body in bodies)


PARTS: dict[str, dict[str, Any]] = {
    "contacts": {},
    "clearance": {"clearance_m": 1e-4},
    "response": {"clearance_m": 1e-4, "response": ResponseSettings()},
    "doubt": {"clearance_m": 1e-4, "response": ResponseSettings(), "doubt": DoubtSettings()},
}


@pytest.mark.recording
@pytest.mark.parametrize("parts", list(PARTS))
@pytest.mark.smallest(parts="doubt")
def bench_parts(
    benchmark: Any, horseman: tuple[Session, Rig], frames: FrameRange, parts: str
) -> None:
    """Frames per second with more and more asked of each; 7 links, 3 of which are reached into."""
    cv2.setNumThreads(1)
    session, rig = horseman
    scene = load_scene(SCENE)
    bodies = [make_body(one, viewport=10) for one in scene.objects]
    views, lenses = rig_views(session, rig)
    settings = EvaluateSettings(frames=frames, **PARTS[parts])
    chain = Chain(session, rig, scene, settings, lenses, views, bodies, None)
    with open_engine("native") as query:

        def run() -> int:
            return sum(1 for _ in evaluate(chain, query))

        benchmark.extra_info["frames"] = benchmark.pedantic(run, rounds=3, warmup_rounds=1)
