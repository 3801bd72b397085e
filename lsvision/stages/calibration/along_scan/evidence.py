"""The evidence for errors that are correlated along the scan: the likelihood of the corners, poses and n marginalised.

The corners of a board err by white noise of their covariance C and by a Gaussian process per component of ``lines``,
all along the travel; ``gaussian_process`` writes a process as W F ξ, W the weights of its knots. With the model
linearised about a state, poses (flat prior) and n (its prior) marginalised, this is the restricted likelihood: what
fitting poses and n takes from low frequencies is allowed for. Whatever the kernels are, the corners enter by the same
normal equations, Wᵀ C⁻¹ W and those of the state; one eigenvalue decomposition per kernel serves all amplitudes.

Source: Patterson & Thompson 1971 (restricted likelihood); Rasmussen & Williams 2006, sec. 5.4.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lsvision.stages.calibration.along_scan.edges import EdgeRows
from lsvision.stages.calibration.along_scan.kernels import SEARCHED, KernelFamily, Knots
from lsvision.stages.calibration.along_scan.lines import COMPONENTS, Travel, directions
from lsvision.stages.calibration.linearise import affine_columns, point_factor
from lsvision.stages.calibration.problem import BoardProblem, BoardState
from lsvision.stages.calibration.reduction import affine_features

POSE = 6
"""Unknowns that each board has of its own, which come first."""
# The upper 0.1 % of a chi-square distribution, in sigmas of Wilson & Hilferty's normal approximation.
_TAIL = 3.09


@dataclass(frozen=True)
class Linearised:
    """The corners of one problem about a state, and the prior on what all boards share: n, and further parameters.

    ``columns`` are derivatives of each corner's prediction by its board's pose and by what is shared, then the corner's
    residual, mm, zero where the corner was not seen; ``prior`` are whitened rows ``[A | r]``. ``by_map`` are the same
    columns for the coefficients of each board's affine map, of which the last is their value, where they are known.
    """

    columns: Float[Tensor, "boards corners 3 columns"]
    prior: Float[Tensor, "shared shared_and_one"]
    by_map: Float[Tensor, "boards 12 columns"] | None = None

    def of_edges(self, rows: Float[Tensor, "boards rows columns_of_edges"]) -> Float[Tensor, "boards rows columns"]:
        """Whitened rows of edges on the state and their residual, from those on the map and 1, see ``EdgeRows``."""
        assert self.by_map is not None
        by_state = rows[..., -13:-1] @ self.by_map
        return torch.cat([by_state[..., :-1], rows[..., -1:] - by_state[..., -1:]], dim=-1)

    @classmethod
    def of(cls, problem: BoardProblem, state: Float[Tensor, " state"], prior_sigma: float) -> "Linearised":
        """A problem of batch shape () whose boards share n alone; ``prior_sigma`` of each component of it.

        The derivative by n leaves the board's centroid where it is measured: a shift of the board makes up for it.
        Where line 0 is far away, digits would be lost otherwise.
        """
        coefficients = affine_columns(problem, state, point_factor(state))[..., 3:].clone()
        coefficients[..., :3, 6:9] = 0.0
        by_feature = coefficients.unflatten(-2, (4, 3)).flatten(-2)
        columns = (affine_features(problem.body_points) @ by_feature).unflatten(-1, (3, -1))
        residual = problem.points - columns[..., -1]
        columns = torch.cat([columns[..., :-1], residual[..., None]], -1)
        n = BoardState.split(state).n
        eye = torch.eye(3, dtype=n.dtype, device=n.device)
        prior = torch.cat([eye, (eye[1] - n)[:, None]], -1) / prior_sigma
        return cls(torch.where(problem.valid[..., None, None], columns, 0.0), prior, coefficients)


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

    ``prior`` is as in ``Linearised``, ``rms_mm`` the residuals' along the directions of the components.
    """

    gram: Float[Tensor, "boards 4 4 knots knots"]
    cross: Float[Tensor, "boards 4 knots columns"]
    state: Float[Tensor, "boards columns columns"]
    prior: Float[Tensor, "shared shared_and_one"]
    freedom: float
    rms_mm: Float[Tensor, "4"]

    @classmethod
    def of(
        cls, problem: BoardProblem, linearised: Linearised, knots: Knots = SEARCHED, edges: EdgeRows | None = None
    ) -> "NormalEquations":
        """Those of a problem of batch shape (), whose white noise is ``noise_chol``, and of edges on the same knots."""
        columns, valid, count = linearised.columns, problem.valid, len(COMPONENTS)
        by_component, weights = directions(problem), Travel.of(problem).weights(problem, knots)
        eye = torch.eye(3, dtype=columns.dtype, device=columns.device)
        precision = torch.cholesky_solve(eye.expand_as(problem.noise_chol), problem.noise_chol)
        weighed = precision @ columns
        between = by_component @ precision @ by_component.mT
        flat = (between[..., None] * weights[..., None, None, :]).flatten(-3)
        gram = (weights.mT @ flat).unflatten(-1, (count, count, knots.count)).permute(0, 2, 3, 1, 4)
        across = weights.mT @ (by_component @ weighed).flatten(-2)
        along = (by_component @ columns[..., -1:])[..., 0]
        corners = cls(
            gram=gram,
            cross=across.unflatten(-1, (count, -1)).movedim(-2, 1),
            state=columns.flatten(1, 2).mT @ weighed.flatten(1, 2),
            prior=linearised.prior,
            freedom=3.0 * float(valid.sum()) - POSE * problem.boards,
            rms_mm=(along.square().sum((0, 1)) / valid.sum()).sqrt(),
        )
        if edges is None:
            return corners
        return corners._with(edges.rows[..., : count * knots.count], linearised.of_edges(edges.rows), edges.values)

    @classmethod
    def of_rows(
        cls,
        by_knot: Float[Tensor, "boards rows knots_of_all"],
        by_state: Float[Tensor, "boards rows columns"],
        prior: Float[Tensor, "shared shared_and_one"],
        values: float,
        rms_mm: Float[Tensor, "4"],
    ) -> "NormalEquations":
        """Those of whitened rows on the processes at the knots, component by component, and on the state.

        Args:
            values: how many measured values the rows stand for.
        """
        boards, count, columns = len(by_knot), len(COMPONENTS), by_state.shape[-1]
        knots = by_knot.shape[-1] // count
        nothing = cls(
            gram=by_knot.new_zeros(boards, count, count, knots, knots),
            cross=by_knot.new_zeros(boards, count, knots, columns),
            state=by_knot.new_zeros(boards, columns, columns),
            prior=prior,
            freedom=-float(POSE * boards),
            rms_mm=rms_mm,
        )
        return nothing._with(by_knot, by_state, values)

    def _with(
        self,
        by_knot: Float[Tensor, "boards rows knots_of_all"],
        by_state: Float[Tensor, "boards rows columns"],
        values: float,
    ) -> "NormalEquations":
        """These and the ones of further rows."""
        count, knots = self.gram.shape[-3], self.gram.shape[-1]
        gram = (by_knot.mT @ by_knot).unflatten(-1, (count, knots)).unflatten(1, (count, knots)).transpose(2, 3)
        return replace(
            self,
            gram=self.gram + gram,
            cross=self.cross + (by_knot.mT @ by_state).unflatten(1, (count, knots)),
            state=self.state + by_state.mT @ by_state,
            freedom=self.freedom + values,
        )

    def given(
        self, component: int, others: Int[Tensor, " others"], roots: Float[Tensor, "_ others knots rank"]
    ) -> Conditional:
        """The equations on one component's process; others, of these components and roots, are marginalised."""
        top = torch.cat([self.gram[:, component, component], self.cross[:, component]], -1)
        bottom = torch.cat([self.cross[:, component].mT, self.state], -1)
        across = torch.cat([self.gram[:, others, component], self.cross[:, others]], -1)
        return self._without(others, roots, torch.cat([top, bottom], -2), across)

    def log_evidence(
        self, components: Int[Tensor, " some"], roots: Float[Tensor, "_ some knots rank"]
    ) -> Float[Tensor, ""]:
        """The log evidence, up to a constant, for processes of some components of given roots, and of no others."""
        rest = self._without(components, roots, self.state, self.cross[:, components])
        return self.of_states(rest.matrix, rest.log_det)

    def _without(self, others: Tensor, roots: Tensor, matrix: Tensor, across: Tensor) -> Conditional:
        """Normal equations freed from processes, to which they are coupled by ``across``."""
        if len(others) == 0:
            return Conditional(matrix, matrix.new_zeros(len(matrix)))
        inner = roots.mT[:, :, None] @ self.gram[:, others][:, :, others] @ roots[:, None]
        inner = inner.movedim(-2, -3).flatten(-2).flatten(1, 2)
        eye = torch.eye(inner.shape[-1], dtype=inner.dtype, device=inner.device)
        factor = torch.linalg.cholesky_ex(inner + eye).L
        removed = torch.linalg.solve_triangular(factor, (roots.mT @ across).flatten(1, 2), upper=False)
        log_det = 2.0 * factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        return Conditional(matrix - removed.mT @ removed, log_det)

    def of_states(
        self, state: Float[Tensor, "*batch columns columns"], log_det: Float[Tensor, "*batch"]
    ) -> Float[Tensor, "*candidates"]:
        """Log of the restricted likelihood, but for a constant; -inf where it cannot be computed.

        Noise that is larger than chance allows is scaled, as in ``noise.noise_scale``.

        Args:
            state: normal equations of each board for a batch of candidates, ``(boards, *candidates, columns,
                columns)``.
            log_det: of what they were freed from, ``(boards, *candidates)``.
        """
        pose = torch.linalg.cholesky_ex(state[..., :POSE, :POSE]).L
        removed = torch.linalg.solve_triangular(pose, state[..., :POSE, POSE:], upper=False)
        rest = (state[..., POSE:, POSE:] - removed.mT @ removed).sum(0) + self.prior.mT @ self.prior
        pivots = torch.linalg.cholesky_ex(rest).L.diagonal(dim1=-2, dim2=-1)
        by_board = (log_det + 2.0 * pose.diagonal(dim1=-2, dim2=-1).log().sum(-1)).sum(0)
        total, chi_square = by_board + 2.0 * pivots[..., :-1].log().sum(-1), pivots[..., -1].square()
        freedom = self.freedom
        limit = freedom * (1.0 - 2.0 / (9.0 * freedom) + _TAIL * math.sqrt(2.0 / (9.0 * freedom))) ** 3
        scale = torch.where(chi_square > limit, chi_square / freedom, 1.0)
        total = total - 2.0 * self.prior.diagonal().log().sum()
        log_evidence = -0.5 * (total + freedom * scale.log() + chi_square / scale)
        return log_evidence.nan_to_num(nan=-torch.inf, neginf=-torch.inf)

    def log_ratios(
        self, conditional: Conditional, family: KernelFamily, variances: Float[Tensor, " amplitudes"]
    ) -> Float[Tensor, "kernels amplitudes"]:
        """Log likelihood ratios of a process of each kernel and variance, mm², to none; -inf without a likelihood."""
        knots = self.gram.shape[-1]
        if not bool(torch.isfinite(conditional.matrix).all()):
            return variances.new_full((len(family.log_prior), len(variances)), -torch.inf)
        process, cross = conditional.matrix[:, :knots, :knots], conditional.matrix[:, :knots, knots:]
        state, log_det = conditional.matrix[:, knots:, knots:], conditional.log_det
        parts = []
        for roots in family.roots:
            values, vectors = torch.linalg.eigh(roots.mT @ process[:, None] @ roots)
            across = (vectors.mT @ (roots.mT @ cross[:, None]))[:, :, None]
            signal = variances[:, None] * values.clamp(min=0.0)[:, :, None]
            gain = variances[:, None] / (1.0 + signal)
            reduced = state[:, None, None] - (across * gain[..., None]).mT @ across
            parts.append(self.of_states(reduced, log_det[:, None, None] + torch.log1p(signal).sum(-1)))
        return torch.cat(parts) - self.of_states(state, log_det)
