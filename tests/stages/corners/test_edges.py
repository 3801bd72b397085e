"""Edges of a rendered board on every line."""

import dataclasses
from pathlib import Path

import pytest
import torch

from lsvision.geometry import project, scan_position, transform
from lsvision.stages.corners.edges import find_edges
from lsvision.stages.corners.find import measure_corners
from lsvision.types import RawCamera, RawRig
from tests.stages.other_renderer import raw_located, raw_scan, true_motion, true_pose
from tests.stages.rendered import BOARD, depth_corners, depth_scan, simulation, stereo_corners, stereo_scan


def test_edges_lie_on_their_board_within_their_sigma() -> None:
    source = simulation()
    scan = stereo_scan(source)
    corners = stereo_corners(source)
    edges = find_edges(scan, BOARD, corners)
    assert edges is not None
    assert len(edges.line) > 1000
    # Where each line's plane meets the edge on the object.
    ends = [
        scan_position(transform(source.pose.rotation, source.pose.translation, side), source.trajectory.n)
        for side in (edges.start, edges.stop)
    ]
    share = (edges.points[:, 1] - ends[0][:, 1]) / (ends[1][:, 1] - ends[0][:, 1])
    assert 0.1 < float(share.min()) < float(share.max()) < 0.9
    true = torch.lerp(*ends, share[:, None])
    seen, expected = (torch.stack(project(scan.rig, p[:, 0], p[:, 2]), -1) for p in (edges.points, true))
    error = seen - expected
    assert float(error.abs().median()) < 0.05
    assert abs(float((error[:, 0] - error[:, 1]).mean())) < 0.02
    # The derivative takes an error of mean column and disparity to one of x and z.
    pixels = torch.stack([error.mean(-1), error[:, 0] - error[:, 1]], -1)
    moved = (edges.by_column @ pixels[..., None])[..., 0]
    torch.testing.assert_close(moved, (edges.points - true)[:, ::2], atol=1e-3, rtol=0)


def test_a_depth_map_shows_no_edges() -> None:
    scan = depth_scan(simulation())
    assert find_edges(scan, BOARD, depth_corners(simulation())) is None


@pytest.mark.parametrize("name", ["raw_a", pytest.param("raw_e", marks=pytest.mark.slow)])
def test_edges_of_another_renderers_raw_images(shared_data: Path, name: str) -> None:
    """Cameras that are turned, distorted, and look at planes up to a millimetre apart."""
    scan = raw_scan(shared_data, name)
    n = true_motion(scan)
    corners = measure_corners(scan, BOARD, raw_located(shared_data, name), n=n)
    edges = find_edges(scan, BOARD, corners, n)
    assert edges is not None
    assert len(edges.line) > 2000
    assert float(edges.later_mm.abs().max()) > 0.3
    rotation, translation = true_pose(scan)
    start, stop = (scan_position(transform(rotation, translation, side), n) for side in (edges.start, edges.stop))
    share = (edges.points[:, 1] - start[:, 1]) / (stop[:, 1] - start[:, 1])
    off = edges.points - torch.lerp(start, stop, share[:, None])
    assert 0.1 < float(share.min()) < float(share.max()) < 0.9
    pixels = torch.linalg.solve(edges.by_column, off[:, ::2, None])[..., 0]  # mean column, disparity
    assert float(pixels.abs().median()) < 0.05
    assert float(pixels.mean(0).abs().max()) < 0.02


def test_edges_of_raw_cameras_without_turn_and_distortion_are_those_of_the_pair() -> None:
    scan = stereo_scan(simulation())
    rig = scan.rig
    raw = RawRig(
        rig.width_px, rig.pixel_pitch_um, rig.baseline_mm,
        RawCamera(rig.focal_length_mm, rig.principal_left_px, 0.0, (0.0, 1e-12)),
        RawCamera(rig.focal_length_mm, rig.principal_right_px),
    )  # fmt: skip
    corners = stereo_corners(simulation())
    one = find_edges(scan, BOARD, corners)
    other = find_edges(dataclasses.replace(scan, raw_rig=raw), BOARD, corners)
    assert one is not None
    assert other is not None
    assert other.later_mm is None
    assert torch.equal(one.line, other.line)
    torch.testing.assert_close(one.points, other.points, rtol=0, atol=1e-6)
    torch.testing.assert_close(one.by_column, other.by_column, rtol=1e-4, atol=1e-6)
