"""Scan lines -> profiles: along each line, the surface that every column of a product's grid sees.

q_x and q_z of a sample depend on its own line alone, so this needs no travel, and every line stands for itself.
"""

from dataclasses import dataclass, field

import torch
from torch import Tensor

from lsvision.geometry import product_axes
from lsvision.image.tiling import in_parallel
from lsvision.image.visibility import Seen, Surface, bridge_gaps, see_cells
from lsvision.types import LineImage, Motion, Rig

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


def resolve_profiles(z: Tensor, sigma: Tensor | None, rig: Rig, motion: Motion, rule: ProfileRule) -> Seen:
    """Lines seen at the columns of a product, from their depth ``z (lines, width)``, float32 mm, NaN for none.

    Returns:
        ``place`` is the column of the left image, px; ``height`` is over the plane of zero disparity, mm; what was
        bridged is not ``measured``; ``carried`` holds the standard deviation of the depth, mm, where it is given.
    """
    axes = product_axes(motion.n)
    # Counted from the middle of the range, single precision holds a depth to a hundred-thousandth of a millimetre.
    middle, half = sum(rule.z_range_mm) / 2, (rule.z_range_mm[1] - rule.z_range_mm[0]) / 2
    beyond = z - middle
    measured = beyond.abs() <= half
    if not bool(measured.all()):
        beyond = beyond.masked_fill_(~measured, torch.nan)
        beyond = bridge_gaps(beyond, longest=rule.bridge_px, largest_step=rule.largest_step_mm)
    slope = (torch.arange(z.shape[1], dtype=torch.float64) - rig.principal_left_px) / rig.focal_length_px
    # (x, z) = (slope, 1) z, so that q_x and q_z are multiples of z too.
    cells_per_mm = (slope * axes[0, 0] + axes[0, 2]) / rule.pitch_mm
    q_z_per_mm = slope * axes[2, 0] + axes[2, 2]
    base = middle * cells_per_mm - rule.origin_x_mm / rule.pitch_mm
    surface = Surface(
        whole=base.floor().to(z.dtype),
        part=torch.addcmul((base - base.floor()).to(z.dtype), beyond, cells_per_mm.to(z.dtype)),
        height=torch.addcmul(
            (rig.zero_disparity_mm - middle * q_z_per_mm).to(z.dtype), beyond, -q_z_per_mm.to(z.dtype)
        ),
        carried=() if sigma is None else (sigma,),
        connected=beyond.diff(dim=1).abs_() <= rule.largest_step_mm,  # false beside a hole
        measured=measured[:, 1:] & measured[:, :-1],
    )
    return see_cells(surface, rule.columns, dim=1)


@dataclass
class ProfileReader:
    """The profiles of a scan, by line ranges; blocks that the next range needs again stay in memory.

    Args:
        depth: z of the left image's samples, mm. sigma: its standard deviation, mm, where it is known.
    """

    depth: LineImage
    sigma: LineImage | None
    rig: Rig
    motion: Motion
    rule: ProfileRule
    _blocks: dict[int, Seen] = field(default_factory=dict, init=False, repr=False)

    def load(self, start: int, stop: int) -> None:
        """Resolve the lines ``start..stop-1`` and forget those outside."""
        wanted = range(start // _BLOCK_LINES, -(-stop // _BLOCK_LINES))
        for index in [index for index in self._blocks if index not in wanted]:
            del self._blocks[index]
        missing = [index for index in wanted if index not in self._blocks]
        if not missing:
            return
        first = missing[0] * _BLOCK_LINES
        last = min((missing[-1] + 1) * _BLOCK_LINES, self.depth.shape[0])
        z = self.depth.read(first, last)[..., 0]
        sigma = None if self.sigma is None else self.sigma.read(first, last)[..., 0]

        def resolved(index: int) -> Seen:
            lines = slice(index * _BLOCK_LINES - first, (index + 1) * _BLOCK_LINES - first)
            return resolve_profiles(z[lines], None if sigma is None else sigma[lines], self.rig, self.motion, self.rule)

        self._blocks.update(zip(missing, in_parallel(resolved, missing), strict=True))

    def read(self, lines: tuple[int, int], columns: slice) -> Seen:
        """Profiles of loaded lines ``lines[0]..lines[1]-1`` at a range of columns."""
        start, stop = lines
        blocks = range(start // _BLOCK_LINES, -(-stop // _BLOCK_LINES))
        parts: list[list[Tensor]] = []
        for index in blocks:
            inside = slice(max(start - index * _BLOCK_LINES, 0), stop - index * _BLOCK_LINES)
            parts.append([values[inside, columns] for values in self._blocks[index].tensors()])
        return Seen.of([torch.cat(values) for values in zip(*parts, strict=True)])
