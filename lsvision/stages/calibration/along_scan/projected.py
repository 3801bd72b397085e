"""The data at the knots, poses and n projected out: what the restricted likelihood and its derivatives are made of.

With P the precision of the data at the knots so projected, and α what it makes of them, the derivative of the log
likelihood by a parameter θ of the covariance K is (αᵀ K' α - tr(P K')) / 2, and the expected information of two
parameters tr(P K' P K'') / 2.

Source: Patterson & Thompson 1971; Gilmour, Thompson & Cullis 1995, Average Information REML.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.estimation.gaussian_process import covariance_root
from lsvision.stages.calibration.along_scan.evidence import NormalEquations

_NOTHING_MM = 1e-7  # what a process displaces no line by


@dataclass(frozen=True)
class Projected:
    """The data at the knots of each board and component, poses and n projected out, whose precision this is.

    ``of_n`` is the change of n by what displaces the data at the knots.
    """

    weighed: Float[Tensor, "boards 4 knots"]
    precision: Float[Tensor, "boards 4 knots 4 knots"]
    of_n: Float[Tensor, "boards 3 4 knots"]

    @property
    def own(self) -> Float[Tensor, "boards 4 knots knots"]:
        """The precision within each component."""
        return self.precision.diagonal(dim1=1, dim2=3).movedim(-1, 1)

    @classmethod
    def of(cls, equations: NormalEquations, covariance: Float[Tensor, "4 knots knots"]) -> "Projected":
        """Those under errors of some covariance, mm²."""
        count, knots = covariance.shape[:2]
        gram = equations.gram.transpose(2, 3).flatten(3, 4).flatten(1, 2)
        both = torch.cat([gram, equations.cross.flatten(1, 2)], dim=-1)
        root = torch.block_diag(*covariance_root(covariance))
        root = root[:, root.square().sum(0) > _NOTHING_MM**2]
        inner = root.mT @ gram @ root + torch.eye(root.shape[-1], dtype=root.dtype, device=root.device)
        removed = torch.linalg.solve_triangular(torch.linalg.cholesky(inner), root.mT @ both, upper=False)
        both = both - removed[..., : count * knots].mT @ removed
        state = equations.state - removed[..., count * knots :].mT @ removed[..., count * knots :]
        by_state = both[..., count * knots : -1]
        solved = _StateOfAll.of(state, equations.prior)
        precision = both[..., : count * knots] - by_state @ solved.covariance @ by_state.mT
        weighed = both[..., -1] - (by_state @ solved.mean[..., None])[..., 0]
        of_n = solved.covariance[:, 6:] @ by_state.mT
        by_component = precision.unflatten(-1, (count, knots)).unflatten(1, (count, knots))
        return cls(weighed.unflatten(-1, (count, knots)), by_component, of_n.unflatten(-1, (count, knots)))


@dataclass(frozen=True)
class _StateOfAll:
    """Poses and n given the normal equations of all boards: mean, and covariance of each board's nine unknowns."""

    mean: Float[Tensor, "boards 9"]
    covariance: Float[Tensor, "boards 9 9"]

    @classmethod
    def of(cls, equations: Float[Tensor, "boards 10 10"], prior: Float[Tensor, "3 4"]) -> "_StateOfAll":
        """The solution; ``prior`` are whitened rows on n."""
        pose, right = equations[:, :6, :6], equations[:, :6, 6:]
        eye = torch.eye(6, dtype=pose.dtype, device=pose.device)
        own = torch.cholesky_solve(eye.expand_as(pose), torch.linalg.cholesky(pose))
        by_shared = own @ right
        rest = (equations[:, 6:, 6:] - right.mT @ by_shared).sum(0) + prior.mT @ prior
        shared = torch.linalg.inv(rest[:3, :3])
        n = shared @ rest[:3, 3]
        back, mean = by_shared[..., :3], by_shared[..., 3] - by_shared[..., :3] @ n
        poses = own + back @ shared @ back.mT
        top = torch.cat([poses, -back @ shared], dim=-1)
        bottom = torch.cat([-(back @ shared).mT, shared.expand(len(own), 3, 3)], dim=-1)
        return cls(torch.cat([mean, n.expand(len(own), 3)], dim=-1), torch.cat([top, bottom], dim=-2))
