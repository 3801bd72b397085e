"""Two processes share a signal: the smoother against a dense posterior, the likelihood against a naive expectation."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from lsvision.estimation import Part, SharedModel, SharedSignal, fit_shares, matern, oscillation, smooth_shares
from lsvision.estimation.gaussian_process import exponential, matern32
from lsvision.estimation.shared_neighbours import with_neighbours
from lsvision.estimation.shared_periodograms import Periodograms
from lsvision.estimation.shared_signal import innovations_of


def signal(total: Tensor, difference: Tensor, sigma: float, ratio: float = 1.0) -> SharedSignal:
    there = torch.ones(len(total), dtype=torch.bool)
    return SharedSignal(total, there, sigma, difference, there.clone(), sigma, ratio)


def waves(count: int, of_a: float, of_b: float, seed: int = 0, noise: float = 0.05) -> tuple[SharedSignal, Tensor]:
    """Waves of a and b, of 40 and 25 samples, in noise, and b."""
    generator = torch.Generator().manual_seed(seed)
    n = torch.arange(-1, count, dtype=torch.float64)
    a, b = of_a * torch.sin(2 * math.pi * n / 40 + seed), of_b * torch.sin(2 * math.pi * n / 25 + 2 * seed)
    e, w = noise * torch.randn(2, count, generator=generator, dtype=torch.float64)
    return signal(a[1:] + b[1:] + e, a.diff() + w, noise), b[1:]


def test_smoother_equals_a_dense_posterior() -> None:
    count, ratio, sigma = 30, 0.9, (0.2, 0.3)
    model = SharedModel(
        [matern(2, torch.tensor(1.0).double(), torch.tensor(6.0).double())],
        [
            matern(2, torch.tensor(0.7).double(), torch.tensor(9.0).double()),
            oscillation(*(torch.tensor(x).double() for x in (0.5, 8.0, 50.0))),
        ],
    )
    lag = (torch.arange(-1, count)[:, None] - torch.arange(-1, count)).double()
    K_a = matern32(lag / 6.0)
    K_b = 0.49 * matern32(lag / 9.0) + 0.25 * torch.cos(2 * math.pi * lag / 8.0) * exponential(lag / 50.0)
    eye = torch.eye(count + 1).double()[1:]
    before = torch.eye(count + 1).double()[:-1]
    H = torch.cat([torch.cat([eye, eye], 1), torch.cat([ratio * (eye - before), 0 * eye], 1)])
    prior = torch.block_diag(K_a, K_b)
    generator = torch.Generator().manual_seed(1)
    z = torch.randn(2 * count, generator=generator, dtype=torch.float64)
    valid = torch.rand(2 * count, generator=generator) > 0.2
    noise = torch.tensor(sigma).double().repeat_interleave(count).square()
    Hv, S = H[valid], H[valid] @ prior @ H[valid].T + torch.diag(noise[valid])
    gain = torch.linalg.solve(S, Hv @ prior).T
    mean, covariance = gain @ z[valid], prior - gain @ Hv @ prior
    data = SharedSignal(z[:count], valid[:count], sigma[0], z[count:], valid[count:], sigma[1], ratio)
    found, variance = smooth_shares(model, data, block=count, halo=0)
    torch.testing.assert_close(found, mean[count + 2 :], rtol=0, atol=1e-5)
    torch.testing.assert_close(variance, covariance.diagonal()[count + 2 :], rtol=1e-5, atol=1e-6)


def test_blocks_with_halos_are_as_good_as_the_whole() -> None:
    data, _ = waves(240, 1.0, 0.5, noise=0.1)
    model = SharedModel(*([matern(2, torch.tensor(0.7).double(), torch.tensor(6.0).double())] for _ in range(2)))
    whole, _ = smooth_shares(model, data, block=240, halo=0)
    parts, _ = smooth_shares(model, data, block=60, halo=120)
    torch.testing.assert_close(parts, whole, rtol=0, atol=2e-3)


def test_expected_periodogram_equals_the_naive_mean() -> None:
    """E |Σ h a e^(-iωt)|² by all pairs of samples, with a gap."""
    data, _ = waves(20, 1.0, 0.0)
    data.total_valid[5:9] = False
    data.difference_valid[12] = False
    found = Periodograms.of(data)
    part = Part("broad", torch.tensor([0.8, 0.4], dtype=torch.float64), torch.tensor([3.0, 5.0]).double())
    taper = torch.hann_window(22, periodic=False, dtype=torch.float64)[1:-1]
    t = torch.arange(20).double()
    lag = t[:, None] - t
    a = 0.64 * matern32(lag / 3.0)
    cross = 0.64 * (matern32(lag / 3.0) - matern32((lag + 1) / 3.0))
    total = a + 0.16 * matern32(lag / 5.0)
    wave = torch.exp(-2j * math.pi * t[:, None] * torch.arange(2, 11) / 20)
    h_m, h_d = taper * data.total_valid, taper * data.difference_valid
    power = taper.square().sum()
    for index, (covariance, left, right) in enumerate(((total, h_m, h_m), (cross, h_m, h_d))):
        naive = torch.einsum("tk,ts,sk->k", wave * left[:, None], covariance + 0j, (wave * right[:, None]).conj())
        torch.testing.assert_close(found.expected(part)[2 * index][0], naive / power, rtol=1e-9, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_what_is_there_is_told_from_what_is_not(seed: int) -> None:
    a_alone, b_alone = (fit_shares(waves(200, *sizes, seed)[0], 1.0, 10.0) for sizes in ((1.0, 0.0), (0.0, 1.0)))
    assert a_alone.evidence[0] > 50 > 5 > a_alone.evidence[1]
    assert b_alone.evidence[1] > 50 > 5 > b_alone.evidence[0]
    data, b = waves(200, 1.0, 0.5, seed)
    both = fit_shares(data, 1.0, 10.0)
    assert min(both.evidence) > 12
    mean, variance = smooth_shares(both.model, data, block=200, halo=0)
    error = (mean - b)[20:-20]
    assert error.square().mean().sqrt() < 0.1
    assert (error.square() / variance[20:-20]).mean() < 3.0


def beats(seed: int, count: int = 260, cycles: tuple[float, float] = (10.0, 10.7)) -> tuple[SharedSignal, Tensor]:
    """A wave of a and one of b that are less than a cycle apart over the signal, and b."""
    generator = torch.Generator().manual_seed(seed)
    n = torch.arange(-1, count, dtype=torch.float64) / count
    phase = 2 * math.pi * torch.rand(2, generator=generator, dtype=torch.float64)
    a, b = (size * torch.sin(2 * math.pi * c * n + p) for size, c, p in zip((1.0, 0.5), cycles, phase, strict=True))
    e, w = torch.randn(2, count, generator=generator, dtype=torch.float64)
    data = signal(a[1:] + b[1:] + 0.05 * e, a.diff() + 0.1 * w, 0.05)
    return replace(data, difference_sigma=0.1), b[1:]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_two_waves_within_a_cycle_are_separated_as_well_as_their_sigma_says(seed: int) -> None:
    data, b = beats(seed)
    found = fit_shares(data, float(data.total.std()), 9.0)
    waves = sorted(260 / float(part.span[0]) for part in found.parts if part.kind == "wave")
    assert waves == pytest.approx([10.0, 10.7], abs=0.15)
    mean, variance = smooth_shares(found.model, data, block=512, halo=0)
    error = mean - b
    assert error.square().mean().sqrt() < 0.1  # 0.25 where both are taken for one wave
    assert (error.square() / variance).mean() < 3.0


@pytest.mark.slow
def test_neighbours_are_two_sines_that_fit_a_signal_with_gaps() -> None:
    data, _ = beats(0)
    data.total_valid[40:60] = False
    data.difference_valid[100] = False
    data.total[40:60] = math.nan
    one = Part("wave", torch.tensor([0.7, 0.4]).double(), torch.tensor([260 / 10.3, 300.0]).double())
    found = with_neighbours([one], data)
    assert [260 / float(part.span[0]) for part in found] == pytest.approx([10.0, 10.7], abs=0.15)
    sizes = torch.stack([part.sigma for part in found]) * math.sqrt(2)
    torch.testing.assert_close(sizes, torch.tensor([[1.0, 0.0], [0.0, 0.5]]).double(), rtol=0, atol=0.2)


def test_a_wave_alone_stays_one() -> None:
    data, _ = waves(200, 1.0, 0.0)
    one = Part("wave", torch.tensor([0.7, 0.03]).double(), torch.tensor([40.0, 3000.0]).double())
    (found,) = with_neighbours([one], data)
    assert float(found.span[0]) == pytest.approx(40.0, rel=0.01)


def test_models_side_by_side_are_as_likely_as_each_alone() -> None:
    data, _ = waves(40, 1.0, 0.5)
    models = [
        SharedModel(*([matern(2, torch.tensor(sigma).double(), torch.tensor(6.0).double())] for _ in range(2)))
        for sigma in (0.3, 0.7, 1.0)
    ]
    together = innovations_of(models, data).log_likelihood
    alone = torch.cat([innovations_of([model], data).log_likelihood.view(1) for model in models])
    torch.testing.assert_close(together, alone, rtol=1e-10, atol=1e-8)


def test_an_empty_signal_has_nothing() -> None:
    zeros = torch.zeros(100, dtype=torch.float64)
    found = fit_shares(signal(zeros, zeros, 0.1), 0.1, 10.0)
    assert max(found.evidence) < 5
    assert all(bool(part.sigma.isfinite().all()) for part in found.parts)
