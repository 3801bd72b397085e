"""Covariance of fitted corners where the noise of neighbouring pixels, or of the two images of a pair, is correlated.

Printed texture is the same in both images and wider than a pixel, and a blurred or resampled image has no independent
pixels at all. A camera that shakes moves every line of its image by itself. The noise of a board is taken as a sum of a
few kinds: white, with Gaussian correlations of one to a few pixels, shifts of lines, sideways and along the scan, and
white on the edges of the squares alone. What each of them would leave of its windows is known, so that the strengths
follow from what the fits have left, as variance components do.

Source: Rao 1971, Estimation of variance and covariance components - MINQUE theory.
"""

import itertools
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.image.board.noise_kinds import SHIFTS, Correlation
from lsvision.image.board.residuals import Residuals

_BEYOND_CHANCE = 4.0  # standard deviations
_SMOOTH = 0.5  # correlation of neighbouring lines from which a motion shifts them that is no noise
_LEAST_SHARE = 0.2  # of the corners' variance: what the other kinds leave unexplained is like small shifts of lines
_LARGEST_CORRELATION = 0.999
_TRACED = 12  # windows of a board from which the expectation is taken: they are much alike


@dataclass(frozen=True)
class BoardNoise:
    """What the fits of a board have left of its windows, and the variance of each kind of noise in it.

    Of the variance of the noise on edges, the share ``surviving`` is left after the mean along an edge. ``aliased``,
    px², is the covariance of moves that depend on where a corner lies between the pixels (``edge_profile``).
    """

    residuals: Residuals
    strength: Float[Tensor, " kinds"]
    surviving: float = 1.0
    aliased: Float[Tensor, "2 2"] | float = 0.0

    @classmethod
    def of(cls, residuals: Residuals, valid: Bool[Tensor, " fits"]) -> "BoardNoise":
        """Noise of the valid fits."""
        seen = residuals.of(valid)
        return cls(residuals, noise_strength(seen, seen))

    def covariance(self, fits: Bool[Tensor, " fits"]) -> Float[Tensor, "some 2 2"]:
        """Covariance of the errors of some corners, px²."""
        residuals = self.residuals.of(fits)
        strength = self.strength.clone()
        strength[-1] *= self.surviving
        return corner_covariance(residuals, residuals, strength) + self.aliased

    def covariance_with(self, other: "BoardNoise", fits: Bool[Tensor, " fits"]) -> Float[Tensor, "some 2 2"]:
        """Covariance, px², of the errors of some corners with those of the same corners in another image.

        What two images share is at most what either has: estimates of all three may contradict. How undersampled edges
        fall between the pixels is another matter in each image: none of that is shared.
        """
        first, second = _of_one_size(self.residuals.of(fits), other.residuals.of(fits))
        shared = torch.minimum(noise_strength(first, second), (self.strength * other.strength).sqrt())
        shared[-1] = 0
        return corner_covariance(first, second, shared)


def noise_strength(first: Residuals, second: Residuals) -> Float[Tensor, " kinds"]:
    """Variance of each kind of noise, of one image or of what two images share, from what the fits have left.

    Args:
        first, second: fits of the same corners in windows of one size; both the same for the noise within an image.
    """
    # Sums over thousands of pixels: seven digits are plenty, and half the time.
    correlation = Correlation.between(first, second, torch.float32)
    left, right = first.residual.float(), second.residual.float()
    found = (correlation.times(right[:, None])[:, :, 0] * left).sum(-1).to(first.residual)
    every = slice(None, None, max(1, len(left) // _TRACED))
    some = first.of(every)
    others = some if first is second else second.of(every)
    expected = expected_products(some, others, correlation.of(every)).to(first.residual)
    expected *= len(left) / len(left[every])
    used = _beyond_chance(expected, found)
    used[SHIFTS] &= _likeness_of_neighbours(first) < _SMOOTH
    strength = _strength_of(used, expected, found)
    if bool(used[SHIFTS].any()) and _share_of_shifts(some, strength) < _LEAST_SHARE:
        used[SHIFTS] = False
        return _strength_of(used, expected, found)
    return strength


def _strength_of(used: Bool[Tensor, " kinds"], expected: Tensor, found: Tensor) -> Float[Tensor, " kinds"]:
    strength = torch.zeros(len(used), dtype=expected.dtype)
    strength[used] = nonnegative_solution(expected[used][:, used], found.sum(1)[used])
    return strength


def _beyond_chance(
    expected: Float[Tensor, "kinds kinds"], found: Float[Tensor, "kinds fits"]
) -> Bool[Tensor, " kinds"]:
    """All kinds, but shifts of lines only where the fits agree that there are such."""
    inverse = torch.linalg.pinv(expected, hermitian=True)
    chance = (inverse @ (found.shape[1] * torch.cov(found)) @ inverse).diagonal().clamp(min=0).sqrt()
    used = inverse @ found.sum(1) > _BEYOND_CHANCE * chance
    used[: SHIFTS.start] = used[SHIFTS.stop :] = True
    return used


def _likeness_of_neighbours(fits: Residuals) -> Float[Tensor, "2"]:
    """Correlation of what neighbouring lines are shifted by, sideways and along the scan."""
    by_pixel = fits.jacobian[:, :2] * fits.residual[:, None]
    shift = by_pixel.unflatten(-1, (fits.size, fits.size)).sum(-1)
    before, after = shift[..., :-1], shift[..., 1:]
    both = (before.square().sum((0, 2)) * after.square().sum((0, 2))).sqrt()
    return (before * after).sum((0, 2)) / both.clamp(min=torch.finfo(both.dtype).tiny)


def _share_of_shifts(fits: Residuals, strength: Float[Tensor, " kinds"]) -> float:
    """Of the variance of the corners."""
    without = strength.clone()
    without[SHIFTS] = 0
    whole, rest = (corner_covariance(fits, fits, each).diagonal(dim1=-2, dim2=-1).sum() for each in (strength, without))
    return float(1 - rest / whole)


def corner_covariance(
    first: Residuals, second: Residuals, strength: Float[Tensor, " kinds"]
) -> Float[Tensor, "fits 2 2"]:
    """Covariance of the errors of corners in one image with those of the same corners in another, px².

    Args:
        first, second: fits of the same corners in windows of one size; the same for the covariance within an image.
        strength: variance of each kind of noise.
    """
    moved = Correlation.between(first, second, torch.float32).times(second.influence.float())
    moved = torch.tensordot(strength.float(), moved, dims=1).to(first.residual)
    return first.influence @ moved.mT


def _of_one_size(first: Residuals, second: Residuals) -> tuple[Residuals, Residuals]:
    if first.size == second.size:
        return first, second
    size = min(first.size, second.size)
    return first.cropped(size), second.cropped(size)


def possible_covariance(
    mixed: Float[Tensor, "fits 2 2"], first: Float[Tensor, "fits 2 2"], second: Float[Tensor, "fits 2 2"]
) -> Float[Tensor, "fits 2 2"]:
    """A covariance between two positions, reduced to what theirs allow: estimates of all three may contradict."""
    first_root, second_root = torch.linalg.cholesky(first), torch.linalg.cholesky(second)
    whitened = torch.linalg.solve_triangular(first_root, mixed, upper=False)
    whitened = torch.linalg.solve_triangular(second_root, whitened.mT, upper=False).mT
    left, correlation, right = torch.linalg.svd(whitened)
    return first_root @ (left * correlation.clamp(max=_LARGEST_CORRELATION)[:, None]) @ right @ second_root.mT


def expected_products(first: Residuals, second: Residuals, correlation: Correlation) -> Float[Tensor, "kinds kinds"]:
    """Expectation of ``residual Kj residual``, summed over windows, under noise of unit strength and covariance Kk.

    A fit leaves ``M = W - Q Qᵀ`` of the noise, Q an orthonormal basis of its Jacobian: this is the trace of
    ``M₁ Kk M₂ Kjᵀ``.
    """
    dtype = correlation.along_u.dtype
    basis, other = first.basis().to(dtype), second.basis().to(dtype)
    weight, other_weight = first.weight[:, None].to(dtype), second.weight[:, None].to(dtype)
    by_second = correlation.times(other)
    by_first = correlation.transposed().times(basis) if first is not second else by_second
    crossed = (basis @ by_second.mT).flatten(1)
    squared = torch.stack([(weight * product.times(other_weight)).sum((1, 2, 3)) for product in correlation.products()])
    taken = (by_second * weight).flatten(1) @ by_second.flatten(1).mT
    taken += (by_first * other_weight).flatten(1) @ by_first.flatten(1).mT
    return squared - taken + crossed @ crossed.mT


def nonnegative_solution(matrix: Float[Tensor, "n n"], right: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """Nearest to the solution of ``matrix x = right``, symmetric, with ``x >= 0``: all subsets are tried."""
    scale = matrix.diagonal().clamp(min=torch.finfo(matrix.dtype).tiny).rsqrt()
    matrix, right = matrix * scale * scale[:, None], right * scale
    best, least = torch.zeros_like(right), 0.0
    for used in itertools.chain.from_iterable(
        itertools.combinations(range(len(right)), count) for count in range(1, len(right) + 1)
    ):
        chosen = list(used)
        part = torch.linalg.lstsq(matrix[chosen][:, chosen], right[chosen, None]).solution[:, 0]
        value = float(-0.5 * part @ right[chosen])
        if bool((part >= 0).all()) and value < least:
            best, least = torch.zeros_like(right), value
            best[chosen] = part
    return best * scale
