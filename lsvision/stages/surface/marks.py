"""Candidates that repeat with a period, as marks of a damaged roll do: one at every turn."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lsvision.stages.surface.config import SurfaceConfig
from lsvision.types import Candidate, MarkGroup

_NEXT = 12  # candidates ahead of one, whose distances are tried as periods
_TURNS = 3  # at most between these two: some marks may be missed
_LEAST_SHARE = 0.7  # of the turns between the first mark and the last that show one
_LEAST_OFF_MM = 1.0  # from where the period expects a mark
_CHANCE = 1e-3  # that candidates at random places make such a group


@dataclass(frozen=True)
class MarkedSurface:
    """Candidates with the numbers of their groups, and the groups."""

    candidates: list[Candidate]
    groups: list[MarkGroup]


def grouped(candidates: Sequence[Candidate], config: SurfaceConfig) -> MarkedSurface:
    """Find the groups of marks that repeat, the largest first."""
    marked, groups = list(candidates), list[MarkGroup]()
    while (comb := _best_comb(marked, config)) is not None:
        number = len(groups) + 1
        for index in comb.members:
            marked[index] = replace(marked[index], group=number)
        groups.append(comb.group(number, marked))
    return MarkedSurface(marked, groups)


@dataclass(frozen=True)
class _Comb:
    """Candidates, by index in the order of their places, one a turn; ``turns`` counts from the first."""

    members: list[int]
    turns: Int[Tensor, " members"]

    def group(self, number: int, candidates: Sequence[Candidate]) -> MarkGroup:
        """Its period by least squares."""
        of = [candidates[index] for index in self.members]
        along = torch.tensor([candidate.along_mm for candidate in of], dtype=torch.float64)
        stated = torch.tensor([candidate.along_sigma_mm for candidate in of], dtype=torch.float64)
        turns = self.turns.double()
        design = torch.stack([torch.ones_like(turns), turns], 1)
        inverse = torch.linalg.inv(design.T @ design)
        first, period = (inverse @ (design.T @ along)).tolist()
        left = along - first - period * turns
        scatter = max(float(left.square().sum()) / (len(of) - 2), float(stated.square().mean()))
        return MarkGroup(
            number=number,
            kind=of[0].kind,
            marks=len(of),
            turns=int(self.turns[-1]) + 1,
            period_mm=period,
            period_sigma_mm=math.sqrt(scatter * float(inverse[1, 1])),
            first_along_mm=first,
            around_mm=sum(candidate.around_mm for candidate in of) / len(of),
            depth_mm=sum(candidate.depth_mm for candidate in of) / len(of),
        )


def _best_comb(candidates: Sequence[Candidate], config: SurfaceConfig) -> _Comb | None:
    """The comb with the most marks among the candidates that are in no group; of equals the one of longest period."""
    best: _Comb | None = None
    for kind in ("dent", "bump"):
        free = [i for i, candidate in enumerate(candidates) if candidate.kind == kind and candidate.group is None]
        order = sorted(free, key=lambda index: candidates[index].along_mm)
        along, around = (
            torch.tensor([getattr(candidates[index], name) for index in order], dtype=torch.float64)
            for name in ("along_mm", "around_mm")
        )
        for first in range(len(order) - config.least_marks + 1):
            beside = (around[first:] - around[first]).abs() <= config.mark_tolerance_mm
            near = first + beside.nonzero()[:, 0]
            comb = _comb_from(along[near], len(order), config)
            if comb is not None and (best is None or len(comb.members) > len(best.members)):
                best = _Comb([order[int(near[member])] for member in comb.members], comb.turns)
    return best


def _comb_from(along: Float[Tensor, " places"], tried: int, config: SurfaceConfig) -> _Comb | None:
    """The best comb that begins with the first of rising places at one place around the object.

    None where it may be chance, as one is looked for from ``tried`` places.
    """
    if len(along) < config.least_marks:
        return None
    low, high = config.mark_period_mm
    ahead = along[1 : 1 + _NEXT] - along[0]
    periods = (ahead[:, None] / torch.arange(1, _TURNS + 1)).flatten()
    periods = periods[(periods >= low) & (periods <= high)].sort(descending=True).values
    best: _Comb | None = None
    for period in periods.tolist():
        comb = _grown(along, period)
        if len(comb.members) >= config.least_marks and (best is None or len(comb.members) > len(best.members)):
            best = comb if tried * _chance(along, comb, period) <= _CHANCE else best
    return best


def _grown(along: Float[Tensor, " places"], period_mm: float) -> _Comb:
    """Marks turn by turn from the first place on, the period refined by those found, until turns stay empty."""
    members, turns, missed, turn = [0], [0], 0, 1
    while missed < _TURNS:
        expected = float(along[0]) + turn * period_mm
        if expected > float(along[-1]) + _LEAST_OFF_MM:
            break
        nearest = int((along - expected).abs().argmin())
        if abs(float(along[nearest]) - expected) <= _LEAST_OFF_MM + 0.005 * period_mm / max(turns[-1], 1):
            members.append(nearest)
            turns.append(turn)
            period_mm = (float(along[nearest]) - float(along[0])) / turn
            missed = 0
        else:
            missed += 1
        turn += 1
    if len(members) < _LEAST_SHARE * (turns[-1] + 1):
        return _Comb([0], torch.zeros(1, dtype=torch.long))
    return _Comb(members, torch.tensor(turns))


def _chance(along: Float[Tensor, " places"], comb: _Comb, period_mm: float) -> float:
    """Probability that places at random have one at so many turns, over all periods that were tried from the first."""
    turns, found = int(comb.turns[-1]), len(comb.members) - 1
    density = len(along) / max(float(along[-1] - along[0]), period_mm)
    hit = 1 - math.exp(-density * 2 * _LEAST_OFF_MM)
    tail = sum(math.comb(turns, k) * hit**k * (1 - hit) ** (turns - k) for k in range(found, turns + 1))
    return tail * _NEXT * _TURNS
