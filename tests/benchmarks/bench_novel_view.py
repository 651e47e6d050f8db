"""The hull from a viewpoint that moves, 320 x 240 pixels from four cameras, as the paper had it.

`novel` draws one frame's hull again and again from another place; `frame` takes another frame each
time, with all that this needs: where the hull is, its silhouettes in graphics memory, and its
picture. Both without colours and with what the cameras saw. `extra_info` holds the frames a second
by processor time on one core, all threads together, which hardly depends on what else the machine
does. The paper's 15 to 18 a second are those of a new frame each time.

Run: pytest tests/benchmarks/bench_novel_view.py --full
"""

import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import moderngl
import numpy as np
import pytest

from hybridve.calib.rig import Rig
from hybridve.hull.cad.scene import load_scene
from hybridve.hull.capture.recording import FrameRange
from hybridve.hull.capture.session import Session
from hybridve.hull.chain import Chain, EvaluateSettings, hulls, rig_views
from hybridve.hull.query.device import open_device
from hybridve.hull.query.silhouettes import Hull
from hybridve.hull.show import Image, pinhole_images
from hybridve.hull.view.cells import hull_cells
from hybridve.hull.view.novel import HullOnDevice, NovelView, full_screen
from hybridve.hull.view.skin import SkinOnDevice
from hybridve.hull.view.viewpoint import Viewpoint, choose_viewpoint, orbited

pytestmark = [pytest.mark.gl, pytest.mark.recording]

SCENE = Path(__file__).parent.parent.parent / "data" / "horseman" / "scene.toml"

SIZE_PX = (320, 240)

#: Maps of what a camera sees of the hull, in texels for a pixel of its image.
DEPTHS_PER_PX = 0.5

#: How many boxes tell where the hull is: for the eye few will do.
MOST_CELLS = 300

N_FRAMES = 10


@dataclass(frozen=True)
class Recorded:
    hulls: list[Hull]
    images: list[list[Image | None]]
    viewpoint: Viewpoint

    def view(self, number: int) -> NovelView:
        return orbited(self.viewpoint, 0.05 * number).novel_view(4 / 3, (0.1, 20.0))


@pytest.fixture(scope="module")
def recorded(horseman: tuple[Session, Rig], is_full: bool) -> Recorded:
    session, rig = horseman
    count = N_FRAMES if is_full else 2
    settings = EvaluateSettings(frames=FrameRange(100, 100 + count))
    views, lenses = rig_views(session, rig)
    chain = Chain(session, rig, load_scene(SCENE), settings, lenses, views, [], None)
    with closing(hulls(chain)) as frames, closing(pinhole_images(chain, settings.frames)) as seen:
        found = [frame.hull for frame in frames if frame.hull is not None]
        images = list(islice(seen, len(found)))
    return Recorded(found, images, choose_viewpoint(found[0], rig, [], aspect=4 / 3))


class Drawer:
    """A device with all that draws, and what of the hull is on it."""

    def __init__(self) -> None:
        self.device: moderngl.Context = open_device()
        self._march = full_screen(self.device, "novel.frag.glsl")
        self._paint = full_screen(self.device, "skin.frag.glsl")
        self._depth = self.device.texture(SIZE_PX, 1, dtype="f4")
        self._normal = self.device.texture(SIZE_PX, 4, dtype="f2")
        self._colours = self.device.texture(SIZE_PX, 4, dtype="f1")
        self._surface = self.device.framebuffer([self._depth, self._normal])
        self._skin = self.device.framebuffer([self._colours])

    def hull(self, hull: Hull) -> HullOnDevice:
        return HullOnDevice(self.device, self._march, hull, hull_cells(hull, most=MOST_CELLS))

    def skin(self, hull: Hull, there: HullOnDevice, images: list[Image | None]) -> SkinOnDevice:
        return SkinOnDevice(self.device, hull, there, images, DEPTHS_PER_PX)

    def draw(self, there: HullOnDevice, skin: SkinOnDevice | None, view: NovelView) -> bytes:
        there.draw(self._surface, view, SIZE_PX)
        if skin is None:
            return bytes(self._depth.read())
        skin.draw(self._skin, self._paint, (self._depth, self._normal), view, SIZE_PX)
        return bytes(self._colours.read())


@pytest.fixture
def drawer() -> Iterator[Drawer]:
    found = Drawer()
    yield found
    found.device.gc()
    found.device.release()


@pytest.mark.parametrize("textured", [False, True])
@pytest.mark.parametrize("what", ["novel", "frame"])
def bench_novel_view(
    benchmark: Any, recorded: Recorded, drawer: Drawer, is_full: bool, what: str, textured: bool
) -> None:
    def prepared(number: int) -> tuple[HullOnDevice, SkinOnDevice | None]:
        number %= len(recorded.hulls)
        hull = recorded.hulls[number]
        there = drawer.hull(hull)
        return there, drawer.skin(hull, there, recorded.images[number]) if textured else None

    count, cpu_s = 0, 0.0
    kept = prepared(0)

    def draw() -> bytes:
        nonlocal count, cpu_s
        started = time.process_time()
        shown = prepared(count) if what == "frame" else kept
        picture = drawer.draw(*shown, recorded.view(count))
        drawer.device.gc()
        cpu_s += time.process_time() - started
        count += 1
        return picture

    benchmark.pedantic(draw, rounds=60 if is_full else 1, warmup_rounds=3 if is_full else 0)
    picture = np.frombuffer(draw(), np.uint8)
    benchmark.extra_info["cpu_ms"] = round(1e3 * cpu_s / count, 2)
    benchmark.extra_info["per_s_of_one_core"] = round(count / cpu_s, 1)
    assert picture.any()
