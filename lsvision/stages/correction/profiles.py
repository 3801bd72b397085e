"""Scan lines -> profiles: along each line, the surface that every column of a product's grid sees.

q_x and q_z of a sample depend on its own line alone, so this needs no travel, and every line stands for itself.
"""

from dataclasses import dataclass, field

import torch
from jaxtyping import Bool
from torch import Tensor

from lsvision.geometry import ProductFrame, zero_disparity_mm
from lsvision.image.tiling import in_parallel
from lsvision.image.visibility import Seen, Surface, bridge_gaps, see_cells
from lsvision.types import Depth, DepthSource

_BLOCK_LINES = 64


@dataclass(frozen=True)
class ProfileRule:
    """What counts as one surface, and the columns it is wanted at: cell i lies at q_x = origin + i·pitch, mm.

    Depths outside ``z_range_mm`` count as not measured; see ``CorrectionConfig`` for the rest.
    """

    columns: int
    pitch_mm: float
    origin_x_mm: float
    z_range_mm: tuple[float, float]
    largest_step_mm: float
    bridge_px: int


def resolve_profiles(depth: Depth, frame: ProductFrame, rule: ProfileRule) -> Seen:
    """What the columns of a product see on some lines.

    Returns:
        ``place`` is the column of the left image, px; ``height`` is the relief z0 - q_z, mm; bridged cells are not
        ``measured``; ``carried`` holds the sigma of the depth, mm, where it is given.
    """
    z = depth.z
    # Counted from the middle of the range, single precision holds a depth to a hundred-thousandth of a millimetre.
    middle, half = sum(rule.z_range_mm) / 2, (rule.z_range_mm[1] - rule.z_range_mm[0]) / 2
    beyond = z - middle
    measured = beyond.abs() <= half
    if not bool(measured.all()):
        beyond = beyond.masked_fill_(~measured, torch.nan)
        beyond = bridge_gaps(beyond, longest=rule.bridge_px, largest_step=rule.largest_step_mm)
    # q_x and q_z are multiples of z: q = z ray.
    ray = frame.ray(torch.arange(z.shape[1], dtype=torch.float64))
    cells_per_mm, q_z_per_mm = ray[:, 0] / rule.pitch_mm, ray[:, 2]
    cell = middle * cells_per_mm - rule.origin_x_mm / rule.pitch_mm
    relief = zero_disparity_mm(frame.rig) - middle * q_z_per_mm
    surface = Surface(
        whole=cell.floor().to(z.dtype),
        part=torch.addcmul((cell - cell.floor()).to(z.dtype), beyond, cells_per_mm.to(z.dtype)),
        height=torch.addcmul(relief.to(z.dtype), beyond, -q_z_per_mm.to(z.dtype)),
        carried=() if depth.sigma is None else (depth.sigma,),
        connected=beyond.diff(dim=1).abs_() <= rule.largest_step_mm,  # false beside a hole
        measured=measured[:, 1:] & measured[:, :-1],
    )
    return see_cells(surface, rule.columns, dim=1)


@dataclass(frozen=True)
class DepthWithoutLines:
    """A depth of which some lines count as not measured: those that ``without``, ``(lines,)``, marks."""

    depth: DepthSource
    without: Bool[Tensor, " lines"]

    @property
    def lines(self) -> int:
        """Number of lines of the scan."""
        return self.depth.lines

    def read(self, start: int, stop: int) -> Depth:
        """Depth of lines ``start..stop-1``."""
        depth = self.depth.read(start, stop)
        return Depth(depth.z.masked_fill(self.without[start:stop, None], torch.nan), depth.sigma)


@dataclass
class ProfileReader:
    """The profiles of a scan, by line ranges; blocks that the next range needs again stay in memory.

    Args:
        with_sigma: whether the sigma of the depth is carried along, where the source knows it.
    """

    depth: DepthSource
    frame: ProductFrame
    rule: ProfileRule
    with_sigma: bool
    _blocks: dict[int, Seen] = field(default_factory=dict, init=False, repr=False)

    def load(self, start: int, stop: int) -> None:
        """Resolve the lines ``start..stop-1`` and drop those outside."""
        wanted = range(start // _BLOCK_LINES, -(-stop // _BLOCK_LINES))
        for index in [index for index in self._blocks if index not in wanted]:
            del self._blocks[index]
        missing = [index for index in wanted if index not in self._blocks]
        if not missing:
            return
        first = missing[0] * _BLOCK_LINES
        depth = self.depth.read(first, min((missing[-1] + 1) * _BLOCK_LINES, self.depth.lines))
        sigma = depth.sigma if self.with_sigma else None

        def resolve_block(index: int) -> Seen:
            """Profiles of one block of lines."""
            lines = slice(index * _BLOCK_LINES - first, (index + 1) * _BLOCK_LINES - first)
            return resolve_profiles(
                Depth(depth.z[lines], None if sigma is None else sigma[lines]), self.frame, self.rule
            )

        self._blocks.update(zip(missing, in_parallel(resolve_block, missing), strict=True))

    def read(self, start: int, stop: int, columns: slice) -> Seen:
        """Profiles of the loaded lines ``start..stop-1`` at a range of columns."""
        parts: list[list[Tensor]] = []
        for index in range(start // _BLOCK_LINES, -(-stop // _BLOCK_LINES)):
            inside = slice(max(start - index * _BLOCK_LINES, 0), stop - index * _BLOCK_LINES)
            parts.append([values[inside, columns] for values in self._blocks[index].tensors()])
        return Seen.of([torch.cat(values) for values in zip(*parts, strict=True)])
