"""Gaussian processes along a line, by their values at evenly spaced knots: kernels, roots, interpolation between knots.

A process f ~ GP(0, k) is written f(u) = w(u)ᵀ F ξ, ξ ~ N(0, I), where F Fᵀ is the covariance at the knots and w(u) are
the weights of cubic interpolation. All that depends on the kernel is F, and F does not depend on where f is observed:
one table of roots serves any number of problems.

Source: Rasmussen & Williams 2006, sec. 4.2 (kernels); Wilson & Nickisch 2015 (interpolated inducing points); Keys 1981
(cubic convolution, a = -1/2).
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor


def exponential(distance: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Kernel of a rough process of variance one, at distances in units of its length."""
    return torch.exp(-distance.abs())


def matern32(distance: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Matérn kernel of smoothness 3/2 and variance one, at distances in units of its length."""
    scaled = math.sqrt(3.0) * distance.abs()
    return (1.0 + scaled) * torch.exp(-scaled)


def narrow_band(distance: Float[Tensor, "*batch"], wavelength: float, coherence: float) -> Float[Tensor, "*batch"]:
    """Kernel of variance one of a wave of random phase and amplitude, both of which wander over a coherence length."""
    return torch.cos(2.0 * math.pi / wavelength * distance) * matern32(distance / coherence)


def covariance_root(covariance: Float[Tensor, "*batch knots knots"]) -> Float[Tensor, "*batch knots knots"]:
    """F with F Fᵀ = covariance, which may be singular; its columns are orthogonal, the longest last."""
    values, vectors = torch.linalg.eigh(covariance)
    return vectors * values.clamp(min=0.0).sqrt()[..., None, :]


def cubic_weights(position: Float[Tensor, "*batch"], knots: int) -> Float[Tensor, "*batch knots"]:
    """Weights of the knots 0, 1, .. at positions between knot 1 and knot ``knots`` - 2; exact for quadratics."""
    d = (position[..., None] - torch.arange(knots, dtype=position.dtype, device=position.device)).abs()
    near = (1.5 * d - 2.5) * d.square() + 1.0
    far = ((-0.5 * d + 2.5) * d - 4.0) * d + 2.0
    return torch.where(d < 1.0, near, torch.where(d < 2.0, far, 0.0))
