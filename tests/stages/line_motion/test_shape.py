"""The stated prior: long waves of the motion are the object's shape and stay in the height."""

import math

import pytest
import torch

from lsvision.geometry import without_trend
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
