"""Which cause explains boards that contradict each other: hypotheses compared by their evidence, no cause among them.

A cause is accepted where the corners are ``_ACCEPTED`` times more probable under it than without it, the noise being as
large as the corners themselves show. Causes are added one by one while they are. Errors that all corners of a line
share, a shake of the object or a wrong travel, are one of the causes: a motion that seems to differ between scans must
explain the corners better than such errors do.
"""

import math
from dataclasses import dataclass
from itertools import groupby

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lsvision.stages.calibration.causes import NONE, STILL_MM, Candidate, Wander, candidates, wanders
from lsvision.stages.calibration.departure_fit import Beliefs, DepartureFit, Hypothesis, NormalRows, fit
from lsvision.stages.calibration.departures import KINDS, KNOTS, Placement, ReducedCorners

_ACCEPTED = 1e4
_RIVAL = 100.0  # times less probable than the best, a cause is worth mentioning beside it
_ROUNDS = 3
_BOARDS_AT_ONCE = 512  # of systems with a wander: some 10 MB


@dataclass(frozen=True)
class Explanation:
    """What explains the contradictions of a batch of problems.

    ``causes`` are numbers of ``candidates`` in the order of their acceptance, ``NONE`` past the last; ``rivals`` are
    candidates that would have served nearly as well as the first; ``wander`` is one of ``wanders`` or ``NONE``.
    ``gain`` is the log ratio of the evidence to that without a cause. ``departure`` and ``covariance`` are of the
    boards' departures of each kind; ``chi_square`` is of the smooth part of the corners, in sigmas of their own noise,
    before and after.
    """

    causes: Int[Tensor, "steps *batch"]
    rivals: Bool[Tensor, "candidates *batch"]
    wander: Int[Tensor, "*batch"]
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


def explain(reduced: ReducedCorners, start: Placement, assumed: Assumed) -> Explanation:
    """The causes that make the corners of each problem of a batch probable.

    Args:
        reduced: corners in sigmas of their own noise, see ``ReducedCorners.scaled``; batch of one dimension.
        start: placements near the boards.
    """
    return _Search.begin(reduced, start, assumed).run()


@dataclass
class _Search:
    """Greedy choice of causes: in each round the move that raises the evidence most, where it does so by enough."""

    reduced: ReducedCorners
    start: Placement
    assumed: Assumed
    candidates: list[Candidate]
    wanders: list[Wander]
    information: Tensor
    causes: Tensor
    rivals: Tensor
    wander: Tensor

    @classmethod
    def begin(cls, reduced: ReducedCorners, start: Placement, assumed: Assumed) -> "_Search":
        """Nothing accepted yet."""
        count, boards = start.n.shape[0], start.position.shape[-2]
        choices = wanders(reduced.curved)
        still = torch.diag(start.n.new_full((3 * KNOTS,), STILL_MM**-2))
        information = torch.stack([*(choice.information(start.n) for choice in choices), still])
        causes = candidates(boards, reduced.curved, start.n)
        none = torch.full((_ROUNDS, count), NONE, device=start.n.device)
        rivals = torch.zeros(len(causes), count, dtype=torch.bool, device=start.n.device)
        return cls(reduced, start, assumed, causes, choices, information, none, rivals, none[0].clone())

    def run(self) -> Explanation:
        """Rounds until no move is worth it."""
        threshold = math.log(_ACCEPTED)
        here = plain = self.fitted(self.hypothesis())
        self.start = self.start.at_poses_of(plain.at, plain.converged)  # mostly near what the causes lead to
        alone = torch.full_like(plain.log_evidence, -torch.inf)
        chosen_alone = self.wander.clone()
        for number in range(_ROUNDS):
            causes = self.with_each_candidate()
            best, index = causes.max(0)
            wander_best, wander_index = self.wandering(here)
            if number == 0:
                alone, chosen_alone = wander_best, wander_index
            to_wander = (wander_best > best) & (wander_best > here.log_evidence + threshold)
            to_cause = ~to_wander & (best > here.log_evidence + threshold)
            first = to_cause & (self.causes == NONE).all(0)
            self.rivals |= first & (causes > best - math.log(_RIVAL))
            self.wander = torch.where(to_wander, wander_index, self.wander)
            self.causes[number] = torch.where(to_cause, index, self.causes[number])
            if not bool((to_wander | to_cause).any()):
                break
            here = self.fitted(self.hypothesis())
        superfluous = (self.causes != NONE).any(0) & (self.wander != NONE) & (alone > here.log_evidence - threshold)
        self.wander = torch.where(superfluous, chosen_alone, self.wander)
        self.causes = torch.where(superfluous, NONE, self.causes)
        return self.explanation(plain, self.fitted(self.hypothesis()))

    def explanation(self, plain: DepartureFit, fitted: DepartureFit) -> Explanation:
        """The result of a search."""
        hypothesis = self.hypothesis()
        by_kind = hypothesis.pattern.movedim(-2, -3)  # (*batch, 7, boards, parameters)
        covariance = by_kind @ fitted.covariance[..., None, :, :] @ by_kind.mT
        gain = fitted.log_evidence - plain.log_evidence
        return Explanation(
            self.causes,
            self.rivals,
            self.wander,
            gain,
            fitted.at.departure,
            covariance,
            plain.chi_square,
            fitted.chi_square,
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

    def beliefs(self) -> Beliefs:
        """Priors with the wander accepted so far."""
        if bool((self.wander == NONE).all()):
            return Beliefs(self.assumed.motion_sigma)
        return Beliefs(self.assumed.motion_sigma, self.information[self.wander][:, None])

    def fitted(self, hypothesis: Hypothesis) -> DepartureFit:
        """The fit under a hypothesis."""
        return fit(self.reduced, self.start, hypothesis, self.beliefs())

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

    def wandering(self, here: DepartureFit) -> tuple[Tensor, Tensor]:
        """The evidence with the best wander about a fit, and which it is; scans that wander already keep theirs."""
        if not self.wanders:
            return torch.full_like(here.log_evidence, -torch.inf), self.wander
        rows = NormalRows.of(self.reduced, here.at, self.hypothesis(), here.parameters)
        at_once = max(1, _BOARDS_AT_ONCE // self.start.position[..., 0].numel())
        by_wander = [
            rows.solved(Beliefs(self.assumed.motion_sigma, some[:, None, None])).log_evidence()
            for some in self.information[:-1].split(at_once)
        ]
        best, index = torch.cat(by_wander).max(0)
        return torch.where(self.wander == NONE, best, -torch.inf), index
