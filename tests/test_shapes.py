"""The checks of shapes notice what is wrong, whatever was called before."""

import beartype
import jaxtyping
import pytest
import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.geometry import displace
from tests.shapes import _once_for_every_shape


def test_wrong_shapes_and_types_are_noticed_however_often_right_ones_came() -> None:
    points, n = torch.rand(4, 3), torch.rand(3)
    for _ in range(3):
        assert displace(points, n).shape == (4, 3)
        for wrong in ((points, torch.rand(2)), (points.int(), n), (points, n.tolist())):
            with pytest.raises(jaxtyping.TypeCheckError):
                displace(*wrong)


def test_a_function_within_another_is_checked_however_often_it_is_defined() -> None:
    def defined():
        def same(points: Float[Tensor, "points 3"]) -> Tensor:
            return points

        return _once_for_every_shape(same, beartype.beartype)

    for count in (4, 4, 5):
        assert defined()(torch.rand(count, 3)).shape == (count, 3)
        with pytest.raises(jaxtyping.TypeCheckError):
            defined()(torch.rand(count, 2))
