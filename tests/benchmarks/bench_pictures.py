"""How near pictures of the hull come to what cameras saw: their outline, and their colours.

`outline`: the hull of all cameras, drawn from the place of each, beside that camera's silhouette
(less the pieces that no other camera confirms, which `render` leaves out):
pixels in common over pixels of either; how many lie beside the silhouette; and the same beside what
of the silhouette all others confirm (`meets_others`), which is the hull itself. `colours`: each
camera in turn is left out, hull and colours come from the others, and within hull and silhouette
the picture from its place is compared with what it recorded, PSNR in dB; beside it the hull in its
plain colour, and the best single colour.

    python tests/benchmarks/bench_pictures.py [outline] [colours] [--smallest]
"""

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.rig import Rig
from hybridve.hull.agreement.others import meets_others
from hybridve.hull.agreement.search import make_pencils
from hybridve.hull.cad.scene import load_scene
from hybridve.hull.capture.recording import FrameRange
from hybridve.hull.capture.rig import calibrate_session, load_rig
from hybridve.hull.capture.session import Session, load_session
from hybridve.hull.chain import Chain, EvaluateSettings, hulls, rig_views
from hybridve.hull.query.choose import open_engine
from hybridve.hull.query.silhouettes import Hull
from hybridve.hull.show import Image, pinhole_images, take_shot
from hybridve.hull.view.cells import hull_cells
from hybridve.hull.view.paint import PaintedScene, Painter, floor_under
from hybridve.hull.view.recorded import view_of_matrix

DATA = Path(__file__).parent.parent.parent / "data"

#: What is drawn lies between these, metres.
RANGE_M = (0.05, 30.0)


@dataclass(frozen=True)
class Recording:
    name: str
    session: Session
    rig: Rig
    frame: int

    def chain(self, without: tuple[str, ...] = ()) -> Chain:
        session = self.session.without(without)
        views, lenses = rig_views(session, self.rig)
        settings = EvaluateSettings(frames=FrameRange(self.frame, self.frame + 1))
        scene = load_scene(DATA / self.name / "scene.toml")
        return Chain(session, self.rig, scene, settings, lenses, views, [], None)


def hull_of(chain: Chain) -> Hull:
    (frame,) = hulls(chain)
    assert frame.hull is not None
    return frame.hull


def images_of(chain: Chain) -> list[Image | None]:
    return next(pinhole_images(chain, chain.settings.frames))


def recordings(asked: argparse.Namespace) -> Iterator[Recording]:
    dino = load_session(DATA / "dino_ring")
    yield Recording("dino_ring", dino, load_rig(dino), 0)
    if asked.smallest:
        return
    rope = load_session(DATA / "child_rope")
    yield Recording("child_rope", rope, load_rig(rope), 20)
    rider = load_session(DATA / "horseman")
    yield Recording("horseman", rider, calibrate_session(rider).rig, 100)


def outline(one: Recording, painter: Painter, most: int) -> dict[str, float]:
    """Return how far outlines from the cameras' places are those of their silhouettes."""
    with open_engine("native") as engine:
        hull = take_shot(one.chain(), one.frame, engine).hull
    pencils = make_pencils(hull.views)
    shares, of_hull, beside = [], [], 0
    for camera in range(min(len(hull.views), most)):
        size_px = hull.views.sizes_px[camera]
        view = view_of_matrix(
            hull.views.img_from_local[camera], size_px, hull.views.origin_world, (1e-3, 1e6)
        )
        width, height = (int(side) for side in size_px)
        drawn = np.isfinite(painter.depth(hull, view, (width, height)))
        silhouette = hull.mask(camera) > 0
        confirmed = silhouette & meets_others(hull, camera, pencils)
        shares.append(overlap(drawn, silhouette))
        of_hull.append(overlap(drawn, confirmed))
        beside += int((drawn & ~silhouette).sum())
    return {
        f"{one.name}.outline_least": min(shares),
        f"{one.name}.outline_median": float(np.median(shares)),
        f"{one.name}.outline_most": max(shares),
        f"{one.name}.outline_of_hull_least": min(of_hull),
        f"{one.name}.beside_px": beside,
    }


def overlap(first: NDArray[np.bool_], second: NDArray[np.bool_]) -> float:
    """Return how many pixels both have, of those that either has."""
    return float((first & second).sum() / (first | second).sum())


def colours(one: Recording, painter: Painter, most: int) -> dict[str, float]:
    """Return the PSNR of cameras that were left out."""
    whole = one.chain()
    hull, recorded = hull_of(whole), images_of(whole)
    told = []
    step = max(1, -(-len(hull.views) // most))
    for camera in range(0, len(hull.views), step):
        truth = recorded[camera]
        if truth is None:  # masks alone
            return {}
        rest = one.chain((hull.views.names[camera],))
        of_rest, images = hull_of(rest), images_of(rest)
        size_px = hull.views.sizes_px[camera]
        view = view_of_matrix(
            hull.views.img_from_local[camera], size_px, hull.views.origin_world, RANGE_M
        )
        width, height = (int(side) for side in size_px)
        inside = np.isfinite(painter.depth(of_rest, view, (width, height)))
        inside &= hull.mask(camera) > 0
        floor = floor_under(np.zeros((0, 3)), np.array([0.0, 0.0, 1.0]))
        cells = hull_cells(of_rest)
        drawn = []
        for seen in ((), images):
            scene = PaintedScene(of_rest, cells, [], (), 1.0, floor, images=seen)
            drawn.append(painter.paint(scene, view, (width, height))[inside].astype(float))
        mean = np.broadcast_to(truth[inside].mean(axis=0), drawn[0].shape)
        told.append([psnr(picture, truth[inside]) for picture in (drawn[1], drawn[0], mean)])
        sys.stdout.write(f"{one.name} without {hull.views.names[camera]}: {told[-1]}\n")
    as_it_looked, plain, best = np.mean(told, axis=0).tolist()
    return {
        f"{one.name}.texture_db": as_it_looked,
        f"{one.name}.plain_db": plain,
        f"{one.name}.single_colour_db": best,
    }


def psnr(picture: NDArray[np.float64], truth: Image) -> float:
    """Return the peak signal to noise ratio of pixels (N, 3), dB."""
    return float(10 * np.log10(255.0**2 / np.square(picture - truth).mean()))


def main(arguments: Sequence[str] | None = None) -> dict[str, float]:
    """Measure what is asked for, and return it."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("kinds", nargs="*", help="outline, colours; both if left out")
    parser.add_argument("--smallest", action="store_true", help="one camera of one recording")
    asked = parser.parse_args(arguments)
    kinds = asked.kinds or ["outline", "colours"]
    cv2.setNumThreads(1)
    told: dict[str, float] = {}
    with Painter(samples=1) as painter:
        for one in recordings(asked):
            if "outline" in kinds:
                told |= outline(one, painter, 1 if asked.smallest else 1000)
            if "colours" in kinds:
                told |= colours(one, painter, 1 if asked.smallest else 5)
            for name, value in told.items():
                if name.startswith(one.name):
                    sys.stdout.write(f"{name:36} {value:.4f}\n")
            sys.stdout.flush()
    return told


if __name__ == "__main__":
    main()
