"""How noisy the points of boards are, told apart from what a model does not fit."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.boards.board import is_seen
from hybridve.calib.record import Noise
from hybridve.calib.solving.bundle import (
    POSE,
    Adjusted,
    Bundle,
)

#: What is smooth over a board: polynomials in its coordinates up to this degree.
_SMOOTH_DEGREE = 3

#: The smooth part of residuals is a misfit, or a group of views noisier or quieter than others, if
#: its mean square is larger, or other, by so many standard deviations of what chance does.
_MISFIT_SIGMAS = 2.0
_GROUP_SIGMAS = 3.0


def measure_noise(adjusted: Adjusted) -> Noise:
    """Return how noisy the points of an adjusted bundle were."""
    return _group_sums(adjusted, [""] * len(adjusted.bundle.views))[""].noise()


def measure_group_noise(adjusted: Adjusted, groups: Sequence[str]) -> dict[str, Noise]:
    """Return how noisy the points of groups of views were.

    Parameters
    ----------
    adjusted : Adjusted
        The bundle after its adjustment.
    groups : sequence of str
        For each view of the bundle its group; views of one pose should be of one.

    Returns
    -------
    dict of str to Noise
        By group. A group whose noise differs from that of all views by no more than chance allows
        (`_GROUP_SIGMAS`) is told with that of all.
    """
    whole = measure_noise(adjusted)
    found = {}
    for name, sums in _group_sums(adjusted, groups).items():
        own = sums.noise()
        left = sums.n_smooth - sums.n_parameters
        ratio = (own.smooth_px / whole.smooth_px) ** 2 if whole.smooth_px > 0 else 1.0
        chance = _GROUP_SIGMAS * np.sqrt(2.0 / left) if left > 0 else np.inf
        if not abs(ratio - 1.0) > chance:
            own = replace(own, rough_px=whole.rough_px, smooth_px=whole.smooth_px)
        found[name] = own
    return found


@dataclass(slots=True)
class _Sums:
    """Squares of residuals, smooth and rough, and how many numbers they stand for."""

    smooth: float = 0.0
    rough: float = 0.0
    n_smooth: int = 0
    n_rough: int = 0
    n_points: int = 0
    n_parameters: float = 0.0

    def noise(self) -> Noise:
        total, freedom = self.smooth + self.rough, 2 * self.n_points - self.n_parameters
        pooled = total / max(1.0, freedom)
        rough = self.rough / self.n_rough if self.n_rough else pooled
        # The parameters have taken their share of what is smooth. What chance explains is no
        # misfit of model or boards.
        left = self.n_smooth - self.n_parameters
        smooth = self.smooth / left if left > self.n_smooth / 10 else pooled
        if smooth < rough * (1.0 + _MISFIT_SIGMAS * np.sqrt(2.0 / max(1.0, left))):
            smooth = rough = pooled
        expected = rough * max(1.0, freedom)
        return Noise(
            float(np.sqrt(rough)),
            float(np.sqrt(smooth)),
            float(np.sqrt(total / max(1, self.n_points))),
            min(1.0, float(expected / total)) if total > 0 else 1.0,
            self.n_points,
            round(self.n_parameters),
        )


def _group_sums(adjusted: Adjusted, groups: Sequence[str]) -> dict[str, _Sums]:
    bundle, layout = adjusted.bundle, adjusted.layout
    sums: dict[str, _Sums] = {}
    of_lens: dict[int, dict[str, int]] = {}
    of_camera: dict[int, dict[str, int]] = {}
    of_pose: dict[int, str] = {}
    for view, missed, group in zip(bundle.views, adjusted.residuals_px, groups, strict=True):
        seen = is_seen(view.pixels)
        points, rows = bundle.points_board[view.board][seen, :2], missed[seen]
        basis = _smooth_basis(points)
        fitted = basis @ (basis.T @ rows)
        own = sums.setdefault(group, _Sums())
        own.smooth += float((fitted**2).sum())
        own.rough += float(((rows - fitted) ** 2).sum())
        own.n_smooth += 2 * basis.shape[1]
        own.n_rough += 2 * (len(rows) - basis.shape[1])
        own.n_points += len(rows)
        if view.pose not in of_pose and view.pose != bundle.held_pose:
            own.n_parameters += POSE
        of_pose[view.pose] = group
        lens = bundle.lens_of[view.camera]
        for table, key in ((of_lens, lens), (of_camera, view.camera)):
            counts = table.setdefault(key, {})
            counts[group] = counts.get(group, 0) + 2 * basis.shape[1]
    # A lens is told by all of its views. A camera's place is told by the poses that others saw,
    # too; a still of one camera alone says nothing of it.
    shared = _shared_groups(bundle, groups)
    for lens, counts in of_lens.items():
        if lens in layout.of_lens:
            span = layout.of_lens[lens]
            _share_out(sums, counts, span.stop - span.start)
    for counts in of_camera.values():
        told = {group: count for group, count in counts.items() if group in shared}
        _share_out(sums, told or counts, POSE)
    _share_out(sums, dict.fromkeys(shared or sums, 1), POSE * len(layout.of_board))
    return sums


def _shared_groups(bundle: Bundle, groups: Sequence[str]) -> set[str]:
    """Return the groups with a pose that tells where cameras are."""
    cameras: dict[int, set[int]] = {}
    for view in bundle.views:
        cameras.setdefault(view.pose, set()).add(view.camera)
    return {
        group
        for view, group in zip(bundle.views, groups, strict=True)
        if len(cameras[view.pose]) > 1 or view.pose == bundle.held_pose
    }


def _share_out(sums: dict[str, _Sums], counts: Mapping[str, int], n_parameters: int) -> None:
    total = sum(counts.values())
    for group, count in counts.items():
        sums[group].n_parameters += n_parameters * count / total


def _smooth_basis(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return an orthonormal basis (S, K) of the smooth functions over points (S, 2) of a board."""
    centred = points - points.mean(axis=0)
    x, y = (centred / max(float(np.abs(centred).max()), 1e-12)).T
    degree = _SMOOTH_DEGREE
    terms = [x**i * y**j for i in range(degree + 1) for j in range(degree + 1 - i)]
    u, values, _ = np.linalg.svd(np.column_stack(terms), full_matrices=False)
    return np.asarray(u[:, values > 1e-9 * values[0]])
