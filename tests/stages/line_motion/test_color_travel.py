"""The advance of an object by the lines of the colours, without a target: its mean, a step, and too little texture."""

from pathlib import Path

import pytest
import torch
from torch import Tensor

from lsvision.geometry import ProductFrame, scaled_rig, travel_at, without_trend, zero_disparity_mm
from lsvision.image.levels import PairLevels
from lsvision.image.stereo.relation import PairRelation
from lsvision.image.stereo.rows import RowOffset
from lsvision.stages.line_motion.color_pair import ColorPair, ObjectDepth, color_pair
from lsvision.stages.line_motion.color_travel import ColorTravel, measure_color_travel, with_travel
from lsvision.stages.line_motion.estimate import not_measured
from lsvision.types import Scan, StereoPair, TensorImage, Transport, Travel
from tests.stages.rendered import FULL_RIG

PITCH, WIDTH, LINES, SPACING = 0.28, 96, 1500, 4.0
N = torch.tensor([0.0, 1.02, 0.0], dtype=torch.float64)


def texture(y: Tensor, seed: int, contrast: float) -> Tensor:
    """Grey values of columns at places along the object, mm: waves of 1.4 mm and more."""
    generator = torch.Generator().manual_seed(seed)
    frequency = 2 * torch.pi / 1.4 * torch.rand(80, WIDTH, generator=generator, dtype=torch.float64)
    phase = 2 * torch.pi * torch.rand(80, WIDTH, generator=generator, dtype=torch.float64)
    columns = [torch.sin(y[:, None] * frequency[:, u] + phase[:, u]).sum(1) for u in range(WIDTH)]
    return 100 + contrast * torch.stack(columns, 1) / 80**0.5


def seen(
    positions: Tensor, *, registered: bool, contrast: float = 25.0, transport: Transport = "forward", seed: int = 0
) -> ColorPair:
    """What the colours see of a texture that lies at ``positions``, mm of Y, on each line; nominal travel is even."""
    sign = -1.0 if transport == "reverse" else 1.0
    generator = torch.Generator().manual_seed(seed)
    channels = []
    for spacing in (-SPACING, 0.0, SPACING):
        line = torch.arange(len(positions)) - (sign * round(spacing) if registered else 0)
        inside = line.long().clamp(0, len(positions) - 1)
        grey = texture(sign * positions[inside] + spacing * PITCH, seed, contrast)
        channels.append(grey + 1.5 * torch.randn(grey.shape, generator=generator, dtype=torch.float64))
    image = TensorImage(torch.stack(channels, -1).round().clamp(0, 255).byte())
    rig = scaled_rig(FULL_RIG, 4)
    rig = type(rig)(WIDTH, *list(vars(rig).values())[1:6], color_spacing_lines=(-SPACING, 0.0, SPACING))
    images = StereoPair(image, image)
    scan = Scan(Path("texture"), rig, Travel(PITCH, None, transport), images, registered)
    relation = PairRelation(PairLevels.of(images), RowOffset(0.0, 0.0), None)
    depth = ObjectDepth(torch.full((len(positions),), zero_disparity_mm(rig)).double(), torch.zeros(WIDTH - 4).double())
    pair = color_pair(scan, ProductFrame(rig, scan.travel, N), relation, depth)
    assert pair is not None
    return pair


def measured(pair: ColorPair) -> ColorTravel:
    return measure_color_travel(pair, slice(2, WIDTH - 2))


@pytest.mark.parametrize(("registered", "transport"), [(True, "forward"), (False, "forward"), (True, "reverse")])
def test_the_mean_rate_is_the_true_one(registered: bool, transport: Transport) -> None:
    true = 1.0006
    travel = measured(seen(torch.arange(LINES) * PITCH * 1.02 * true, registered=registered, transport=transport))
    assert travel.is_measured
    assert travel.whole.rate == pytest.approx(true, abs=2e-4)
    assert abs(travel.whole.rate - true) < 4 * travel.whole.sigma
    assert len(travel.pieces) == 1
    assert travel.metadata(1.02)["n2_measured"] == pytest.approx(1.02 * true, abs=2.1e-4)
    assert "1.000" in travel.in_words


def test_sigma_covers_the_scatter_of_windows() -> None:
    travel = measured(seen(torch.arange(LINES) * PITCH * 1.02, registered=True, seed=3))
    assert 0.6 < float((travel.rate - travel.whole.rate).std() / travel.sigma.mean()) < 1.5


def test_a_step_of_half_a_per_cent_is_found_within_200_lines() -> None:
    step = torch.where(torch.arange(LINES) < 700, 1.0, 1.005).double() * PITCH * 1.02
    pair = seen(step.cumsum(0) - step[0], registered=True)
    travel = measured(pair)
    first, second = travel.pieces
    assert abs(second.first - 700) < 100
    assert second.rate - first.rate == pytest.approx(0.005, abs=1e-3)
    along = travel_at(pair.scan.travel, torch.arange(LINES).double())
    motion = with_travel(not_measured(LINES, "no profile"), travel, along)
    assert [finding.component for finding in motion.findings] == ["dx", "dz", "roll", "dy"]
    assert motion.findings[3].state == "corrected"
    true = without_trend(along)((step.cumsum(0) - step[0]) / 1.02 - along)
    assert true.abs().max() > 0.2
    assert (motion.dy_mm - true).square().mean().sqrt() < 0.05


def test_too_little_texture_is_said() -> None:
    pair = seen(torch.arange(600) * PITCH * 1.02, registered=True, contrast=0.3)
    travel = measured(pair)
    assert not travel.is_measured
    assert "too little texture" in travel.in_words
    assert travel.metadata(1.02).keys() == {"measured", "share", "in_words"}
    still = not_measured(600, "no profile")
    assert with_travel(still, travel, torch.arange(600).double()) is still
    assert not measured(seen(torch.arange(100) * PITCH, registered=True)).is_measured
