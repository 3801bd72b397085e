"""In which rows of an image the colours of a trilinear sensor show the same piece of the object.

Red, green and blue look at different planes Y = s z / z0. The depth of a scan is that of its green lines; another
colour sees the same point Y / n2 of travel later (``ProductFrame.plane_y``, ``shifted_line``), and some cameras shift
the rows of each colour by whole lines to make up for it.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.geometry.product import ProductFrame
from lsvision.types import Scan

_GREEN = 1


def color_shift(scan: Scan) -> Float[Tensor, " channels"] | None:
    """Lines by which each colour looks beyond green; None where all look at one line."""
    shift = torch.tensor(scan.rig.color_spacing_lines, dtype=torch.float64)
    shift = shift - shift[_GREEN]
    return None if scan.left.shape[2] == 1 or not bool(shift.any()) else shift


def color_rows(
    scan: Scan, frame: ProductFrame, lines: tuple[int, int], shift: Float[Tensor, " channels"]
) -> Float[Tensor, "channels lines"]:
    """The image row in which each colour shows what green shows on each of the lines ``lines[0]..lines[1]-1``."""
    shift_mm = shift * scan.travel.line_pitch_mm
    return (
        frame.shifted_line(torch.arange(*lines, dtype=torch.float64), shift_mm[:, None])
        + registered_rows(scan, shift)[:, None]
    )


def registered_rows(scan: Scan, shift: Float[Tensor, " channels"]) -> Float[Tensor, " channels"]:
    """Rows by which the camera has shifted each colour: row less these is the line that it was taken on."""
    sign = -1.0 if scan.travel.transport == "reverse" else 1.0
    return sign * shift if scan.color_registered else torch.zeros_like(shift)
