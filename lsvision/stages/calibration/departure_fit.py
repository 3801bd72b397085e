"""The extended model fitted under a hypothesis, and the evidence for it: Gauss-Newton on reduced corners.

Poses are local to a board and eliminated board by board; n and the parameters of the hypothesis are common. Everything
is a batch: problems, and hypotheses of one kind before them.

Source: evidence by Laplace's approximation, MacKay 1992, Neural Computation 4(3), Eq. 2.5.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.stages.calibration.departures import KINDS, Placement, ReducedCorners, residual_and_jacobian

_POSE, _MOTION = 6, 3
_SETTLED = 1e-2  # squared length of a step, in sigmas; the evidence is that at its end


@dataclass(frozen=True)
class Hypothesis:
    """Departures that are linear in a few parameters: departure of a board = pattern @ parameters.

    ``sigma`` is the parameters' prior, about zero.
    """

    pattern: Float[Tensor, "*batch boards 7 parameters"]
    sigma: Float[Tensor, " parameters"]


@dataclass(frozen=True)
class DepartureFit:
    """The extended model at its maximum.

    ``log_evidence`` is up to a constant that all hypotheses on one problem share; ``covariance`` is of the parameters;
    ``chi_square`` is of the smooth part of the corners, ``converged`` whether the maximum was reached.
    """

    at: Placement
    parameters: Float[Tensor, "*batch parameters"]
    covariance: Float[Tensor, "*batch parameters parameters"]
    chi_square: Float[Tensor, "*batch"]
    log_evidence: Float[Tensor, "*batch"]
    converged: Bool[Tensor, "*batch"]


def fit(
    reduced: ReducedCorners, start: Placement, hypothesis: Hypothesis, motion_sigma: float, iterations: int = 8
) -> DepartureFit:
    """The maximum of the posterior under a hypothesis.

    Args:
        start: where the iteration begins; its departures must be zero.
        motion_sigma: prior sigma of n about (0, 1, 0).
    """
    batch = torch.broadcast_shapes(start.n.shape[:-1], hypothesis.pattern.shape[:-3])
    at, parameters = start.expanded(batch), start.n.new_zeros(*batch, hypothesis.sigma.numel())
    for _ in range(iterations):
        step = System.of(reduced, at, parameters, hypothesis, motion_sigma).step()
        moved = (hypothesis.pattern * step.common[..., None, None, _MOTION:]).sum(-1)
        at = at.moved(step.pose, step.common[..., :_MOTION], moved)
        parameters = parameters + step.common[..., _MOTION:]
        if bool((step.length <= _SETTLED).all()):
            break
    return System.of(reduced, at, parameters, hypothesis, motion_sigma).result(at, parameters)


@dataclass(frozen=True)
class Step:
    """A Gauss-Newton step and its squared length in sigmas."""

    pose: Float[Tensor, "*batch boards 6"]
    common: Float[Tensor, "*batch common"]
    length: Float[Tensor, "*batch"]


@dataclass(frozen=True)
class System:
    """Triangular normal equations about a placement, the pose of each board eliminated.

    ``cost`` is twice the negative log evidence, were the placement the maximum.
    """

    pose_chol: Float[Tensor, "*batch boards 6 6"]
    pose_right: Float[Tensor, "*batch boards 6 1"]
    coupling: Float[Tensor, "*batch boards 6 common"]
    common_chol: Float[Tensor, "*batch common common"]
    common_right: Float[Tensor, "*batch common"]
    scale: Float[Tensor, "*batch common"]
    chi_square: Float[Tensor, "*batch"]
    cost: Float[Tensor, "*batch"]

    @classmethod
    def of(
        cls, reduced: ReducedCorners, at: Placement, parameters: Float[Tensor, "*batch _"], hypothesis: Hypothesis,
        motion_sigma: float,
    ) -> "System":  # fmt: skip
        """The system of a hypothesis, with its priors."""
        pose, n, departures, r = residual_and_jacobian(reduced, at).split([_POSE, _MOTION, len(KINDS), 1], dim=-1)
        J = torch.cat([pose, n, departures @ hypothesis.pattern], dim=-1)
        gram, right = J.mT @ J, J.mT @ r
        chol = torch.linalg.cholesky_ex(gram[..., :_POSE, :_POSE]).L
        both = torch.cat([gram[..., :_POSE, _POSE:], right[..., :_POSE, :]], dim=-1)
        coupling, half = torch.linalg.solve_triangular(chol, both, upper=False).split([both.shape[-1] - 1, 1], -1)
        nominal = torch.tensor([0.0, 1.0, 0.0]).to(n)
        away = torch.cat([(at.n - nominal).expand(*parameters.shape[:-1], 3), parameters], dim=-1)
        sigma = torch.cat([hypothesis.sigma.new_full((_MOTION,), motion_sigma), hypothesis.sigma])
        precision = sigma.square().reciprocal()
        information = (gram[..., _POSE:, _POSE:] - coupling.mT @ coupling).sum(-3) + torch.diag(precision)
        common_right = (right[..., _POSE:, :] - coupling.mT @ half)[..., 0].sum(-2) - precision * away
        scale = information.diagonal(dim1=-2, dim2=-1).clamp(min=1e-300).rsqrt()
        common_chol = torch.linalg.cholesky_ex(scale[..., :, None] * information * scale[..., None, :]).L
        log_det = 2 * (_log_diagonal(common_chol) - scale.log().sum(-1) + _log_diagonal(chol).sum(-1))
        chi_square = r.square().sum((-3, -2, -1))
        cost = chi_square + (precision * away.square()).sum(-1) + log_det + 2 * hypothesis.sigma.log().sum()
        return cls(chol, half, coupling, common_chol, common_right, scale, chi_square.expand_as(cost), cost)

    def step(self) -> Step:
        """The full Gauss-Newton step."""
        right = (self.common_right * self.scale)[..., None]
        common = torch.cholesky_solve(right, self.common_chol)
        length = (common * right).sum((-2, -1))
        common = common[..., 0] * self.scale
        half = self.pose_right - self.coupling @ common[..., None, :, None]
        pose = torch.linalg.solve_triangular(self.pose_chol.mT, half, upper=True)[..., 0]
        return Step(pose, common, length + self.pose_right.square().sum((-3, -2, -1)))

    def result(self, at: Placement, parameters: Tensor) -> DepartureFit:
        """The fit, where the placement is the maximum."""
        covariance = torch.cholesky_inverse(self.common_chol) * self.scale[..., :, None] * self.scale[..., None, :]
        length = self.step().length
        settled = length <= 1.0
        evidence = torch.where(settled, -(self.cost - length) / 2, -torch.inf)
        return DepartureFit(at, parameters, covariance[..., _MOTION:, _MOTION:], self.chi_square, evidence, settled)


def _log_diagonal(chol: Tensor) -> Tensor:
    return chol.diagonal(dim1=-2, dim2=-1).log().sum(-1)
