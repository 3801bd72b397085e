"""Rotations in a Gaussian state: a rotation vector about a stored nominal rotation, re-centred when it has grown.

Source: Solà 2017, Quaternion kinematics for the error-state Kalman filter, sec. 6.3 (reset).
"""

from jaxtyping import Float
from torch import Tensor

from lsvision.estimation.triangular import lower_factor
from lsvision.geometry import left_jacobian, rotation_from_vector


def recentre(
    nominal: Float[Tensor, "*batch 3 3"],
    mean: Float[Tensor, "*batch state"],
    chol: Float[Tensor, "*batch state state"],
    first: int,
) -> tuple[Float[Tensor, "*batch 3 3"], Float[Tensor, "*batch state"], Float[Tensor, "*batch state state"]]:
    """The same Gaussian about the rotation exp(theta) nominal, theta the mean of ``state[first : first + 3]``.

    Returns:
        The new nominal rotation, the mean with theta zero, and the Cholesky factor with theta's rows turned by the
        reset Jacobian: exp(theta + d) = exp(J d) exp(theta).
    """
    own = slice(first, first + 3)
    theta = mean[..., own]
    rotation = rotation_from_vector(theta) @ nominal
    centred, factor = mean.clone(), chol.clone()
    centred[..., own] = 0.0
    factor[..., own, :] = left_jacobian(theta) @ chol[..., own, :]
    return rotation, centred, lower_factor(factor)
