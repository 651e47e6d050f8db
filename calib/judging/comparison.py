"""How far a rig as it is stated is from one that boards show today, by what either can tell.

The two are compared up to what boards cannot tell, where the world is, and up to the rig's scale,
in the metric of what the boards tell about the cameras and their lenses; the errors that the stated
rig admits, its covariance, are let take their share.

This work is based on: Koch, *Parameter estimation and hypothesis testing in linear models*, 2nd
ed., 1999 (section 4.5, tests for single shifts); Abramowitz and Stegun, *Handbook of mathematical
functions*, 1964 (26.4, chi-squared).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.camera import Camera
from hybridve.calib.pose import nearest_rotation, rotation_vector
from hybridve.calib.solving.bundle import POSE
from hybridve.calib.solving.placement import Views, solve_scaled

#: Corners are at least this noisy.
LEAST_NOISE_PX = 0.05

#: What is smooth over a board: polynomials up to this degree. It counts as repeated from view to
#: view, a lens or board that is not quite as modelled, where it exceeds the noise of single points
#: by more than this many standard deviations.
_SMOOTH_DEGREE = 3
_EXCESS_SIGMAS = 3.0

#: The scale of a comparison of two rigs: steps at most, when they are small enough (a share), and
#: that of differences.
_MAX_TURNS = 12
_SCALE_CONVERGED = 1e-7
_STEP = 1e-5


def chance_of(statistic: float, freedom: int) -> float:
    """Return how often chi-squared with so many degrees of freedom is larger.

    Parameters
    ----------
    statistic : float
        The value of chi-squared, at least 0.
    freedom : int
        Degrees of freedom; with none, nothing is ever larger.

    Examples
    --------
    >>> round(chance_of(3.841459, 1), 4), round(chance_of(12.591587, 6), 4)
    (0.05, 0.05)
    """
    if freedom <= 0:
        return 1.0
    half = statistic / 2.0
    # Abramowitz and Stegun, 26.4.4 and 26.4.5.
    chance = math.erfc(math.sqrt(half)) if freedom % 2 else math.exp(-half)
    for order in range(2 - freedom % 2, freedom, 2):
        if half > 0:
            chance += math.exp(order / 2.0 * math.log(half) - half - math.lgamma(order / 2.0 + 1.0))
    return min(1.0, chance)


def variance_of(views: Views, residuals: NDArray[np.float64], cameras: Sequence[int]) -> float:
    """Return the variance of a coordinate that disagreement is compared with, pixels squared.

    That of what is smooth over the boards, by which poses are moved, and at least that of single
    points. Smooth misses beyond the noise repeat from view to view, and do not average out. Of
    several cameras the median counts, so that one with another lens does not hide itself.

    Parameters
    ----------
    views : Views
        What was seen.
    residuals : (V, N, 2) float64
        Observed minus projected points, pixels, once cameras and boards were let free.
    cameras : sequence of int
        The cameras that count.
    """
    n_seen = views.seen.sum(axis=1)
    shared = np.bincount(views.place)
    found = []
    for index in cameras:
        own = np.flatnonzero((views.camera == index) & (n_seen > 0))
        smooth = rough = 0.0
        n_smooth, n_rough = 0, 0
        for number in own:
            seen = views.seen[number]
            basis = _smooth_basis(views.points[number, seen, :2])
            rows = residuals[number, seen]
            fitted = basis @ (basis.T @ rows)
            smooth += float((fitted**2).sum())
            rough += float(((rows - fitted) ** 2).sum())
            n_smooth += 2 * basis.shape[1]
            n_rough += 2 * (len(rows) - basis.shape[1])
        # The camera's pose, and its part of those of the boards, have taken their share.
        taken = POSE + POSE * float((1.0 / shared[views.place[own]]).sum())
        left = max(n_smooth - taken, 1.0)
        of_rough = rough / n_rough if n_rough > 0 else 0.0
        of_smooth = smooth / left if n_smooth > 1.1 * taken else of_rough
        chance = 1.0 + _EXCESS_SIGMAS * math.sqrt(2.0 / left)
        excess = max(0.0, of_smooth - of_rough * chance) if n_rough else 0.0
        found.append(max(of_rough, of_smooth) + excess * (len(own) - 1))
    return max(float(np.median(found)), LEAST_NOISE_PX**2)


def _smooth_basis(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return an orthonormal basis (S, K) of the smooth functions over points (S, 2) of a board."""
    centred = points - points.mean(axis=0)
    x, y = (centred / max(float(np.abs(centred).max()), 1e-12)).T
    powers = range(_SMOOTH_DEGREE + 1)
    terms = [x**i * y**j for i in powers for j in powers if i + j <= _SMOOTH_DEGREE]
    u, values, _ = np.linalg.svd(np.column_stack(terms), full_matrices=False)
    return np.asarray(u[:, values > 1e-9 * values[0]])


def root_of(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return L (P, K) with ``L @ L.T`` the covariance (P, P), which may be singular."""
    sigma = np.sqrt(np.diag(covariance))
    sigma[sigma == 0] = 1.0
    values, vectors = np.linalg.eigh(covariance / np.outer(sigma, sigma))
    kept = values > 1e-14 * max(float(values.max(initial=0.0)), 1e-300)
    return np.asarray(sigma[:, None] * vectors[:, kept] * np.sqrt(values[kept]))


@dataclass(frozen=True, slots=True, eq=False)
class _Similarity:
    """Where today's world stands in the rig's: ``x_rig = scale * rotation @ x_today + shift``."""

    rotation: NDArray[np.float64]
    shift: NDArray[np.float64]
    scale: float


@dataclass(frozen=True, slots=True, eq=False)
class Disagreement:
    """Squared, in units of its variance, up to a constant; and the scale at which it is least."""

    cost: float
    log_scale: float
    log_scale_sigma: float


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """A rig as it is stated, and as boards show some of its cameras today.

    Attributes
    ----------
    stated, today : tuple of Camera
        Cameras in the rig's world, and in one of their own at true scale.
    cameras : tuple of int
        Those that are compared.
    spans : sequence of slice
        Their parameters' columns.
    information : (P, P) float64
        What the boards tell of the parameters, at true scale.
    gradient : (P,) float64
        Half the derivative of the squared misses by these.
    root : (P, K) float64
        Of the covariance of the stated parameters; no column where they count as exact.
    """

    stated: tuple[Camera, ...]
    today: tuple[Camera, ...]
    cameras: tuple[int, ...]
    spans: Sequence[slice]
    information: NDArray[np.float64]
    gradient: NDArray[np.float64]
    root: NDArray[np.float64]

    def disagreement(self, loose: Sequence[int]) -> Disagreement:
        """Return how far the cameras disagree, some of them let loose.

        Unknown are the errors of the rig, which its covariance holds back, its scale, and the poses
        of loose cameras. Where today's world is in the rig's makes no difference to first order:
        the boards, wherever they are, do not tell. It is taken from the cameras that are held.
        """
        held = [index for index in self.cameras if index not in loose]
        is_scaled = len(held) > 1
        similarity = self._nearest(held or list(self.cameras))
        free = [self.spans[index].start + k for index in loose for k in range(POSE)]
        loosened = np.zeros((len(self.information), len(free)))
        loosened[free, range(len(free))] = 1.0
        n_root = self.root.shape[1]
        cost, log_sigma = np.inf, np.inf
        for _ in range(_MAX_TURNS):
            off = self._off(similarity)
            errors = self.root.copy()
            for index in self.cameras:
                first = self.spans[index].start
                errors[first + 3 : first + POSE] /= similarity.scale
            larger, smaller = (
                self._off(self._nearest(held or list(self.cameras), similarity.scale * factor))
                for factor in (np.exp(_STEP), np.exp(-_STEP))
            )
            by_scale = (larger - smaller)[:, None] / (2.0 * _STEP) * is_scaled
            design = np.concatenate([errors, loosened, -by_scale], axis=1)
            normal = design.T @ self.information @ design
            normal[range(n_root), range(n_root)] += 1.0
            right = design.T @ (self.information @ off - self.gradient)
            solution, inverse = solve_scaled(normal, right)
            left = design @ solution - off
            cost = float(left @ self.information @ left + 2.0 * self.gradient @ left)
            cost += float((solution[:n_root] ** 2).sum())
            log_sigma = float(np.sqrt(max(inverse[-1, -1], 0.0)))
            change = float(np.clip(solution[-1], -1.0, 1.0))
            if not is_scaled or abs(change) < _SCALE_CONVERGED:
                break
            similarity = self._nearest(held, similarity.scale * math.exp(change))
        return Disagreement(cost, math.log(similarity.scale), log_sigma)

    def _off(self, similarity: _Similarity) -> NDArray[np.float64]:
        """Return by how much (P,) today's poses are off the stated ones, at true scale."""
        off = np.zeros(len(self.information))
        for index in self.cameras:
            today, stated = self.today[index].cam_from_world, self.stated[index].cam_from_world
            rotation = today[:, :3] @ similarity.rotation.T
            shift = similarity.scale * today[:, 3] - rotation @ similarity.shift
            relative = rotation @ stated[:, :3].T
            first = self.spans[index].start
            off[first : first + 3] = rotation_vector(relative)
            off[first + 3 : first + POSE] = (shift - relative @ stated[:, 3]) / similarity.scale
        return off

    def _nearest(self, held: Sequence[int], scale: float | None = None) -> _Similarity:
        """Return the similarity that takes cameras onto the stated ones, in closed form."""
        together = sum(
            self.stated[index].cam_from_world[:, :3].T @ self.today[index].cam_from_world[:, :3]
            for index in held
        )
        rotation = nearest_rotation(np.asarray(together))
        centers = np.array([self.stated[index].center_world for index in held])
        turned = np.array([self.today[index].center_world for index in held]) @ rotation.T
        if scale is None:
            # By their distances: they tell it even where cameras stand elsewhere altogether.
            spread, spread_today = (
                float(np.linalg.norm(np.std(places, axis=0))) for places in (centers, turned)
            )
            scale = spread / max(spread_today, 1e-12)
            scale = scale if len(held) > 1 and scale > 0 else 1.0
        return _Similarity(rotation, centers.mean(axis=0) - scale * turned.mean(axis=0), scale)
