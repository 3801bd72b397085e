"""The advance of rendered rails by the lines of the colours, which look the further apart the further away it is."""

from pathlib import Path

import pytest
import torch

from lsvision.simulation import Acquisition, SceneConfig, SensorConfig, Simulation, simulate
from lsvision.stages.line_motion.color_travel import ColorTravel
from lsvision.stages.line_motion.measure import measure_line_motion
from lsvision.types import Motion, Scan, StereoPair, StoredDepth, TensorImage
from tests.stages.line_motion.test_colors import AT_REST, CONFIG, PITCH, rig
from tests.stages.rendered import BOARD


def travel_of(source: Simulation, assumed: float) -> ColorTravel:
    """Measured on images and true depth, where the calibration's n is ``assumed`` times the true one."""
    left, right = (TensorImage(torch.cat(list(source.strips(camera)))) for camera in ("left", "right"))
    scan = Scan(Path("rail"), source.rig, source.travel, StereoPair(left, right), color_registered=True)
    depth = StoredDepth(TensorImage(torch.cat(list(source.depth_strips()))[..., None]))
    n = Motion(assumed * source.trajectory.n, torch.zeros(3, 3).double())
    travel = measure_line_motion(scan, depth, n, CONFIG).travel
    assert travel is not None
    return travel


@pytest.mark.slow
@pytest.mark.parametrize("rise_mm", [-15.0, 0.0, 20.0])
def test_the_rate_does_not_depend_on_the_depth(rise_mm: float) -> None:
    """20 mm above the plane of zero disparity the colours look 2.5 % less apart; so wrong would the stretch be."""
    scene = SceneConfig("rail", rail_rise_mm=rise_mm, conveyor_drop_mm=60.0)
    source = simulate(rig(), BOARD, scene, AT_REST, SensorConfig(supersampling=2), Acquisition(PITCH, lines=1400))
    travel = travel_of(source, 1 / 1.0006)
    assert travel.whole.rate == pytest.approx(1.0006, abs=3e-4)
    assert abs(travel.whole.rate - 1.0006) < 4 * travel.whole.sigma
