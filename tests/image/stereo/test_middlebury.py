"""The Middlebury 2014 motorcycle at a quarter of its size, where the folder of shared data is present."""

import cv2
import numpy as np
import pytest
import torch

from lsvision.geometry import focal_length_px, zero_disparity_mm
from lsvision.stages.disparity.config import DisparityConfig
from lsvision.stages.disparity.match import StripMatch, measure_strip
from lsvision.types import Rig

HIGHEST_PX = 79
# Heights over the plane of zero disparity that make a range of 0..79 px on this rig.
RIG = Rig(741, 10.0, 9.94978, 193.001, 311.193, 311.193 + 31.086)


@pytest.fixture(scope="module")
def motorcycle(shared_data):
    folder = shared_data / "motorcycle"
    images = [cv2.imread(str(folder / f"motorcycle_{side}.png")) for side in ("left", "right")]
    left, right = (torch.from_numpy(cv2.cvtColor(image, cv2.COLOR_BGR2RGB)) for image in images)
    with np.load(folder / "motorcycle_disp.npz") as archive:
        truth = torch.from_numpy(archive[archive.files[0]])
    return left, right, truth


def bad_share(disparity: torch.Tensor, truth: torch.Tensor) -> float:
    """Share of the pixels with truth that are wrong by more than a pixel or have no disparity."""
    return float((~((disparity - truth).abs() <= 1.0))[torch.isfinite(truth)].float().mean())


def matched(left: torch.Tensor, right: torch.Tensor, **options: float) -> StripMatch:
    """Disparities of 0..79 px by the default matcher."""
    highest = zero_disparity_mm(RIG) - focal_length_px(RIG) * RIG.baseline_mm / (HIGHEST_PX + 31.086)
    return measure_strip(left, right, RIG, DisparityConfig(height_range_mm=(0.0, highest), **options))


def test_sigma_is_that_of_the_errors_on_a_photograph(motorcycle):
    """By the median, and by the rms of those right to a pixel; the truth itself is good to a twentieth of one."""
    left, right, truth = motorcycle
    match = matched(left, right)
    error = match.disparity - truth
    ratio = (error / match.sigma)[error.abs() <= 1.0].abs()
    assert 0.8 < ratio.median() / 0.6745 < 1.3
    assert 0.8 < ratio.square().mean().sqrt() < 1.3


def test_no_more_pixels_are_bad_than_with_opencv(motorcycle):
    left, right, truth = motorcycle
    grey = [cv2.cvtColor(image.numpy(), cv2.COLOR_RGB2GRAY) for image in (left, right)]
    peer = cv2.StereoSGBM.create(
        minDisparity=0, numDisparities=HIGHEST_PX + 1, blockSize=5, P1=8 * 25, P2=32 * 25, disp12MaxDiff=10,
        uniquenessRatio=5, speckleWindowSize=100, speckleRange=1, mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )  # fmt: skip
    expected = torch.from_numpy(peer.compute(*grey)).float() / 16
    expected = torch.where(expected >= 0, expected, torch.nan)
    match = matched(left, right, largest_sigma_px=0.2)
    assert bad_share(expected, truth) == pytest.approx(0.2148, abs=0.01)
    assert bad_share(match.disparity, truth) <= bad_share(expected, truth)
