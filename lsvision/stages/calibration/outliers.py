"""Corners that do not lie where their board's other corners put them: found before anything is estimated.

The corners of a rigid board that one motion moves are an affine map of their places on the board, whatever the poses,
the motion and the noise's scale. So the map is fitted to each board alone, by a cost that begins as the square and
grows robust step by step (Geman-McClure), and a corner that lies too far off is left out. What is too far follows from
the residuals' own scale, so that larger noise than stated, or a shake of the whole scan, throws no corners out.

Source: Yang, Antonante, Tzoumas & Carlone 2020, Graduated Non-Convexity for Robust Spatial Perception, sec. III.
"""

from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import pad

from lsvision.estimation import apply, chi_square_tail
from lsvision.stages.calibration.measurements import BoardMeasurements, SoundProblem
from lsvision.stages.calibration.problem import BoardProblem

# Squared distance, in sigmas, beyond which a corner lies off: one of 1e5 sound ones does (chi-square of 3).
_LIMIT = 25.9
_MEDIAN = 2.366  # of chi-square of 3
_MEDIAN_OF_ONE = 0.4549  # of chi-square of 1
_LARGE_SCALE = 25.0  # so much larger residuals may be those of corners that drew the whole map to themselves
_GROWTH = 1.6  # of the cost's robustness, by step
_REFITS = 4
_CLEARLY = 0.25  # scale of another start's residuals that shows the first one to have failed
_MIDDLE = 0.75  # of a board's half lengths
_NEIGHBOURS = 11  # consecutive corners, centred on one, from which the displacement of its line is estimated
_SHARED = 0.25  # of a corner's squared distance at most is its own, where its line is displaced
_LITTLE = 0.01  # of the board's span, that lines may be displaced by: a tenth of a square of ours
# A board's residuals are looked into where as large ones have less than this probability.
_SUSPICIOUS = 1e-2
_PLANAR = 3  # features of an affine map of a planar board


@dataclass(frozen=True)
class AffineFit:
    """Affine maps fitted to boards: squared distances of corners from their places, in sigmas, weights, errors, mm."""

    squared: Float[Tensor, "boards corners"]
    weight: Float[Tensor, "boards corners"]
    error: Float[Tensor, "boards corners 3"]

    def scale(self, valid: Bool[Tensor, "boards corners"]) -> Float[Tensor, " boards"]:
        """Variance of the residuals over the stated one by their median; not below 1."""
        known = torch.where(valid, self.squared, torch.nan)
        return (known.nanmedian(dim=-1).values / _MEDIAN).clamp(min=1.0)


@dataclass(frozen=True)
class _Boards:
    """Boards of any problems, side by side."""

    points: Tensor
    variance: Tensor
    information: Tensor
    features: Tensor
    valid: Tensor

    @classmethod
    def of(cls, problem: BoardProblem, chosen: Tensor) -> "_Boards":
        """The chosen boards of a batch of problems."""
        valid, body = problem.valid[chosen], problem.body_points[chosen][..., :2]
        body = body / torch.where(valid[..., None], body.abs(), 0.0).amax(-2, keepdim=True).clamp(min=1e-9)
        features = torch.cat([torch.ones_like(body[..., :1]), body], dim=-1)
        chol = problem.noise_chol[chosen]
        variance = chol.square().sum(-1)
        return cls(problem.points[chosen], variance, torch.cholesky_inverse(chol), features, valid)

    def taken(self, chosen: Tensor) -> "_Boards":
        """Some of these boards."""
        return _Boards(*(getattr(self, field.name)[chosen] for field in fields(self)))

    def fit(self, weight: Tensor) -> AffineFit:
        """The weighed affine maps."""
        weighed = torch.where(self.valid, weight, 0.0)[..., None, None] * self.information
        moments = self.features[..., :, None] * self.features[..., None, :]
        gram = torch.einsum("bcfg,bcij->bfigj", moments, weighed).flatten(-2).flatten(1, 2)
        right = torch.einsum("bcf,bci->bfi", self.features, apply(weighed, self.points)).flatten(1)
        scale = gram.diagonal(dim1=-2, dim2=-1).clamp(min=1e-300).rsqrt()
        chol = torch.linalg.cholesky_ex(scale[..., :, None] * gram * scale[..., None, :]).L
        solved = torch.cholesky_solve((scale * right)[..., None], chol)[..., 0] * scale
        coefficients = solved.unflatten(-1, (3, 3))
        error = self.points - self.features @ coefficients
        squared = (error * apply(self.information, error)).sum(-1)
        return AffineFit(torch.where(self.valid, squared, 0.0), weight, error)

    def standardised(self, fit: AffineFit) -> Tensor:
        """Squared distances with each component in sigmas that the corners show: a shake is one of x and z alone."""
        near = self.valid & (fit.weight > 0)
        known = torch.where(near[..., None], fit.error.square() / self.variance, torch.nan)
        spread = (known.nanmedian(dim=-2, keepdim=True).values / _MEDIAN_OF_ONE).clamp(min=1.0)
        error = fit.error / spread.sqrt()
        return (error * apply(self.information, error)).sum(-1)


def outlying(problem: BoardProblem) -> Bool[Tensor, "*batch boards corners"]:
    """Which corners lie off their boards; none of a board whose residuals are unsuspicious, or that is not planar."""
    off = torch.zeros_like(problem.valid)
    rows = problem.affine_rows[..., 3 * _PLANAR :, -1]  # of what no affine map of a planar board explains
    freedom = (3 * problem.valid.sum(-1) - 3 * _PLANAR).clamp(min=1)
    suspicious = chi_square_tail(rows.square().sum(-1), freedom) < _SUSPICIOUS
    if not bool(suspicious.any()) or bool(problem.body_points[..., 2].any()):
        return off
    boards = _Boards.of(problem, suspicious)
    first = boards.fit(torch.ones_like(boards.features[..., 0]))
    scale = first.scale(boards.valid)
    chosen = (first.squared.amax(-1) > _LIMIT * scale) | (scale > _LARGE_SCALE)
    if bool(chosen.any()):
        found = torch.zeros_like(boards.valid)
        found[chosen] = _robust_outliers(boards.taken(chosen))
        off[suspicious] = found
    return off


def little_off(measured: BoardMeasurements, off: Bool[Tensor, "boards corners"]) -> Bool[Tensor, "boards corners"]:
    """Corners, of those that are off boards, that lie no farther off than lines may be displaced by."""
    problem = SoundProblem.of(measured, None).problem
    boards = _Boards.of(problem, problem.valid.any(-1))
    error = boards.fit((~off).to(problem.points)).error
    known = torch.where(boards.valid[..., None], boards.points, torch.nan)
    return off & (error.abs().amax(-1) < _little(known))


def _little(known: Float[Tensor, "boards corners 3"]) -> Float[Tensor, "boards 1"]:
    """What lines may be displaced by, mm, on boards whose corners, nan where not seen, these are."""
    span = known.nan_to_num(nan=-torch.inf).amax(-2) - known.nan_to_num(nan=torch.inf).amin(-2)
    return _LITTLE * span.amax(-1, keepdim=True)


def _robust_outliers(boards: _Boards) -> Tensor:
    """Corners off their board, ``(boards, corners)``."""
    best = _concentrated(boards, _graduated(boards))
    scale = best.scale(boards.valid)
    if bool((scale > _LARGE_SCALE).any()):
        for weight in _parts(boards.features):
            other = _concentrated(boards, boards.fit(weight))
            best = _where(other.scale(boards.valid) < _CLEARLY * scale, other, best)
            scale = best.scale(boards.valid)
    near = boards.valid & (best.weight > 0)
    far = (best.squared > _LIMIT * best.scale(near)[:, None]) & (boards.standardised(best) > _LIMIT)
    return boards.valid & far & ~_displaced_with_their_line(boards, best)


def _displaced_with_their_line(boards: _Boards, fit: AffineFit) -> Tensor:
    """Corners that lie as far off as those that were scanned just before and after them: the whole line is displaced.

    By little, that is: where all corners of a line are a square off they are off.
    """
    known = torch.where(boards.valid[..., None], boards.points, torch.nan)
    order = known[..., 1].argsort(dim=-1)  # those not seen come last
    error = torch.where(boards.valid[..., None], fit.error, torch.nan)
    window = min(_NEIGHBOURS, order.shape[-1])
    in_order = error.gather(-2, order[..., None].expand_as(error))
    padded = pad(in_order, (0, 0, window // 2, (window - 1) // 2), value=torch.nan)
    shared = padded.unfold(-2, window, 1).nanmedian(dim=-1).values
    shared = torch.zeros_like(error).scatter(-2, order[..., None].expand_as(error), shared)
    rest = error - shared
    squared = (rest * apply(boards.information, rest)).sum(-1)
    scale = (squared.nanmedian(dim=-1, keepdim=True).values / _MEDIAN).clamp(min=1.0)
    little = shared.abs().amax(-1) < _little(known)
    return (squared <= _LIMIT * scale) & (squared <= _SHARED * fit.squared) & little


def _graduated(boards: _Boards) -> AffineFit:
    """The fit under a cost that grows robust: from squares to Geman-McClure at the limit."""
    now = boards.fit(torch.ones_like(boards.features[..., 0]))
    limit = _LIMIT * now.scale(boards.valid)[:, None]
    tolerance = (2 * now.squared.amax(-1, keepdim=True) / limit).clamp(min=1.0)
    ended = torch.zeros_like(tolerance[:, 0], dtype=torch.bool)
    while not bool(ended.all()):
        wide = tolerance * limit
        now = _where(ended, now, boards.fit((wide / (now.squared + wide)).square()))
        limit = _LIMIT * now.scale(boards.valid)[:, None]
        ended = (tolerance <= 1.0)[:, 0]
        tolerance = (tolerance / _GROWTH).clamp(min=1.0)
    return now


def _concentrated(boards: _Boards, now: AffineFit) -> AffineFit:
    """The fit to the corners that lie near it, refitted to those that lie near that."""
    near = boards.valid
    for _ in range(_REFITS):
        near = boards.valid & (now.squared <= _LIMIT * now.scale(near)[:, None])
        now = boards.fit(near.to(now.squared))
    return now


def _parts(features: Tensor) -> list[Tensor]:
    """Weights of parts of a board that may be sound where others are not: its middle, and its halves."""
    x, y = features[..., 1:].unbind(-1)
    middle = torch.maximum(x.abs(), y.abs()) < _MIDDLE
    return [part.to(x) for part in (middle, x < 0, x > 0, y < 0, y > 0)]


def _where(chosen: Tensor, one: AffineFit, other: AffineFit) -> AffineFit:
    """One fit for the chosen boards, the other for the rest."""
    each = chosen[:, None]
    return AffineFit(
        torch.where(each, one.squared, other.squared),
        torch.where(each, one.weight, other.weight),
        torch.where(each[..., None], one.error, other.error),
    )
