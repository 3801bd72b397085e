"""Scan lines -> profiles: along each line, the surface that every column of a product's grid sees.

q_x and q_z of a sample depend on its own line alone, so this needs no travel, and every line stands for itself.
"""

from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.geometry import ProductFrame, slope_at, zero_disparity_mm
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


def resolve_profiles(depth: Depth, frame: ProductFrame, rule: ProfileRule, first_line: int = 0) -> Seen:
    """What the columns of a product see on some lines.

    Args:
        first_line: line of the scan that the depth begins with.

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
    part = torch.addcmul((cell - cell.floor()).to(z.dtype), beyond, cells_per_mm.to(z.dtype))
    height = torch.addcmul(relief.to(z.dtype), beyond, -q_z_per_mm.to(z.dtype))
    if frame.line_motion is not None:
        _displace(part, height, beyond, _LineShift.of(frame, rule, first_line, len(z)), middle)
    surface = Surface(
        whole=cell.floor().to(z.dtype),
        part=part,
        height=height,
        carried=() if depth.sigma is None else (depth.sigma,),
        connected=beyond.diff(dim=1).abs_() <= rule.largest_step_mm,  # false beside a hole
        measured=measured[:, 1:] & measured[:, :-1],
    )
    return see_cells(surface, rule.columns, dim=1)


@dataclass(frozen=True)
class _LineShift:
    """What line motion adds to (cell, relief): z (slope by_slope + by_depth) + offset, for each line, float64."""

    slope: Float[Tensor, " columns"]
    by_slope: Float[Tensor, "lines 2"]
    by_depth: Float[Tensor, "lines 2"]
    offset: Float[Tensor, "lines 2"]

    @classmethod
    def of(cls, frame: ProductFrame, rule: ProfileRule, first_line: int, lines: int) -> "_LineShift":
        """That of consecutive lines of a frame."""
        axes = frame.line_axes(torch.arange(first_line, first_line + lines).double())
        unit = axes.origin.new_tensor([1 / rule.pitch_mm, -1.0])  # cells, and a relief that falls with q_z
        across, ahead = (
            turned[:, ::2] - still
            for turned, still in zip((axes.across, axes.ahead), (frame.axes[::2, 0], frame.axes[::2, 2]), strict=True)
        )
        slope = slope_at(frame.rig, torch.arange(frame.rig.width_px).double())
        return cls(slope, across * unit, ahead * unit, axes.origin[:, ::2] * unit)


def _displace(part: Tensor, height: Tensor, beyond: Tensor, shift: _LineShift, middle: float) -> None:
    """Add the line motion to cells and reliefs of samples at depths middle + beyond, mm; in place."""
    slope = shift.slope.to(part.dtype)
    for index, values in enumerate((part, height)):
        # What the roll adds at the middle depth is summed in double precision and is small after that.
        level = (middle * shift.by_depth + shift.offset)[:, index, None].to(part.dtype)
        tilt, gain = (middle * shift.by_slope)[:, index, None].to(part.dtype), shift.by_depth[:, index, None]
        values.add_(torch.addcmul(level, tilt, slope))
        turned = torch.addcmul(gain.to(part.dtype), shift.by_slope[:, index, None].to(part.dtype), slope)
        values.addcmul_(beyond, turned)


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
                Depth(depth.z[lines], None if sigma is None else sigma[lines]),
                self.frame,
                self.rule,
                index * _BLOCK_LINES,
            )

        self._blocks.update(zip(missing, in_parallel(resolve_block, missing), strict=True))

    def read(self, start: int, stop: int, columns: slice) -> Seen:
        """Profiles of the loaded lines ``start..stop-1`` at a range of columns."""
        parts: list[list[Tensor]] = []
        for index in range(start // _BLOCK_LINES, -(-stop // _BLOCK_LINES)):
            inside = slice(max(start - index * _BLOCK_LINES, 0), stop - index * _BLOCK_LINES)
            parts.append([values[inside, columns] for values in self._blocks[index].tensors()])
        return Seen.of([torch.cat(values) for values in zip(*parts, strict=True)])
