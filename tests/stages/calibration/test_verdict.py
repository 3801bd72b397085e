"""The verdict on a calibration, and the reasons that it gives."""

from dataclasses import replace

import pytest
import torch

from lsvision.geometry import project, triangulate, zero_disparity_mm
from lsvision.stages.calibration.calibrate import calibrate
from lsvision.stages.calibration.config import CalibrationConfig
from lsvision.stages.calibration.verdict import judge, not_settled, rmse_grew
from lsvision.types import Observability, ObservedDirection
from tests.stages.calibration.boards import RIG, simulate, thinned, with_vibration

SEEN = Observability((ObservedDirection((0.0, 0.0, 1.0), 0.05, 1e-4, True),), "n is determined")
UNSEEN = Observability((ObservedDirection((0.0, 0.0, 1.0), 0.05, 0.05, False),), "the boards do not show n3")


@pytest.mark.parametrize(
    ("converged", "contradictions", "observability", "verdict", "reasons"),
    [
        (True, [], SEEN, "determined", 0),
        (True, [], UNSEEN, "prior-dominated", 1),
        (True, ["scan b ran faster"], SEEN, "inconsistent", 1),
        (True, ["scan b ran faster"], UNSEEN, "inconsistent", 1),
        (False, ["scan b ran faster"], UNSEEN, "not converged", 2),
    ],
)
def test_the_worst_that_holds_is_the_verdict_and_its_reasons_are_given(
    converged, contradictions, observability, verdict, reasons
):
    judged = judge(not_settled(converged, 20), contradictions, observability)
    assert judged.verdict == verdict
    assert len(judged.reasons) == reasons
    assert set(contradictions) <= set(judged.reasons)


def test_a_larger_rmse_is_a_contradiction_beyond_what_the_weights_explain():
    assert rmse_grew(1.0, 1.05) == []
    (sentence,) = rmse_grew(3.5, 6.3)
    assert "grew from 3.5 to 6.3 mm" in sentence


def with_pixels(corners, exchange):
    """The corners as a pair of cameras sees them, with left and right in their places or not."""
    boards = []
    for board in corners.boards():
        left, right = (u[:, None].expand(-1, 2) for u in project(RIG, board.points[:, 0], board.points[:, 2]))
        if exchange:
            left, right = right, left
        x, z = triangulate(RIG, left[:, 0], left[:, 0] - right[:, 0])
        points = torch.stack([x, board.points[:, 1], z], dim=-1)
        boards.append(replace(board, points=points, left_px=left, right_px=right))
    return boards


@pytest.mark.parametrize("method", ["joint", "two_step", "least_squares"])
def test_exchanged_images_are_said_to_be(method):
    config = CalibrationConfig(method=method)
    z0 = zero_disparity_mm(RIG)
    corners = thinned(simulate([(2.0, 1.5, 0.0), (-5.0, 1.0, 6.0)], origin=(20.0, 60.0, z0)))
    result = calibrate(with_pixels(corners, True), RIG, config)
    assert not result.usable
    assert "the left and right images look exchanged" in " ".join(result.reasons)
    right = calibrate(with_pixels(corners, False), RIG, config)
    assert "exchanged" not in " ".join(right.reasons)


def test_a_shaken_scan_is_not_called_exchanged():
    corners = with_vibration(thinned(simulate([(2.0, 1.5, 0.0), (-5.0, 1.0, 6.0)])), 0.5)
    result = calibrate(with_pixels(corners, False), RIG, CalibrationConfig())
    assert result.noise_scale > 4
    assert "exchanged" not in " ".join(result.reasons)
