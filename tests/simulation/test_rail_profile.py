"""The head of the rail 60E1 and the point that a ray meets first."""

import math

import numpy as np
import pytest
import torch

from lsvision.simulation.rail_profile import first_hit, head_60e1, slopes_from


def test_standard_dimensions():
    chain = head_60e1()
    half = chain.x[chain.crown :]
    z = chain.z[chain.crown :]
    at = torch.tensor(np.interp([14.3], z.numpy(), half.numpy()))
    torch.testing.assert_close(2 * at, torch.tensor([72.0]).double(), rtol=0, atol=0.005)
    side = (z > 15) & (z < 35)
    torch.testing.assert_close(half[side].diff() / z[side].diff(), torch.full((int(side.sum()) - 1,), 1 / 20).double())


def test_steps_are_equal_tangents_continuous_and_sides_mirrored():
    chain = head_60e1()
    step = torch.hypot(chain.x.diff(), chain.z.diff())
    torch.testing.assert_close(step, torch.full_like(step, chain.step_mm), rtol=0, atol=1e-4)
    bend_mid_step = chain.step_mm / 3.0 / 8.0  # a step that runs half on the side and half on the arc of 3 mm
    middle = (chain.angle[1:] + chain.angle[:-1]) / 2
    torch.testing.assert_close(torch.atan2(chain.z.diff(), chain.x.diff()), middle, rtol=0, atol=bend_mid_step)
    torch.testing.assert_close(chain.x, -chain.x.flip(0))
    torch.testing.assert_close(chain.z, chain.z.flip(0))


def test_agrees_with_a_published_outline(shared_data):
    """The Manchester benchmark's UIC60 head, which is stored canted by 1:40."""
    text = (shared_data / "rail_profile" / "MBench_UIC60_v3.prr").read_text()
    rows = (line.split("!")[0].split() for line in text.splitlines())
    points = torch.tensor([[float(a) for a in row] for row in rows if len(row) == 2 and row[0][0] in "+-0123456789"])
    points = points.double()[points[:, 1] < 33.0]
    cos, sin = math.cos(math.atan(1 / 40)), math.sin(math.atan(1 / 40))
    x, z = cos * points[:, 0] - sin * points[:, 1], cos * points[:, 1] + sin * points[:, 0]
    outline = torch.stack([x - (x.min() + x.max()) / 2, z - z.min()], dim=-1)
    chain = head_60e1()
    distance = torch.cdist(outline, torch.stack([chain.x, chain.z], -1)).amin(-1)
    assert distance.max() < 0.3


@pytest.mark.parametrize("eye_x", [-177.0, 0.0, 177.0])
def test_first_hit_equals_a_dense_march_along_each_ray(eye_x):
    chain = head_60e1()
    eye = torch.tensor([[eye_x, -770.0]], dtype=torch.float64)
    ray = torch.linspace(-0.055, 0.055, 301, dtype=torch.float64)[None] - eye_x / 780.0
    slopes, horizon = slopes_from(chain, eye[:, 0], eye[:, 1])
    hit = first_hit(chain, slopes, horizon, eye[:, 1], ray.float())
    depth = torch.arange(-1.0, 36.0, 0.005, dtype=torch.float64)
    x = eye_x + ray[0][:, None] * (depth + 770.0)
    half = torch.tensor(np.interp(depth.numpy(), chain.z[chain.crown :].numpy(), chain.x[chain.crown :].numpy()))
    inside = (x.abs() <= half) & (depth >= 0)
    marched = depth[inside.int().argmax(-1)]
    sure = inside.any(-1)
    torch.testing.assert_close(hit.z[0, sure], marched[sure].float(), rtol=0, atol=0.006)
    assert hit.valid[0, sure].all()
    assert (~sure).sum() > 20
    missed_well = ~(x.abs() <= half + 0.3).any(-1)
    assert not hit.valid[0, missed_well].any()
    on_ray = eye_x + ray[0].float() * (hit.z[0] + 770.0)
    torch.testing.assert_close(hit.x[0, sure], on_ray[sure], rtol=0, atol=1e-3)


def test_batch_of_eyes_equals_a_loop():
    chain = head_60e1()
    eyes = torch.tensor([[-177.0, -770.0], [-176.2, -771.0], [30.0, -769.0]], dtype=torch.float64)
    ray = torch.linspace(-0.1, 0.3, 50).expand(3, -1)
    both = first_hit(chain, *slopes_from(chain, *eyes.T), eyes[:, 1], ray)
    for i in range(3):
        eye = eyes[i : i + 1]
        one = first_hit(chain, *slopes_from(chain, *eye.T), eye[:, 1], ray[i : i + 1])
        assert torch.equal(one.valid[0], both.valid[i])
        torch.testing.assert_close(one.z[0], both.z[i])
