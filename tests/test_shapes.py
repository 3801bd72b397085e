"""The checks of shapes notice what is wrong, whatever was called before."""

import jaxtyping
import pytest
import torch

from lsvision.geometry import displace


def test_wrong_shapes_and_types_are_noticed_however_often_right_ones_came() -> None:
    points, n = torch.rand(4, 3), torch.rand(3)
    for _ in range(3):
        assert displace(points, n).shape == (4, 3)
        for wrong in ((points, torch.rand(2)), (points.int(), n), (points, n.tolist())):
            with pytest.raises(jaxtyping.TypeCheckError):
                displace(*wrong)
