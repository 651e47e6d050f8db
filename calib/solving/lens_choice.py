"""Which lens model the views call for: an information criterion over COLMAP's models.

All candidates are fitted to the same corners, those that a flexible lens finds good, and compared
by the Bayesian information criterion, with two precautions for real pictures:

* Noise is taken from the best candidate's residuals, robustly (`hybridve.calib.solving.lens_fit`).
* Residuals of one view hang together (a bent board, blur, the light), so that N coordinates tell
  less than N independent ones would. How much less shows in the views' scores, the pulls of each
  view at the lens: their spread over what independent noise would give is the inflation c (trace of
  Takeuchi's criterion by the number of parameters). The criterion is ``cost / (sigma^2 c) +
  k log(N / c)``: N / c is the number of coordinates that would tell as much.

This work is based on: Schwarz, *Estimating the dimension of a model*, Annals of Statistics 6(2),
1978; Takeuchi, *Distribution of informational statistics*, 1976 (in Burnham and Anderson, *Model
selection*, 2002, sections 2.5 and 7.3); White, *Maximum likelihood estimation of misspecified
models*, Econometrica 50(1), 1982; Kass and Raftery, *Bayes factors*, JASA 90, 1995.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.boards.board import Board, Observations
from hybridve.calib.camera import N_PARAMS, Camera
from hybridve.calib.errors import CalibrationError
from hybridve.calib.record import CandidateLens, LensChoice
from hybridve.calib.solving.lens_adjust import Batch, LensAdjustment, adjust_lens, batch_residuals
from hybridve.calib.solving.lens_fit import (
    FittedLens,
    LensSettings,
    collect_views,
    fit_batch,
    make_batch,
    noise_of,
    share_out,
)
from hybridve.calib.solving.lens_judge import Fit, refuse_degenerate
from hybridve.calib.solving.lens_seed import imitate
from hybridve.calib.solving.locate import are_finite, rays_of

#: The lenses that corners are judged by: between them they do what the candidates do.
_FLEXIBLE = ("OPENCV_FISHEYE", "OPENCV")

#: The candidates, simple ones first. COLMAP's thin prism models describe tilted sensors and are
#: left to those who ask for them.
CANDIDATES = (
    "SIMPLE_PINHOLE",
    "SIMPLE_FISHEYE",
    "PINHOLE",
    "FISHEYE",
    "SIMPLE_RADIAL",
    "SIMPLE_RADIAL_FISHEYE",
    "SIMPLE_DIVISION",
    "RADIAL",
    "RADIAL_FISHEYE",
    "DIVISION",
    "FOV",
    "EUCM",
    "OPENCV",
    "OPENCV_FISHEYE",
    "FULL_OPENCV",
)

#: Candidates this close to the best are as good (Kass and Raftery: below 2 the evidence is not
#: worth a mention); the simplest of them is taken.
_TIE = 2.0

#: Corners further off the axis are beyond lenses that are polynomials in the tangent of the angle.
_TANGENT_DEG = 70.0
_OF_TANGENT = {"SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"}

#: Steps in which a candidate shows what it can do; the one that is chosen is adjusted to the end.
_TRIAL_STEPS = 25
_TRIAL_TOLERANCE = 1e-6

#: More of the image than this in which the lens sees nothing is told.
_UNSEEN_TOLD = 0.02

#: The scores of fewer views than this say nothing of how residuals hang together.
_LEAST_SCORED_VIEWS = 8

#: A parameter is told apart from zero beyond so many standard deviations.
_TOLD_APART = 3.0

#: Places across and down an image at which a lens must see.
_GRID = (13, 9)

#: What the coefficients of a model that can be zero are called, after its pixel parameters.
_COEFFICIENTS = {
    "SIMPLE_RADIAL": ("k1",),
    "RADIAL": ("k1", "k2"),
    "SIMPLE_RADIAL_FISHEYE": ("k1",),
    "RADIAL_FISHEYE": ("k1", "k2"),
    "OPENCV": ("k1", "k2", "p1", "p2"),
    "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4"),
    "FULL_OPENCV": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "SIMPLE_DIVISION": ("k",),
    "DIVISION": ("k",),
}


@dataclass(frozen=True, slots=True, eq=False)
class _Candidate:
    lens: LensAdjustment
    noise_px: float
    rms_px: float
    unseen: float  # the share of the image in which it sees nothing

    @property
    def model(self) -> str:
        return self.lens.camera.model


def choose_lens(
    boards: Sequence[Board], seen: Observations, settings: LensSettings | None = None
) -> FittedLens:
    """Fit a camera's lens with the model that its views call for.

    Parameters
    ----------
    boards : sequence of Board
        The boards.
    seen : Observations
        Of the camera; its model does not matter.
    settings : LensSettings, optional
        How lenses are fitted.

    Returns
    -------
    FittedLens
        Its ``choice`` says why.

    Raises
    ------
    CalibrationError
        As `fit_lens`.
    """
    return choose_shared_lens(boards, [seen], settings)[0]


def choose_shared_lens(
    boards: Sequence[Board], seen: Sequence[Observations], settings: LensSettings | None = None
) -> list[FittedLens]:
    """Fit one lens to several cameras with the model that all their views call for together."""
    settings = settings or LensSettings()
    flexible = [replace(camera, model=_FLEXIBLE[0]) for camera in seen]
    views, unusable = collect_views(boards, flexible, settings, is_free=True)
    batch = make_batch(boards, views)
    fit = _flexible_fit(seen, batch, settings)
    used = np.flatnonzero(fit.kept)
    part = batch.only(fit.mask).of(used)
    candidates = _fit_candidates(fit, batch, settings)
    sigma_px = min(candidate.noise_px for candidate in candidates)
    n_values = 2 * int(are_finite(part.pixels).sum())
    inflation = _inflation(_best_fitting(candidates), sigma_px)
    bics = {
        candidate.model: candidate.lens.cost / (sigma_px**2 * inflation)
        + N_PARAMS[candidate.model] * np.log(n_values / inflation)
        for candidate in candidates
    }
    chosen = _choose(candidates, bics)
    every = np.ones(N_PARAMS[chosen.model], np.bool_)
    adjusted = adjust_lens(chosen.lens.camera, chosen.lens.poses, part, settings.loss_px, every)
    poses = fit.lens.poses.copy()
    poses[used] = adjusted.poses
    misses_px = np.linalg.norm(batch_residuals(adjusted.camera, poses, batch), axis=2)
    misses_px[are_finite(batch.pixels) & ~np.isfinite(misses_px)] = np.inf
    final = replace(
        fit,
        lens=replace(adjusted, poses=poses),
        misses_px=misses_px,
        noise_px=chosen.noise_px,
    )
    refuse_degenerate(seen, batch, final)
    lowest = min(bics.values())
    fitted = share_out(boards, seen, views, unusable, batch, final, is_free=True)
    choice = LensChoice(
        chosen.model,
        _reason(chosen, bics, fitted[0].sigmas),
        sigma_px,
        inflation,
        n_values / inflation,
        {
            candidate.model: CandidateLens(
                float(bics[candidate.model] - lowest),
                candidate.rms_px,
                N_PARAMS[candidate.model],
                candidate.unseen,
            )
            for candidate in sorted(candidates, key=lambda each: bics[each.model])
        },
    )
    extra: tuple[str, ...] = ()
    if chosen.unseen > _UNSEEN_TOLD:
        extra = (
            f"the chosen lens, {chosen.model}, sees nothing in {100 * chosen.unseen:.0f} % of the "
            "image; show the board there too",
        )
    return [replace(lens, choice=choice, warnings=lens.warnings + extra) for lens in fitted]


def _flexible_fit(seen: Sequence[Observations], batch: Batch, settings: LensSettings) -> Fit:
    """Return the better of the flexible fits: which views and corners are good."""
    fits: list[Fit] = []
    errors: list[CalibrationError] = []
    for model in _FLEXIBLE:
        if fits and _widest_deg(fits[0], batch) > _TANGENT_DEG and model in _OF_TANGENT:
            continue
        as_model = [replace(camera, model=model) for camera in seen]
        try:
            fits.append(fit_batch(as_model, batch, settings))
        except CalibrationError as error:
            errors.append(error)
    if not fits:
        raise errors[0]
    # More corners explained first: a lens that drops the difficult ones has small residuals.
    return max(fits, key=lambda fit: ((fit.mask & fit.kept[:, None]).sum(), -fit.noise_px))


def _widest_deg(fit: Fit, batch: Batch) -> float:
    """Return how far off the axis the outermost corners lie."""
    part = batch.only(fit.mask & fit.kept[:, None])
    rays = rays_of(fit.lens.camera, part.pixels[are_finite(part.pixels)])
    return float(np.rad2deg(np.arccos(np.clip(np.nanmin(rays[:, 2]), -1.0, 1.0))))


def _fit_candidates(fit: Fit, batch: Batch, settings: LensSettings) -> list[_Candidate]:
    """Fit every candidate to the same corners, from the flexible lens."""
    used = np.flatnonzero(fit.kept)
    part = batch.only(fit.mask).of(used)
    corners = part.pixels[are_finite(part.pixels)]
    candidates = []
    is_wide = _widest_deg(fit, batch) > _TANGENT_DEG
    for model in CANDIDATES:
        if is_wide and model in _OF_TANGENT:
            continue
        start = fit.lens.camera
        if model != start.model:
            start = imitate(start, model, corners)
        free = np.ones(N_PARAMS[model], np.bool_)
        poses = fit.lens.poses[used]
        if not are_finite(batch_residuals(start, poses, part))[are_finite(part.pixels)].all():
            continue  # it cannot see what others do
        lens = adjust_lens(
            start, poses, part, settings.loss_px, free, True, _TRIAL_STEPS, _TRIAL_TOLERANCE
        )
        residuals = batch_residuals(lens.camera, lens.poses, part)
        squares = (residuals[are_finite(residuals)] ** 2).sum(axis=1)
        candidates.append(
            _Candidate(
                lens,
                noise_of(residuals, N_PARAMS[model]),
                float(np.sqrt(squares.mean())),
                _unseen(lens.camera),
            )
        )
    return candidates


def _unseen(camera: Camera) -> float:
    """Return the share of the image in which a lens sees nothing: it ends, or folds, there."""
    columns, rows = _GRID
    grid = np.stack(
        np.meshgrid(
            (np.arange(columns) + 0.5) * camera.width_px / columns,
            (np.arange(rows) + 0.5) * camera.height_px / rows,
        ),
        axis=-1,
    )
    return float(1.0 - are_finite(rays_of(camera, grid.reshape(-1, 2))).mean())


def _best_fitting(candidates: Sequence[_Candidate]) -> LensAdjustment:
    return min(candidates, key=lambda candidate: candidate.lens.cost).lens


def _inflation(lens: LensAdjustment, sigma_px: float) -> float:
    """Return by how much the views' pulls at the lens exceed independent noise: at least 1."""
    n_views = len(lens.scores)
    if n_views < _LEAST_SCORED_VIEWS or sigma_px == 0:
        return 1.0
    diagonal = np.sqrt(np.maximum(np.diag(lens.information), 1e-300))
    scaled = lens.information / np.outer(diagonal, diagonal)
    scores = lens.scores / diagonal
    # Pulls in directions that nothing tells are rounding.
    values, vectors = np.linalg.eigh(scaled)
    known = values > 1e-10 * values[-1]
    pulls = (scores @ vectors[:, known]) / np.sqrt(values[known])
    spread = (pulls**2).sum() * n_views / (n_views - 1) / known.sum()
    return max(1.0, float(spread / sigma_px**2))


def _choose(candidates: Sequence[_Candidate], bics: dict[str, float]) -> _Candidate:
    """Return the simplest of the best candidates."""
    lowest = min(bics.values())
    ties = [candidate for candidate in candidates if bics[candidate.model] <= lowest + _TIE]
    return min(ties, key=lambda each: (N_PARAMS[each.model], bics[each.model]))


def _reason(chosen: _Candidate, bics: dict[str, float], sigmas: NDArray[np.float64]) -> str:
    """Say in one line why a model was chosen."""
    model = chosen.model
    bic, name = min((bic, name) for name, bic in bics.items() if name != model)
    text = f"{model}: BIC {bic - bics[model]:.1f} below the next, {name}"
    if bic < bics[model]:
        text = f"{model}: the simplest within {_TIE:.0f} of the lowest BIC ({name})"
    names = _COEFFICIENTS.get(model, ())
    if not names:
        return text
    params = chosen.lens.camera.params[-len(names) :]
    told = np.abs(params) > _TOLD_APART * sigmas[-len(names) :]
    parts = []
    for is_told, verb in ((True, "told apart from zero"), (False, "not told apart from zero")):
        group = [each for each, flag in zip(names, told, strict=True) if flag == is_told]
        if group:
            parts.append(f"{', '.join(group)} {'is' if len(group) == 1 else 'are'} {verb}")
    return f"{text}; {'; '.join(parts)}"
