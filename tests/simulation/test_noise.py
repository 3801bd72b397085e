"""Hashed value noise: independent of the piece evaluated, of known moments, smooth between nodes."""

import torch

from lsvision.simulation.noise import Nodes, Octave, Raster, covering, lattice_hash, octaves, value_noise


def test_hash_by_hand():
    h = (3 * 0x27D4EB2D + 5 * 0x165667B1 + 8 * 0x9E3779B1) & 0xFFFFFFFF
    h = ((h ^ (h >> 15)) * 0x85EBCA6B) & 0xFFFFFFFF
    h = ((h ^ (h >> 13)) * 0xC2B2AE35) & 0xFFFFFFFF
    expected = (h ^ (h >> 16)) / 2**31 - 1
    torch.testing.assert_close(float(lattice_hash(torch.tensor(3), 5, 7)), expected, rtol=0, atol=1e-7)


def test_hash_is_uniform_and_uncorrelated():
    x, y = torch.arange(-300, 300)[None], torch.arange(-300, 300)[:, None]
    h = lattice_hash(x, y, 0)
    assert abs(h.mean()) < 0.005
    assert abs(h.var() - 1 / 3) < 0.005
    for other in (h.roll(1, 0), h.roll(1, 1), lattice_hash(x, y, 1)):
        assert abs(torch.corrcoef(torch.stack([h.flatten(), other.flatten()]))[0, 1]) < 0.01


def test_pieces_equal_the_whole_at_negative_and_distant_nodes():
    for first_y in (-7, 3_000_000):
        whole = value_noise(Nodes(-20, first_y, 60, 50, 0.4), octaves(5), 3)
        piece = value_noise(Nodes(-5, first_y + 11, 20, 13, 0.4), octaves(5), 3)
        assert torch.equal(whole[11:24, 15:35], piece)


def test_octave_passes_through_its_lattice_and_is_smooth():
    values = value_noise(Nodes(0, 0, 33, 33, 1.0), (Octave(8, 4),), 0)
    lattice = lattice_hash(torch.arange(5)[None], torch.arange(9)[:, None], 0) * 3**0.5
    torch.testing.assert_close(values[::4, ::8], lattice)
    assert values.diff(dim=1).abs().max() < 1.5 / 8 * 2 * 3**0.5  # steepest step of a smooth blend over 8 nodes


def test_variance_is_near_one():
    assert 0.4 < value_noise(Nodes(0, 0, 400, 400, 1.0), octaves(4), 0).var() < 1.1


def test_raster_is_bilinear_and_counts_from_its_base():
    nodes = Nodes(-2, 1_000_000, 5, 4, 0.5)
    x, y = nodes.grid()
    raster = Raster((2.0 * x + 3.0 * (y - 500_000.0)).float()[None], nodes)
    at_x, at_y = torch.tensor([[-0.9, 0.13]]), torch.tensor([[0.2, 1.4]])
    torch.testing.assert_close(raster.at(at_x, at_y, 1_000_000)[0], 2 * at_x + 3 * at_y, rtol=0, atol=1e-5)


def test_covering_nodes_reach_around_the_points():
    x, y = torch.tensor([-1.05, 3.2]), torch.tensor([0.3, 0.9])
    nodes = covering(x, y, 0.5, base_y=100)
    grid_x, grid_y = nodes.grid()
    assert grid_x.min() < -1.05
    assert grid_x.max() > 3.2
    assert grid_y.min() < 50.3
    assert grid_y.max() > 50.9
