"""Which cause explains boards that contradict each other: hypotheses compared by their evidence, no cause among them.

A cause is accepted where the corners are ``_ACCEPTED`` times more probable under it than without it, the noise being as
large as the corners themselves show. Causes are added one by one while they are. Where they leave errors along the scan
(see ``along_scan``), these are part of the noise from then on, and causes must explain the corners better than such
errors alone do: a scan that shakes may seem to have another motion.
"""

import math
from dataclasses import dataclass
from itertools import groupby

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lsvision.estimation.gaussian_process import covariance_root
from lsvision.stages.calibration.along_scan import (
    SEARCHED,
    SUSPICION,
    Beforehand,
    FoundErrors,
    Linearised,
    by_chance,
    latents,
    search,
)
from lsvision.stages.calibration.causes import NONE, Candidate, candidates
from lsvision.stages.calibration.departure_fit import DepartureFit, Hypothesis, fit
from lsvision.stages.calibration.departures import KINDS, Placement, ReducedCorners, corner_rows
from lsvision.stages.calibration.problem import BoardProblem

_ACCEPTED = 1e4
_RIVAL = 100.0  # times less probable than the best, a cause is worth mentioning beside it
_ROUNDS = 3


@dataclass(frozen=True)
class Explanation:
    """What explains the contradictions of a batch of problems.

    ``causes`` are numbers of ``candidates`` in the order of their acceptance, ``NONE`` past the last; ``rivals`` are
    candidates that would have served nearly as well as the first; ``along_scan`` are each problem's errors of lines.
    ``gain`` is the log ratio of the evidence to that without a cause, the noise the same. ``departure`` and
    ``covariance`` are of the boards' departures of each kind; ``chi_square`` is of the smooth part of the corners, in
    sigmas of their own noise, before and after.
    """

    causes: Int[Tensor, "steps *batch"]
    rivals: Bool[Tensor, "candidates *batch"]
    along_scan: tuple[FoundErrors | None, ...]
    gain: Float[Tensor, "*batch"]
    departure: Float[Tensor, "*batch boards 7"]
    covariance: Float[Tensor, "*batch 7 boards boards"]
    chi_square_before: Float[Tensor, "*batch"]
    chi_square: Float[Tensor, "*batch"]


@dataclass(frozen=True)
class Assumed:
    """What is known before any cause: sigmas of n about (0, 1, 0) and of the board's relative size."""

    motion_sigma: float
    board_scale_sigma: float = 0.0

    def hypothesis(self, at: Placement) -> Hypothesis:
        """The extended model without a cause."""
        count = 1 if self.board_scale_sigma > 0 else 0
        pattern = at.n.new_zeros(*at.departure.shape, count)
        pattern[..., KINDS.index("scale"), :] = 1.0
        return Hypothesis(pattern, at.n.new_full((count,), self.board_scale_sigma))


def explain(problem: BoardProblem, reduced: ReducedCorners, start: Placement, assumed: Assumed) -> Explanation:
    """The causes that make the corners of each problem of a batch probable.

    Args:
        problem: with a batch of one dimension, its noise as stated.
        reduced: its corners in sigmas of their own noise, see ``ReducedCorners.scaled``.
        start: placements near the boards.
    """
    return _Search.begin(problem, reduced, start, assumed).run()


@dataclass
class _Search:
    """Greedy choice of causes: in each round the one that raises the evidence most, where it does so by enough."""

    problem: BoardProblem
    reduced: ReducedCorners
    start: Placement
    assumed: Assumed
    candidates: list[Candidate]
    causes: Tensor
    rivals: Tensor
    along_scan: list[FoundErrors | None]

    @classmethod
    def begin(cls, problem: BoardProblem, reduced: ReducedCorners, start: Placement, assumed: Assumed) -> "_Search":
        """Nothing accepted yet."""
        count, boards = start.n.shape[0], start.position.shape[-2]
        causes = candidates(boards, reduced.curved, start.n)
        none = torch.full((_ROUNDS, count), NONE, device=start.n.device)
        rivals = torch.zeros(len(causes), count, dtype=torch.bool, device=start.n.device)
        return cls(problem, reduced, start, assumed, causes, none, rivals, [None] * count)

    def run(self) -> Explanation:
        """Causes, then errors along the scan, then the causes that are left beside these."""
        plain = self.fitted(self.assumed.hypothesis(self.start))
        self.start = self.start.at_poses_of(plain.at, plain.converged)  # mostly near what the causes lead to
        here = self.with_causes(plain)
        if self.look_along_the_scans(plain, here):
            plain = self.fitted(self.assumed.hypothesis(self.start))
            here = self.with_causes(self.fitted(self.hypothesis()))
        return self.explanation(plain, here)

    def with_causes(self, here: DepartureFit) -> DepartureFit:
        """The fit with all causes that are worth it added to those of a fit."""
        threshold, problems = math.log(_ACCEPTED), torch.arange(len(self.along_scan))
        for _ in range(_ROUNDS):
            evidence = self.with_each_candidate()
            best, index = evidence.max(0)
            free = self.causes == NONE
            accepted = free.any(0) & (best > here.log_evidence + threshold)
            if not bool(accepted.any()):
                break
            self.rivals |= accepted & free.all(0) & (evidence > best - math.log(_RIVAL))
            slot = free.to(torch.long).argmax(0)
            self.causes[slot, problems] = torch.where(accepted, index, self.causes[slot, problems])
            here = self.fitted(self.hypothesis())
        return here

    def look_along_the_scans(self, plain: DepartureFit, here: DepartureFit) -> bool:
        """Whether errors along the scan were found, in problems whose residuals are correlated under their causes.

        They are part of the corners' noise then, under which the causes have to be found again. Where they alone
        explain as much as they do beside the causes, they are taken as they are alone.
        """
        without, hypothesis, threshold = self.assumed.hypothesis(self.start), self.hypothesis(), math.log(_ACCEPTED)
        known, scale = Beforehand(0.0, _ACCEPTED), self.reduced.noise_scale.sqrt()
        for i in range(len(self.along_scan)):
            one, given = self.problem.at((i,)), self.linearised(i, here, hypothesis)
            white = torch.linalg.solve_triangular(one.noise_chol, given.columns[..., -1:], upper=False)[..., 0]
            if bool(by_chance(one, white / scale[i, :, None, None]) > SUSPICION):
                continue
            errors = search(one, given, known)
            if errors is None:
                continue
            if bool((self.causes[:, i] != NONE).any()):
                alone = search(one, self.linearised(i, plain, without), known)
                if alone is not None and alone.log_evidence > errors.log_evidence - threshold:
                    errors = alone
            self.causes[:, i], self.rivals[:, i] = NONE, False
            self.along_scan[i] = errors
            noisy = ReducedCorners.with_latents(one, latents(one, covariance_root(errors.covariance(SEARCHED)[None])))
            self.reduced = self.reduced.replaced(i, noisy.scaled())
        return any(errors is not None for errors in self.along_scan)

    def linearised(self, i: int, fitted: DepartureFit, hypothesis: Hypothesis) -> Linearised:
        """The corners of one problem about a fit, beside n the parameters of its hypothesis shared by all boards."""
        rows = corner_rows(self.problem.at((i,)), fitted.at.one(i))
        pose_and_n, departures, residual = rows.split([9, len(KINDS), 1], dim=-1)
        columns = torch.cat([pose_and_n, departures @ hypothesis.pattern[i][:, None], residual], dim=-1)
        n = fitted.at.n[i]
        away = torch.cat([n - n.new_tensor([0.0, 1.0, 0.0]), fitted.parameters[i]])
        sigma = torch.cat([n.new_full((3,), self.assumed.motion_sigma), hypothesis.sigma])
        return Linearised(columns, torch.cat([torch.diag(1 / sigma), (-away / sigma)[:, None]], dim=-1))

    def explanation(self, plain: DepartureFit, fitted: DepartureFit) -> Explanation:
        """The result of a search."""
        by_kind = self.hypothesis().pattern.movedim(-2, -3)  # (*batch, 7, boards, parameters)
        covariance = by_kind @ fitted.covariance[..., None, :, :] @ by_kind.mT
        return Explanation(
            causes=self.causes,
            rivals=self.rivals,
            along_scan=tuple(self.along_scan),
            gain=fitted.log_evidence - plain.log_evidence,
            departure=fitted.at.departure,
            covariance=covariance,
            chi_square_before=plain.chi_square,
            chi_square=fitted.chi_square,
        )

    def hypothesis(self) -> Hypothesis:
        """The causes accepted so far: as many parameters for each problem, without effect where it has fewer."""
        boards = self.start.position.shape[-2]
        size = max(candidate.pattern.shape[-1] for candidate in self.candidates)
        table = self.start.n.new_zeros(len(self.candidates) + 1, boards, len(KINDS), size)
        sigma = self.start.n.new_ones(len(self.candidates) + 1, size)
        for k, candidate in enumerate(self.candidates):
            table[k, ..., : candidate.pattern.shape[-1]] = candidate.pattern
            sigma[k, : candidate.pattern.shape[-1]] = candidate.sigma
        used = [number for number in range(_ROUNDS) if bool((self.causes[number] != NONE).any())]
        given = self.assumed.hypothesis(self.start)
        if not used:
            return given
        # Parameters in units of their sigma, as it differs between the problems.
        scaled = table * sigma[:, None, None]
        patterns = [scaled[self.causes[number]] for number in used]
        pattern = torch.cat([given.pattern, *patterns], dim=-1)
        return Hypothesis(pattern, torch.cat([given.sigma, pattern.new_ones(size * len(used))]))

    def fitted(self, hypothesis: Hypothesis) -> DepartureFit:
        """The fit under a hypothesis."""
        return fit(self.reduced, self.start, hypothesis, self.assumed.motion_sigma)

    def with_each_candidate(self) -> Tensor:
        """Log evidence with one more cause, ``(candidates, *batch)``; those of one kind and size are fitted at once."""
        accepted = self.hypothesis()
        found: list[Tensor] = []
        for _, alike in groupby(self.candidates, key=lambda each: (each.kind, each.sigma.numel())):
            group = list(alike)
            more = torch.stack([candidate.pattern for candidate in group])[:, None]
            shape = (len(group), *accepted.pattern.shape[:-1])
            pattern = torch.cat([accepted.pattern.expand(*shape, -1), more.expand(*shape, -1)], dim=-1)
            found.append(self.fitted(Hypothesis(pattern, torch.cat([accepted.sigma, group[0].sigma]))).log_evidence)
        return torch.cat(found)
