"""The posterior of a raw rig, the motion and all poses: one least squares problem.

Corners count by their covariance, the data sheet by its own. A corner far off is left out; where those that remain
scatter more than their covariance says, it is scaled as they ask.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lsvision.estimation import BorderedFit, BorderedState, bordered_least_squares
from lsvision.geometry import RawPair
from lsvision.stages.rig.config import RigConfig
from lsvision.stages.rig.model import POSE, SHARED, RigModel, RigPrior, Shared
from lsvision.stages.rig.sightings import Sightings

_NORMAL_MEDIAN = 3.3567  # median of a chi-square variable of four: a corner has a column and a travel in two images
_ROUNDS = 10
_SOFT = 3.0  # scales at which a corner weighs a quarter
_MOST = 0.7  # of a board's corners that must be left
_SETTLED = 1.05  # ratio of two scales in a row
_NO_ERROR = 1e-4  # sigmas


@dataclass(frozen=True)
class SharedErrors:
    """What the residuals of each board, in sigmas, err by together besides white noise: Z ξ, ξ standard normal.

    The covariance I + Z Zᵀ has the ``axes`` of Z, the singular vectors, along which an error's sigma is 1 / ``shrink``.
    """

    axes: Float[Tensor, "boards rows latents"]
    shrink: Float[Tensor, "boards latents"]

    @classmethod
    def of(cls, by_latents: Float[Tensor, "boards rows latents"]) -> "SharedErrors":
        """Those of Z."""
        axes, size, _ = torch.linalg.svd(by_latents, full_matrices=False)
        large = size.amax(0) > _NO_ERROR
        return cls(axes[..., large], (1.0 + size[:, large].square()).rsqrt())

    def whitened(self, residuals: Float[Tensor, "boards corners 4"]) -> Float[Tensor, "boards corners 4"]:
        """As many that are independent, of variance 1: multiplied by the inverse root of their covariance."""
        rows = residuals.flatten(-2)[..., None]
        along = self.axes.mT @ rows
        return (rows - self.axes @ ((1.0 - self.shrink)[..., None] * along))[..., 0].unflatten(-1, (-1, 4))


@dataclass(frozen=True)
class RigSolution:
    """The posterior of a batch of problems.

    ``sightings`` are without the corners that were left out, which ``outliers`` counts by board; ``noise_scale`` is on
    the corners' sigma, at least 1. ``along`` is what the corners of each board err by together, in sigmas as stated;
    None where they do not.
    """

    model: RigModel
    sightings: Sightings
    outliers: Int[Tensor, "*batch boards"]
    found: BorderedFit
    noise_scale: Float[Tensor, "*batch"]
    along: SharedErrors | None = None

    @property
    def shared(self) -> Shared:
        """Rig and motion."""
        return self.model.prior.shared(self.found.state.shared)

    @property
    def pair(self) -> RawPair:
        """The cameras of one problem."""
        return RawPair.of(self.model.prior.rig, self.shared.quantities)

    @property
    def whitened_covariance(self) -> Float[Tensor, "*batch shared shared"]:
        """Covariance of the state: of rig and motion in units of the prior."""
        return self.found.factor @ self.found.factor.mT

    @property
    def covariance(self) -> Float[Tensor, "*batch shared shared"]:
        """Covariance of rig and motion, in their units."""
        factor = self.model.prior.root @ self.found.factor
        return factor @ factor.mT

    @property
    def factor(self) -> Float[Tensor, "*batch shared columns"]:
        """Factor of the covariance of rig and motion, in the prior's sigmas."""
        return self.model.prior.in_sigmas(self.found.factor)

    @property
    def whitened(self) -> Float[Tensor, "*batch boards corners 4"]:
        """Residuals of the corners, measured less predicted, in sigmas as stated; zero where a corner was left out."""
        residuals = corner_residuals(self.model, self.sightings, self.found.state)
        return residuals if self.along is None else self.along.whitened(residuals)


def solve_rig(sightings: Sightings, prior: RigPrior, config: RigConfig) -> RigSolution:
    """Estimate rig, motion and poses of a batch of independent problems of equally many boards."""
    model = RigModel.of(sightings, prior)
    zeros = sightings.left.position.new_zeros(*sightings.valid.shape[:-1], SHARED)
    state = BorderedState(zeros[..., 0, :], zeros[..., :POSE])
    state, kept = _without_outliers(model, sightings, state, config)
    scale = noise_scale_of(corner_residuals(model, kept, state), kept)
    found = fit_rig(model, kept, state, _each(kept, scale.reciprocal()), config)
    return RigSolution(model, kept, sightings.valid.sum(-1) - kept.valid.sum(-1), found, scale)


def corner_residuals(
    model: RigModel, sightings: Sightings, state: BorderedState
) -> Float[Tensor, "*batch boards corners 4"]:
    """Corners measured less predicted in sigmas: column and travel in the left and in the right image."""
    predicted = model.predict(state)
    rows = [
        _in_sigmas(eye.factor, eye.position - there)
        for eye, there in ((sightings.left, predicted.left), (sightings.right, predicted.right))
    ]
    return torch.where(sightings.valid[..., None], torch.cat(rows, dim=-1), 0.0)


def _in_sigmas(factor: Float[Tensor, "*#batch 2 2"], off: Float[Tensor, "*#batch 2"]) -> Float[Tensor, "*batch 2"]:
    """Solution of factor x = off, lower triangular, written out: LAPACK is called once for every corner."""
    first = off[..., 0] / factor[..., 0, 0]
    return torch.stack([first, (off[..., 1] - factor[..., 1, 0] * first) / factor[..., 1, 1]], dim=-1)


def noise_scale_of(
    residuals: Float[Tensor, "*batch boards corners 4"], sightings: Sightings
) -> Float[Tensor, "*batch"]:
    """How many times larger than stated residuals are, at least 1; the boards' poses were fitted to them."""
    freedom = 4.0 * sightings.valid.sum((-2, -1)) - POSE * sightings.boards
    return (residuals.square().sum((-3, -2, -1)) / freedom.clamp(min=1)).sqrt().clamp(min=1.0)


def _without_outliers(
    model: RigModel, sightings: Sightings, state: BorderedState, config: RigConfig
) -> tuple[BorderedState, Sightings]:
    """A state that fits most corners, each weighed by how far it is off, and the sightings without those far off.

    The weights are Geman & McClure's, in units of the median corner's scale, as iteratively reweighted least squares.
    """
    off, scale = _distances(model, sightings, state)
    weight = _each(sightings, scale.reciprocal())
    for _ in range(_ROUNDS):
        state = fit_rig(model, sightings, state, weight, config).state
        before, (off, scale) = scale, _distances(model, sightings, state)
        if bool((before <= _SETTLED * scale).all()):
            break
        weight = _each(sightings, scale.reciprocal()) / (1 + (off / (_SOFT * scale[..., None, None])).square())
    valid = near_corners(sightings.valid, off <= config.outlier_sigma * scale[..., None, None])
    return state, replace(sightings, valid=valid)


def near_corners(
    seen: Bool[Tensor, "*batch boards corners"], near: Bool[Tensor, "*batch boards corners"]
) -> Bool[Tensor, "*batch boards corners"]:
    """The seen corners that are near; of a board most of whose corners are not, all: outliers are no whole board."""
    valid = seen & near
    few = valid.sum(-1) < _MOST * seen.sum(-1)
    return torch.where(few[..., None], seen, valid)


def typical_scale(
    square: Float[Tensor, "*batch boards corners"], valid: Bool[Tensor, "*batch boards corners"]
) -> Float[Tensor, "*batch"]:
    """How many sigmas as stated the median corner takes for one, at least 1, from the squares of distances in them."""
    median = torch.where(valid, square, torch.nan).flatten(-2).nanmedian(-1).values
    return (median / _NORMAL_MEDIAN).sqrt().clamp(min=1.0)


def _distances(model: RigModel, sightings: Sightings, state: BorderedState) -> tuple[Tensor, Tensor]:
    """How far each corner is off, in sigmas as stated, and how many of them the median corner takes for one, >= 1."""
    square = corner_residuals(model, sightings, state).square().sum(-1)
    return square.sqrt(), typical_scale(square, sightings.valid)


def _each(sightings: Sightings, of_problem: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch boards corners"]:
    return of_problem[..., None, None].expand(sightings.valid.shape)


def fit_rig(
    model: RigModel,
    sightings: Sightings,
    start: BorderedState,
    weight: Float[Tensor, "*batch boards corners"],
    config: RigConfig,
    along: SharedErrors | None = None,
) -> BorderedFit:
    """Estimate rig, motion and poses from corners; ``weight`` is what each residual in sigmas is multiplied by.

    Args:
        along: as of ``RigSolution``.
    """

    def rows(state: BorderedState) -> Tensor:
        residuals = corner_residuals(model, sightings, state) * weight[..., None]
        return (residuals if along is None else along.whitened(residuals)).flatten(-2)

    return bordered_least_squares(rows, start, max_iterations=config.max_iterations, tolerance=config.tolerance)
