"""Matching of cameras whose columns respond unevenly."""

from dataclasses import replace

import pytest
import torch

from lsvision.geometry import scaled_rig
from lsvision.image.flat_field import FlatFieldImage
from lsvision.image.levels import CameraLevels, PairLevels
from lsvision.image.resampled import ResampledImage
from lsvision.image.sheared_rows import ShearedRows
from lsvision.simulation import Acquisition, SceneConfig, SensorConfig, simulate
from lsvision.stages.disparity.depth import depth_of
from lsvision.stages.disparity.gray_lines import GrayLines
from lsvision.types import CameraResponse, Scan, StereoPair, TensorImage, Travel
from tests.stages.rendered import BOARD, FULL_RIG, MOTION, stereo_scan


@pytest.fixture
def uneven() -> FlatFieldImage:
    """Twenty lines of a camera of which column 3 does not see, and some samples are saturated."""
    chance = torch.Generator().manual_seed(0)
    raw = torch.randint(20, 200, (20, 30, 3), generator=chance).to(torch.uint8)
    raw[5, 11] = 255
    gain = 0.5 + 0.5 * torch.rand(30, 3, generator=chance)
    gain[3] = torch.nan
    return FlatFieldImage(TensorImage(raw), CameraResponse(torch.zeros(30, 3), gain))


def test_saturated_samples_and_blind_columns_are_no_measurements(uneven):
    levels = CameraLevels.of(uneven.source, 255.0)
    levels = replace(levels, faulty=torch.zeros(30, dtype=torch.bool))
    lines = GrayLines.read(uneven, range(20), levels, 255.0)
    assert lines.unusable is not None
    expected = torch.zeros(20, 30, dtype=torch.bool)
    expected[:, 3] = True
    expected[5, 11] = True
    assert torch.equal(lines.unusable, expected)
    assert float(lines.gray.max()) > 255  # brighter than any code: not clamped
    resampled = ResampledImage(uneven, slice(None), ShearedRows(Travel(1.0), 20, 0, None))
    again = GrayLines.read(resampled, range(20), levels, 255.0)
    assert torch.equal(again.gray[:, 5:10], lines.gray[:, 5:10])
    assert bool(again.unusable[:, 3].all())


def test_levels_are_those_of_the_codes_as_the_camera_delivered_them(uneven):
    pair = PairLevels.of(StereoPair(uneven, uneven))
    taken = PairLevels.of(StereoPair(uneven.source, uneven.source))
    assert (pair.white, pair.left.plateau, pair.left.tops) == (taken.white, taken.left.plateau, taken.left.tops)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_as_much_is_matched_as_of_an_even_pair(seed):
    """40 % of vignetting, 5 % of noise of the gains: within 1 % of the pixels of the even pair."""
    rig, acquisition = scaled_rig(FULL_RIG, 8), Acquisition(0.56, lines=300)
    scene = SceneConfig("rail", seed=seed)
    sensors = SensorConfig(), SensorConfig(vignetting=0.4, gain_noise=0.05, offset=3.0, offset_noise=1.0)
    even, raw = (simulate(rig, BOARD, scene, MOTION, sensor, acquisition) for sensor in sensors)
    truth = torch.cat(list(even.depth_strips()))

    def found(scan: Scan) -> tuple[float, float]:
        z = depth_of(scan).read(0, 300).z
        return float(z.isfinite().double().mean()), float((z - truth).abs().nanmedian())

    taken = stereo_scan(raw)
    images = [FlatFieldImage(getattr(taken.images, camera), raw.response(camera)) for camera in ("left", "right")]
    (share, error), (of_uneven, _) = found(stereo_scan(even)), found(taken)
    evened, evened_error = found(replace(taken, images=StereoPair(*images)))
    assert abs(evened - share) < 0.01
    assert evened_error < 1.25 * error
    assert of_uneven < share  # which the response makes good
