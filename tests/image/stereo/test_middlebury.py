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


def matched_by_opencv(left: torch.Tensor, right: torch.Tensor) -> torch.Tensor:
    """Disparities of OpenCV's matcher alone."""
    grey = [cv2.cvtColor(image.numpy(), cv2.COLOR_RGB2GRAY) for image in (left, right)]
    peer = cv2.StereoSGBM.create(
        minDisparity=0, numDisparities=HIGHEST_PX + 1, blockSize=5, P1=8 * 25, P2=32 * 25, disp12MaxDiff=10,
        uniquenessRatio=5, speckleWindowSize=100, speckleRange=1, mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )  # fmt: skip
    expected = torch.from_numpy(peer.compute(*grey)).float() / 16
    return torch.where(expected >= 0, expected, torch.nan)


def seen_with(image: torch.Tensor, exposure: str) -> torch.Tensor:
    """The image as a camera of another exposure would take it."""
    value, across = image.float(), torch.linspace(-1, 1, image.shape[1])[None, :, None]
    exposed = {
        "darker": 0.8 * value,
        "brighter": 1.25 * value,
        "more offset": value + 10,
        "less offset": value - 10,
        "gamma": 255 * (value / 255).pow(0.8),
        "vignetting": value * (1 - 0.45 * across.square()),
        "half lit": value * (0.775 - 0.225 * across),
    }
    return exposed[exposure].round().clamp(0, 255).to(torch.uint8)


@pytest.mark.parametrize(
    "exposure", ["darker", "brighter", "more offset", "less offset", "gamma", "vignetting", "half lit"]
)
def test_no_exposure_of_the_right_camera_harms_more_than_opencv(motorcycle, exposure):
    left, right, truth = motorcycle
    right = seen_with(right, exposure)
    ours, expected = matched(left, right).disparity, matched_by_opencv(left, right)
    known = [float(disparity[torch.isfinite(truth)].isfinite().float().mean()) for disparity in (ours, expected)]
    assert known[0] >= known[1]
    assert bad_share(ours, truth) <= bad_share(expected, truth)
    assert bad_share(ours, truth) < 0.205  # as with equal exposures, where 0.192 are bad


@pytest.mark.parametrize("offset", [1, -2])
def test_cameras_out_of_step_match_as_those_in_step(motorcycle, offset):
    left, right, truth = motorcycle
    late = right[(torch.arange(len(right)) - offset).clamp(0, len(right) - 1)]
    match = matched(left, late)
    beyond = slice(-offset, None) if offset > 0 else slice(0, -offset)  # the right camera saw no such lines
    assert match.disparity[beyond].isnan().all()
    assert bad_share(match.disparity, truth) < 0.205


def test_no_more_pixels_are_bad_than_with_opencv(motorcycle):
    left, right, truth = motorcycle
    expected = matched_by_opencv(left, right)
    match = matched(left, right, largest_sigma_px=0.2)
    assert bad_share(expected, truth) == pytest.approx(0.2148, abs=0.01)
    assert bad_share(match.disparity, truth) <= bad_share(expected, truth)
