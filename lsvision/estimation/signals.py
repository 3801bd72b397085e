"""Signals of several components from noisy values at every sample, by Gaussian processes in state-space form.

    z_k = s_k + D C_k e_k,    s_k the processes' values,    e_k = √(1-w) u_k + √w ε_k,    u_k = φ u_(k-1) + √(1-φ²) ν_k

with C_k C_kᵀ the stated covariance of the values of sample k, D a scale of each signal's noise, and u, ε, ν white of
variance one: neighbouring values err alike, over a memory of -1 / ln φ samples. The noise is part of the state, so that
the posterior covariance is honest about it.

Long sequences are cut into blocks at fixed places, each with a halo that is thrown away, and all blocks are filtered
and smoothed at once as a batch: the recursion is as long as one block, whatever the length of the sequence, and what a
sample gets depends on nothing but the values within the halo of its block.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.estimation.filtering import StateSpace, Track, filter_sequence
from lsvision.estimation.gaussian import Gaussian
from lsvision.estimation.linalg import apply, product
from lsvision.estimation.signal_filter import Measurements, SignalBlocks, filter_blocks
from lsvision.estimation.signal_smoother import smooth_blocks
from lsvision.estimation.state_space_process import Process

# At once smoothed blocks of some 600 samples with their halo: what they leave at every sample fills 30 MB.
_BLOCKS_AT_ONCE = 32


@dataclass(frozen=True)
class NoisyValues:
    """Measured values of signals: ``root`` is C, ``valid`` where something was measured; elsewhere they may be NaN."""

    values: Float[Tensor, "samples *batch signals"]
    root: Float[Tensor, "samples *batch signals signals"]
    valid: Bool[Tensor, "samples *batch"]

    def at(self, samples: Tensor) -> "NoisyValues":
        """Samples by their numbers; those beyond either end were not measured."""
        inside = samples.clamp(0, len(self.values) - 1)
        valid = self.valid[inside] & (inside == samples)
        return NoisyValues(self.values[inside], self.root[inside], valid)


@dataclass(frozen=True)
class SignalModel:
    """Processes of the signals, one each, and the noise of their values; tensors broadcast over the batch.

    Attributes:
        memory: φ of each noise from sample to sample, 0 <= φ < 1. white: share w of its variance without memory, > 0.
        noise_scale: the diagonal of D.
    """

    processes: Sequence[Process]
    memory: Float[Tensor, "*batch signals"]
    noise_scale: Float[Tensor, "*batch signals"]
    white: float = 0.1

    @cached_property
    def places(self) -> Tensor:
        """Where each signal's value stands in the state; the noise follows the processes."""
        sizes = torch.tensor([process.size for process in self.processes])
        return sizes.cumsum(0) - sizes

    def state_space(self, data: NoisyValues) -> tuple[StateSpace, Gaussian]:
        """The model for the filter, and the state before the first sample."""
        signals, batch = len(self.processes), data.values.shape[1:-1]
        eye = torch.eye(signals, dtype=data.values.dtype, device=data.values.device)
        memory = self.memory[..., None]
        noise = (memory * eye, (1 - memory**2).sqrt() * eye, eye.expand(*memory.shape[:-1], -1))
        roots = [(process.transition, process.noise_root, process.start_root) for process in self.processes]
        F, Q, start = (_block_diagonal(parts, batch) for parts in zip(*roots, noise, strict=True))
        first_noise, places = F.shape[-1] - signals, self.places
        noise_root = self.noise_scale[..., None] * data.root
        lasting, fresh = (1 - self.white) ** 0.5 * noise_root, self.white**0.5 * noise_root

        def h(points: Tensor, step: int) -> Tensor:
            """Values without fresh noise."""
            return points[..., places] + apply(lasting[step], points[..., first_noise:])

        model = StateSpace(h, fresh, Q, lambda points: apply(F, points))
        return model, Gaussian(F.new_zeros(F.shape[:-1]), start)

    def blocks(self, batch: Sequence[int]) -> SignalBlocks:
        """The same states signal by signal, for every problem of a batch, which is flattened."""
        size = max(process.size for process in self.processes) + 1
        memory = self.memory.expand(*batch, -1)

        def bordered(blocks: Sequence[Tensor], noise: Tensor) -> Tensor:
            """Blocks of the processes with that of the noise in the last row."""
            whole = noise.new_zeros(len(blocks), *batch, size, size)
            for i, block in enumerate(blocks):
                whole[i, ..., : block.shape[-1], : block.shape[-1]] = block
                whole[i, ..., -1, -1] = noise[..., i]
            return whole.flatten(1, -3).movedim(1, -1).contiguous()

        return SignalBlocks(
            bordered([process.transition for process in self.processes], memory),
            bordered([product(each.noise_root, each.noise_root.mT) for each in self.processes], 1 - memory.square()),
            bordered(
                [product(each.start_root, each.start_root.mT) for each in self.processes], torch.ones_like(memory)
            ),
        )

    def measurements(self, data: NoisyValues) -> Measurements:
        """What ``filter_blocks`` takes, for every problem of a batch, which is flattened."""
        root = (self.noise_scale[..., None] * data.root).flatten(1, -3)
        lasting, fresh = (1 - self.white) ** 0.5 * root, self.white * product(root, root.mT)
        values = data.values.nan_to_num().flatten(1, -2)
        values, lasting, fresh = (each.movedim(1, -1).contiguous() for each in (values, lasting, fresh))
        return Measurements(values, lasting, fresh, data.valid.flatten(1))


def filter_signals(model: SignalModel, data: NoisyValues, *, history: bool = False) -> Track:
    """Library API: filter signals sample by sample in square-root form, for the innovations of every value.

    Args:
        data: a sequence, or a batch of them side by side.
    """
    space, start = model.state_space(data)
    return filter_sequence(space, start, data.values.nan_to_num(), data.valid, history=history)


def smooth_signals(
    model: SignalModel, data: NoisyValues, *, block: int, halo: int
) -> tuple[Float[Tensor, "samples signals"], Float[Tensor, "samples signals signals"]]:
    """Mean and covariance of the signals at every sample, given all values of its block and the halo on either side.

    Args:
        data: one sequence. model: without a batch.
        block: samples of a block; blocks begin at multiples of it. halo: samples on either side.
    """
    samples = len(data.values)
    starts = torch.arange(0, samples, block)
    within = torch.arange(-halo, block + halo)
    parts = [
        _smoothed(model, data.at(within[:, None] + group), slice(halo, halo + block))
        for group in starts.split(_BLOCKS_AT_ONCE)
    ]
    means, covariances = (torch.cat(part)[:samples] for part in zip(*parts, strict=True))
    return means, covariances


def log_likelihood_of(model: SignalModel, data: NoisyValues) -> Float[Tensor, "*batch"]:
    """Logarithm of the likelihood of every sequence of a batch, by its innovations."""
    batch = data.valid.shape[1:]
    with torch.inference_mode():
        measured = model.measurements(data)
        found = filter_blocks(model.blocks(batch), measured).log_likelihood(measured.valid)
    return found.clone().unflatten(0, batch)  # outside: tensors of inference cannot be used in gradients


def _smoothed(model: SignalModel, blocks: NoisyValues, inner: slice) -> tuple[Tensor, Tensor]:
    """Mean and covariance of the inner samples of blocks side by side, one block after the other."""
    with torch.inference_mode():
        measured, states = model.measurements(blocks), model.blocks(blocks.valid.shape[1:])
        found = smooth_blocks(states, measured, filter_blocks(states, measured), inner)
        mean, covariance = (each.movedim(-1, 0).flatten(0, 1) for each in (found.mean, found.covariance))
    return mean.clone(), covariance.clone()


def _block_diagonal(parts: Sequence[Tensor], batch: Sequence[int]) -> Tensor:
    """Square matrices along the diagonal of one, for every problem of a batch."""
    size = sum(part.shape[-1] for part in parts)
    whole, start = parts[0].new_zeros(*batch, size, size), 0
    for part in parts:
        stop = start + part.shape[-1]
        whole[..., start:stop, start:stop] = part
        start = stop
    return whole
