"""The board's size as an unknown with a prior: its print and its temperature, marginalised into the posterior.

One Gauss-Newton step about the posterior without it, which is exact to first order: sizes differ by parts in a
thousand at most.

Source: Bierman 1977, Factorization Methods for Discrete Sequential Estimation, ch. VII (consider parameters).
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.estimation import Posterior, apply, lower_factor, product
from lsvision.stages.calibration.linearise import affine_columns, point_factor
from lsvision.stages.calibration.problem import BoardProblem

_COLUMNS = slice(3, 12)  # of pose and n, between the latents and the value


def explained_by_size(problem: BoardProblem, posterior: Posterior, sigma: float) -> Float[Tensor, "*batch"]:
    """By how much an unknown size of the board lowers the squared residuals, in sigmas; 0 where sigma is."""
    one = torch.ones_like(posterior.mean[..., 0])
    return _BoardScale.of(problem, posterior, one, sigma).gain if sigma > 0 else torch.zeros_like(one)


def with_unknown_size(
    problem: BoardProblem, posterior: Posterior, noise_scale: Float[Tensor, "*batch"], sigma: float
) -> Posterior:
    """The posterior with the board larger than stated by an unknown part ~ N(0, sigma²), the same in all scans.

    Args:
        noise_scale: factor on the corners' covariance with which the posterior was computed.
    """
    if sigma == 0:
        return posterior
    return _BoardScale.of(problem, posterior, noise_scale, sigma).marginalised(posterior)


@dataclass(frozen=True)
class _BoardScale:
    """The board's size beside a posterior that takes it as stated.

    ``value`` is its relative excess, ``information`` the inverse of its variance, ``shift`` the change of the state per
    unit of it.
    """

    value: Float[Tensor, "*batch"]
    information: Float[Tensor, "*batch"]
    shift: Float[Tensor, "*batch state"]

    @classmethod
    def of(
        cls, problem: BoardProblem, posterior: Posterior, noise_scale: Float[Tensor, "*batch"], sigma: float
    ) -> "_BoardScale":
        """The size that the corners show."""
        columns = affine_columns(problem, posterior.mean, point_factor(posterior.mean))
        by_scale = columns[..., -1:].clone()
        by_scale[..., :3, :] = 0.0  # the board's centre stays
        rows = problem.affine_rows / noise_scale.sqrt()[..., None, None, None]
        S, q = rows[..., :-1], rows[..., -1]
        moved = product(S, torch.cat([columns[..., _COLUMNS], by_scale, columns[..., -1:]], dim=-1))
        A, a, residual = moved[..., :-2], moved[..., -2], q - moved[..., -1]
        gradient = apply(A.mT, a)
        gradient = torch.cat([gradient[..., :6].flatten(-2), gradient[..., 6:].sum(-2)], dim=-1)
        shift = apply(posterior.factor, apply(posterior.factor.mT, gradient))
        information = sigma**-2 + a.square().sum((-2, -1)) - (gradient * shift).sum(-1)
        return cls((a * residual).sum((-2, -1)) / information, information, -shift)

    @property
    def gain(self) -> Float[Tensor, "*batch"]:
        """By how much the size lowers the squared residuals."""
        return self.value.square() * self.information

    def marginalised(self, posterior: Posterior) -> Posterior:
        """The posterior with the size unknown."""
        mean = posterior.mean + self.shift * self.value[..., None]
        wider = torch.cat([posterior.factor, (self.shift / self.information.sqrt()[..., None])[..., None]], dim=-1)
        path = torch.cat([posterior.path[:-1], mean[None]])
        return replace(posterior, mean=mean, factor=lower_factor(wider), path=path)
