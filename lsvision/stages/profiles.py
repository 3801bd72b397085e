"""Scan lines -> profiles: along each line, the surface that every column of a product's grid sees.

q_x and q_z of a sample depend on its own line alone, so this needs no travel, and every line stands for itself.
"""

from collections import OrderedDict
from dataclasses import dataclass, field

import torch
from torch import Tensor

from lsvision.geometry import product_axes
from lsvision.image.tiling import in_parallel
from lsvision.image.visibility import both_ends, bridge_gaps, interpolate_segments, visible_segments
from lsvision.types import LineImage, Motion, Rig

_BLOCK_LINES = 16  # few enough that all of a block's intermediate values stay in the processor's cache


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


@dataclass(frozen=True)
class Profiles:
    """Lines seen at the columns of a product, each ``(lines, columns)``.

    ``column`` of the left image, px, and ``q_z``, mm, are float64 and NaN where nothing is seen; ``measured`` is false
    where the depth was bridged; ``sigma`` is the standard deviation of the depth, mm, where the scan has it.
    """

    column: Tensor
    q_z: Tensor
    measured: Tensor
    sigma: Tensor | None


def resolve_profiles(z: Tensor, sigma: Tensor | None, rig: Rig, motion: Motion, rule: ProfileRule) -> Profiles:
    """Profiles of lines from their depth ``z (lines, width)``, mm, NaN for none."""
    axes = product_axes(motion.n)
    z = z.to(torch.float64)
    measured = (z >= rule.z_range_mm[0]) & (z <= rule.z_range_mm[1])
    if not bool(measured.all()):
        z = bridge_gaps(torch.where(measured, z, torch.nan), longest=rule.bridge_px, largest_step=rule.largest_step_mm)
    slope = (torch.arange(z.shape[1], dtype=torch.float64) - rig.principal_left_px) / rig.focal_length_px
    # (x, z) = (slope, 1) z, so that q_x and q_z are multiples of z too.
    position = z * ((slope * axes[0, 0] + axes[0, 2]) / rule.pitch_mm) - rule.origin_x_mm / rule.pitch_mm
    q_z = z * (slope * axes[2, 0] + axes[2, 2])
    connected = z.diff(dim=1).abs() <= rule.largest_step_mm  # false beside a hole
    segment, fraction = visible_segments(position, q_z, connected, rule.columns)
    return Profiles(
        column=segment + fraction,
        q_z=interpolate_segments(q_z, segment, fraction),
        measured=both_ends(measured, segment),
        sigma=None if sigma is None else interpolate_segments(sigma, segment, fraction),
    )


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
    _blocks: OrderedDict[int, Profiles] = field(default_factory=OrderedDict, init=False, repr=False)

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

        def resolved(index: int) -> Profiles:
            lines = slice(index * _BLOCK_LINES - first, (index + 1) * _BLOCK_LINES - first)
            return resolve_profiles(z[lines], None if sigma is None else sigma[lines], self.rig, self.motion, self.rule)

        self._blocks.update(zip(missing, in_parallel(resolved, missing), strict=True))

    def read(self, lines: tuple[int, int], columns: slice) -> Profiles:
        """Profiles of loaded lines ``lines[0]..lines[1]-1`` at a range of columns."""
        start, stop = lines
        blocks = range(start // _BLOCK_LINES, -(-stop // _BLOCK_LINES))
        inside = slice(start - blocks[0] * _BLOCK_LINES, stop - blocks[0] * _BLOCK_LINES)

        def joined(name: str) -> Tensor:
            return torch.cat([getattr(self._blocks[index], name)[:, columns] for index in blocks])[inside]

        sigma = None if self.sigma is None else joined("sigma")
        return Profiles(joined("column"), joined("q_z"), joined("measured"), sigma)
