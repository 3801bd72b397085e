"""Waves so near to each other that a periodogram shows them as one.

Periodograms take each frequency by itself. Two waves less than a cycle apart differ from one that wanders in how
neighbouring frequencies belong together, which the likelihood of the innovations contains. So every wave of a fit
(``shared_waves``) is tried anew: as one of another period and coherence, and as two. Both start from the sines that fit
the signal best, by least squares over a grid of cycles.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.estimation.shared_parts import Part
from lsvision.estimation.shared_signal import SharedModel, SharedSignal, innovations_of

_ROUNDS = 2  # of trying the waves anew
_WORTH = 3.0  # that the logarithm of the likelihood must gain
_COHERENCES = (4.0, 16.0)  # signals long
_GRIDS = ((0.15, 12), (0.04, 3))  # step in cycles, and steps to either side
_LEAST_APART = 0.1  # cycles of two waves


def with_neighbours(parts: Sequence[Part], data: SharedSignal) -> tuple[Part, ...]:
    """The parts, with waves changed or divided in two as long as that makes the signal likelier."""
    current = tuple(parts)
    density = float(_log_likelihoods([current], data))
    for _ in range(_ROUNDS):
        candidates = [
            (*current[:index], *waves, *current[index + 1 :])
            for index, part in enumerate(current)
            if part.kind == "wave"
            for waves in _instead(part, current[:index] + current[index + 1 :], data)
        ]
        tried = [_best(candidates, size, data) for size in sorted({len(each) for each in candidates})]
        best, likelier = max(tried, key=lambda one: one[1], default=(current, density))
        if likelier < density + _WORTH:
            break
        current, density = best, likelier
    return current


def _best(candidates: Sequence[tuple[Part, ...]], size: int, data: SharedSignal) -> tuple[tuple[Part, ...], float]:
    """The likeliest of the candidates of so many parts, and the logarithm of its likelihood."""
    alike = [each for each in candidates if len(each) == size]
    densities = _log_likelihoods(alike, data)
    return alike[int(densities.argmax())], float(densities.max())


def _log_likelihoods(candidates: Sequence[Sequence[Part]], data: SharedSignal) -> Float[Tensor, " candidates"]:
    """Of equally many parts each, by their innovations."""
    models = [SharedModel(*([part.process(which) for part in parts] for which in range(2))) for parts in candidates]
    return innovations_of(models, data).log_likelihood.view(-1)


def _instead(wave: Part, others: Sequence[Part], data: SharedSignal) -> list[tuple[Part, ...]]:
    """What a wave may be instead: the best single sine, and the best two, each more or less coherent."""
    sines, samples = _Sines.of(others, data), len(data.total)
    found = []
    for count in (1, 2):
        cycles = torch.full((count,), samples / float(wave.span[0]), dtype=data.total.dtype)
        for step, reach in _GRIDS:
            cycles = sines.best_near(cycles, step, reach)
        found.append(sines.waves(cycles))
    return [
        tuple(replace(one, span=one.span * one.span.new_tensor([1.0, long])) for one in waves)
        for waves in found
        for long in _COHERENCES
    ]


@dataclass(frozen=True)
class _Sines:
    """Least squares of sines in a and b: rows of m and of d in sigmas, and columns for what else is there."""

    data: SharedSignal
    weight: Float[Tensor, "2 samples"]
    right: Float[Tensor, " rows"]
    rest: Float[Tensor, "rows columns"]

    @classmethod
    def of(cls, others: Sequence[Part], data: SharedSignal) -> "_Sines":
        """Beside other parts: broad ones as noise, waves as sines of their periods; mean and trend of m are free."""
        one, samples = data.total.new_ones(()), len(data.total)
        variance = [data.total_sigma**2 * one, data.difference_sigma**2 * one]
        for part in others:
            if part.kind == "broad":
                at, beside = part.covariance(one.new_tensor([0.0, 1.0]), 0)
                variance[0] = variance[0] + part.sigma.square().sum()
                variance[1] = variance[1] + 2.0 * data.ratio**2 * (at - beside)
        valid = torch.stack([data.total_valid, data.difference_valid])
        weight = valid / torch.stack(variance).sqrt()[:, None]
        right = (weight * torch.where(valid, torch.stack([data.total, data.difference]), 0.0)).flatten()
        sines = cls(data, weight, right, right.new_zeros(len(right), 0))
        trend = torch.linspace(-1.0, 1.0, samples, dtype=right.dtype)
        level = torch.stack([torch.ones_like(trend), trend], -1) * weight[0][:, None]
        cycles = [samples / float(part.span[0]) for part in others if part.kind == "wave"]
        waves = sines.columns(right.new_tensor(cycles)).flatten(1)
        return replace(sines, rest=torch.cat([torch.cat([level, 0.0 * level]), waves], -1))

    def columns(self, cycles: Float[Tensor, " waves"]) -> Float[Tensor, "rows waves 4"]:
        """Of waves with some cycles in all: cosine and sine of a, then of b."""
        samples = len(self.data.total)
        angle = 2 * math.pi / samples * cycles * torch.arange(-1, samples, dtype=cycles.dtype)[:, None]
        wave = torch.stack([torch.cos(angle), torch.sin(angle)], -1)
        here, moved = wave[1:], self.data.ratio * wave.diff(dim=0)
        of_a, of_b = torch.cat([here, moved]), torch.cat([here, torch.zeros_like(moved)])
        return torch.cat([of_a, of_b], -1) * self.weight.flatten()[:, None, None]

    def best_near(self, cycles: Float[Tensor, " waves"], step: float, reach: int) -> Float[Tensor, " waves"]:
        """Cycles of one or two waves that fit best, on a grid around given ones."""
        offsets = step * torch.arange(-reach, reach + 1, dtype=cycles.dtype)
        grid = torch.cartesian_prod(*(one + offsets for one in cycles)).view(-1, len(cycles))
        apart = (grid[:, 0] - grid[:, -1]).abs() > _LEAST_APART
        grid = grid[(apart | (len(cycles) == 1)) & (grid > 0).all(-1)]
        each, index = torch.unique(grid, return_inverse=True)
        columns = self.columns(each)
        first = self.rest.shape[-1]
        whole = torch.cat([self.rest, columns.flatten(1)], -1)
        gram, right = whole.mT @ whole, whole.mT @ self.right
        own = (first + 4 * index[..., None] + torch.arange(4)).flatten(1)
        used = torch.cat([torch.arange(first).expand(len(grid), -1), own], -1)
        A, b = gram[used[:, :, None], used[:, None]], right[used]
        eye = torch.eye(A.shape[-1], dtype=A.dtype) * 1e-9 * A.diagonal(dim1=-2, dim2=-1).amax(-1)[:, None, None]
        explained = (b * torch.linalg.solve(A + eye, b)).sum(-1)
        return grid[int(explained.argmax())]

    def waves(self, cycles: Float[Tensor, " waves"]) -> tuple[Part, ...]:
        """Waves as large as the sines that fit, and their errors, make them; coherent over one signal."""
        whole = torch.cat([self.columns(cycles).flatten(1), self.rest], -1)
        inverse = torch.linalg.pinv(whole.mT @ whole, hermitian=True)
        size = 4 * len(cycles)
        squares = (inverse @ (whole.mT @ self.right))[:size].square() + inverse.diagonal()[:size]
        sigma = (squares.view(-1, 2, 2).sum(-1) / 2).sqrt()
        samples = float(len(self.data.total))
        return tuple(
            Part("wave", own, own.new_tensor([samples / cycle, samples]))
            for own, cycle in zip(sigma, cycles.tolist(), strict=True)
        )
