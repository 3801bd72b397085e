"""Where the edges of a board's squares cross the lines of an image, to a fraction of a pixel.

An edge that runs along the motion crosses every line. Around each crossing a line shows

    level + step E((u - position) / blur),     E the mean of erf over a pixel,

which is fitted to each crossing by itself, all at once. Between the corners at its ends an edge need not be straight:
a vibration bends it. So it is first looked for around the chord.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int, Real
from torch import Tensor

from lsvision.image.brightness import gray
from lsvision.image.missing import missing_mask
from lsvision.types import LineImage, missing_ranges

_READ_LINES = 256
_RIM = 0.2  # share of a segment at either end that is left out: there the other edges of the corner are near
_AROUND = 0.12  # share of the squares' width to either side of the chord, in which an edge is looked for
_STEEPEST = 2.0  # columns per line: a flatter edge is a blur along the line
_BLURS = 4.0  # half width of the fitted window
_LEAST_HALF, _MOST_HALF = 4, 12  # px
_ITERATIONS = 8
_FIRST_BLUR, _BLUR_STEP, _BLURS_TRIED = 0.3, 1.2, 13  # px; that many times larger the next; how many
_BLUR_PROFILES = 2000  # of which the blur is taken
_LEAST_STEP = 0.4  # of the median step between dark and bright
_LARGEST_MISFIT = 4.0  # times the median misfit


@dataclass(frozen=True)
class EdgeSegments:
    """Parts of edges between two corners, ``start`` and ``stop`` (column, line) px, of squares ``width_px`` wide."""

    start: Float[Tensor, "segments 2"]
    stop: Float[Tensor, "segments 2"]
    width_px: float

    def lines(self) -> Float[Tensor, "segments 2"]:
        """First and last line that lie well between the ends; those of a segment that is too flat are none."""
        ends = torch.stack([self.start[:, 1], self.stop[:, 1]], -1)
        low, high = ends.amin(-1), ends.amax(-1)
        rim = _RIM * (high - low)
        flat = (self.stop[:, 0] - self.start[:, 0]).abs() > _STEEPEST * (high - low)
        usable = torch.isfinite(low + high) & ~flat
        return torch.where(usable[:, None], torch.stack([low + rim, high - rim], -1), high.new_tensor([1.0, 0.0]))

    def column_at(self, segment: Int[Tensor, " crossings"], line: Real[Tensor, " crossings"]) -> Tensor:
        """Column of the chord on a (fractional) line."""
        start, stop = self.start[segment], self.stop[segment]
        return torch.lerp(start[:, 0], stop[:, 0], (line - start[:, 1]) / (stop[:, 1] - start[:, 1]))


@dataclass(frozen=True)
class Crossings:
    """Columns at which edges cross lines, their variance, px², and whether they were measured.

    ``step`` is half the difference of brightness from left to right.
    """

    column: Float[Tensor, " crossings"]
    variance: Float[Tensor, " crossings"]
    valid: Bool[Tensor, " crossings"]
    step: Float[Tensor, " crossings"]


def common_lines(*images: EdgeSegments) -> tuple[Int[Tensor, " crossings"], Int[Tensor, " crossings"]]:
    """Segments and lines on which all images show an edge, segment by segment."""
    ranges = torch.stack([segments.lines() for segments in images])
    first, last = ranges[..., 0].amax(0).ceil().long(), ranges[..., 1].amin(0).floor().long()
    count = (last - first + 1).clamp(min=0)
    segment = torch.repeat_interleave(torch.arange(len(count)), count)
    before = count.cumsum(0) - count
    return segment, first[segment] + torch.arange(len(segment)) - before[segment]


def find_crossings(
    image: LineImage, segments: EdgeSegments, segment: Int[Tensor, " crossings"], line: Int[Tensor, " crossings"]
) -> Crossings:
    """Locate the crossings of segments with lines, by pairs of both."""
    expected = segments.column_at(segment, line)
    around = max(_LEAST_HALF, round(_AROUND * segments.width_px))
    coarse, seen = expected.new_zeros(len(line)), torch.zeros(len(line), dtype=torch.bool)
    profiles = expected.new_zeros(len(line), 2 * _MOST_HALF + 1)
    reach = around + _MOST_HALF
    span = torch.arange(-reach, reach + 1)
    for start in range(0, image.shape[0], _READ_LINES):
        here = ((line >= start) & (line < start + _READ_LINES)).nonzero()[:, 0]
        if len(here) == 0:
            continue
        strip = gray(image.read(start, min(start + _READ_LINES, image.shape[0]))).to(expected)
        centre = expected[here].round().long()
        inside = (centre >= reach) & (centre < image.shape[1] - reach)
        columns = centre.clamp(reach, image.shape[1] - 1 - reach)[:, None] + span
        wide = strip[(line[here] - start)[:, None], columns]
        offset = _steepest(wide, around)
        profiles[here] = wide.gather(1, (offset + reach)[:, None] + torch.arange(-_MOST_HALF, _MOST_HALF + 1))
        coarse[here], seen[here] = (centre + offset).to(expected), inside & (offset.abs() < around)
    if missing_ranges(image):
        seen &= ~missing_mask(image, line)
    slant = ((segments.stop - segments.start)[segment, 0] / (segments.stop - segments.start)[segment, 1]).abs()
    return _fitted(profiles, slant, coarse, seen)


def _steepest(wide: Float[Tensor, "crossings size"], around: int) -> Int[Tensor, " crossings"]:
    """The pixel, counted from the middle, at which brightness changes most over four pixels."""
    change = wide[:, 2:-1] + wide[:, 3:] - wide[:, :-3] - wide[:, 1:-2]  # at i, between pixels i + 1 and i + 2
    middle = wide.shape[-1] // 2 - 2
    part = change[:, middle - around : middle + around + 1]
    return part.abs().argmax(-1) - around


def _fitted(profiles: Tensor, slant: Tensor, coarse: Tensor, seen: Tensor) -> Crossings:
    """Position, blur, level and step of every profile by Gauss-Newton."""
    offset = torch.arange(-_MOST_HALF, _MOST_HALF + 1, dtype=profiles.dtype)
    blur = _typical_blur(profiles[seen], slant[seen], offset) if bool(seen.any()) else 1.0
    half = min(_MOST_HALF, max(_LEAST_HALF, math.ceil(_BLURS * blur)))
    inner = slice(_MOST_HALF - half, _MOST_HALF + half + 1)
    fit = _gauss_newton(profiles[:, inner], slant, offset[inner], blur)
    position, misfit, step, variance = fit.unbind(-1)
    ok = seen & torch.isfinite(fit).all(-1) & (position.abs() < 2.0)
    if bool(ok.any()):
        ok &= step.abs() >= _LEAST_STEP * step[ok].abs().median()
        ok &= misfit <= _LARGEST_MISFIT * misfit[ok].median()
        noise = misfit[ok].square().mean()
        variance = variance * noise
    return Crossings(coarse + position, variance, ok, step)


def _typical_blur(profiles: Tensor, slant: Tensor, offset: Tensor) -> float:
    """The blur that fits most of some profiles best: of a few sizes, then between them."""
    some = torch.linspace(0, len(profiles) - 1, min(len(profiles), _BLUR_PROFILES)).long()
    tried = _FIRST_BLUR * _BLUR_STEP ** torch.arange(_BLURS_TRIED, dtype=profiles.dtype)
    misfit = torch.stack(
        [_gauss_newton(profiles[some], slant[some], offset, float(blur))[:, 1].nanmedian() for blur in tried]
    ).square()
    best = int(misfit.argmin().clamp(1, _BLURS_TRIED - 2))
    before, here, after = misfit[best - 1 : best + 2].tolist()
    part = 0.5 * (before - after) / max(before - 2.0 * here + after, 1e-12)
    return float(tried[best]) * _BLUR_STEP ** max(-1.0, min(1.0, part))


def _gauss_newton(profiles: Tensor, slant: Tensor, offset: Tensor, blur: float) -> Tensor:
    """Position, rms misfit, step and variance of the position for noise of one, by profile; ``(profiles, 4)``."""
    position = torch.zeros_like(slant)
    wide = (blur**2 + slant.square() / 12).sqrt()[:, None]
    for _ in range(_ITERATIONS):
        value, slope = _edge(offset - position[:, None], wide)
        A = torch.stack([torch.ones_like(value), value], -1)
        gram = A.mT @ A
        level = torch.linalg.solve(gram, A.mT @ profiles[..., None])
        residual = profiles - (A @ level)[..., 0]
        by_position = -level[:, 1] * slope
        free = by_position - (A @ torch.linalg.solve(gram, A.mT @ by_position[..., None]))[..., 0]
        power = free.square().sum(-1)
        position = (position + ((free * residual).sum(-1) / power).clamp(-1.0, 1.0)).clamp(-3.0, 3.0)
    freedom = profiles.shape[-1] - 3
    misfit = (residual.square().sum(-1) / freedom).sqrt()
    return torch.stack([position, misfit, level[:, 1, 0], 1 / power], -1)


def _edge(distance: Tensor, blur: Tensor) -> tuple[Tensor, Tensor]:
    """Mean of erf over a pixel and its derivative, at distances from the edge."""
    left, right = ((distance + side) / (math.sqrt(2) * blur) for side in (-0.5, 0.5))
    by_blur = math.sqrt(2) * blur

    def integral(x: Tensor) -> Tensor:
        return by_blur * (x * torch.erf(x) + torch.exp(-x * x) / math.sqrt(math.pi))

    return integral(right) - integral(left), torch.erf(right) - torch.erf(left)
