"""How far the quantities of a raw rig may be off, as independent errors of one sigma each."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.types import RIG_QUANTITIES, RawRig

_ROUNDING = 1e-12  # of the largest variance: what is less is no direction of its own


def rig_covariance(rig: RawRig) -> Float[Tensor, "quantities quantities"]:
    """Covariance of ``RIG_QUANTITIES``, float64, in the units of the rig's file: as calibrated, else by its sigmas."""
    if rig.covariance is not None:
        return torch.tensor(rig.covariance, dtype=torch.float64)
    stated = dict(rig.sigma)
    return torch.tensor([stated.get(name, 0.0) for name in RIG_QUANTITIES], dtype=torch.float64).square().diag()


def rig_modes(rig: RawRig) -> Float[Tensor, "quantities modes"] | None:
    """Independent errors of the quantities, of one sigma each: the columns; None where the rig counts as exact.

    Their sum of squares is the covariance. They are the principal directions of its correlations.
    """
    covariance = rig_covariance(rig)
    sigma = covariance.diagonal().clamp(min=0).sqrt()
    if not bool(sigma.any()):
        return None
    unit = torch.where(sigma > 0, sigma, 1.0)
    values, vectors = torch.linalg.eigh(covariance / torch.outer(unit, unit))
    kept = values > _ROUNDING * values.max()
    return sigma[:, None] * (vectors * values.clamp(min=0).sqrt())[:, kept]


def with_covariance(rig: RawRig, covariance: Float[Tensor, "quantities quantities"]) -> RawRig:
    """The rig with what is known of it, its sigmas being those of the covariance."""
    sigma = covariance.diagonal().sqrt().tolist()
    return replace(
        rig,
        sigma=tuple(zip(RIG_QUANTITIES, sigma, strict=True)),
        covariance=tuple(tuple(row) for row in covariance.tolist()),
    )


def in_larger_pixels(rig: RawRig, scale: float | int) -> RawRig:
    """The same knowledge of a rig whose columns have become ``scale`` times as wide."""
    ratio = torch.tensor([1.0 / scale if "principal_point_px" in name else 1.0 for name in RIG_QUANTITIES]).double()
    by_name = dict(zip(RIG_QUANTITIES, ratio.tolist(), strict=True))
    covariance = None
    if rig.covariance is not None:
        scaled = rig_covariance(rig) * torch.outer(ratio, ratio)
        covariance = tuple(tuple(row) for row in scaled.tolist())
    sigma = tuple((name, value * by_name[name]) for name, value in rig.sigma)
    return replace(rig, sigma=sigma, covariance=covariance)
