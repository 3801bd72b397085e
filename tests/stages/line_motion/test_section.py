"""A nominal section laid on a profile: drawn ones with wear, noise and other radii, and rendered rails."""

import dataclasses
import math

import pytest
import torch
from torch import Tensor

from lsvision.geometry import product_axes
from lsvision.io import read_section
from lsvision.simulation import SceneConfig
from lsvision.simulation.rail_profile import head_60e1
from lsvision.stages.line_motion.config import LineMotionConfig
from lsvision.stages.line_motion.profiles import Reference, reference_of
from lsvision.stages.line_motion.section import FittedSection, fit_section
from lsvision.types import Section
from tests.stages.line_motion.test_measure import CONFIG as OF_SCAN
from tests.stages.line_motion.test_measure import LINES, SHAKEN, matched, measure, rendered, true_values

CONFIG, STEP = LineMotionConfig(), 0.1
EN60E1 = read_section("EN60E1")
PLACE = (176.4, 21.7, math.radians(1.2))


def drawn(section: Section, worn: Tensor | None = None, noise_mm: float = 0.004, seed: int = 0) -> Reference:
    """The profile of a section at ``PLACE``; ``worn`` is taken off along the height, by place across the section."""
    x, height, roll = PLACE
    outline = section.outline
    if worn is not None:
        outline[:, 1] -= worn
    cos, sin = math.cos(roll), math.sin(roll)
    turned = outline @ torch.tensor([[cos, sin], [-sin, cos]], dtype=torch.float64)
    steep = turned[:, 1].diff().abs() > 3 * turned[:, 0].diff()
    inner = torch.cat([~steep, steep[:1] & False]) & torch.cat([steep[:1] & False, ~steep])
    turned = turned[inner] + torch.tensor([x, height])
    q_x = torch.arange(float(turned[0, 0]), float(turned[-1, 0]), STEP, dtype=torch.float64)
    after = torch.searchsorted(turned[:, 0].contiguous(), q_x).clamp(1, len(turned) - 1)
    (x0, h0), (x1, h1) = turned[after - 1].T, turned[after].T
    exact = torch.lerp(h0, h1, (q_x - x0) / (x1 - x0))
    generator = torch.Generator().manual_seed(seed)
    found = reference_of(float(q_x[0]), STEP, exact + noise_mm * torch.randn(len(q_x), generator=generator))
    assert found is not None
    return found


def across() -> Tensor:
    return torch.tensor(EN60E1.across_mm, dtype=torch.float64)


def laid(profile: Reference, section: Section = EN60E1) -> FittedSection:
    found = fit_section(profile, section, CONFIG)
    assert found is not None
    return found


def test_the_section_is_that_of_the_published_radii() -> None:
    chain, outline = head_60e1(), EN60E1.outline
    upper = (chain.x.abs() < 36) & (chain.z < 14.3)
    after = torch.searchsorted(outline[:, 0].contiguous(), chain.x[upper]).clamp(1, len(outline) - 1)
    (x0, h0), (x1, h1) = outline[after - 1].T, outline[after].T
    off = torch.lerp(h0, h1, (chain.x[upper] - x0) / (x1 - x0)) + chain.z[upper]
    assert (off * torch.cos(chain.angle[upper])).abs().max() < 1e-3
    assert float(torch.tensor(EN60E1.height_mm).max()) == 0.0


WEAR = {
    "new": torch.zeros(len(across())),
    "crown": 0.8 * torch.exp(-0.5 * (across() / 6.0).square()),
    "gauge corner": 1.5 * ((across() - 18.0) / 12.0).clamp(0, 1),
    "20 um": 0.02 * (across().abs() < 14),
}


@pytest.mark.parametrize("kind", WEAR)
@pytest.mark.parametrize("seed", range(3))
def test_wear_does_not_draw_the_section(kind: str, seed: int) -> None:
    worn = WEAR[kind].double()
    found = laid(drawn(EN60E1, worn, seed=seed))
    fit = found.fit
    assert fit.is_reference
    assert abs(fit.x_mm - PLACE[0]) < 0.02
    assert abs(fit.height_mm - PLACE[1]) < 0.02
    assert abs(fit.roll_rad - PLACE[2]) < math.radians(0.03)
    assert fit.departure_most_mm == pytest.approx(-float(worn.max()), abs=0.3 * float(worn.max()) + 0.025)
    assert "section EN60E1: at q_x 176" in fit.in_words


@pytest.mark.slow
def test_sigma_covers_the_place() -> None:
    errors, sigma = [], []
    for seed in range(40):
        fit = laid(drawn(EN60E1, noise_mm=0.01, seed=seed)).fit
        errors.append([fit.x_mm - PLACE[0], fit.height_mm - PLACE[1], fit.roll_rad - PLACE[2]])
        sigma.append([fit.x_sigma_mm, fit.height_sigma_mm, fit.roll_sigma_rad])
    ratio = torch.tensor(errors).square().mean(0).sqrt() / torch.tensor(sigma).square().mean(0).sqrt()
    assert ((ratio > 0.6) & (ratio < 1.4)).all()


def test_the_reference_is_the_section_less_the_noise_and_with_the_wear() -> None:
    worn = WEAR["crown"].double()
    exact, noisy = (drawn(EN60E1, worn, noise) for noise in (0.0, 0.01))
    reference = laid(noisy).reference
    off = (reference.height - exact.height)[reference.slope.isfinite()]
    assert off.square().mean().sqrt() < 0.005
    slopes = [(each.slope - exact.slope)[reference.slope.isfinite()].nan_to_num() for each in (reference, noisy)]
    assert slopes[0].square().mean().sqrt() < 0.5 * slopes[1].square().mean().sqrt()


def test_another_section_is_said() -> None:
    height = torch.tensor(EN60E1.height_mm, dtype=torch.float64) - 0.004 * across().square().clamp(max=900.0)
    other = dataclasses.replace(EN60E1, name="other", height_mm=tuple(height.tolist()))
    profile = drawn(other)
    found = laid(profile)
    assert not found.fit.is_reference
    assert found.reference is profile
    assert "another section or badly worn" in found.fit.in_words
    assert found.fit.departure_rms_mm > 0.2


def test_a_profile_of_next_to_nothing() -> None:
    height = torch.full((40,), torch.nan, dtype=torch.float64)
    height[20:24] = 1.0
    assert fit_section(Reference(0.0, STEP, height, height), EN60E1, CONFIG) is None


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_a_rendered_rail_lies_where_the_section_says(seed: int) -> None:
    """The line motion is as good as with the scan's own profile; where the rail lies is known besides."""
    scene = SceneConfig("rail", roll_deg=(0.0, 2.0, -1.0, 0.0)[seed], seed=seed)
    source, depth = rendered(dataclasses.replace(SHAKEN, seed=seed), scene)
    config = dataclasses.replace(OF_SCAN, reference="EN60E1")
    found, of_scan = measure(matched(depth, seed), config, EN60E1), measure(matched(depth, seed))
    fit, mean = found.section, source.trajectory.vibration(torch.arange(LINES).double()).mean(0)
    frame = product_axes(source.trajectory.n)
    place = [float(frame[0] @ source.pose.translation + mean[0]), 22.0 - float(mean[1])]
    place.append(math.radians(scene.roll_deg) + float(mean[2]))
    errors = torch.tensor([fit.x_mm, fit.height_mm, fit.roll_rad]) - torch.tensor(place)
    assert (errors.abs() < torch.tensor([0.03, 0.005, math.radians(0.04)])).all()
    assert (errors.abs() < 3 * torch.tensor([fit.x_sigma_mm, fit.height_sigma_mm, fit.roll_sigma_rad])).all()
    assert fit.is_reference
    assert fit.share > 0.98
    rms = [(each.values[:, :3] - true_values(source)).square().mean(0).sqrt() for each in (found, of_scan)]
    assert (rms[0] < 1.05 * rms[1]).all()
    assert of_scan.section is None
