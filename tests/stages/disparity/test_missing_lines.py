"""Matching of rendered scans that lack lines: nothing is measured there, and nothing beside it is spoilt."""

from dataclasses import dataclass

import pytest
import torch

from lsvision.geometry import focal_length_px
from lsvision.image.stereo.relation import PairRelation
from lsvision.simulation import Acquisition, MotionConfig, SceneConfig, SensorConfig, simulate
from lsvision.stages.disparity.config import DisparityConfig, Matcher
from lsvision.stages.disparity.match import measure_block, relation_of
from lsvision.types import StereoPair, TensorImage
from tests.stages.rendered import BOARD, FULL_RIG, scaled_rig

RIG, PITCH, LINES = scaled_rig(FULL_RIG, 8), 0.56, 160


@dataclass(frozen=True)
class Lacking(TensorImage):
    """An image of which some lines are noise of no meaning."""

    missing: tuple[range, ...] = ()


@pytest.fixture(scope="module")
def rendered() -> tuple[torch.Tensor, ...]:
    """Both images of a rail and the true disparity, px."""
    motion = MotionConfig(angle_x_deg=-1.5, angle_z_deg=0.8, stretch=1.0246)
    source = simulate(RIG, BOARD, SceneConfig("rail"), motion, SensorConfig(supersampling=2), Acquisition(PITCH, LINES))
    left, right = (torch.cat(list(source.strips(camera))) for camera in ("left", "right"))
    depth = torch.cat(list(source.depth_strips())).double()
    offset = RIG.principal_right_px - RIG.principal_left_px
    return left, right, (focal_length_px(RIG) * RIG.baseline_mm / depth - offset).float()


def lacking(image: torch.Tensor, *ranges: range) -> Lacking:
    image = image.clone()
    for lines in ranges:
        image[lines.start : lines.stop] = torch.randint(0, 256, image[lines.start : lines.stop].shape)
    return Lacking(image, ranges)


def relation(pair: StereoPair, config: DisparityConfig) -> PairRelation:
    return relation_of(pair, RIG, config)


@pytest.mark.parametrize("matcher", ["sgbm", "coarse_to_fine"])
@pytest.mark.parametrize("side", ["left", "right"])
def test_lines_beside_missing_ones_are_measured_as_well(rendered, matcher: Matcher, side):
    left, right, truth = rendered
    config = DisparityConfig(matcher=matcher)
    whole = StereoPair(TensorImage(left), TensorImage(right))
    before = measure_block(whole, relation(whole, config), RIG, config, 0)
    lost = range(70, 90)
    pair = StereoPair(
        lacking(left, lost) if side == "left" else TensorImage(left),
        lacking(right, lost) if side == "right" else TensorImage(right),
    )
    match = measure_block(pair, relation(pair, config), RIG, config, 0)
    near = slice(lost.start - config.refine_window, lost.stop + config.refine_window)
    assert match.disparity[near].isnan().all()
    assert match.sigma[near].isnan().all()
    for lines in (slice(40, near.start), slice(near.stop, 120)):
        errors = (match.disparity[lines] - truth[lines]) / match.sigma[lines]
        errors = errors[errors.isfinite()]
        assert errors.square().mean().sqrt() < 1.5
        assert len(errors) > 0.9 * before.disparity[lines].isfinite().sum()


def test_bands_of_the_relation_avoid_missing_lines(rendered):
    left, right, _ = rendered
    config = DisparityConfig()
    whole = StereoPair(TensorImage(left), TensorImage(right.roll(2, dims=0)))
    lost = range(30), range(100, 160)
    pair = StereoPair(lacking(left, lost[1]), lacking(right.roll(2, dims=0), lost[0]))
    expected, found = relation(whole, config).rows, relation(pair, config).rows
    assert found.whole == expected.whole == 2
    assert abs(found.lines - expected.lines) < 0.05


@pytest.mark.parametrize("matcher", ["sgbm", "coarse_to_fine"])
def test_what_missing_lines_hold_makes_no_difference(rendered, matcher: Matcher):
    left, right, _ = rendered
    config = DisparityConfig(matcher=matcher)
    matches = []
    for _ in range(2):  # each with other noise
        pair = StereoPair(lacking(left, range(70, 90)), lacking(right, range(120, 125)))
        matches.append(measure_block(pair, relation(pair, config), RIG, config, 0))
    assert torch.equal(matches[0].disparity.nan_to_num(), matches[1].disparity.nan_to_num())
    assert torch.equal(matches[0].sigma.nan_to_num(), matches[1].sigma.nan_to_num())
