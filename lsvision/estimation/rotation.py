"""Library API: rotations in a Gaussian state, a rotation vector about a stored nominal that is re-centred as it grows.

Source: Solà 2017, Quaternion kinematics for the error-state Kalman filter, sec. 6.3 (reset).
"""

from jaxtyping import Float
from torch import Tensor

from lsvision.estimation.gaussian import Gaussian
from lsvision.estimation.linalg import lower_factor
from lsvision.geometry import left_jacobian, rotation_from_vector


def recentre(
    nominal: Float[Tensor, "*batch 3 3"], state: Gaussian, first: int
) -> tuple[Float[Tensor, "*batch 3 3"], Gaussian]:
    """The same Gaussian about the rotation exp(theta) nominal, theta the mean of components ``first : first + 3``.

    Returns:
        The new nominal rotation, and the state with theta zero and theta's rows of the Cholesky factor turned by the
        reset Jacobian: exp(theta + d) = exp(J d) exp(theta).
    """
    own = slice(first, first + 3)
    theta = state.mean[..., own]
    mean, factor = state.mean.clone(), state.factor.clone()
    mean[..., own] = 0.0
    factor[..., own, :] = left_jacobian(theta) @ state.factor[..., own, :]
    return rotation_from_vector(theta) @ nominal, Gaussian(mean, lower_factor(factor))
