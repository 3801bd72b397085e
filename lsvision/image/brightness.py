"""Brightness of colour and mono lines, on the scale of the sensor or on that of a byte."""

import cv2
import torch
from jaxtyping import Float, Shaped, UInt8
from torch import Tensor

from lsvision.types import LineImage

_SAMPLED_LINES = 16


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
    """Largest value that the pixels of some images can have: 255, or the largest number of as many bits as they use.

    Sensors of 10 to 14 bits deliver 16-bit images; sixteen lines spread over each image show how many bits are used.
    """
    if all(image.dtype == torch.uint8 for image in images):
        return 255.0
    brightest = 0.0
    for image in images:
        lines = image.shape[0]
        for line in sorted({index * (lines - 1) // (_SAMPLED_LINES - 1) for index in range(_SAMPLED_LINES)}):
            brightest = max(brightest, float(image.read(line, line + 1).to(torch.float32).max()))
    return float(2 ** max(8, int(brightest).bit_length()) - 1)
