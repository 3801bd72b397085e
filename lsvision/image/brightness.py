"""Brightness of colour and mono lines, on the scale of the sensor or on that of a byte."""

import math
from collections.abc import Sequence

import cv2
import torch
from jaxtyping import Float, Shaped, UInt8
from torch import Tensor

from lsvision.image.missing import missing_mask
from lsvision.types import LineImage, missing_ranges

_SAMPLED_LINES = 16
_BRIGHT_SHARE = 0.99  # of the pixels are no brighter than what counts as the brightest
_HEADROOM = 1.25  # over that, for highlights
# Bytes are stretched where no more than a quarter of their codes is used: noise grows with them. Fewer than sixteen
# codes are noise alone.
_DARK_BITS, _FEWEST_BITS = 6, 4


def gray(lines: Shaped[Tensor, "*batch lines width channels"]) -> Float[Tensor, "*batch lines width"]:
    """Brightness (luma of ITU-R BT.601) of mono or RGB values of any type; float32 on the same scale.

    Args:
        lines: ``(*batch, lines, width, 1 or 3)``.
    """
    values = lines.to(torch.float32)
    if values.shape[-1] == 1:
        return values[..., 0]
    flat = values[..., :3].reshape(-1, values.shape[-2], 3)
    return torch.from_numpy(cv2.cvtColor(flat.numpy(), cv2.COLOR_RGB2GRAY)).reshape(values.shape[:-1])


def gray_bytes(lines: Shaped[Tensor, "lines width channels"], white: float = 255.0) -> UInt8[Tensor, "lines width"]:
    """Brightness of mono or RGB values as bytes: ``white`` becomes 255, as does everything brighter.

    Args:
        lines: ``(lines, width, 1 or 3)``.
    """
    if lines.dtype == torch.uint8 and white == 255.0:
        if lines.shape[-1] == 1:
            return lines[..., 0].contiguous()
        return torch.from_numpy(cv2.cvtColor(lines[..., :3].contiguous().numpy(), cv2.COLOR_RGB2GRAY))
    return (gray(lines) * (255.0 / white)).clamp_(0.0, 255.0).round_().to(torch.uint8)


def white_level(*images: LineImage) -> float:
    """Largest number of as many bits as the values of some images use, which becomes white: 255 for bytes.

    Sensors of 10 to 14 bits deliver 16-bit images, and dark scans use few codes even of bytes. A few lines spread over
    each image show how many bits are used. The brightest hundredth of their pixels does not count: hot pixels, and line
    counters that a camera writes into its first pixels.
    """
    brightest = max(_brightest(sampled_lines(image)) for image in images)
    bits = int(_HEADROOM * brightest).bit_length()
    if all(image.dtype == torch.uint8 for image in images):
        return float(2 ** max(bits, _FEWEST_BITS) - 1) if bits <= _DARK_BITS else 255.0
    return float(2 ** min(max(bits, 8), 16) - 1)


def sampled_lines(image: LineImage) -> Float[Tensor, "lines width channels"]:
    """Sixteen lines at fixed places among those of an image, or all of fewer; float32 on the image's scale."""
    present: Sequence[int] = range(image.shape[0])
    if missing_ranges(image):
        present = (~missing_mask(image, torch.arange(image.shape[0]))).nonzero()[:, 0].tolist()
    chosen = sorted({present[index * (len(present) - 1) // (_SAMPLED_LINES - 1)] for index in range(_SAMPLED_LINES)})
    return torch.cat([image.read(line, line + 1).to(torch.float32) for line in chosen])


def _brightest(sampled: Tensor) -> float:
    values = sampled.amax(-1).flatten()
    return float(values.kthvalue(max(1, math.ceil(_BRIGHT_SHARE * len(values)))).values)
