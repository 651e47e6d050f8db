"""How often the shift that suffices at 95 % does, over recordings whose cameras and outlines err.

Two kinds of task:

* balls before a wall in closed form (`helpers.erring_task`), where one frame decides, or several
  need the same room;
* recordings of the preset "payload", generated and calibrated: in every repeat the cameras are
  believed to stand where the rig's own covariance lets them, one draw for all frames, and all
  outlines are those of the true shapes, moved outward or inward by a normal error, smooth along
  the outline, another one for each camera and frame. Nothing is rendered.

Told are the share of repeats in which the truth is not above the shift at 95 %, and above the shift
that is found without it; the error's mean and standard deviation; and the deviation stated.

Run: OPENBLAS_NUM_THREADS=1 python tests/benchmarks/bench_spacing_doubt.py balls --frames 1
     OPENBLAS_NUM_THREADS=1 python tests/benchmarks/bench_spacing_doubt.py payload SESSION...
"""

import argparse
import os
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[1]))

from helpers.erring_task import erring_task

from hybridve.calib.bundle import moved_pose
from hybridve.calib.rig import Rig
from hybridve.calib.uncertainty import parameter_slices
from hybridve.hull.capture.recording import undistort_mask
from hybridve.hull.capture.rig import load_rig
from hybridve.hull.capture.session import Session, load_session
from hybridve.hull.capture.synth.truth import SpacingTruth, read_truth, true_masks
from hybridve.hull.contact.scene import load_scene
from hybridve.hull.contact.spacing import Move, blocked_shifts, free_of, union
from hybridve.hull.contact.spacing_doubt import unsure_shifts
from hybridve.hull.contact.uncertainty import Doubter, DoubtSettings, outline_errors
from hybridve.hull.evaluate import rig_views
from hybridve.hull.query.silhouettes import make_hull
from hybridve.hull.spacing import Layout

#: Frames that need less room than the recording by more than this decide nothing, metres.
_NEAR_M = 0.025

#: The error of an outline is alike over so many pixels.
_SMOOTH_PX = 40

#: Outlines are found anew on a grid so many times finer.
_FINER = 4


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
        return (
            f"truth {1e3 * truth_m:.1f} mm; not above the shift at 95 %: {(at_95 >= truth_m).sum()}"
            f" of {len(found)}, above the shift found: {(found < truth_m).sum()}; error mean "
            f"{error.mean():+.2f}, std {error.std():.2f}, median {np.median(error):+.2f} mm; std "
            f"stated {1e3 * np.nanmean(self.std_m):.2f} mm"
        )


def balls(arguments: argparse.Namespace) -> None:
    """Print how often the shift at 95 % suffices for balls before a wall."""
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


class Payload:
    """A generated recording, to be seen with errors again and again."""

    def __init__(self, folder: Path, mask_std_px: float, rng: np.random.Generator) -> None:
        self._session: Session = load_session(folder)
        self._calibrated = load_rig(self._session)
        truth = read_truth(folder)
        by_name = {camera.name: camera for camera in truth.cameras}
        self._true = by_name
        self.truth: SpacingTruth = truth.spacing["payload_a"]
        self._settings, self._rng = DoubtSettings(segmentation_px=mask_std_px), rng
        move = Move(np.asarray(self.truth.along), -0.05, 0.15, 1e-3)
        self._layout = Layout.of(load_scene(folder / "scene.toml"), ["payload_a"], move)
        needed_m = self.truth.needed_hull_by_frame_m
        self.frames = np.flatnonzero(needed_m > needed_m.max() - _NEAR_M).tolist()
        self._inside_px = [
            [_inside_px(masks[camera.name]) for camera in self._session.cameras]
            for masks in (true_masks(folder, frame) for frame in self.frames)
        ]

    def repeat(self, tally: Tally) -> None:
        """See the recording once more."""
        rig, move = self._believed(), self._layout.move
        views, lenses = rig_views(self._session, rig)
        errors = outline_errors(views.names, {}, [0.0] * len(views), self._settings, rig)
        doubter = Doubter(errors, self._settings)
        blocked, unsure, std_m = [], [], []
        for inside_px in self._inside_px:
            masks = [
                undistort_mask((one > self._error_px(one.shape)).astype(np.uint8), lens)
                for one, lens in zip(inside_px, lenses, strict=True)
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

    def _believed(self) -> Rig:
        """Return a rig that is as far from the truth as the calibrated one says that it may be."""
        covariance = self._calibrated.covariance
        assert covariance is not None
        error = self._rng.multivariate_normal(
            np.zeros(len(covariance.labels)), covariance.matrix, method="eigh"
        )
        cameras = []
        calibrated = self._calibrated.cameras
        for camera, part in zip(calibrated, parameter_slices(calibrated), strict=True):
            true = self._true[camera.name]
            change = error[part]
            cameras.append(
                replace(
                    true,
                    cam_from_world=moved_pose(true.cam_from_world, change[:6]),
                    params=true.params + change[6:],
                )
            )
        return Rig(tuple(cameras), covariance=covariance)

    def _error_px(self, shape: tuple[int, ...]) -> NDArray[np.float32]:
        """Return by how much an outline lies farther in, all over an image: smooth and normal."""
        height, width = shape
        coarse = self._rng.normal(size=(height // _SMOOTH_PX + 4, width // _SMOOTH_PX + 4))
        field = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
        # Between its nodes an interpolated field varies less than at them.
        return np.asarray(
            self._settings.segmentation_px * field / float(np.sqrt(np.mean(field**2))), np.float32
        )


def _inside_px(mask: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return how deep the centre of each pixel lies in a silhouette, pixels, negative outside."""
    size = (_FINER * mask.shape[1], _FINER * mask.shape[0])
    fine = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_LINEAR) > 0.5
    depth = cv2.distanceTransform(fine.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    away = cv2.distanceTransform((~fine).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    signed = np.where(fine, depth - 0.5, 0.5 - away) / _FINER
    return np.asarray(
        cv2.resize(signed, mask.shape[::-1], interpolation=cv2.INTER_AREA), np.float32
    )


def payload(arguments: argparse.Namespace) -> None:
    """Print how often the shift at 95 % suffices for generated recordings."""
    os.environ["HYBRIDVE_CACHE"] = "off"  # of lenses that are looked through but once
    for folder in arguments.sessions:
        task = Payload(folder, arguments.mask_std_px, np.random.default_rng(arguments.seed))
        tally = Tally([], [], [])
        for _ in range(arguments.repeats):
            task.repeat(tally)
        sys.stdout.write(
            f"{folder}: outlines {arguments.mask_std_px} px, {len(task.frames)} frames\n"
            f"  hull: {tally.text(task.truth.needed_hull_m)}\n"
            f"  shapes: {tally.text(task.truth.needed_m)}\n"
        )
        sys.stdout.flush()


def main() -> None:
    """Run what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("kind", choices=["balls", "payload"])
    parser.add_argument("sessions", nargs="*", type=Path)
    parser.add_argument("--repeats", type=int, default=200)
    parser.add_argument("--mask-std-px", type=float, default=1.2)
    parser.add_argument("--frames", type=int, default=1)
    parser.add_argument("--tied", action="store_true")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    (balls if arguments.kind == "balls" else payload)(arguments)


if __name__ == "__main__":
    main()
