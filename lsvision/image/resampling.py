"""Resampling of image strips at given positions by ``grid_sample``."""

import math
from typing import Literal

import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Float
from torch import Tensor

Interpolation = Literal["bilinear", "bicubic"]

# Positions along Y are rounded to this part of a line: float32 holds such a fraction of up to 8192 lines exactly.
_LINE_PARTS = 2048


def sample_image(
    image: Tensor, column: Float[Tensor, "rows columns"], line: Float[Tensor, "rows columns"], mode: Interpolation
) -> Tensor:
    """Sample an image ``(lines, width, channels)`` at positions in px; ``(rows, columns, channels)`` of its dtype.

    Positions are relative to the image's first line, and lines are rounded to 1/2048: cut from a taller image, at any
    line, an image gives the same bits. Positions outside are clamped to the rim; NaN positions give 0.
    """
    lines, width, _ = image.shape
    known = torch.isfinite(column) & torch.isfinite(line)
    # With a power of two of lines grid_sample's way from a normalised position back to lines rounds nothing.
    intervals = 2 ** math.ceil(math.log2(max(lines - 1, 1)))
    line = (line * _LINE_PARTS).round() / _LINE_PARTS
    grid = torch.stack([2 * column / max(width - 1, 1) - 1, 2 * line / intervals - 1], dim=-1)
    grid = torch.where(known[..., None], grid, 0.0).to(torch.float32)
    source = image.to(torch.float32).movedim(-1, 0)[None]
    source = F.pad(source, (0, 0, 0, intervals + 1 - lines), mode="replicate")
    # grid_sample gives each item of the batch a thread of its own: bands of rows over one shared image.
    bands = _bands(grid, torch.get_num_threads())
    sampled = F.grid_sample(
        source.expand(bands.shape[0], *source.shape[1:]), bands, mode=mode, padding_mode="border", align_corners=True
    )
    sampled = sampled.movedim(1, -1).flatten(0, 1)[: column.shape[0]]
    sampled = torch.where(known[..., None], sampled, 0.0)
    if image.dtype.is_floating_point:
        return sampled.to(image.dtype)
    top = float(torch.iinfo(image.dtype).max)
    return sampled.round_().clamp_(0.0, top).to(image.dtype)


def _bands(grid: Tensor, threads: int) -> Tensor:
    """Split rows into equal bands, (bands, rows, columns, 2); the last is padded with copies of the last row."""
    rows = grid.shape[0]
    count = max(1, min(threads, rows))
    height = -(-rows // count)
    missing = height * count - rows
    padded = torch.cat([grid, grid[-1:].expand(missing, -1, -1)]) if missing else grid
    return padded.reshape(count, height, *grid.shape[1:])
