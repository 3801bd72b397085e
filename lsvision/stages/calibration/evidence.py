"""The evidence for errors that are correlated along the scan: the likelihood of the corners, poses and n marginalised.

The corners of a board err by white noise of their covariance C and by a Gaussian process per component of (x, travel,
z), all along the travel; ``gaussian_process`` writes a process as W F ξ, W the weights of its knots. With the model
linearised about a state, poses (flat prior) and n (its prior) marginalised, this is the restricted likelihood: what
fitting poses and n takes from low frequencies is allowed for. Whatever the kernels are, the corners enter by the same
normal equations, Wᵀ C⁻¹ W and those of the state; one eigenvalue decomposition per kernel serves all amplitudes.

Source: Patterson & Thompson 1971 (restricted likelihood); Rasmussen & Williams 2006, sec. 5.4.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lsvision.estimation.gaussian_process import cubic_weights
from lsvision.stages.calibration.kernels import INTERVALS, KNOTS, KernelFamily
from lsvision.stages.calibration.linearise import affine_columns, point_factor
from lsvision.stages.calibration.problem import BoardProblem, BoardState

_POSE = 6
# The upper 0.1 % of a chi-square distribution, in sigmas of Wilson & Hilferty's normal approximation.
_TAIL = 3.09


@dataclass(frozen=True)
class Conditional:
    """Normal equations on one component's process and on the state of each board, all other processes marginalised.

    ``matrix`` is on the process at the knots, the pose, n and the residual; ``log_det`` of what was marginalised.
    """

    matrix: Float[Tensor, "boards size size"]
    log_det: Float[Tensor, " boards"]


@dataclass(frozen=True)
class NormalEquations:
    """Of one problem about a state: of the processes at the knots (``gram``), across (``cross``), of pose, n, residual.

    ``prior`` are whitened rows ``[A | r]`` of the prior on n, ``rms_mm`` the residuals' by component.
    """

    gram: Float[Tensor, "boards 3 3 knots knots"]
    cross: Float[Tensor, "boards 3 knots 10"]
    state: Float[Tensor, "boards 10 10"]
    prior: Float[Tensor, "3 4"]
    freedom: float
    rms_mm: Float[Tensor, "3"]

    @classmethod
    def of(cls, problem: BoardProblem, state: Float[Tensor, " state"], prior_sigma: float) -> "NormalEquations":
        """Those of a problem of batch shape (), whose white noise is ``noise_chol``."""
        columns, valid = _corner_columns(problem, state), problem.valid
        eye = torch.eye(3, dtype=state.dtype, device=state.device)
        precision = torch.cholesky_solve(eye.expand_as(problem.noise_chol), problem.noise_chol)
        weighed = precision @ columns
        weights = Travel.of(problem).weights(problem)
        flat = (precision[..., None] * weights[..., None, None, :]).flatten(-3)
        gram = (weights.mT @ flat).unflatten(-1, (3, 3, KNOTS)).permute(0, 2, 3, 1, 4)
        n = BoardState.split(state).n
        from_prior = n.new_tensor([0.0, 1.0, 0.0]) - n
        squares = columns[..., -1].square().sum((0, 1))
        return cls(
            gram=gram,
            cross=(weights.mT @ weighed.flatten(-2)).unflatten(-1, (3, -1)).movedim(-2, 1),
            state=columns.flatten(1, 2).mT @ weighed.flatten(1, 2),
            prior=torch.cat([eye, from_prior[:, None]], -1) / prior_sigma,
            freedom=3.0 * float(valid.sum()) - _POSE * problem.boards,
            rms_mm=(squares / valid.sum()).sqrt(),
        )

    def given(
        self, component: int, others: Int[Tensor, " others"], roots: Float[Tensor, "_ others knots knots"]
    ) -> Conditional:
        """The equations on one component's process; others, of these components and roots, are marginalised."""
        across = torch.cat([self.gram[:, others, component], self.cross[:, others]], -1)
        inner = roots.mT[:, :, None] @ self.gram[:, others][:, :, others] @ roots[:, None]
        inner = inner.movedim(-2, -3).flatten(-2).flatten(1, 2)
        eye = torch.eye(inner.shape[-1], dtype=inner.dtype, device=inner.device)
        factor = torch.linalg.cholesky_ex(inner + eye).L
        removed = torch.linalg.solve_triangular(factor, (roots.mT @ across).flatten(1, 2), upper=False)
        top = torch.cat([self.gram[:, component, component], self.cross[:, component]], -1)
        bottom = torch.cat([self.cross[:, component].mT, self.state], -1)
        log_det = 2.0 * factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        return Conditional(torch.cat([top, bottom], -2) - removed.mT @ removed, log_det)

    def log_evidence(
        self, state: Float[Tensor, "*batch 10 10"], log_det: Float[Tensor, "*batch"]
    ) -> Float[Tensor, "*candidates"]:
        """Log of the restricted likelihood, but for a constant; -inf where it cannot be computed.

        Noise that is larger than chance allows is scaled, as in ``noise.noise_scale``.

        Args:
            state: normal equations of each board for a batch of candidates, ``(boards, *candidates, 10, 10)``.
            log_det: of what they were freed from, ``(boards, *candidates)``.
        """
        pose = torch.linalg.cholesky_ex(state[..., :_POSE, :_POSE]).L
        removed = torch.linalg.solve_triangular(pose, state[..., :_POSE, _POSE:], upper=False)
        rest = (state[..., _POSE:, _POSE:] - removed.mT @ removed).sum(0) + self.prior.mT @ self.prior
        pivots = torch.linalg.cholesky_ex(rest).L.diagonal(dim1=-2, dim2=-1)
        by_board = (log_det + 2.0 * pose.diagonal(dim1=-2, dim2=-1).log().sum(-1)).sum(0)
        total, chi_square, freedom = (
            by_board + 2.0 * pivots[..., :3].log().sum(-1),
            pivots[..., 3].square(),
            self.freedom,
        )
        limit = freedom * (1.0 - 2.0 / (9.0 * freedom) + _TAIL * math.sqrt(2.0 / (9.0 * freedom))) ** 3
        scale = torch.where(chi_square > limit, chi_square / freedom, 1.0)
        log_evidence = -0.5 * (total + freedom * scale.log() + chi_square / scale)
        return log_evidence.nan_to_num(nan=-torch.inf, neginf=-torch.inf)

    def log_ratios(
        self, conditional: Conditional, family: KernelFamily, variances: Float[Tensor, " amplitudes"]
    ) -> Float[Tensor, "kernels amplitudes"]:
        """Log likelihood ratios of a process of each kernel and variance, mm², to none."""
        process, cross = conditional.matrix[:, :KNOTS, :KNOTS], conditional.matrix[:, :KNOTS, KNOTS:]
        state, log_det = conditional.matrix[:, KNOTS:, KNOTS:], conditional.log_det
        parts = []
        for roots in (family.broad, family.waves):
            values, vectors = torch.linalg.eigh(roots.mT @ process[:, None] @ roots)
            across = (vectors.mT @ (roots.mT @ cross[:, None]))[:, :, None]
            signal = variances[:, None] * values.clamp(min=0.0)[:, :, None]
            gain = variances[:, None] / (1.0 + signal)
            reduced = state[:, None, None] - (across * gain[..., None]).mT @ across
            parts.append(self.log_evidence(reduced, log_det[:, None, None] + torch.log1p(signal).sum(-1)))
        return torch.cat(parts) - self.log_evidence(state, log_det)


@dataclass(frozen=True)
class Travel:
    """Where the boards' corners lie on the knots: the travel at which each board begins, and that of a unit, mm."""

    start_mm: Float[Tensor, "*batch boards"]
    extent_mm: Float[Tensor, "*batch"]

    @classmethod
    def of(cls, problem: BoardProblem) -> "Travel":
        """Of a problem; its longest board sets the unit."""
        travel = problem.points[..., 1]
        start = torch.where(problem.valid, travel, torch.inf).amin(-1)
        end = torch.where(problem.valid, travel, -torch.inf).amax(-1)
        return cls(start, (end - start).amax(-1).clamp(min=1e-9))

    def walk(self, process_sigma: float) -> Float[Tensor, "*batch boards knots knots"]:
        """Covariance at the knots, mm², of what each component is displaced by where n walks at random along the scan.

        It is counted from the end of each board, where n is asked for; ``process_sigma`` is per square root of a mm.
        """
        place = (torch.arange(KNOTS, dtype=self.start_mm.dtype, device=self.start_mm.device) - 1.0) / INTERVALS
        travel = self.start_mm[..., None] + self.extent_mm[..., None, None] * place
        left = self.extent_mm[..., None, None] * (1.0 - place).clamp(min=0.0)
        by_n = torch.minimum(left[..., :, None], left[..., None, :])
        return process_sigma**2 * travel[..., :, None] * travel[..., None, :] * by_n

    def weights(self, problem: BoardProblem) -> Float[Tensor, "*batch boards corners knots"]:
        """Weights of the knots at each corner, zero where ``valid`` is false."""
        place = (problem.points[..., 1] - self.start_mm[..., None]) / self.extent_mm[..., None, None]
        return torch.where(problem.valid[..., None], cubic_weights(1.0 + INTERVALS * place, KNOTS), 0.0)


def _corner_columns(problem: BoardProblem, state: Tensor) -> Tensor:
    """Derivatives of each corner's prediction by its pose and n, and its residual, ``(boards, corners, 3, 10)``.

    The derivative by n holds the position where the board's centroid is seen: the same subspace, and no loss of digits
    where line 0 is far away.
    """
    affine = affine_columns(problem, state, point_factor(state))
    value, by_state = affine[..., -1], affine[..., 3:-1]
    by_n = by_state[..., 6:] + value[..., 1, None, None] * by_state[..., 3:6]
    coefficients = torch.cat([by_state[..., :6], by_n, value[..., None]], -1).unflatten(-2, (4, -1))
    factors = torch.nn.functional.pad(problem.body_points, (1, 0), value=1.0)
    columns = (factors @ coefficients.flatten(-2)).unflatten(-1, (3, -1))
    residual = problem.points - columns[..., -1]
    columns = torch.cat([columns[..., :-1], residual[..., None]], -1)
    return torch.where(problem.valid[..., None, None], columns, 0.0)
