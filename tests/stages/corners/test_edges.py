"""Edges of a rendered board on every line."""

import torch

from lsvision.geometry import project, scan_position, transform
from lsvision.stages.corners.edges import find_edges
from lsvision.stages.corners.find import find_corners
from tests.stages.rendered import BOARD, depth_scan, simulation, stereo_scan


def test_edges_lie_on_their_board_within_their_sigma() -> None:
    source = simulation()
    scan = stereo_scan(source)
    corners = find_corners(scan, BOARD)
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
    assert find_edges(scan, BOARD, find_corners(scan, BOARD)) is None
