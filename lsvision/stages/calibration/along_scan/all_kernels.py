"""The errors along the scan where edges show them on every line: how large those of every kernel are, all at once.

Corners alone leave several kernels possible, and the search averages over them. On every line a vibration shows as it
is: a sum of a few waves. Then the variances of all kernels are those of the greatest restricted likelihood: each is
multiplied, again and again, by how much its process shows over how much it should,

    v_k <- v_k √(Σ αᵀ K_k α / (Σ tr(K_k P) + 2 / s²)),

P the precision of the data at the knots with poses and n projected out, α what it makes of the data, the sums over all
boards. A variance is exponentially distributed beforehand, its mean s² that of the residuals: long waves, many times
larger, could stand for any n otherwise. No step lowers the posterior density, and none leaves the range. It needs no
start: all begin alike.

A variance that follows from few squares, of a wave that each board shows once, may well be larger: v_k Σ tr(K_k P) is
their number ν, and ν / (ν - 2) the mean of what is probable over what is most probable.

Source: Zhou, Hu, Zhou & Lange 2019, MM algorithms for variance components models; Patterson & Thompson 1971.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.estimation.gaussian_process import covariance_root
from lsvision.stages.calibration.along_scan.edges import EdgeRows
from lsvision.stages.calibration.along_scan.evidence import Linearised, NormalEquations
from lsvision.stages.calibration.along_scan.kernels import FINE, covariance_of, kernel_family
from lsvision.stages.calibration.along_scan.search import FoundErrors, evidence_by_component
from lsvision.stages.calibration.problem import BoardProblem

_STEPS, _STEPS_NEARBY = 60, 30
_STIRRED = 1e-3  # of what the residuals show, to begin with: a kernel without any would stay without
_CAREFUL = 20  # steps with the root; later ones go twice as far
_FEWEST_SQUARES = 4.0  # that a variance counts as known by
_LEAST_MM = 1e-6  # of what the residuals show
_NOTHING = 1e-12  # of a component's variance


def search_with_edges(
    problem: BoardProblem, linearised: Linearised, edges: EdgeRows, near: Float[Tensor, "4 kernels"] | None = None
) -> FoundErrors:
    """The errors along the scans of a problem of batch shape (), given corners and edges.

    Args:
        near: variances, mm², that the search begins near to, in fewer steps; all alike if None.
    """
    equations = NormalEquations.of(problem, linearised, FINE, edges)
    correlation = kernel_family(FINE).covariance.to(equations.state)
    usual = equations.rms_mm.square()[:, None].clamp(min=_LEAST_MM**2)
    variances = (usual / len(correlation)).expand(-1, len(correlation))
    if near is not None:
        variances = near + _STIRRED * variances
    for step in range(_STEPS if near is None else _STEPS_NEARBY):
        data = _Projected.of(equations, torch.tensordot(variances, correlation, 1))
        shown = torch.einsum("bci,kij,bcj->ck", data.weighed, correlation, data.weighed)
        expected = torch.einsum("kij,bcij->ck", correlation, data.precision)
        ratio = (shown / (expected + 2.0 / usual)).clamp(0.0, 1e3)
        variances = variances * (ratio.sqrt() if step < _CAREFUL else ratio)
    squares = (variances * expected).clamp(min=_FEWEST_SQUARES)
    variances = variances * squares / (squares - 2.0)
    variances = torch.where(variances > _NOTHING * variances.amax(), variances, 0.0)
    evidence, log_ratio = evidence_by_component(equations, covariance_of(variances, FINE)[None])
    return FoundErrors(variances, log_ratio, variances.sum(-1).sqrt(), float(evidence))


@dataclass(frozen=True)
class _Projected:
    """The data at the knots of each board and component, poses and n projected out, whose precision this is."""

    weighed: Float[Tensor, "boards 4 knots"]
    precision: Float[Tensor, "boards 4 knots knots"]

    @classmethod
    def of(cls, equations: NormalEquations, covariance: Float[Tensor, "4 knots knots"]) -> "_Projected":
        """Those under errors of some covariance, mm²."""
        count, knots = covariance.shape[:2]
        gram = equations.gram.transpose(2, 3).flatten(3, 4).flatten(1, 2)
        both = torch.cat([gram, equations.cross.flatten(1, 2)], dim=-1)
        root = torch.block_diag(*covariance_root(covariance))
        inner = root.mT @ gram @ root + torch.eye(count * knots, dtype=root.dtype, device=root.device)
        removed = torch.linalg.solve_triangular(torch.linalg.cholesky(inner), root.mT @ both, upper=False)
        both = both - removed[..., : count * knots].mT @ removed
        state = equations.state - removed[..., count * knots :].mT @ removed[..., count * knots :]
        by_state = both[..., count * knots : -1]
        solved = _StateOfAll.of(state, equations.prior)
        precision = both[..., : count * knots] - by_state @ solved.covariance @ by_state.mT
        weighed = both[..., -1] - (by_state @ solved.mean[..., None])[..., 0]
        by_component = precision.unflatten(-1, (count, knots)).unflatten(1, (count, knots))
        own = by_component.diagonal(dim1=1, dim2=3).movedim(-1, 1)
        return cls(weighed.unflatten(-1, (count, knots)), own)


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
