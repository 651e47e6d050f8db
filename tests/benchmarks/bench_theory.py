"""Calibration against theory: errors beside the Cramer-Rao bound, and how often they are as stated.

Rings of cameras see a board that lies still, and boards in hand, with normal noise of known size;
one rig is linked by a moved board alone. Over many seeds the whole of `solve_rig` runs on the
corners; told are

* the root mean square error of the cameras' places and turns, by the least that any unbiased
  estimate can have (the inverse of the information at the truth);
* in how many of the calibrations the error of a point, as the rig places what the true cameras
  see, stays within the radius that the rig states for 95 %.

Each is told with its standard error, from what differs between calibrations.

Run: OPENBLAS_NUM_THREADS=1 python tests/benchmarks/bench_theory.py -o theory.png
(--seeds 0 draws what stands in the JSON beside the picture; of a JSON no picture is drawn.)
"""

import argparse
import json
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from itertools import islice
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[1]))

from helpers.theory import (
    BOARD,
    Scene,
    least_covariance,
    moving_scene,
    observed,
    parameter_errors,
    placed,
    still_scene,
)

from hybridve.calib.calibrate import solve_rig
from hybridve.calib.placing.settings import CalibrationSettings
from hybridve.calib.solving.errors_in_space import parameter_slices, point_errors
from hybridve.calib.solving.lens_fit import LensSettings

N_STILLS = 20
N_FRAMES = 60

#: Where the error of a point is asked, about the middle of the board (metres).
POINTS = BOARD.center_board + np.array(
    [[0.0, 0.0, 0.1], [0.3, 0.2, 0.3], [-0.3, 0.1, 0.5], [0.1, -0.3, 0.7], [-0.2, -0.2, 0.2]]
)

#: After so many calibrations what stands is written.
CHUNK = 20


@dataclass(frozen=True)
class Case:
    """A rig that is calibrated many times."""

    n_cameras: int
    noise_px: float
    moves: bool
    share: float  # of the seeds that are asked for

    @property
    def label(self) -> str:
        board = f"board moved, {N_FRAMES} frames" if self.moves else f"{N_STILLS} stills each"
        return f"{self.n_cameras} cameras, {board}, {self.noise_px:g} px"

    @property
    def settings(self) -> CalibrationSettings:
        """Those that take so noisy views: by default views may miss by 1 px rms at most."""
        return CalibrationSettings(lens=LensSettings(max_view_px=max(1.0, 4.0 * self.noise_px)))

    @property
    def scene(self) -> Scene:
        if self.moves:
            return moving_scene(self.n_cameras, N_FRAMES)
        return still_scene(self.n_cameras, N_STILLS)


CASES = (
    Case(4, 0.3, False, 1.0),
    Case(8, 0.3, False, 0.5),
    Case(16, 0.3, False, 0.3),
    Case(4, 0.1, False, 0.5),
    Case(4, 1.0, False, 0.5),
    Case(4, 0.3, True, 0.5),
)


def main(arguments: Sequence[str] | None = None) -> dict[str, float]:
    """Calibrate; tell a line a case, write all as JSON beside the picture, and draw it.

    Returns what stands in the JSON for each case, as single numbers.
    """
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("-o", "--output", type=Path, default=Path("theory.png"))
    parser.add_argument("--seeds", type=int, default=200)
    parser.add_argument("--cases", type=int, nargs="+", default=range(len(CASES)))
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--smallest", action="store_true", help="3 cameras, twice, no picture")
    asked = parser.parse_args(arguments)
    if asked.smallest:
        return numbers(*calibrate_often(Case(3, 0.3, False, 1.0), 2, 1))
    path = asked.output.with_suffix(".json")
    rows = {row["case"]: row for row in json.loads(path.read_text())} if path.exists() else {}
    if asked.seeds:
        for case in (CASES[number] for number in asked.cases):
            n_seeds = max(2, round(asked.seeds * case.share))
            for row in calibrate_often(case, n_seeds, asked.processes):
                rows[case.label] = row
                ordered = [json.dumps(rows[one.label]) for one in CASES if one.label in rows]
                path.write_text("[\n" + ",\n".join(ordered) + "\n]\n")
            tell(rows[case.label])
    if asked.output != path:
        draw([rows[case.label] for case in CASES if case.label in rows], asked.output)
    return numbers(*rows.values())


def numbers(*rows: dict[str, Any]) -> dict[str, float]:
    """Return errors by the bound and the share within what is stated, of each case."""
    found: dict[str, float] = {}
    for row in rows:
        found |= {
            f"{row['case']}.place_by_bound": row["place_by_bound"][0],
            f"{row['case']}.turn_by_bound": row["turn_by_bound"][0],
            f"{row['case']}.within_stated_percent": 100.0 * row["within_stated_95"][0],
        }
    return found


@lru_cache(maxsize=1)
def _scene_and_bound(case: Case) -> tuple[Scene, NDArray[np.float64]]:
    scene = case.scene
    return scene, least_covariance(scene, case.noise_px)


@dataclass(frozen=True)
class Trial:
    """What one calibration gave."""

    place: NDArray[np.float64]  # (C,) squared error by the bound's variance
    turn: NDArray[np.float64]  # (C,)
    by_stated: NDArray[np.float64]  # (points,) error by the stated 95 % radius
    seconds: float


def calibrate_once(case: Case, seed: int) -> Trial:
    """Calibrate one rig from corners with noise of their own."""
    scene, bound = _scene_and_bound(case)
    observations = observed(scene, case.noise_px, seed)
    start = time.perf_counter()
    rig = solve_rig([BOARD], observations, case.settings).rig
    seconds = time.perf_counter() - start
    errors, variances = parameter_errors(rig, scene.rig), np.diag(bound)
    place, turn = [], []
    for span in parameter_slices(scene.cameras):
        of_turn, of_place = (slice(span.start + at, span.start + at + 3) for at in (0, 3))
        place.append(float((errors[of_place] ** 2).sum() / variances[of_place].sum()))
        turn.append(float((errors[of_turn] ** 2).sum() / variances[of_turn].sum()))
    errors_m = np.linalg.norm(placed(rig, scene.rig, POINTS) - POINTS, axis=1)
    stated_m = point_errors(rig, POINTS).radius95_m
    return Trial(np.array(place), np.array(turn), errors_m / stated_m, seconds)


def calibrate_often(case: Case, n_seeds: int, n_processes: int) -> Iterator[dict[str, Any]]:
    """Calibrate one rig with noise that differs; give what stands after each chunk of seeds."""
    trials: list[Trial] = []
    if n_processes == 1:
        results = (calibrate_once(case, seed) for seed in range(n_seeds))
        while chunk := list(islice(results, CHUNK)):
            trials += chunk
            yield summed_up(case, trials)
        return
    with ProcessPoolExecutor(n_processes, get_context("spawn")) as pool:
        spread = pool.map(calibrate_once, [case] * n_seeds, range(n_seeds))
        while chunk := list(islice(spread, CHUNK)):
            trials += chunk
            yield summed_up(case, trials)


def summed_up(case: Case, trials: list[Trial]) -> dict[str, Any]:
    """Return what many calibrations gave, as plain values."""
    place = np.array([trial.place for trial in trials])
    turn = np.array([trial.turn for trial in trials])
    by_stated = np.array([trial.by_stated for trial in trials])
    inside = (by_stated <= 1.0).mean(axis=1)
    bound = np.sqrt(np.diag(_scene_and_bound(case)[1]))
    places = [
        np.linalg.norm(bound[span][3:6])
        for span in parameter_slices(_scene_and_bound(case)[0].cameras)
    ]

    def root(squares: NDArray[np.float64]) -> tuple[float, float]:
        """Return the root of the mean (S,), and its standard error."""
        mean = float(squares.mean())
        error = float(squares.std(ddof=1)) / np.sqrt(len(squares)) / (2.0 * np.sqrt(mean))
        return round(float(np.sqrt(mean)), 4), round(float(error), 4)

    return {
        "case": case.label,
        "cameras": case.n_cameras,
        "noise_px": case.noise_px,
        "calibrations": len(trials),
        "bound_of_place_mm": round(1000.0 * float(np.sqrt(np.mean(np.square(places)))), 4),
        "place_by_bound": root(place.mean(axis=1)),
        "turn_by_bound": root(turn.mean(axis=1)),
        "place_by_bound_of_cameras": [root(column) for column in place.T],
        "turn_by_bound_of_cameras": [root(column) for column in turn.T],
        "within_stated_95": [
            round(float(inside.mean()), 4),
            round(float(inside.std(ddof=1) / np.sqrt(len(inside))), 4),
        ],
        "error_by_stated_percentiles": [
            round(float(value), 4) for value in np.percentile(by_stated, np.arange(0, 100.5, 1))
        ],
        "median_s": round(float(np.median([trial.seconds for trial in trials])), 3),
    }


def tell(row: dict[str, Any]) -> None:
    """Write one line."""

    def worst(cameras: list[tuple[float, float]]) -> str:
        value, error = max(cameras)
        return f"{value:.3f} ± {error:.3f}"

    sys.stdout.write(
        f"{row['case']}: {row['calibrations']} calibrations of {row['median_s']:.2f} s; place "
        "error {:.3f} ± {:.3f} of the bound".format(*row["place_by_bound"])
        + f" (worst camera {worst(row['place_by_bound_of_cameras'])}), turn "
        + "{:.3f} ± {:.3f}".format(*row["turn_by_bound"])
        + f" ({worst(row['turn_by_bound_of_cameras'])}); within the stated 95 % radius "
        + "{:.1%} ± {:.1%}\n".format(*row["within_stated_95"])
    )
    sys.stdout.flush()


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Draw errors by the bound, and how often errors stay within shares of what is stated."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(
        1, 2, figsize=(10.0, 4.2), layout="constrained", width_ratios=[1.35, 1.0]
    )
    labels = []
    for index, row in enumerate(rows):
        color = f"C{index}"
        n_cameras = row["cameras"]
        x = index + (np.linspace(-0.32, 0.32, n_cameras) if n_cameras > 1 else np.zeros(1))
        for kind, marker, face in (("place", "o", color), ("turn", "^", "white")):
            values = np.array(row[f"{kind}_by_bound_of_cameras"])
            left.errorbar(
                *(x + 0.012 * (kind == "turn"), values[:, 0], values[:, 1]),
                fmt=marker,
                **{"ms": 4, "color": color, "mfc": face, "elinewidth": 0.6, "zorder": 3},
            )
            left.hlines(
                row[f"{kind}_by_bound"][0],
                *(index - 0.38, index + 0.38),
                **{"color": color, "lw": 1.2, "ls": "-" if kind == "place" else ":"},
            )
        label = row["case"].split(", ")
        noise = f"{row['noise_px']:g} px"
        what = "moved board" if "moved" in row["case"] else "still board"
        labels.append(f"{label[0]}\n{what}\n{noise}\n{row['calibrations']} times")
        right.plot(
            row["error_by_stated_percentiles"],
            np.arange(101),
            color=color,
            label=f"{label[0]}, {what}, {noise}: {row['within_stated_95'][0]:.1%}",
        )
    left.axhspan(1.0, 1.1, color="tab:green", alpha=0.12, lw=0)
    left.axhline(1.0, color="black", lw=1)
    left.axhline(1.1, color="grey", lw=1, ls="--")
    left.set_xticks(range(len(rows)), labels, fontsize=8)
    left.set(ylim=(0.78, 1.28), ylabel="rms error / least possible (Cramér-Rao)")
    left.set_title("One mark a camera, and their mean: ● — place, △ ··· turn", fontsize=10)
    right.axhspan(93, 97, color="tab:green", alpha=0.15, lw=0)
    right.axvline(1.0, color="black", lw=1)
    right.axhline(95, color="grey", lw=0.8, ls="--")
    right.set(
        xlabel="error of a point / stated 95 % radius",
        ylabel="calibrations below, %",
        xlim=(0, 1.6),
        ylim=(0, 100),
    )
    right.set_title("Stated 95 %: how many were within", fontsize=10)
    right.legend(frameon=False, fontsize=7.5, loc="lower right")
    for axes in (left, right):
        axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=100)


if __name__ == "__main__":
    main()
