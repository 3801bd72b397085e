"""Covariance-form filter and smoother of signals: the same as in square-root form, at any length and noise."""

import pytest
import torch

from lsvision.estimation import NoisyValues, SignalModel, SignalParameters, filter_signals, matern, oscillation, smooth
from lsvision.estimation.filtering import filter_sequence
from lsvision.estimation.signals import log_likelihood_of, smooth_signals

STEPS = 50


def measured(noise: list[float], sequences: int = 3) -> NoisyValues:
    """Wandering values of signals of very different units, some lines of which are missing or of little weight."""
    generator = torch.Generator().manual_seed(7)
    scale = torch.tensor(noise, dtype=torch.float64)
    mixed = torch.eye(len(noise)).double() + 0.9 * torch.ones(len(noise), len(noise)).double().tril(-1)
    weight = 1 + 9 * (torch.rand(STEPS, sequences, 1, 1, generator=generator) < 0.1).double()
    values = torch.randn(STEPS, sequences, len(noise), generator=generator, dtype=torch.float64).cumsum(0)
    valid = torch.rand(STEPS, sequences, generator=generator) > 0.2
    valid[:5, 0] = valid[-5:, 1] = False
    return NoisyValues(values.where(valid[..., None], torch.nan) * scale, weight * scale[:, None] * mixed, valid)


MODELS = {
    "usual": SignalParameters(
        2, *torch.tensor([[0.5, 0.7, 4e-4], [30.0, 50.0, 80.0], [1.5, 1.0, 2.0], [4.0, 2.0, 8.0]]).double()
    ).model(),
    "hardly any noise, nearly a constant": SignalParameters(
        3, *torch.tensor([[5.0, 9.0, 4e-3], [1e4, 1e3, 3e3], [0.1, 0.2, 0.1], [0.3, 1.0, 0.5]]).double()
    ).model(),
    "hardly any signal": SignalParameters(
        1, *torch.tensor([[1e-5, 1e-5, 1e-9], [3.0, 50.0, 9.0], [1.0, 1.0, 1.0], [50.0, 2.0, 1.0]]).double()
    ).model(),
    "processes of several sizes": SignalModel(
        [
            matern(3, *torch.tensor([0.5, 30.0]).double()),
            oscillation(*torch.tensor([0.7, 9.0, 40.0]).double()),
            matern(1, *torch.tensor([4e-4, 80.0]).double()),
        ],
        torch.tensor([0.2, 0.8, 0.5]).double(),
        torch.tensor([1.0, 2.0, 0.5]).double(),
    ),
}


@pytest.mark.parametrize("name", MODELS)
def test_the_same_as_in_square_root_form(name: str) -> None:
    model, data = MODELS[name], measured([0.03, 0.01, 1e-4])
    expected = filter_signals(model, data).log_likelihood
    torch.testing.assert_close(log_likelihood_of(model, data), expected, rtol=1e-8, atol=1e-8)
    one = NoisyValues(data.values[:, 0], data.root[:, 0], data.valid[:, 0])
    mean, covariance = smooth_signals(model, one, block=STEPS, halo=0)
    space, start = model.state_space(one)
    posterior = smooth(filter_sequence(space, start, one.values.nan_to_num(), one.valid), space)
    rows = posterior.factor[:, model.places]
    unit = torch.tensor([0.03, 0.01, 1e-4]).double()
    torch.testing.assert_close(mean / unit, posterior.mean[:, model.places] / unit, rtol=1e-8, atol=1e-8)
    torch.testing.assert_close(
        covariance / unit / unit[:, None], rows @ rows.mT / unit / unit[:, None], rtol=1e-8, atol=1e-8
    )


def test_a_problem_gets_the_same_bits_alone_and_in_a_batch() -> None:
    data = measured([0.03, 0.01, 1e-4], sequences=9)
    model = MODELS["usual"]
    whole = log_likelihood_of(model, data)
    for i in (0, 4, 8):
        one = NoisyValues(*(part[:, i : i + 1] for part in (data.values, data.root, data.valid)))
        assert torch.equal(whole[i : i + 1], log_likelihood_of(model, one))
