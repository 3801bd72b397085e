"""Which combinations of a rig's quantities the scans show, and which matter for heights."""

from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor

from lsvision.estimation import principal_directions
from lsvision.stages.rig.height_shape import HeightShape
from lsvision.types import RIG_QUANTITIES, RigCombination

NAMES = (*RIG_QUANTITIES, "n1", "n2", "n3")
_MENTIONED = 0.25  # of a direction's length: a component that is named


def unobserved(
    covariance: Float[Tensor, "shared shared"], shape: HeightShape, observed_share: float
) -> tuple[RigCombination, ...]:
    """The combinations whose sigma is more than a share of the prior's, the least known first.

    Args:
        covariance: in units of the prior's sigmas.
    """
    found = principal_directions(covariance, 1.0)
    return tuple(
        RigCombination(_parts(vector.tolist()), float(share), 1e3 * float(shape.bend_mm(share * vector)))
        for vector, share in zip(found.vectors, found.share, strict=True)
        if float(share) > observed_share
    )


def _parts(vector: Sequence[float]) -> tuple[tuple[str, float], ...]:
    named = [(name, weight) for name, weight in zip(NAMES, vector, strict=True) if abs(weight) >= _MENTIONED]
    return tuple(sorted(named, key=lambda part: -abs(part[1])))
