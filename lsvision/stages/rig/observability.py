"""Which combinations of a rig's quantities the scans show, and which matter for heights."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.estimation import principal_directions
from lsvision.stages.rig.config import RigConfig
from lsvision.stages.rig.height_shape import HeightShape
from lsvision.stages.rig.model import RigPrior
from lsvision.stages.rig.solve import RigSolution
from lsvision.types import RIG_QUANTITIES, RigCombination

NAMES = (*RIG_QUANTITIES, "n1", "n2", "n3")
_MENTIONED = 0.25  # of a direction's length: a component that is named


def unobserved(solution: RigSolution, shape: HeightShape, config: RigConfig) -> tuple[RigCombination, ...]:
    """The combinations whose sigma is more than a share of the prior's, the least known first.

    Where the data sheet is itself a calibration, the usual sigmas take the place of the prior's: the boards that it was
    made from are scans too. What the data sheet calls exact is no combination.

    Args:
        solution: of one problem.
    """
    prior, factor = solution.model.prior, solution.found.factor
    sheet = prior
    if prior.rig.covariance is not None:
        sheet = RigPrior.of(replace(prior.rig, covariance=None, sigma=()), config)
        factor = torch.linalg.solve(sheet.root, prior.root @ factor)
    found = principal_directions(factor @ factor.mT, 1.0)
    return tuple(
        RigCombination(_parts(vector), float(share), 1e3 * float(shape.bend_mm(share * prior.over_sigma(error))))
        for vector, error, share in zip(
            sheet.in_sigmas(found.vectors.mT).mT, found.vectors @ sheet.root.mT, found.share, strict=True
        )
        if float(share) > config.observed_share and bool(error.any())
    )


def _parts(vector: Float[Tensor, " shared"]) -> tuple[tuple[str, float], ...]:
    weights = (vector / vector.norm()).tolist()
    named = [(name, weight) for name, weight in zip(NAMES, weights, strict=True) if abs(weight) >= _MENTIONED]
    return tuple(sorted(named, key=lambda part: -abs(part[1])))
