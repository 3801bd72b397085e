"""The stated prior: long waves of the motion are the object's shape and stay in the height."""

import math
from dataclasses import replace

import pytest
import torch

from lsvision.geometry import without_trend
from lsvision.stages.line_motion.color_differences import ColorDifferences
from lsvision.stages.line_motion.config import LineMotionConfig
from lsvision.stages.line_motion.errors import LineErrors
from lsvision.stages.line_motion.register import Registered
from lsvision.stages.line_motion.shape import ShapeData, without_shape
from lsvision.types import LineFinding, LineMotion

LINES, PITCH = 4000, 0.28


def wave(length_mm: float) -> torch.Tensor:
    return torch.sin(2 * math.pi * torch.arange(LINES).double() * PITCH / length_mm)


GAUGE = without_trend(torch.arange(LINES).double())
SHORT, LONG = GAUGE(0.1 * wave(40.0)), GAUGE(0.3 * wave(300.0))


def split(longest_mm: float | None) -> LineMotion:
    """Waves of 0.1 mm over 40 mm and of 0.3 mm over 300 mm in depth; sideways nothing was found."""
    values = torch.zeros(LINES, 4, dtype=torch.float64)
    values[:, 1] = SHORT + LONG
    covariance = torch.diag(torch.tensor([0.0, 1e-6, 0.0, 0.0], dtype=torch.float64)).repeat(LINES, 1, 1)
    rms = float(values[:, 1].square().mean().sqrt())
    findings = LineFinding("dx", "absent", sigma=0.01), LineFinding("dz", "corrected", rms, 1e-3, 50.0)
    lines = Registered.nothing(LINES)
    ones = torch.ones(3, dtype=torch.float64)
    data = ShapeData(
        lines,
        torch.ones(LINES, dtype=torch.bool),
        PITCH * torch.arange(LINES).double(),
        LineErrors(ones, ones, ones),
        None,
    )
    return without_shape(
        LineMotion(values, covariance, findings), data, LineMotionConfig(shape_longer_than_mm=longest_mm)
    )


def test_long_waves_stay_in_the_height() -> None:
    found = split(110.0)
    error = found.dz_mm - SHORT
    assert error[400:-400].abs().max() < 0.005
    assert error.square().mean().sqrt() < 0.01
    finding = found.findings[1]
    assert finding.state == "corrected"
    assert finding.rms == pytest.approx(0.1 / math.sqrt(2), rel=0.05)
    assert finding.shape_rms == pytest.approx(0.3 / math.sqrt(2), rel=0.05)
    assert "0.21 mm rms are the object's shape" in finding.in_words
    assert found.findings[0] == LineFinding("dx", "absent", sigma=0.01)


def test_all_may_be_shape_or_none() -> None:
    still = split(10.0)
    assert still.is_still
    assert not still.covariance.any()
    assert still.findings[1].state == "absent"
    assert still.findings[1].shape_rms == pytest.approx(math.hypot(0.1, 0.3) / math.sqrt(2), rel=0.02)
    everything = split(None)
    assert torch.equal(everything.dz_mm, SHORT + LONG)
    assert everything.findings[1].shape_rms == 0.0


def seen_by_colors(seed: int, vibration_mm: float, corrugation_mm: float, length_mm: float = 560.0) -> ShapeData:
    """Lines that vibrate over 80 mm and are corrugated over 75 mm, and differences of colours eight lines apart."""
    generator, count, lag = torch.Generator().manual_seed(seed), int(length_mm / PITCH), 8
    phase = 2 * math.pi * torch.rand(2, generator=generator, dtype=torch.float64)
    noise = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    line = torch.arange(count).double()

    def vibration(at: torch.Tensor) -> torch.Tensor:
        return vibration_mm * torch.sin(2 * math.pi * at * PITCH / 80.0 + phase[0])

    values, moved, errors = (torch.zeros(count, 3, dtype=torch.float64) for _ in range(3))
    shape = corrugation_mm * torch.sin(2 * math.pi * line * PITCH / 75.0 + phase[1])
    values[:, 1] = vibration(line) + shape + 0.014 * noise[:, 0]
    moved[:, 1] = vibration(line + lag / 2) - vibration(line - lag / 2) + 0.03 * noise[:, 1]
    errors[:, 1] = 0.03 * noise[:, 2]
    differences = ColorDifferences(moved, errors, line + lag / 2, line - lag / 2)
    usual = torch.full((3,), 0.014, dtype=torch.float64)
    lines = replace(Registered.nothing(count), values=values)
    return ShapeData(lines, line >= 0, PITCH * line, LineErrors(usual, 0 * usual + 0.3, usual), differences)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("corrugation_mm", [0.05, 0.03])
def test_what_is_separated_or_not_is_covered_by_sigma(seed: int, corrugation_mm: float) -> None:
    """Two waves half a cycle apart over the scan: separated, or stated as ambiguous with a sigma as wide as that."""
    data = seen_by_colors(seed, 0.1, corrugation_mm)
    gauge = without_trend(data.along_mm)
    values = torch.nn.functional.pad(gauge(data.lines.values.T).T, (0, 1))
    found = LineMotion(
        values,
        torch.diag(torch.tensor([0.0, 1e-5, 0.0, 0.0]).double()).repeat(len(values), 1, 1),
        (LineFinding("dx", "absent"), LineFinding("dz", "corrected", 0.08, 3e-3, 50.0)),
    )
    split = without_shape(found, data, LineMotionConfig())
    generator = torch.Generator().manual_seed(seed)
    phase = 2 * math.pi * torch.rand(2, generator=generator, dtype=torch.float64)
    truth = gauge(0.1 * torch.sin(2 * math.pi * data.along_mm / 80.0 + phase[0]))
    error, finding = split.dz_mm - truth, split.findings[1]
    smooth = torch.nn.functional.avg_pool1d(error[None], 8, 8)[0]  # without the noise of single lines
    sigma = torch.nn.functional.avg_pool1d(split.sigma[None, :, 1], 8, 8)[0]
    assert (smooth / sigma).square().mean() < 4.0
    if finding.separated_up_to_mm is not None:
        assert finding.sigma < 0.012
