"""Corners of scans: against the truth of two renderers, with their covariance."""

import dataclasses
from pathlib import Path

import cv2
import pytest
import torch

from lsvision.errors import BoardNotFoundError
from lsvision.geometry import focal_length_px, object_pitch_mm, triangulate, zero_disparity_mm
from lsvision.image.board.refine import DetectedCorners
from lsvision.simulation import EncoderConfig
from lsvision.stages.corners.config import CornersConfig
from lsvision.stages.corners.find import _triangulated, find_corners
from lsvision.stages.corners.rows import row_difference
from lsvision.types import DepthView, Scan, StereoPair, TensorImage, Travel
from tests.stages.other_renderer import tilt_corners, tilt_scans, true_points
from tests.stages.rendered import (
    BOARD,
    PITCH,
    SMALL_RIG,
    depth_corners,
    depth_scan,
    simulation,
    stereo_corners,
    stereo_scan,
    true_measurement,
)


def rms(error: torch.Tensor) -> torch.Tensor:
    return error.square().mean(0).sqrt()


BLANK = TensorImage(torch.zeros(2, 2, 1))


def test_corners_of_another_renderer(shared_data: Path):
    errors, variances = [], []
    for scan, corners in zip(tilt_scans(shared_data), tilt_corners(shared_data), strict=True):
        assert corners.valid.all()
        assert corners.scan == str(scan.path)
        error = corners.points - true_points(scan)
        assert (rms(error) <= 0.03).all()  # in depth a fortieth of a pixel: 1.26 mm each on this rig
        errors.append(error)
        variances.append(corners.covariance.diagonal(dim1=-2, dim2=-1))
    ratio = rms(torch.cat(errors)) / torch.cat(variances).mean(0).sqrt()
    assert (ratio < 1.2).all()
    assert (ratio > 0.8).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("noise", "contrast", "blur"),
    [(1.0, 1.0, 0.0), (2.0, 0.3, 0.0), (2.0, 1.0, 0.4), (2.0, 1.0, 0.7), (2.0, 1.0, 1.0), (2.0, 1.0, 2.0)],
)
def test_chi_square_of_the_points_of_another_renderer(shared_data: Path, noise, contrast, blur):
    squared = []
    for scan in tilt_scans(shared_data) * 3:  # another noise each time
        images = (TensorImage(degraded(image, noise, contrast, blur)) for image in (scan.left, scan.images.right))
        corners = find_corners(dataclasses.replace(scan, images=StereoPair(*images)), BOARD)
        error = (corners.points - true_points(scan))[corners.valid]
        covariance = corners.covariance[corners.valid]
        squared.append((error * torch.linalg.solve(covariance, error[..., None])[..., 0]).sum(-1))
    assert (2.7 if contrast == 1 else 2.6) < torch.cat(squared).mean() < 3.4  # 3 ± 0.08


def degraded(image, noise: float, contrast: float, blur: float) -> torch.Tensor:
    """A grey image out of focus, of low contrast, with the noise of a sensor."""
    grey = image.read(0, image.shape[0]).float().mean(-1).numpy()
    grey = cv2.GaussianBlur(grey, (0, 0), blur) if blur else grey
    noisy = 110 + contrast * (torch.from_numpy(grey) - 110) + noise * torch.randn(grey.shape)
    return noisy.round().clamp(0, 255).to(torch.uint8)[..., None]


def test_cameras_in_step_are_not_called_out_of_step(shared_data: Path):
    difference = row_difference(tilt_corners(shared_data)[0])
    assert difference.lines == pytest.approx(0.0, abs=0.02)
    assert not difference.is_systematic
    assert difference.sigma < 0.02


def test_cameras_out_of_step_change_no_corner(shared_data: Path):
    late = 2
    scan, corners = tilt_scans(shared_data)[0], tilt_corners(shared_data)[0]
    right = scan.images.right.read(0, scan.lines)
    shifted = TensorImage(right[(torch.arange(scan.lines) - late).clamp(min=0)])
    found = find_corners(dataclasses.replace(scan, images=StereoPair(scan.left, shifted)), BOARD)
    assert found.valid.all()
    assert (found.points - corners.points).abs().max() < 0.02
    difference = row_difference(found)
    assert difference.lines == pytest.approx(late, abs=0.02)
    assert difference.is_systematic
    assert difference.sigma < 0.02


def test_one_corner_by_hand():
    # On the axis of the left camera at zero disparity: x = 0, z = z0; line 100 at half weight each.
    position = torch.tensor([[SMALL_RIG.principal_left_px, 100.0]], dtype=torch.float64)
    covariance = 0.0004 * torch.eye(2).double()[None]
    left = DetectedCorners(position, covariance, torch.ones(1, dtype=torch.bool))
    right = dataclasses.replace(left, position=position + torch.tensor([[0.0, 0.5]]).double())
    scan = Scan(Path("hand"), SMALL_RIG, Travel(PITCH), StereoPair(BLANK, BLANK))
    measured = _triangulated(scan, left, right, CornersConfig())
    points, covariance, valid = measured.points, measured.covariance, measured.valid
    z0 = zero_disparity_mm(SMALL_RIG)
    torch.testing.assert_close(
        points[0], torch.tensor([0.0, 100.25 * PITCH, z0], dtype=torch.float64), rtol=0, atol=1e-9
    )
    by_disparity = z0**2 / (focal_length_px(SMALL_RIG) * SMALL_RIG.baseline_mm)
    expected = torch.tensor([0.02 * object_pitch_mm(SMALL_RIG), 0.02 / 2**0.5 * PITCH, 0.02 * 2**0.5 * by_disparity])
    torch.testing.assert_close(covariance[0].diagonal().sqrt(), expected.double(), rtol=1e-6, atol=0)
    apart = dataclasses.replace(left, position=position + torch.tensor([[0.0, 1.5]]).double())
    assert valid.all()
    assert not _triangulated(scan, left, apart, CornersConfig()).valid.any()


@pytest.mark.parametrize("transport", ["forward", "reverse"])
def test_covariance_agrees_with_monte_carlo(transport):
    draws = 20_000
    factor_left = torch.tensor([[0.02, 0.0], [0.008, 0.015]]).double()
    factor_right = torch.tensor([[0.03, 0.0], [-0.01, 0.02]]).double()

    def detected(u: float, factor: torch.Tensor) -> DetectedCorners:
        position = torch.tensor([u, 200.0]).double() + torch.randn(draws, 2).double() @ factor.mT
        return DetectedCorners(position, (factor @ factor.mT).expand(draws, 2, 2), torch.ones(draws, dtype=torch.bool))

    scan = Scan(Path("drawn"), SMALL_RIG, Travel(PITCH, None, transport), StereoPair(BLANK, BLANK))
    left, right = detected(300.0, factor_left), detected(293.0, factor_right)
    measured = _triangulated(scan, left, right, CornersConfig())
    assert measured.valid.all()
    sampled, predicted = torch.cov(measured.points.T), measured.covariance.mean(0)
    sigma = predicted.diagonal().sqrt()
    torch.testing.assert_close(sampled / sigma / sigma[:, None], predicted / sigma / sigma[:, None], rtol=0, atol=0.05)


@pytest.mark.parametrize("case", ["forward", "reverse", "encoder"])
def test_rendered_boards_fit_their_truth(case):
    encoder = EncoderConfig(enabled=True, wobble_mm=1.0) if case == "encoder" else None
    source = simulation(transport="reverse" if case == "reverse" else "forward", encoder=encoder)
    corners = stereo_corners(source)
    assert corners.valid.all()
    left, right = source.corners()
    assert rms(corners.left_px - left).max() < 0.03
    assert rms(corners.right_px - right).max() < 0.03
    error = corners.points - true_measurement(source)
    assert (rms(error) < torch.tensor([0.04, 0.04, 0.12])).all()  # 2.5 mm of depth per pixel


def test_depth_maps_agree_with_two_images():
    source = simulation()
    stereo, mapped = stereo_corners(source), depth_corners(source)
    assert mapped.right_px is None
    assert mapped.valid.all()
    error = mapped.points - true_measurement(source)
    assert (rms(error) < torch.tensor([0.04, 0.04, 0.01])).all()
    assert (rms(mapped.points - stereo.points) < torch.tensor([0.04, 0.04, 0.12])).all()
    assert (torch.linalg.eigvalsh(mapped.covariance) > 0).all()


def test_covariance_of_an_exact_depth_map_covers_the_error_of_the_corner():
    source = simulation()
    corners = depth_corners(source)
    error = corners.points - true_measurement(source)
    ratio = rms(error) / corners.covariance.diagonal(dim1=-2, dim2=-1).mean(0).sqrt()
    assert (ratio < 2).all()
    assert (ratio > 0.5).all()
    # Three coordinates of two measured ones: the rest of the covariance is that of the map's numbers.
    squared = (error * torch.linalg.solve(corners.covariance, error[..., None])[..., 0]).sum(-1)
    assert 1.0 < squared.mean() < 6.0


def test_no_board_names_the_scan():
    source = simulation()
    scan = stereo_scan(source)
    blank = TensorImage(torch.full_like(scan.left.tensor, 90))
    with pytest.raises(BoardNotFoundError, match="rendered: no board of 12 x 9 squares in the left image"):
        find_corners(dataclasses.replace(scan, images=StereoPair(blank, scan.images.right)), BOARD)
    with pytest.raises(BoardNotFoundError, match="in the right image"):
        find_corners(dataclasses.replace(scan, images=StereoPair(scan.left, blank)), BOARD)
    with pytest.raises(BoardNotFoundError, match=r"88 of 88 corners .* 89 are needed"):
        find_corners(scan, BOARD, CornersConfig(min_corners=89))


def test_corners_without_depth_are_not_valid():
    scan = depth_scan(simulation())
    depth = scan.images.depth.tensor.clone()
    depth[: len(depth) // 2] = torch.nan
    corners = find_corners(dataclasses.replace(scan, images=DepthView(scan.left, TensorImage(depth))), BOARD)
    assert 20 <= int(corners.valid.sum()) < 88
    assert corners.points[~corners.valid].isnan().all()
    assert corners.covariance[~corners.valid].isnan().all()
    _, z = triangulate(SMALL_RIG, torch.zeros(1).double(), torch.zeros(1).double())
    assert (corners.points[corners.valid, 2] - z).abs().max() < 40
