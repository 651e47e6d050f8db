"""Doubts of a frame, and the walk of a ray through it: horseman beside and in a robot's links.

``bench_doubt`` doubts all 7 links, 3 of which reach into the person, in every round another frame,
given contacts and clearances. ``bench_walk`` walks one ray of an object pixel through the hull, as
doubts do, compiled and as `hybridve.hull.query.walk_reference` says; ``bench_walk_rays`` walks 64
in one call.

Run: pytest tests/benchmarks/bench_doubt.py --full
"""

import itertools
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from hybridve.calib.rig import Rig
from hybridve.hull.cad.scene import load_scene
from hybridve.hull.capture.recording import FrameRange, segmented_frames
from hybridve.hull.capture.session import Session
from hybridve.hull.chain import rig_views
from hybridve.hull.contact.clearance import Clearance, ClearanceMeter
from hybridve.hull.contact.components import FAR_M, pixel_rays
from hybridve.hull.contact.detect import Contact, detect_contacts, make_body
from hybridve.hull.contact.finding import agreed
from hybridve.hull.contact.outline_errors import DoubtSettings, outline_errors
from hybridve.hull.contact.uncertainty import Doubt, Doubter
from hybridve.hull.query import walk_reference
from hybridve.hull.query.native import Native
from hybridve.hull.query.silhouettes import Hull, make_hull
from hybridve.hull.query.walk import spans_in_hull, spans_of_rays

SCENE = Path(__file__).parent.parent.parent / "data" / "horseman" / "scene.toml"

Seen = tuple[Hull, list[tuple[Contact, Clearance]]]
Ray = tuple[Hull, NDArray[np.float64], NDArray[np.float64]]

pytestmark = pytest.mark.recording


@pytest.fixture(scope="module")
def hulls(horseman: tuple[Session, Rig], is_full: bool) -> list[Hull]:
    session, rig = horseman
    views, undistortions = rig_views(session, rig)
    which = FrameRange(0, 400 if is_full else 40, 20)
    frames = segmented_frames(session, which, undistortions=undistortions)
    with closing(frames):
        return [make_hull(views, frame.masks) for frame in frames if frame.masks is not None]


@pytest.mark.parametrize("near_m", [DoubtSettings().near_m, np.inf])
@pytest.mark.smallest(near_m=np.inf)
def bench_doubt(benchmark: Any, hulls: list[Hull], near_m: float) -> None:
    """All links, looked at closely where they are near, and wherever they are."""
    links = load_scene(SCENE).objects
    bodies = [make_body(link, viewport=10) for link in links]
    meters = [
        ClearanceMeter(
            link.vertices_world,
            link.faces,
            is_closed=link.is_closed,
            solid_faces=link.solid_faces,
        )
        for link in links
    ]
    seen: list[Seen] = []
    with Native(1) as engine:
        for hull in hulls:
            contacts = detect_contacts(hull, bodies, engine)
            clearances = [meter.measure(hull) for meter in meters]
            seen.append((hull, list(map(agreed, contacts, clearances))))
    settings = DoubtSettings(near_m=near_m)
    names = hulls[0].views.names
    doubter = Doubter(outline_errors(names, None, [0.0] * len(names), settings), settings)
    queue = itertools.cycle(seen)

    def doubt_all() -> list[Doubt]:
        hull, findings = next(queue)
        doubts = doubter.frame(hull)
        return [
            doubts.doubt(meter, *finding) for meter, finding in zip(meters, findings, strict=True)
        ]

    benchmark.pedantic(doubt_all, rounds=2 * len(seen), warmup_rounds=len(seen))
    closely = sum(doubt.survives is not None for _ in seen for doubt in doubt_all())
    benchmark.extra_info.update(links=len(links), looked_at_closely=closely / len(seen))


def object_rays(hulls: list[Hull]) -> list[Ray]:
    """Return rays of random object pixels of the first camera."""
    rng = np.random.default_rng(0)
    rays = []
    for hull in hulls:
        for row, column in rng.choice(np.argwhere(hull.mask(0)), 8).tolist():
            origin_world, (direction,) = pixel_rays(hull.views, 0, [(column, row)])
            rays.append((hull, origin_world, direction))
    return rays


@pytest.mark.parametrize(
    "walk", [spans_in_hull, walk_reference.spans_in_hull], ids=["compiled", "specification"]
)
def bench_walk(benchmark: Any, hulls: list[Hull], walk: Callable[..., Any]) -> None:
    """One ray, and as its specification says."""
    rays = itertools.cycle(object_rays(hulls))
    benchmark.pedantic(lambda: walk(*next(rays), FAR_M), rounds=320, warmup_rounds=20)


def bench_walk_rays(benchmark: Any, hulls: list[Hull]) -> None:
    """64 rays of one hull in one call."""
    hull = hulls[0]
    pixels = np.random.default_rng(0).choice(np.argwhere(hull.mask(0)), 64)
    origin_world, directions = pixel_rays(hull.views, 0, [(x, y) for y, x in pixels.tolist()])
    origins_world = np.tile(origin_world, (len(directions), 1))
    benchmark.pedantic(
        lambda: spans_of_rays(hull, origins_world, directions, FAR_M), rounds=50, warmup_rounds=5
    )
