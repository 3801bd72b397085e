"""The shift that fits a warped right image to the left one best, in a window around each block, by least squares.

With s the slope of the left image, e = left - warped right and cov over a window, a change of the disparity by -q fits
best where ``(cov(s, s) + prior) q = cov(s, e)``. An offset of brightness drops out of the covariances. A factor of it,
where asked for, is a second unknown: with m the mean of both images, ``e = s q + g m``, and g is eliminated.

Source: Lucas & Kanade 1981, in one dimension; Baker & Matthews 2004 for the slope of the image that is not warped;
Gruen 1985, Adaptive least squares correlation, for brightness as an unknown.
"""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from lsvision.image.stereo import differences
from lsvision.image.stereo.windows import Windows

_ROUNDING = 1.0 / 6.0  # variance of the difference of two whole grey values
# Variance of half the difference of two neighbours over that of the residual: half of a pixel's noise variance, over
# that of one pixel and of another which interpolation has smoothed to 0.6 of it on average.
SLOPE_NOISE = 0.5 / 1.6
_GAIN_SIGMA = 0.3  # of the factor between the brightnesses of two images, as far as it is known beforehand


@dataclass(frozen=True)
class Fit:
    """The best shift in each window.

    Attributes:
        step: q, px.
        texture: cov(s, s), as far as it does not look like a factor of brightness.
        explained: variance of e that the fit explains.
        mean: of e.
    """

    step: Float[Tensor, "rows columns"]
    texture: Float[Tensor, "rows columns"]
    explained: Float[Tensor, "rows columns"]
    mean: Float[Tensor, "rows columns"]


@dataclass(frozen=True)
class Certainty:
    """How well a fit is known: sigma of the step, px, and variance of the grey values that the fit leaves."""

    sigma: Float[Tensor, "rows columns"]
    residual_variance: Float[Tensor, "rows columns"]


@dataclass(frozen=True)
class LeftWindows:
    """What the windows of a left image contribute to the equations of every step.

    Args:
        noise: sigma of the noise of grey values.
        block: side of a block, px.
    """

    left: Float[Tensor, "lines width"]
    slope: Float[Tensor, "lines width"]
    windows: Windows
    noise: float
    block: int
    mean_slope: Float[Tensor, "rows columns"]
    texture: Float[Tensor, "rows columns"]
    brightness: "Brightness | None"

    @classmethod
    def of(
        cls, left: Float[Tensor, "lines width"], windows: Windows, noise: float, *, with_gain: bool
    ) -> "LeftWindows":
        """Those of the windows around some blocks of an image; ``with_gain``: brightness may differ by a factor."""
        # The slope of the left image has noise independent of the right one. Interpolation smooths the right image
        # between its pixels: a slope that shared its noise would pull disparities towards the middle between them.
        slope = differences.slope(left)
        mean_slope = windows.mean(slope)
        texture = windows.covariance(slope, slope, mean_slope, mean_slope)
        brightness = Brightness.of(left, slope, mean_slope, windows) if with_gain else None
        block = left.shape[0] // windows.weight.shape[0]
        return cls(left, slope, windows, noise, block, mean_slope, texture, brightness)

    @property
    def prior(self) -> float:
        """The variance of the window's mean of noise times slope; it keeps untextured ground where matching put it."""
        return 4.0 * self.noise**2 / (self.block * self.windows.size) ** 2

    def fit(self, residual: Float[Tensor, "lines width"]) -> Fit:
        """The best shift, from the left image less the warped right one."""
        mean = self.windows.mean(residual)
        pull = self.windows.covariance(self.slope, residual, self.mean_slope, mean)
        if self.brightness is None:
            step = pull / (self.texture + self.prior)
            return Fit(step, self.texture, pull.mul_(step), mean)
        return self._fit_with_gain(self.brightness, residual, mean, pull)

    def _fit_with_gain(self, brightness: "Brightness", residual: Tensor, mean: Tensor, pull: Tensor) -> Fit:
        """The same where m = left - e / 2 explains a part of the residual.

        The noise of both images cancels in cov(m, e); with one image instead of their mean it would look like a factor.
        """
        variance = self.windows.covariance(residual, residual, mean, mean)
        by_left = self.windows.covariance(self.left, residual, brightness.mean, mean)
        of_mean = brightness.variance.sub(by_left).add_(variance, alpha=0.25).clamp_(min=0)
        of_mean.add_(self.prior / (2 * _GAIN_SIGMA**2))
        by_mean, slope_by_mean = by_left.sub_(variance, alpha=0.5), brightness.with_slope.sub(pull, alpha=0.5)
        share = slope_by_mean / of_mean
        texture = self.texture.addcmul(share, slope_by_mean, value=-1).clamp_(min=0)
        pull = pull.addcmul(share, by_mean, value=-1)
        step = pull / (texture + self.prior)
        return Fit(step, texture, by_mean.square().div_(of_mean).addcmul_(pull, step), mean)

    def certainty(self, residual: Float[Tensor, "lines width"], fit: Fit) -> Certainty:
        """How well the shift that was fitted to a residual is known, as if its pixels had independent noise."""
        variance = self.windows.covariance(residual, residual, fit.mean, fit.mean).sub_(fit.explained)
        pixels = self.windows.count * self.block**2
        variance.mul_(pixels).div_((pixels - 2).clamp_(min=1)).clamp_(min=_ROUNDING)
        # The noise of the slope looks like texture but carries no information.
        known = fit.texture.sub(variance, alpha=SLOPE_NOISE).clamp_(min=0).add_(self.prior)
        normal = fit.texture.add(self.prior).clamp_(min=0)
        return Certainty(normal.mul_(variance).div_(pixels).sqrt_().div_(known), variance)


@dataclass(frozen=True)
class Brightness:
    """Mean and variance of the left image over windows, and its covariance with its slope."""

    mean: Float[Tensor, "rows columns"]
    variance: Float[Tensor, "rows columns"]
    with_slope: Float[Tensor, "rows columns"]

    @classmethod
    def of(cls, left: Tensor, slope: Tensor, mean_slope: Tensor, windows: Windows) -> "Brightness":
        """Those of some windows."""
        mean = windows.mean(left)
        return cls(mean, windows.covariance(left, left, mean, mean), windows.covariance(slope, left, mean_slope, mean))


def explained_share(
    left: Float[Tensor, "lines width"], windows: Windows, residual_variance: Float[Tensor, "rows columns"], noise: float
) -> Float[Tensor, "rows columns"]:
    """Share of the variance of the left image in a window, noise aside, that a match explains: 0..1.

    Args:
        residual_variance: of the grey values that the match leaves.
        noise: sigma of the noise of grey values.
    """
    values = windows.reduced(left)
    mean = windows.mean(values)
    variance = windows.covariance(values, values, mean, mean).clamp_(min=1.0)
    unexplained = residual_variance.sub(noise**2).clamp_(min=0).div_(variance).clamp_(max=1.0)
    return unexplained.neg_().add_(1.0)
