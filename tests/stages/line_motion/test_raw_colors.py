"""The lines of the colours of raw cameras: where their images are read, and motion told from shape by them."""

import dataclasses
import math

import pytest
import torch

from lsvision.geometry import (
    ProductFrame,
    Rectification,
    disparity_at,
    object_pitch_mm,
    scaled_raw_rig,
    slope_at,
    zero_disparity_mm,
)
from lsvision.stages.disparity.config import DisparityConfig
from lsvision.stages.disparity.depth import relation_of_scan
from lsvision.stages.line_motion.color_pair import ObjectPlace, at_rows, color_pair
from lsvision.stages.line_motion.color_registration import register_color
from lsvision.stages.line_motion.ideal_images import ideal_images
from lsvision.stages.line_motion.measure import measure_line_motion, measure_travel
from lsvision.stages.line_motion.profiles import LineSamples, columns_of, reference_profile
from lsvision.stages.line_motion.register import placed
from lsvision.types import Motion, RawRig
from tests.raw_cameras import RAW
from tests.stages.line_motion.test_colors import (
    CONFIG,
    FIRST,
    WIDTH,
    amplitudes,
    depth_of,
    rail,
    true_corrugation,
    true_depth,
)


def raw_rig(spacing: float = 4.0) -> RawRig:
    """A part of a quarter of the raw cameras, the same as of the rectified ones."""
    whole = scaled_raw_rig(RAW, 4)
    left, right = (
        dataclasses.replace(camera, principal_px=camera.principal_px - FIRST) for camera in (whole.left, whole.right)
    )
    spacings = (-spacing, 0.0, spacing)
    return dataclasses.replace(whole, width_px=WIDTH, left=left, right=right, color_spacing_lines=spacings)


def test_images_are_read_where_and_when_the_raw_cameras_see_a_point() -> None:
    source, scan = rail(16, 0.0, 0.0, cameras=raw_rig())
    rectification = Rectification.of(scan.raw_rig, source.trajectory.n)
    assert rectification is not None
    column = torch.linspace(100.0, 500.0, 401, dtype=torch.float64)
    z = zero_disparity_mm(scan.rig) + 0.03 * (column - 300.0)
    images = ideal_images(scan, rectification, column, z)
    points = torch.stack([slope_at(scan.rig, column) * z, torch.zeros_like(z), z], -1)
    seen = rectification.raw.seen_right(points, rectification.n)
    partner = (column - disparity_at(scan.rig, z))[2:-2]
    base, part = partner.floor().long(), partner - partner.floor()

    def read(values: torch.Tensor) -> torch.Tensor:
        return torch.lerp(values[base], values[base + 1], part)

    assert (read(images.right.columns) - seen.column[2:-2]).abs().max() < 1e-3
    assert (read(images.right.rows.late_mm) - seen.travel[2:-2]).abs().max() < 1e-6
    assert (read(images.right.rows.late_mm)).abs().max() > 0.3
    at = images.left.columns[column.long()]
    assert (at - rectification.raw.seen_left(points, rectification.n).column).abs().max() < 1e-9


@pytest.mark.parametrize("registered", [True, False])
def test_colors_of_raw_cameras_show_what_moves_between_their_moments(registered: bool) -> None:
    lines = 200
    source, scan = rail(lines, 0.8, 0.4, registered=registered, cameras=raw_rig())
    n = source.trajectory.n
    frame, every = ProductFrame(scan.rig, scan.travel, n), slice(None)
    samples = LineSamples.of(depth_of(scan, n).read(0, lines), frame, (-60.0, 60.0), every)
    middle = samples.z[samples.z < zero_disparity_mm(scan.rig)].mean()
    beside = (samples.z.nanmedian(0).values - middle).nan_to_num().double()
    place = ObjectPlace(middle.expand(lines), beside, torch.zeros(lines).double())
    pair = color_pair(scan, frame, relation_of_scan(scan, DisparityConfig()), place)
    assert pair is not None
    start = torch.zeros(lines, 3).double()
    start[:, 1] = source.trajectory.vibration(torch.arange(lines).double())[:, 1] - true_corrugation(source)
    q_x, height = placed(samples, start, frame)
    reference = reference_profile(q_x, height, object_pitch_mm(scan.rig), 40.0)
    shown = samples.on(columns_of(reference, q_x, 10_000))
    seen = [
        register_color(pair, channel, 0, dataclasses.replace(shown, plane_slope=slope), start, (reference, 4.0)).values
        for channel, slope in zip(pair.channels, pair.plane_slopes, strict=True)
    ]
    assert (seen[0] - start)[12:-12, 1].mean().abs() < 0.03  # where green saw it
    one, other = (at_rows(values, row) for values, row in zip(seen, pair.rows(), strict=True))
    later, earlier = pair.taken()
    true = (source.trajectory.vibration(later) - source.trajectory.vibration(earlier))[:, 1]
    error = ((one - other)[:, 1] - true)[12:-12]
    assert true.abs().max() > 0.1
    assert error.std() < 0.04  # single lines, as of rectified cameras
    assert error.mean().abs() < 0.006


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_corrugation_stays_in_the_height_under_vibration(seed: int) -> None:
    source, scan = rail(2800, 0.1, 0.05, seed, cameras=raw_rig())
    n = source.trajectory.n
    measured = measure_line_motion(scan, depth_of(scan, n), Motion(n, torch.zeros(3, 3).double()), CONFIG)
    found = measured.motion
    error = found.dz_mm - true_depth(source)
    vibration, wave = amplitudes(source, found.dz_mm)
    assert vibration == pytest.approx(0.1, abs=0.01)
    assert wave < 0.01
    kept = amplitudes(source, true_corrugation(source) + error)[1]
    assert kept == pytest.approx(0.05, abs=0.01)
    assert (error / found.sigma[:, 1]).square().mean() < 3.0
    finding = found.findings[1]
    assert finding.shape_rms == pytest.approx(0.05 / math.sqrt(2), abs=0.006)
    assert "are the object's shape" in finding.in_words
    assert measured.travel is not None
    assert measured.travel.is_measured
    assert measured.travel.whole.rate == pytest.approx(1.0, abs=3e-4)
    assert abs(measured.travel.whole.rate - 1.0) < 4 * measured.travel.whole.sigma


def test_cameras_whose_colors_look_at_one_line_show_no_travel() -> None:
    source, scan = rail(16, 0.0, 0.0, cameras=raw_rig(0.0))
    n = source.trajectory.n
    assert measure_travel(scan, depth_of(scan, n), Motion(n, torch.zeros(3, 3).double()), CONFIG) is None
