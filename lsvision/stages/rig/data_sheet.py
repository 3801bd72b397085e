"""Whether the corners fit what the data sheet is sure of.

Where it calls a quantity exact that is not, poses and all other quantities bend to make up for it, and the corners are
left with more than their noise. The corners are fitted anew under a data sheet that is less sure by what is usual.
Under a true one the gain is at most a chi-square variable of as many degrees of freedom as there are quantities.

Source: the likelihood ratio of nested Gaussian priors, Kass & Raftery 1995, Bayes factors.
"""

from dataclasses import replace

import torch
from torch import Tensor

from lsvision.estimation import BorderedState, lower_factor
from lsvision.stages.rig.config import RigConfig
from lsvision.stages.rig.model import QUANTITIES, RigPrior
from lsvision.stages.rig.solve import RigSolution, corner_residuals, fit_rig
from lsvision.types import RIG_QUANTITIES

_BEYOND_CHANCE = 80.0  # gain: of 22 degrees of freedom once in ten million


def contradicted(solution: RigSolution, config: RigConfig) -> str | None:
    """What the corners contradict of the data sheet, as a sentence; None where they fit it."""
    prior, kept = solution.model.prior, solution.sightings
    usual = RigPrior.of(replace(prior.rig, sigma=(), covariance=None), config)
    less_sure = replace(prior, root=lower_factor(torch.cat([prior.root, usual.root], dim=-1)))
    model = replace(solution.model, prior=less_sure)
    weight = solution.noise_scale.reciprocal().expand(kept.valid.shape)
    own = solution.found.state
    freed = fit_rig(model, kept, BorderedState(torch.zeros_like(own.shared), own.own), weight, config)

    def cost(fitted: BorderedState, rows: Tensor) -> float:
        return float((rows * weight[..., None]).square().sum() + fitted.shared.square().sum())

    gain = cost(own, solution.whitened) - cost(freed.state, corner_residuals(model, kept, freed.state))
    if not (gain > _BEYOND_CHANCE and bool(freed.converged)):
        return None
    off = (model.prior.shared(freed.state.shared).vector - prior.mean)[:QUANTITIES]
    seen = (model.prior.root @ freed.factor).square().sum(-1)[:QUANTITIES].sqrt()
    worst = int((off.abs() / torch.hypot(seen, prior.sigma[:QUANTITIES])).argmax())
    value, stated = float(prior.mean[worst]), float(prior.sigma[worst])
    sure = "exactly" if stated == 0 else f"with a sigma of {stated:.2g}"
    return (
        f"the corners contradict the data sheet: it says {RIG_QUANTITIES[worst]} {value:.6g} {sure}, they show "
        f"{value + float(off[worst]):.6g} ± {float(seen[worst]):.2g}; check it, or state a larger sigma"
    )
