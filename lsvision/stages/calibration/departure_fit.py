"""The extended model fitted under a hypothesis, and the evidence for it: Gauss-Newton on reduced corners.

Poses, and a wander of each scan where it has a prior, are local to a board and eliminated board by board; n and the
parameters of the hypothesis are common. Everything is a batch: problems, and hypotheses of one kind before them.

Source: evidence by Laplace's approximation, MacKay 1992, Neural Computation 4(3), Eq. 2.5.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import pad

from lsvision.estimation import apply
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


@dataclass(frozen=True)
class Beliefs:
    """Priors that all hypotheses share: sigma of n about (0, 1, 0), and the information on the wander's knots.

    Without the latter scans do not wander.
    """

    motion_sigma: float
    wander: Float[Tensor, "*#batch #boards knots3 knots3"] | None = None


def fit(
    reduced: ReducedCorners, start: Placement, hypothesis: Hypothesis, beliefs: Beliefs, iterations: int = 8
) -> DepartureFit:
    """The maximum of the posterior under a hypothesis.

    Args:
        start: where the iteration begins; its departures and wander must be zero.
    """
    batch = torch.broadcast_shapes(start.n.shape[:-1], hypothesis.pattern.shape[:-3])
    at, parameters = start.expanded(batch), start.n.new_zeros(*batch, hypothesis.sigma.numel())
    for _ in range(iterations):
        step = NormalRows.of(reduced, at, hypothesis, parameters).solved(beliefs).step()
        pose, wander = step.local[..., :_POSE], step.local[..., _POSE:]
        moved = (hypothesis.pattern * step.common[..., None, None, _MOTION:]).sum(-1)
        wander = wander if beliefs.wander is not None else torch.zeros_like(at.wander)
        at = at.moved(pose, step.common[..., :_MOTION], moved, wander)
        parameters = parameters + step.common[..., _MOTION:]
        if bool((step.length <= _SETTLED).all()):
            break
    return NormalRows.of(reduced, at, hypothesis, parameters).solved(beliefs).result(at, parameters)


@dataclass(frozen=True)
class NormalRows:
    """Products of the rows about a placement, of which any beliefs make a system: JᵀJ and Jᵀr of each board.

    The columns are pose (6), wander, then n (3) and the hypothesis' parameters.
    """

    gram: Float[Tensor, "*batch boards columns columns"]
    right: Float[Tensor, "*batch boards columns"]
    away: Float[Tensor, "*batch common"]
    sigma: Float[Tensor, " parameters"]
    wander: Float[Tensor, "*batch boards knots3"]
    chi_square: Float[Tensor, "*batch"]

    @classmethod
    def of(
        cls, reduced: ReducedCorners, at: Placement, hypothesis: Hypothesis, parameters: Float[Tensor, "*batch _"]
    ) -> "NormalRows":
        """The products for a hypothesis about a placement."""
        rows = residual_and_jacobian(reduced, at)
        pose, n, departures, wander, r = rows.split([_POSE, _MOTION, len(KINDS), reduced.wander.shape[-1], 1], dim=-1)
        J = torch.cat([pose, wander, n, departures @ hypothesis.pattern], dim=-1)
        nominal = torch.tensor([0.0, 1.0, 0.0]).to(n)
        away = torch.cat([(at.n - nominal).expand(*parameters.shape[:-1], 3), parameters], dim=-1)
        chi_square = r.square().sum((-3, -2, -1))
        return cls(J.mT @ J, (J.mT @ r)[..., 0], away, hypothesis.sigma, at.wander, chi_square)

    def solved(self, beliefs: Beliefs) -> "System":
        """The system with priors, the local unknowns of each board eliminated."""
        knots = self.gram.shape[-1] - _POSE - self.away.shape[-1]
        local = slice(0, _POSE) if beliefs.wander is None else slice(0, _POSE + knots)
        by_local, right_local = self.gram[..., local, local], self.right[..., local]
        common, right = self.gram[..., _POSE + knots :, _POSE + knots :], self.right[..., _POSE + knots :]
        from_prior = torch.zeros_like(self.chi_square)
        if beliefs.wander is not None:
            pull = apply(beliefs.wander, self.wander)
            by_local = by_local + pad(beliefs.wander, (_POSE, 0, _POSE, 0))
            right_local = right_local - pad(pull, (_POSE, 0))
            from_prior = (self.wander * pull).sum((-2, -1)) - _log_det(beliefs.wander, self.gram.shape[-3])
        chol = torch.linalg.cholesky_ex(by_local).L
        across = self.gram[..., local, _POSE + knots :]
        both = torch.cat([across.expand(*chol.shape[:-1], -1), right_local[..., None].expand(*chol.shape[:-1], 1)], -1)
        coupling, half = torch.linalg.solve_triangular(chol, both, upper=False).split([across.shape[-1], 1], -1)
        precision = torch.cat([self.sigma.new_full((_MOTION,), beliefs.motion_sigma), self.sigma]).square().reciprocal()
        information = (common - coupling.mT @ coupling).sum(-3) + torch.diag(precision)
        right = (right - (coupling.mT @ half)[..., 0]).sum(-2) - precision * self.away
        scale = information.diagonal(dim1=-2, dim2=-1).clamp(min=1e-300).rsqrt()
        common_chol = torch.linalg.cholesky_ex(scale[..., :, None] * information * scale[..., None, :]).L
        log_det = 2 * (_log_diagonal(common_chol) - scale.log().sum(-1) + _log_diagonal(chol).sum(-1))
        cost = self.chi_square + (precision * self.away.square()).sum(-1) + from_prior + log_det
        cost = cost + 2 * self.sigma.log().sum()
        return System(chol, half, coupling, common_chol, right, scale, self.chi_square.expand_as(cost), cost)


@dataclass(frozen=True)
class Step:
    """A Gauss-Newton step and its squared length in sigmas."""

    local: Float[Tensor, "*batch boards local"]
    common: Float[Tensor, "*batch common"]
    length: Float[Tensor, "*batch"]


@dataclass(frozen=True)
class System:
    """Triangular normal equations; ``cost`` is twice the negative log evidence, were the placement the maximum."""

    local_chol: Float[Tensor, "*batch boards local local"]
    local_right: Float[Tensor, "*batch boards local 1"]
    coupling: Float[Tensor, "*batch boards local common"]
    common_chol: Float[Tensor, "*batch common common"]
    common_right: Float[Tensor, "*batch common"]
    scale: Float[Tensor, "*batch common"]
    chi_square: Float[Tensor, "*batch"]
    cost: Float[Tensor, "*batch"]

    def step(self) -> Step:
        """The full Gauss-Newton step."""
        right = (self.common_right * self.scale)[..., None]
        common = torch.cholesky_solve(right, self.common_chol)
        length = (common * right).sum((-2, -1))
        common = common[..., 0] * self.scale
        half = self.local_right - self.coupling @ common[..., None, :, None]
        local = torch.linalg.solve_triangular(self.local_chol.mT, half, upper=True)[..., 0]
        return Step(local, common, length + self.local_right.square().sum((-3, -2, -1)))

    def log_evidence(self) -> Float[Tensor, "*batch"]:
        """The log evidence of the linearised problem: at the end of the step, not where it begins."""
        return -(self.cost - self.step().length) / 2

    def result(self, at: Placement, parameters: Tensor) -> DepartureFit:
        """The fit, where the placement is the maximum."""
        covariance = torch.cholesky_inverse(self.common_chol) * self.scale[..., :, None] * self.scale[..., None, :]
        length = self.step().length
        settled = length <= 1.0
        evidence = torch.where(settled, -(self.cost - length) / 2, -torch.inf)
        return DepartureFit(at, parameters, covariance[..., _MOTION:, _MOTION:], self.chi_square, evidence, settled)


def _log_det(information: Tensor, boards: int) -> Tensor:
    """Log-determinants of the information on the boards' wander, summed over boards."""
    by_board = 2 * _log_diagonal(torch.linalg.cholesky(information))
    return by_board.expand(*by_board.shape[:-1], boards).sum(-1)


def _log_diagonal(chol: Tensor) -> Tensor:
    return chol.diagonal(dim1=-2, dim2=-1).log().sum(-1)
