"""One measured signal that two processes share, and differences that only one of them has: which is which.

    m_j = a_j + b_j + e_j,      d_j = r (a_j - a_(j-1)) + w_j,      e, w white.

Given the processes (``shared_waves`` finds them), filter and smoother give b in blocks at fixed places, as in
``signals``.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.estimation.filtering import StateSpace, Track, filter_sequence
from lsvision.estimation.gaussian import Gaussian
from lsvision.estimation.linalg import apply
from lsvision.estimation.smoothing import smooth
from lsvision.estimation.state_space_process import Process

_UNKNOWN = 1e4  # times the sigma of a value where none was measured
_BLOCKS_AT_ONCE = 64


@dataclass(frozen=True)
class SharedSignal:
    """Evenly spaced samples of m and d; ``ratio`` is r, and values that are not ``valid`` mean nothing."""

    total: Float[Tensor, "*samples"]
    total_valid: Bool[Tensor, "*samples"]
    total_sigma: float
    difference: Float[Tensor, "*samples"]
    difference_valid: Bool[Tensor, "*samples"]
    difference_sigma: float
    ratio: float

    def at(self, samples: Tensor) -> "SharedSignal":
        """Samples by their numbers, in any shape; those beyond either end were not measured."""
        inside = samples.clamp(0, len(self.total) - 1)
        there = inside == samples
        return replace(
            self,
            total=self.total[inside],
            total_valid=self.total_valid[inside] & there,
            difference=self.difference[inside],
            difference_valid=self.difference_valid[inside] & there,
        )


@dataclass(frozen=True)
class SharedModel:
    """Processes whose sum is a, and others whose sum is b."""

    a: Sequence[Process]
    b: Sequence[Process]

    def state_space(self, data: SharedSignal) -> tuple[StateSpace, Gaussian]:
        """The model for the filter, and the state before the first sample: all processes, and a one sample before."""
        return _state_space([self], data, data.total.shape[1:])

    def matrices(self) -> tuple[Tensor, Tensor]:
        """What takes all processes, and a one sample before, to the next sample; the factor of the noise on the way."""
        transition, noise = (self._blocks(part) for part in ("transition", "noise_root"))
        transition[-1] = self.row(0)
        return transition, noise

    def start(self) -> Float[Tensor, "state state"]:
        """Factor of the covariance before the first sample."""
        start = self._blocks("start_root")
        start[-1, -1] = (self.row(0) @ start).norm()
        return start

    def _blocks(self, part: str) -> Tensor:
        processes = [*self.a, *self.b]
        of_before = processes[0].transition.new_zeros(1, 1)
        return torch.block_diag(*(getattr(process, part) for process in processes), of_before)

    def row(self, which: int) -> Float[Tensor, " state"]:
        """What of the state adds up to a (0) or b (1)."""
        processes = [*self.a, *self.b]
        row = torch.zeros(sum(process.size for process in processes) + 1, dtype=processes[0].transition.dtype)
        place = 0
        for index, process in enumerate(processes):
            row[place] = float((index >= len(self.a)) == bool(which))
            place += process.size
        return row


def innovations_of(models: Sequence[SharedModel], data: SharedSignal) -> Track:
    """Filter one signal by several models of equally many processes at once; the batch is that of the models.

    Args:
        data: one sequence.
    """
    values, seen = _values_of(data)
    count = len(models)
    space, start = _state_space(models, data.at(torch.arange(len(data.total))[:, None].expand(-1, count)), (count,))
    return filter_sequence(
        space, start, values[:, None].expand(-1, count, -1), seen[:, None].expand(-1, count), history=False
    )


def _values_of(data: SharedSignal) -> tuple[Tensor, Tensor]:
    """The measured pairs (m, d), and where there is any."""
    valid = torch.stack([data.total_valid, data.difference_valid], -1)
    return torch.where(valid, torch.stack([data.total, data.difference], -1), 0.0), valid.any(-1)


def _state_space(
    models: Sequence[SharedModel], data: SharedSignal, batch: Sequence[int]
) -> tuple[StateSpace, Gaussian]:
    """One model for all of a batch, or as many as it has problems."""
    F, Q = (torch.stack(part).squeeze(0) for part in zip(*(model.matrices() for model in models), strict=True))
    start = torch.stack([model.start() for model in models]).squeeze(0)
    of_a, of_b = models[0].row(0), models[0].row(1)
    before = torch.zeros_like(of_a)
    before[-1] = 1.0
    H = torch.stack([of_a + of_b, data.ratio * (of_a - before)])
    valid = torch.stack([data.total_valid, data.difference_valid], -1)
    sigma = data.total.new_tensor([data.total_sigma, data.difference_sigma])
    noise = torch.diag_embed(torch.where(valid, sigma, _UNKNOWN * sigma))
    space = StateSpace(lambda points, _: apply(H, points), noise, Q, lambda points: apply(F, points))
    return space, Gaussian(F.new_zeros(*batch, len(H[0])), start.expand(*batch, *start.shape[-2:]))


def smooth_shares(
    model: SharedModel, data: SharedSignal, *, block: int, halo: int
) -> tuple[Float[Tensor, " samples"], Float[Tensor, " samples"]]:
    """Mean and variance of b at every sample, given all of its block and the halo on either side.

    Args:
        block: samples of a block; blocks begin at multiples of it. halo: samples on either side.
    """
    samples, of_b = len(data.total), model.row(1)
    if samples <= block:
        block, halo = samples, 0
    within = torch.arange(-halo, block + halo)[:, None]
    means, variances = [], []
    for group in torch.arange(0, samples, block).split(_BLOCKS_AT_ONCE):
        blocks = data.at(within + group)
        values, seen = _values_of(blocks)
        space, start = model.state_space(blocks)
        posterior = smooth(filter_sequence(space, start, values, seen), space)
        inner = slice(halo, halo + block)
        row = (of_b[:, None] * posterior.factor[inner]).sum(-2)
        means.append(apply(of_b[None], posterior.mean[inner])[..., 0].T.flatten())
        variances.append(row.square().sum(-1).T.flatten())
    return torch.cat(means)[:samples], torch.cat(variances)[:samples]
