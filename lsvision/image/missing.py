"""Lines of an image that are not there: no value of theirs may be matched, measured or shown."""

import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Bool, Int
from torch import Tensor

from lsvision.types import LineImage, missing_ranges


def missing_mask(image: LineImage, lines: Int[Tensor, " lines"]) -> Bool[Tensor, " lines"]:
    """Which of some lines are not there; beyond the ends of the image, its first and last line stand for all."""
    mask = torch.zeros(len(lines), dtype=torch.bool)
    lines = lines.clamp(0, image.shape[0] - 1)
    for missing in missing_ranges(image):
        mask |= (lines >= missing.start) & (lines < missing.stop)
    return mask


def missing_near(mask: Bool[Tensor, " lines"], reach: int) -> Bool[Tensor, " lines"]:
    """Lines that are not there and those up to ``reach`` beside them."""
    return F.max_pool1d(mask.float()[None], 2 * reach + 1, 1, reach)[0].bool()
