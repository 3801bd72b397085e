"""Signals from noisy values: filter, smoother and likelihood against the dense Gaussian, and in blocks."""

import math

import pytest
import torch
from torch import Tensor

from lsvision.estimation import NoisyValues, SignalParameters, fit_signals, log_likelihood, smooth_signals
from lsvision.estimation.gaussian_process import exponential, matern32

SAMPLES, WHITE = 40, 0.1


def parameters(states: int = 2) -> SignalParameters:
    return SignalParameters(
        states,
        sigma=torch.tensor([1.5, 0.4]).double(),
        length=torch.tensor([9.0, 14.0]).double(),
        noise_scale=torch.tensor([1.2, 0.8]).double(),
        memory=torch.tensor([2.0, 3.0]).double(),
    )


def values(samples: int = SAMPLES, missing: float = 0.2) -> NoisyValues:
    generator = torch.Generator().manual_seed(samples)
    root = torch.tensor([[0.5, 0.0], [0.4, 0.3]]).double() * (
        1 + torch.rand(samples, 1, 1, generator=generator, dtype=torch.float64)
    )
    measured = torch.randn(samples, 2, generator=generator, dtype=torch.float64)
    valid = torch.rand(samples, generator=generator) >= missing
    return NoisyValues(torch.where(valid[:, None], measured, torch.nan), root, valid)


def dense(given: SignalParameters, data: NoisyValues) -> tuple[Tensor, Tensor]:
    """Covariances of the signals and of the noise, ``(2 samples, 2 samples)``, sample by sample."""
    lag = (torch.arange(len(data.values))[:, None] - torch.arange(len(data.values))).abs().double()
    signal = torch.stack([s**2 * matern32(lag / span) for s, span in zip(given.sigma, given.length, strict=True)])
    noise = torch.stack([(1 - WHITE) * exponential(lag / m) + WHITE * (lag == 0) for m in given.memory])
    root = given.noise_scale[:, None] * data.root
    errors = torch.einsum("vik,kvw,wjk->viwj", root, noise, root)
    signals = torch.einsum("ivw,ij->viwj", signal, torch.eye(2).double())
    return signals.reshape(2 * len(lag), -1), errors.reshape(2 * len(lag), -1)


def test_smoother_and_likelihood_equal_the_dense_gaussian() -> None:
    given, data = parameters(), values()
    signals, errors = dense(given, data)
    seen = data.valid.repeat_interleave(2)
    total, z = (signals + errors)[seen][:, seen], data.values.flatten()[seen]
    gain = signals[:, seen] @ torch.linalg.inv(total)
    mean, covariance = smooth_signals(given.model(), data, block=SAMPLES, halo=0)
    torch.testing.assert_close(mean.flatten(), gain @ z, rtol=0, atol=1e-8)
    expected = (signals - gain @ signals[seen]).reshape(SAMPLES, 2, SAMPLES, 2)
    expected = expected.diagonal(dim1=0, dim2=2).movedim(-1, 0)
    torch.testing.assert_close(covariance, expected, rtol=0, atol=1e-8)

    batch = given.at(given.logarithms()[None])
    sequence = NoisyValues(data.values[:, None], data.root[:, None], data.valid[:, None])
    found = log_likelihood(batch, sequence)
    dense_likelihood = torch.distributions.MultivariateNormal(torch.zeros_like(z), total).log_prob(z)
    torch.testing.assert_close(found[0], dense_likelihood, rtol=1e-8, atol=0)


def test_candidates_are_a_batch() -> None:
    given, data = parameters(), values()
    points = given.logarithms() + 0.3 * torch.randn(5, 8, dtype=torch.float64)
    sequences = NoisyValues(
        *(part.unflatten(0, (2, -1)).transpose(0, 1) for part in (data.values, data.root, data.valid))
    )
    whole = log_likelihood(given.at(points), sequences)
    assert torch.equal(whole[3:4], log_likelihood(given.at(points[3:4]), sequences))


def test_blocks_agree_with_the_whole_and_do_not_depend_on_what_lies_far_off() -> None:
    given, data = parameters(), values(200)
    whole, whole_covariance = smooth_signals(given.model(), data, block=200, halo=0)
    mean, covariance = smooth_signals(given.model(), data, block=32, halo=60)
    torch.testing.assert_close(mean, whole, rtol=0, atol=2e-3)
    torch.testing.assert_close(covariance, whole_covariance, rtol=0, atol=2e-3)
    cut = NoisyValues(data.values[:128], data.root[:128], data.valid[:128])
    some, _ = smooth_signals(given.model(), cut, block=32, halo=32)
    longer, _ = smooth_signals(given.model(), data, block=32, halo=32)
    assert torch.equal(some[:96], longer[:96])


def test_nothing_measured_leaves_the_process_as_it_is() -> None:
    data = values(30, missing=1.1)
    mean, covariance = smooth_signals(parameters().model(), data, block=30, halo=0)
    assert not mean.any()
    expected = torch.diag(parameters().sigma.square()).expand(30, 2, 2)
    torch.testing.assert_close(covariance, expected, rtol=0, atol=1e-8)


@pytest.mark.parametrize("seed", [0, 1])
def test_the_fit_finds_what_the_values_were_drawn_from(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    truth = SignalParameters(
        2, *(torch.tensor([value]).double() for value in (1.5, 12.0, 1.3)), torch.tensor([0.5]).double()
    )
    count = 600
    lag = (torch.arange(count)[:, None] - torch.arange(count)).abs().double()
    root = torch.linalg.cholesky(2.25 * matern32(lag / 12.0) + 1e-9 * torch.eye(count).double())
    signal = root @ torch.randn(count, generator=generator, dtype=torch.float64)
    noise = 1.3 * 0.5 * torch.randn(count, generator=generator, dtype=torch.float64)
    data = NoisyValues(
        (signal + noise).view(4, 150, 1).transpose(0, 1),
        torch.full((150, 4, 1, 1), 0.5).double(),
        torch.ones(150, 4, dtype=torch.bool),
    )
    start = SignalParameters(2, *(torch.tensor([value]).double() for value in (0.3, 40.0, 0.6, 0.05)))
    free = torch.tensor([1.0, 1.0, 1.0, 0.0])
    fit = fit_signals(start, data, lambda at: at.sigma.new_zeros(len(at.sigma)), free, iterations=14)
    found, flat = fit.parameters, lambda at: float(log_likelihood(at.at(at.logarithms()[None]), data))
    assert fit.log_density > flat(truth) - 1.0
    assert float(found.memory) == pytest.approx(0.05)
    assert math.log(float(found.length) / 12.0) == pytest.approx(0.0, abs=0.5)
    assert math.log(float(found.noise_scale) / 1.3) == pytest.approx(0.0, abs=0.15)


def test_thinning_counts_lengths_in_the_samples_kept() -> None:
    thin = parameters().thinned(4.0)
    assert torch.equal(thin.length, parameters().length / 4)
    torch.testing.assert_close(thin.thinned(0.25).memory, parameters().memory)
