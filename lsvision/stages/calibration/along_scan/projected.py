"""The data at the knots, poses and n projected out: what the restricted likelihood and its derivatives are made of.

With P the precision of the data at the knots so projected, and α what it makes of them, the derivative of the log
likelihood by a parameter θ of the covariance K is (αᵀ K' α - tr(P K')) / 2, and the expected information of two
parameters tr(P K' P K'') / 2.

Source: Patterson & Thompson 1971; Gilmour, Thompson & Cullis 1995, Average Information REML.
"""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.estimation.gaussian_process import covariance_root
from lsvision.stages.calibration.along_scan.evidence import POSE, NormalEquations

_NOTHING_MM = 1e-7  # what a process displaces no line by


@dataclass(frozen=True)
class Projected:
    """The data at the knots of each board and component, poses and n projected out.

    ``of_shared`` is the change of n, and of what else all boards share, by what displaces the data at the knots. Their
    precision is the ``gram`` of corners and edges less that of ``removed``, which errors along the scan, poses and what
    is shared stand for.
    """

    weighed: Float[Tensor, "boards 4 knots"]
    of_shared: Float[Tensor, "boards shared 4 knots"]
    gram: Float[Tensor, "boards 4 4 knots knots"]
    removed: Float[Tensor, "boards rows 4 knots"]

    @property
    def precision(self) -> Float[Tensor, "boards 4 knots 4 knots"]:
        """The precision of the data so projected."""
        rows, each = self.removed.flatten(-2), self.removed.shape[-2:]
        return self.gram.transpose(2, 3) - (rows.mT @ rows).unflatten(-1, each).unflatten(1, each)

    @cached_property
    def own(self) -> Float[Tensor, "boards 4 knots knots"]:
        """The precision within each component, without that between them, which takes longest."""
        rows = self.removed.transpose(1, 2)
        return self.gram.diagonal(dim1=1, dim2=2).movedim(-1, 1) - rows.mT @ rows

    @classmethod
    def of(cls, equations: NormalEquations, covariance: Float[Tensor, "4 knots knots"]) -> "Projected":
        """Those under errors of some covariance, mm²."""
        gram, (count, knots) = equations.gram, covariance.shape[:2]
        roots = [root[:, root.square().sum(0) > _NOTHING_MM**2] for root in covariance_root(covariance)]
        by_latents = torch.cat([root.mT @ gram[:, c] for c, root in enumerate(roots)], dim=2)
        inner = torch.cat([by_latents[:, c] @ root for c, root in enumerate(roots)], dim=-1)
        by_state = torch.cat([root.mT @ equations.cross[:, c] for c, root in enumerate(roots)], dim=1)
        factor = torch.linalg.cholesky(inner + torch.eye(inner.shape[-1], dtype=inner.dtype, device=inner.device))
        both = torch.cat([by_latents.transpose(1, 2).flatten(-2), by_state], dim=-1)
        both = torch.linalg.solve_triangular(factor, both, upper=False)
        by_knots, by_state = both.split([count * knots, by_state.shape[-1]], dim=-1)
        solved = _StateOfAll.of(equations.state - by_state.mT @ by_state, equations.prior)
        cross = equations.cross.flatten(1, 2) - by_knots.mT @ by_state
        weighed = cross[..., -1] - (cross[..., :-1] @ solved.mean[..., None])[..., 0]
        of_shared = solved.covariance[:, POSE:] @ cross[..., :-1].mT
        removed = torch.cat([by_knots, covariance_root(solved.covariance).mT @ cross[..., :-1].mT], dim=1)
        return cls(
            weighed=weighed.unflatten(-1, (count, knots)),
            of_shared=of_shared.unflatten(-1, (count, knots)),
            gram=gram,
            removed=removed.unflatten(-1, (count, knots)),
        )


@dataclass(frozen=True)
class _StateOfAll:
    """What each board has of its own and shares, given the normal equations of all boards: mean and covariance."""

    mean: Float[Tensor, "boards state"]
    covariance: Float[Tensor, "boards state state"]

    @classmethod
    def of(
        cls, equations: Float[Tensor, "boards columns columns"], prior: Float[Tensor, "shared shared_and_one"]
    ) -> "_StateOfAll":
        """The solution; ``prior`` are whitened rows on what is shared."""
        pose, right, count = equations[:, :POSE, :POSE], equations[:, :POSE, POSE:], prior.shape[-1] - 1
        eye = torch.eye(POSE, dtype=pose.dtype, device=pose.device)
        own = torch.cholesky_solve(eye.expand_as(pose), torch.linalg.cholesky(pose))
        by_shared = own @ right
        rest = (equations[:, POSE:, POSE:] - right.mT @ by_shared).sum(0) + prior.mT @ prior
        shared = torch.linalg.inv(rest[:-1, :-1])
        value = shared @ rest[:-1, -1]
        back, mean = by_shared[..., :-1], by_shared[..., -1] - by_shared[..., :-1] @ value
        poses = own + back @ shared @ back.mT
        top = torch.cat([poses, -back @ shared], dim=-1)
        bottom = torch.cat([-(back @ shared).mT, shared.expand(len(own), count, count)], dim=-1)
        return cls(torch.cat([mean, value.expand(len(own), count)], dim=-1), torch.cat([top, bottom], dim=-2))
