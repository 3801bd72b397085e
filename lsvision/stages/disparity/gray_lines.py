"""Lines of an image as they are matched: grey values, and which samples carry no measurement."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Shaped
from torch import Tensor

from lsvision.image.brightness import gray, gray_bytes
from lsvision.image.flat_field import FlatFieldImage
from lsvision.image.levels import CameraLevels, as_taken
from lsvision.image.resampled import ResampledImage
from lsvision.types import LineImage


@dataclass(frozen=True)
class GrayLines:
    """Brightness on a scale of 0..255, as is the configured noise, and the unusable samples; None where none is."""

    gray: Shaped[Tensor, "lines width"]
    unusable: Bool[Tensor, "lines width"] | None

    @classmethod
    def read(cls, image: LineImage, lines: range, levels: CameraLevels, white: float) -> "GrayLines":
        """Those of some lines; beyond the ends of the image its first and last line stand for all.

        An image that is resampled is so as grey values: one channel of three. What is interpolated from an unusable
        sample is unusable.
        """
        if isinstance(image, ResampledImage):
            return cls._resampled(image, lines, levels, white)
        return cls._of(image, _read_within(as_taken(image), lines), levels, white)

    @classmethod
    def _of(cls, image: LineImage, codes: Tensor, levels: CameraLevels, white: float) -> "GrayLines":
        """Those of codes as the camera delivered them; made even where the image is."""
        unusable = levels.unusable(codes)
        if not isinstance(image, FlatFieldImage):
            return cls(_gray(codes, white), unusable)
        if image.blind is not None:
            blind = image.blind.expand(codes.shape[:2])
            unusable = blind.contiguous() if unusable is None else unusable | blind
        return cls(_gray(image.values(codes), white), unusable)

    @classmethod
    def _resampled(cls, image: ResampledImage, lines: range, levels: CameraLevels, white: float) -> "GrayLines":
        taken = image.source_lines(lines)
        source = cls._of(image.source, as_taken(image).read(taken.start, taken.stop), levels, white)
        brightness = image.resample(source.gray[..., None], taken.start, lines)[..., 0]
        bad = source.unusable
        return cls(brightness, None if bad is None else image.spread(bad, taken.start, lines))


def _read_within(image: LineImage, lines: range) -> Tensor:
    """Lines of an image; beyond its ends those are repeated."""
    last = image.shape[0] - 1
    start, stop = (min(max(line, 0), last) for line in (lines.start, lines.stop - 1))
    values = image.read(start, stop + 1)
    if len(values) == len(lines):
        return values
    return values[torch.arange(lines.start, lines.stop).clamp(start, stop) - start]


def _gray(image: Tensor, white: float) -> Tensor:
    """Brightness on a scale of 0..255: bytes of byte images, float32 of others."""
    return gray_bytes(image) if image.dtype == torch.uint8 and white == 255.0 else gray(image) * (255.0 / white)
