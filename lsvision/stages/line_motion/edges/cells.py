"""Both images of a scan as brightness on cells of about 0.28 mm of the object: neighbouring columns are averaged.

Edges are blurred and textured over some tenths of a millimetre: finer columns take time and show nothing more.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.geometry import color_shift, object_pitch_mm
from lsvision.image.brightness import gray
from lsvision.types import LineImage, Scan, StereoPair

_CELL_MM = 0.28  # on the object, that a cell reaches at least, but for half a column
_GREEN = 1
_READ_LINES = 512


@dataclass(frozen=True)
class Cells:
    """The images of a scan on cells of some columns: the left one, and the right one where there is one.

    Where the colours of a sensor look at different lines, the green ones stand for all: depth is theirs.

    Attributes:
        later: lines by which the right image shows the same later.
    """

    scan: Scan
    size: int
    later: int = 0

    @classmethod
    def of(cls, scan: Scan, later: int = 0) -> "Cells":
        """Those of a scan whose images are rectified."""
        return cls(scan, max(1, round(_CELL_MM / object_pitch_mm(scan.rig))), later)

    @property
    def count(self) -> int:
        """Cells of a line; columns that fill none at the end are left out."""
        return self.scan.rig.width_px // self.size

    @property
    def pitch_mm(self) -> float:
        """Width of a cell on the object, at the plane of zero disparity."""
        return self.size * object_pitch_mm(self.scan.rig)

    @property
    def views(self) -> int:
        """Number of images: 2 of a stereo scan, else 1."""
        return 2 if isinstance(self.scan.images, StereoPair) else 1

    def place(self, column_px: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """Columns counted in cells; the middle of a cell is a whole number."""
        return (column_px + 0.5) / self.size - 0.5

    def column(self, place: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """Columns, px, of places counted in cells."""
        return (place + 0.5) * self.size - 0.5

    def read(self, view: int, start: int, stop: int) -> Float[Tensor, "lines cells"]:
        """Brightness of some lines of the left (0) or right (1) image; beyond its ends, lines are repeated."""
        images = self.scan.images
        image: LineImage = images.left
        if view == 1 and isinstance(images, StereoPair):
            image, start, stop = images.right, start + self.later, stop + self.later
        last = image.shape[0] - 1
        inside = torch.arange(start, stop).clamp(0, last)
        values = image.read(int(inside[0]), int(inside[-1]) + 1)
        values = values[..., [_GREEN]] if color_shift(self.scan) is not None else values
        cells = gray(values)[:, : self.count * self.size].unflatten(1, (self.count, self.size)).mean(-1)
        return cells[inside - inside[0]]

    def windows(self, view: int, first: Tensor, size: int, lines: range) -> Float[Tensor, "tracks lines size"]:
        """Some cells of lines from ``first`` ``(tracks, lines)`` on; beyond either end the outermost is repeated."""
        parts, reach = [], torch.arange(size)
        for start in range(lines.start, lines.stop, _READ_LINES):
            stop = min(start + _READ_LINES, lines.stop)
            values = self.read(view, start, stop)
            at = (first[:, start - lines.start : stop - lines.start, None] + reach).clamp(0, self.count - 1)
            parts.append(values[torch.arange(stop - start)[:, None], at])
        return torch.cat(parts, 1)
