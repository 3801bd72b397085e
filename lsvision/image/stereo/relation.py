"""How the right image of a scan differs from the left one apart from disparity: white level, lines, brightness.

Measured once for a scan, in bands of lines at fixed places, so that no disparity depends on the strip in which it is
matched. Each band is matched as it is, reduced where lines are long. Where that explains little of what the left image
shows, bands are matched with the right image shifted by some lines, and the shift that explains most is the start.
"""

import math
from dataclasses import dataclass, field
from functools import cached_property

import cv2
import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Bool, Shaped, UInt8
from torch import Tensor

from lsvision.image.brightness import gray_bytes
from lsvision.image.levels import PairLevels
from lsvision.image.missing import missing_mask
from lsvision.image.resampled import ResampledImage
from lsvision.image.stereo.exposure import Exposure, fit_exposure
from lsvision.image.stereo.refine import RefineOptions, refine_disparity
from lsvision.image.stereo.rows import RowOffset, Tiles, joined, row_offset
from lsvision.image.stereo.sgbm import GrayPair, Search, match_sgbm
from lsvision.image.stereo.warp import warp_cubic
from lsvision.types import LineImage, StereoPair

_LINES_PER_BAND, _MOST_BANDS = 1024, 8
_BAND_PX, _FEWEST_LINES, _MOST_LINES = 2**19, 64, 256  # of a band
_LARGEST_SHIFT = 16  # lines by which the cameras may be out of step
_SEARCHED_BANDS = 3
_BLANK_TEST_STEP = 9  # every ninth line shows whether a camera saw anything
_LEAST_EXPLAINED = 0.3  # mean share of the tiles, below which images hardly match whatever the shift
_WELL_EXPLAINED, _IN_STEP_PX = 0.5, 0.25  # mean share of the tiles, and row offset, that need no search
_WINDOW, _SMOOTHED = 7, 5
_MOST_ROUNDS = 3


@dataclass(frozen=True)
class PairRelation:
    """What is to be done to a right image before it is matched.

    Args:
        levels: what the codes of both images mean.
        rows: by how many lines the cameras are out of step; whole ones are taken into account.
        exposure: what makes the right image as bright as the left one; None where it is.
    """

    levels: PairLevels
    rows: RowOffset
    exposure: Exposure | None

    def as_bright_as_left(self, right: Shaped[Tensor, "lines width"]) -> Shaped[Tensor, "lines width"]:
        """Lines of the right image, of 255, as bright as the left image has the same samples."""
        return right if self.exposure is None else self.exposure.apply(right)

    @property
    def metadata(self) -> dict[str, object]:
        """The same as plain data, for products and reports; the gain is the lowest and the highest of a line."""
        exposure = self.exposure or Exposure(torch.ones(1), 0.0, 0.0)
        return {
            "row_offset_lines": self.rows.lines,
            "row_offset_sigma_lines": self.rows.sigma,
            "row_offset_used_lines": self.rows.whole,
            "right_gain": [float(exposure.gain.min()), float(exposure.gain.max())],
            "right_offset": exposure.offset,
            "right_curve": exposure.curve,
        }


def measure_relation(images: StereoPair, search: Search, noise: float, size: int) -> PairRelation:
    """Measure how the right image of a scan differs from the left one.

    Args:
        search: in pixels of the images.
        noise: sigma of the noise of grey values, of 255.
        size: of the images over that of the copies that are matched.
    """
    levels = PairLevels.of(images)
    bands = [band for band in _bands(images, levels.white, size) if not band.is_blank(noise)]
    if not bands:
        return PairRelation(levels, RowOffset(math.nan, math.nan), None)
    views = _Views(bands, search.reduced(size), noise)
    shift = views.best_shift()
    for _ in range(_MOST_ROUNDS):
        rows = views.row_offset(shift)
        if rows.whole == shift or abs(rows.whole) > bands[0].margin:
            break
        shift = rows.whole
    return PairRelation(levels, rows, _exposure(views.at(shift)))


@dataclass(frozen=True)
class _View:
    """A matched band of the reduced images: disparity, left brightness and that of the partners in the right image."""

    disparity: Tensor
    left: Tensor
    partner: Tensor

    @cached_property
    def tiles(self) -> Tiles:
        """What its tiles say about the row offset."""
        return Tiles.of(self.left, self.partner, self.disparity == self.disparity)


@dataclass(frozen=True)
class _Band:
    """Some lines of the left image, and ``margin`` lines more at either end of the right one, as bytes."""

    left: UInt8[Tensor, "lines width"]
    right: UInt8[Tensor, "more_lines width"]
    margin: int
    size: int

    def is_blank(self, noise: float) -> bool:
        """Whether one of the cameras saw no more than its noise."""
        return any(float(image[::_BLANK_TEST_STEP].float().std()) <= noise for image in (self.left, self.right))

    def view(self, shift: int, search: Search, noise: float) -> _View:
        """Match the band with a right image that is ``shift`` lines later."""
        first = self.margin + shift
        pair = GrayPair(self._reduced(self.left), self._reduced(self.right[first : first + len(self.left)]))
        options = RefineOptions(_WINDOW, iterations=1, noise=noise, with_gain=True, with_sigma=False)
        disparity = refine_disparity(pair.left, pair.right, match_sgbm(pair, search), options).disparity
        partner = warp_cubic(pair.right.to(torch.float32), torch.nan_to_num(disparity))
        return _View(disparity, pair.left.to(torch.float32), partner)

    def _reduced(self, image: Tensor) -> Tensor:
        lines, columns = (length // self.size for length in image.shape)
        whole = image[: lines * self.size, : columns * self.size].contiguous().numpy()
        return torch.from_numpy(cv2.resize(whole, (columns, lines), interpolation=cv2.INTER_AREA))


def _bands(images: StereoPair, white: float, size: int) -> list[_Band]:
    """Bands of lines at equal distances; none of images that are too low for one."""
    left, right = images.left, images.right
    lines, width = left.shape[:2]
    margin = min(_LARGEST_SHIFT, lines // 8)
    present = _present(images)
    height = min(max(_BAND_PX // width, _FEWEST_LINES), _MOST_LINES, _longest_run(present) - 2 * margin)
    height -= height % size
    count = min(-(-lines // _LINES_PER_BAND), _MOST_BANDS)
    starts = [(2 * index + 1) * lines // (2 * count) - height // 2 for index in range(count)] if height > 0 else []
    if starts and not bool(present.all()):
        starts = _nearest_whole(starts, present, height, margin)
    return [
        _Band(
            _gray(left, range(start, start + height), white),
            _gray(right, range(start - margin, start + height + margin), white),
            margin,
            size,
        )
        for start in starts
    ]


def _gray(image: LineImage, lines: range, white: float) -> UInt8[Tensor, "lines width"]:
    """Brightness of some lines as bytes; an image that is resampled is so in one channel."""
    if not isinstance(image, ResampledImage):
        return gray_bytes(image.read(lines.start, lines.stop), white)
    return image.read_as(lines, lambda values: gray_bytes(values, white)[..., None])[..., 0]


def _present(images: StereoPair) -> Bool[Tensor, " lines"]:
    """Which lines both images have."""
    lines = torch.arange(images.left.shape[0])
    return ~(missing_mask(images.left, lines) | missing_mask(images.right, lines))


def _longest_run(present: Bool[Tensor, " lines"]) -> int:
    """Most consecutive lines that are there."""
    gaps = F.pad(~present, (1, 1), value=True).nonzero()[:, 0]
    return int(gaps.diff().max()) - 1


def _nearest_whole(starts: list[int], present: Bool[Tensor, " lines"], height: int, margin: int) -> list[int]:
    """The nearest places to ``starts`` where a band and its margins have all their lines."""
    whole = present.unfold(0, height + 2 * margin, 1).all(1).nonzero()[:, 0] + margin
    return sorted({int(whole[(whole - start).abs().argmin()]) for start in starts})


@dataclass
class _Views:
    """The bands of a scan, matched with the right image shifted by some lines, each shift once."""

    bands: list[_Band]
    search: Search
    noise: float
    _known: dict[int, list[_View]] = field(default_factory=dict, init=False)

    def at(self, shift: int) -> list[_View]:
        """The bands matched with a right image that is ``shift`` lines later."""
        if shift not in self._known:
            self._known[shift] = [band.view(shift, self.search, self.noise) for band in self.bands]
        return self._known[shift]

    def score(self, shift: int) -> float:
        """How well they match then."""
        return joined([view.tiles for view in self.at(shift)]).score

    def row_offset(self, shift: int) -> RowOffset:
        """The row offset, lines, as measured from a shift on; NaN where the bands match badly."""
        if self.score(shift) < _LEAST_EXPLAINED:
            return RowOffset(math.nan, math.nan)
        size, seen = self.bands[0].size, row_offset(joined([view.tiles for view in self.at(shift)]))
        return RowOffset(shift + size * seen.lines, size * seen.sigma)

    def best_shift(self) -> int:
        """The shift, lines, with which the bands match best: the top of the hill around none, or else of all."""
        step, margin = self.bands[0].size, self.bands[0].margin
        if self.score(0) >= _WELL_EXPLAINED and abs(self.row_offset(0).lines) <= _IN_STEP_PX * step:
            return 0
        best = self._top_near(0)
        if self.score(best) >= _WELL_EXPLAINED:
            return best
        some = _Views(self.bands[:: -(-len(self.bands) // _SEARCHED_BANDS)], self.search, self.noise)
        reach = margin // step
        return max((step * index for index in sorted(range(-reach, reach + 1), key=abs)), key=some.score)

    def _top_near(self, start: int) -> int:
        """The shift from which neither neighbour matches better, uphill from ``start``."""
        step, margin = self.bands[0].size, self.bands[0].margin
        beside = [shift for shift in (start - step, start + step) if abs(shift) <= margin]
        best = max(beside, key=self.score, default=start)
        return self._top_near(best) if self.score(best) > self.score(start) else start


def _exposure(views: list[_View]) -> Exposure | None:
    """The exposure of the right image from the pixels of all views whose neighbours match too."""

    def smoothed(values: Tensor) -> Tensor:
        return torch.from_numpy(cv2.blur(values.numpy(), (_SMOOTHED, _SMOOTHED)))

    parts: list[tuple[Tensor, ...]] = []
    for view in views:
        width = view.disparity.shape[1]
        matched = smoothed((view.disparity == view.disparity).to(torch.float32)) > 1 - 1e-3
        position = (torch.arange(width) - view.disparity) / (width - 1)
        parts.append(tuple(values[matched] for values in (smoothed(view.left), smoothed(view.partner), position)))
    left, right, position = (torch.cat(values) for values in zip(*parts, strict=True))
    return fit_exposure(left, right, position)
