"""How often the shift that suffices at 95 % does, over recordings whose cameras and outlines err.

Two kinds of task:

* balls before a wall in closed form (`helpers.erring_task`), where one frame decides, or several
  need the same room;
* recordings of the preset "payload", generated and calibrated: in every repeat the cameras are
  believed to stand where the rig's own covariance lets them, one draw for all frames, their pixels
  lie a part of a pixel beside where they did, and all outlines are those of the true shapes, moved
  outward or inward by a normal error, smooth along the outline, another one for each camera and
  frame. No picture is rendered.

Told are the share of repeats in which the truth is not above the shift at 95 %, and above the shift
that is found without it; the error's mean and standard deviation; and the deviation stated.

Run: OPENBLAS_NUM_THREADS=1 python tests/benchmarks/bench_spacing_doubt.py [--repeats 200]
(balls of one frame, and the four participants, generated and calibrated on the way), or
     OPENBLAS_NUM_THREADS=1 python tests/benchmarks/bench_spacing_doubt.py balls --frames 12 --tied
     OPENBLAS_NUM_THREADS=1 python tests/benchmarks/bench_spacing_doubt.py payload SESSION...
"""

import argparse
import os
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from unittest.mock import patch

import cv2
import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[1]))

from helpers.erring_task import erring_task
from helpers.seen import FINER, finer, inside_px

from hybridve.calib.camera import Camera
from hybridve.calib.lens_bound import lens_shift_px
from hybridve.calib.pose import moved_pose
from hybridve.calib.rig import Rig, RigCovariance
from hybridve.calib.solving.covariance import camera_parameter_names
from hybridve.calib.solving.errors_in_space import parameter_slices
from hybridve.hull.cad.scene import load_scene
from hybridve.hull.capture.recording import undistort_mask
from hybridve.hull.capture.rig import calibrate_session, load_rig
from hybridve.hull.capture.session import Session, load_session
from hybridve.hull.chain import rig_views
from hybridve.hull.contact.outline_errors import DoubtSettings, outline_errors
from hybridve.hull.contact.spacing import Move, blocked_shifts, free_of, union
from hybridve.hull.contact.spacing_doubt import unsure_shifts
from hybridve.hull.contact.uncertainty import Doubter
from hybridve.hull.query.silhouettes import make_hull
from hybridve.hull.spacing import Layout
from hybridve.hull.synth import write
from hybridve.hull.synth.render import make_view, true_silhouette
from hybridve.hull.synth.truth import SpacingTruth, read_truth
from hybridve.hull.synth.write import write_session

#: Frames that need less room than the recording by more than this decide nothing, metres.
_NEAR_M = 0.012

#: The error of an outline is alike over so many pixels.
_SMOOTH_PX = 40


@dataclass(frozen=True, slots=True)
class Tally:
    """What repeats say: metres along the move."""

    found_m: list[float]
    at_95_m: list[float]
    std_m: list[float]

    def text(self, truth_m: float) -> str:
        """Return it beside the truth, in mm."""
        found, at_95 = (
            np.nan_to_num(np.array(one), nan=np.inf) for one in (self.found_m, self.at_95_m)
        )
        error = 1e3 * (found - truth_m)
        stated_mm = 1e3 * np.array(self.std_m)[np.isfinite(self.std_m)]
        return (
            f"truth {1e3 * truth_m:.1f} mm; not above the shift at 95 %: {(at_95 >= truth_m).sum()}"
            f" of {len(found)}, above the shift found: {(found < truth_m).sum()}; error mean "
            f"{error.mean():+.2f}, std {error.std():.2f}, median {np.median(error):+.2f} mm; std "
            f"stated {stated_mm.mean() if len(stated_mm) else np.inf:.2f} mm"
        )

    def n_enough(self, truth_m: float) -> int:
        """Return how often the shift at 95 % is not too small."""
        return int((np.nan_to_num(np.array(self.at_95_m), nan=np.inf) >= truth_m).sum())


def balls(arguments: argparse.Namespace) -> dict[str, float]:
    """Print how often the shift at 95 % suffices for balls before a wall, and return it."""
    rng = np.random.default_rng(arguments.seed)
    n_enough, n_found, pulls, repeats = 0, 0, [], 0
    while repeats < arguments.repeats:
        task = erring_task(
            rng, arguments.frames, is_tied=arguments.tied, segmentation_px=arguments.mask_std_px
        )
        needed_m, wall = float(task.needed_by_frame_m().max()), task.wall()
        cosine = float(task.normal @ task.move.direction)
        for _ in range(min(10, arguments.repeats - repeats)):
            found_m, at_95_m, std_m = task.repeat(rng, wall)
            n_enough += needed_m <= at_95_m
            n_found += needed_m <= found_m
            pulls.append((found_m - needed_m) * cosine / std_m)
            repeats += 1
    sys.stdout.write(
        f"{arguments.frames} frames, {'tied' if arguments.tied else 'one decides'}, outlines "
        f"{arguments.mask_std_px} px: enough at 95 % in {n_enough} of {repeats}, as found in "
        f"{n_found}; errors by deviation: mean {np.mean(pulls):+.2f}, std {np.std(pulls):.2f}\n"
    )
    return {"balls.repeats": repeats, "balls.enough": n_enough, "balls.enough_as_found": n_found}


class Payload:
    """A generated recording, to be seen with errors again and again."""

    def __init__(
        self, folder: Path, rig: Rig, mask_std_px: float, rng: np.random.Generator
    ) -> None:
        self._session: Session = load_session(folder)
        self._calibrated = rig
        truth = read_truth(folder)
        by_name = {camera.name: camera for camera in truth.cameras}
        self._true = [by_name[camera.name] for camera in self._session.cameras]
        self.truth: SpacingTruth = truth.spacing["payload_a"]
        self._settings, self._rng = DoubtSettings(segmentation_px=mask_std_px), rng
        move = Move(np.asarray(self.truth.along), -0.05, 0.15, 1e-3)
        self._layout = Layout.of(load_scene(folder / "scene.toml"), ["payload_a"], move)
        needed_m = self.truth.needed_hull_by_frame_m
        self.frames = np.flatnonzero(needed_m > needed_m.max() - _NEAR_M).tolist()
        views = [make_view(finer(camera)) for camera in self._true]
        shapes = list(truth.shapes.values())
        self._inside_px = [
            [
                inside_px(
                    true_silhouette(
                        view, shapes, [truth.world_from_shape[name][frame] for name in truth.shapes]
                    )
                )
                for view in views
            ]
            for frame in self.frames
        ]

    def repeat(self, tally: Tally) -> None:
        """See the recording once more, with pixels that lie otherwise."""
        beside_px = self._rng.uniform(-0.5, 0.5, (len(self._true), 2))
        true = [
            replace(camera, params=camera.params + np.pad([0.0, 0.0, *by], (0, 4)))
            for camera, by in zip(self._true, beside_px, strict=True)
        ]
        rig, move = self._believed(true), self._layout.move
        views, lenses = rig_views(self._session, rig)
        shift_px = [lens_shift_px(*pair) for pair in zip(rig.cameras, lenses, strict=True)]
        doubter = Doubter(
            outline_errors(views.names, rig, shift_px, self._settings), self._settings
        )
        blocked, unsure, std_m = [], [], []
        for of_frame in self._inside_px:
            masks = [
                undistort_mask(self._mask(*seen), lens)
                for *seen, lens in zip(of_frame, true, beside_px, lenses, strict=True)
            ]
            hull = make_hull(views, masks)
            mine = blocked_shifts(hull, self._layout.moved, move)
            found = unsure_shifts(doubter.frame(hull), self._layout.moved, move, mine)
            blocked.append(union(mine.violated_m, mine.undecided_m))
            unsure.append(found.unsure_m)
            std_m.append(found.std_m)
        for kept, together in ((tally.found_m, blocked), (tally.at_95_m, unsure)):
            free_m = free_of(move, union(*together))
            kept.append(float(free_m[0, 0]) if len(free_m) else np.nan)
        tally.std_m.append(std_m[int(np.argmax([one[:, 1].max(initial=-1.0) for one in unsure]))])

    def _believed(self, true: list[Camera]) -> Rig:
        """Return a rig that is as far from the truth as the calibrated one says that it may be."""
        calibrated = self._calibrated.only([camera.name for camera in true])
        covariance = calibrated.covariance
        assert covariance is not None
        error = self._rng.multivariate_normal(
            np.zeros(len(covariance.labels)), covariance.matrix, method="eigh"
        )
        cameras = [
            replace(
                camera,
                cam_from_world=moved_pose(camera.cam_from_world, error[part][:6]),
                params=camera.params + error[part][6:],
            )
            for camera, part in zip(true, parameter_slices(calibrated.cameras), strict=True)
        ]
        return Rig(tuple(cameras), covariance=covariance)

    def _mask(
        self, inside_px: NDArray[np.float32], camera: Camera, beside_px: NDArray[np.float64]
    ) -> NDArray[np.uint8]:
        """Return a silhouette whose outline errs, smoothly along it."""
        width, height = camera.width_px, camera.height_px
        # The centre of pixel x, less what the image is beside, on the finer grid.
        column, row = FINER * (0.5 - beside_px) - 0.5
        at_centres = cv2.warpAffine(
            inside_px,
            np.array([[FINER, 0.0, column], [0.0, FINER, row]]),
            (width, height),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        )
        coarse = self._rng.normal(size=(height // _SMOOTH_PX + 4, width // _SMOOTH_PX + 4))
        error = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
        # Between its nodes an interpolated field varies less than at them.
        error *= self._settings.segmentation_px / np.sqrt(np.mean(error**2))
        return np.asarray(at_centres > error, np.uint8)


def payload(
    arguments: argparse.Namespace, recordings: Iterator[tuple[Path, Rig]]
) -> dict[str, float]:
    """Print how often the shift at 95 % suffices for generated recordings, and return it."""
    told: dict[str, float] = {}
    for number, (folder, rig) in enumerate(recordings, start=1):
        rng = np.random.default_rng(arguments.seed)
        with patch.dict(os.environ, HYBRIDVE_CACHE="off"):  # lenses are looked through but once
            task = Payload(folder, rig, arguments.mask_std_px, rng)
            tally = Tally([], [], [])
            for _ in range(arguments.repeats):
                task.repeat(tally)
        sys.stdout.write(
            f"{folder}: outlines {arguments.mask_std_px} px, {len(task.frames)} frames\n"
            f"  hull: {tally.text(task.truth.needed_hull_m)}\n"
            f"  shapes: {tally.text(task.truth.needed_m)}\n"
        )
        sys.stdout.flush()
        told[f"participant {number}.enough"] = tally.n_enough(task.truth.needed_hull_m)
    return told


def participants(folder: Path) -> Iterator[tuple[Path, Rig]]:
    """Generate and calibrate the recordings of all participants."""
    for participant in range(1, 5):
        place = folder / f"participant {participant}"
        write_session("payload", place, options={"participant": participant})
        yield place, calibrate_session(load_session(place)).rig


def one_frame(folder: Path) -> Iterator[tuple[Path, Rig]]:
    """Generate one frame of the first, whose rig is the true one and may be a little off."""
    place = folder / "one frame"
    with patch.multiple(write, N_STILLS=1, N_BOARD_FRAMES=1, N_BACKGROUND_FRAMES=1):
        write_session("payload", place, n_frames=1)
    cameras = tuple(read_truth(place).cameras)
    labels = tuple(
        f"{camera.name} {what}" for camera in cameras for what in camera_parameter_names(camera)
    )
    yield place, Rig(cameras, covariance=RigCovariance(labels, 1e-8 * np.eye(len(labels))))


def main(arguments: Sequence[str] | None = None) -> dict[str, float]:
    """Run what is asked for, and return its counts."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("kind", choices=["balls", "payload"], nargs="?")
    parser.add_argument("sessions", nargs="*", type=Path)
    parser.add_argument("--repeats", type=int, default=200)
    parser.add_argument("--mask-std-px", type=float, default=1.2)
    parser.add_argument("--frames", type=int, default=1)
    parser.add_argument("--tied", action="store_true")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--smallest", action="store_true", help="once, one frame")
    asked = parser.parse_args(arguments)
    if asked.kind == "balls":
        return balls(asked)
    if asked.kind == "payload":
        given = ((folder, load_rig(load_session(folder))) for folder in asked.sessions)
        return payload(asked, given)
    if asked.smallest:
        asked.repeats = 1
    with tempfile.TemporaryDirectory() as folder:
        make = one_frame if asked.smallest else participants
        return balls(asked) | payload(asked, make(Path(folder)))


if __name__ == "__main__":
    main()
