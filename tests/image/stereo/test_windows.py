"""Window statistics against loops over the pixels of each window."""

import pytest
import torch

from lsvision.image.stereo.windows import Windows


@pytest.mark.parametrize("block", [1, 2])
def test_mean_and_covariance_equal_a_loop(block):
    valid = torch.rand(7, 9) < 0.8
    a, b = torch.randn(7 * block, 9 * block), torch.randn(7 * block, 9 * block)
    windows = Windows.over(valid, 5)
    mean_a, mean_b = windows.mean(a), windows.mean(b)
    covariance = windows.covariance(a, b, mean_a, mean_b)
    pixel_valid = valid.repeat_interleave(block, 0).repeat_interleave(block, 1)
    for i in range(7):
        for j in range(9):
            rows, columns = (slice(block * max(k - 2, 0), block * (k + 3)) for k in (i, j))
            inside = pixel_valid[rows, columns]
            in_a, in_b = a[rows, columns][inside], b[rows, columns][inside]
            torch.testing.assert_close(mean_a[i, j], in_a.mean(), rtol=0, atol=1e-5)
            expected = (in_a * in_b).mean() - in_a.mean() * in_b.mean()
            torch.testing.assert_close(covariance[i, j], expected, rtol=0, atol=1e-5)
            assert int(windows.count[i, j]) * block**2 == int(inside.sum())


def test_an_empty_window_has_a_mean():
    windows = Windows.over(torch.zeros(3, 3, dtype=torch.bool), 3)
    assert windows.mean(torch.ones(3, 3)).tolist() == [[0.0] * 3] * 3
