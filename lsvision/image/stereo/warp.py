"""Values of an image at fractional columns of its lines."""

import cv2
import torch
from jaxtyping import Float, Shaped
from torch import Tensor


def warp_cubic(
    image: Float[Tensor, "lines image_width"], disparity: Float[Tensor, "lines width"], first_column: int = 0
) -> Float[Tensor, "lines width"]:
    """Values of an image at ``u - disparity``, u from ``first_column`` on, by Catmull-Rom interpolation.

    Positions are clamped to the image less a pixel at each end.
    """
    image_width, stop = image.shape[1], first_column + disparity.shape[1]
    position = torch.arange(first_column, stop, dtype=disparity.dtype).sub(disparity).clamp_(1.0, image_width - 2.0)
    base = position.floor().clamp_(max=image_width - 3)
    t = position.sub_(base)
    index = base.sub_(1.0).long()
    # The four neighbours a, b, c, d: one index into views that begin a pixel apart.
    a, b, c, d = (image[:, shift:].gather(1, index) for shift in range(4))
    # b + t/2 (linear + t (quadratic + t cubic)), in place: plain expressions take 1.4 times as long.
    linear, cubic = c - a, d.sub_(a).add_(b, alpha=3).sub_(c, alpha=3)
    quadratic = a.sub_(b).mul_(2).add_(linear).sub_(cubic)
    return b.addcmul_(t, linear.addcmul_(t, quadratic.addcmul_(t, cubic)), value=0.5)


def warp_linear(
    image: Shaped[Tensor, "lines image_width"], column: Float[Tensor, "lines width"]
) -> Shaped[Tensor, "lines width"]:
    """Values of an image at columns of each line by linear interpolation; beyond the image those of its edge."""
    line = torch.arange(column.shape[0], dtype=torch.float32)[:, None].expand_as(column).contiguous()
    values = cv2.remap(image.numpy(), column.numpy(), line.numpy(), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return torch.from_numpy(values)
