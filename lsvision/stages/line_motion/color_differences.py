"""Motion between the moments at which two colours saw the same piece of the object: δ(later) - δ(earlier).

Each colour shows where its lines are displaced (``color_registration``). Where both show the same piece of the object,
the difference is free of the object's shape: corrugation, bow and what a profile differs by from its reference cancel.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.stages.line_motion.color_pair import ColorPair, at_rows
from lsvision.stages.line_motion.color_registration import register_color
from lsvision.stages.line_motion.config import LineMotionConfig
from lsvision.stages.line_motion.profiles import LineSamples, Reference
from lsvision.stages.line_motion.register import Registered
from lsvision.types import DepthSource

_READ_LINES, _AT_ONCE = 1024, 256  # lines


@dataclass(frozen=True)
class ColorDifferences:
    """Displacement of the object on line ``later`` less that on line ``earlier``, for every line of green.

    Attributes:
        values: (δx, δz, ρ); NaN where one of the colours shows none.
        errors: half the difference between what two halves of the columns give: no motion is in it.
        later, earlier: (fractional) lines on which the two colours saw what green saw on each line.
    """

    values: Float[Tensor, "lines 3"]
    errors: Float[Tensor, "lines 3"]
    later: Float[Tensor, " lines"]
    earlier: Float[Tensor, " lines"]

    @property
    def lag(self) -> float:
        """Lines between the two, on average."""
        return float((self.later - self.earlier).mean())

    @property
    def ahead(self) -> float:
        """Lines by which the middle of the two lies behind that of green, on average."""
        middle = (self.later + self.earlier) / 2
        return float((middle - torch.arange(len(middle))).mean())


def measure_color_differences(
    pair: ColorPair,
    depth: DepthSource,
    lines: Registered,
    shown: tuple[Reference, slice],
    config: LineMotionConfig,
) -> ColorDifferences:
    """Differences of all lines of a scan, block by block.

    Args:
        lines: all lines of the scan, as registered.
        shown: the reference profile, and the columns that show it.
    """
    reference, columns = shown
    whole, count = slice(columns.start, columns.stop), len(lines.values)
    colors: list[list[Registered]] = [[], []]
    for start in range(0, count, _READ_LINES):
        block = depth.read(start, min(start + _READ_LINES, count))
        samples = LineSamples.of(block, pair.frame, config.height_range_mm, whole)
        for part in samples.split(_AT_ONCE):
            values = lines.values[start : start + len(part.z)]
            for parts, channel, slope in zip(colors, pair.channels, pair.plane_slopes, strict=True):
                seen = replace(part, plane_slope=slope)
                parts.append(register_color(pair, channel, start, seen, values, (reference, config.cut_sigma)))
            start += len(part.z)
    least = config.min_share * lines.samples.double().median()
    one, other = (
        at_rows(_measured(Registered.joined(parts), least), row) for parts, row in zip(colors, pair.rows(), strict=True)
    )
    (values, error), (later, earlier) = (one - other).unbind(1), pair.taken()
    return ColorDifferences(values, error / 2, later, earlier)


def _measured(rows: Registered, least: Tensor) -> Float[Tensor, "rows 2 3"]:
    """Displacement of rows and the difference that their halves make; NaN where too few columns took part."""
    both = torch.stack([rows.values, rows.difference], 1)
    return torch.where((rows.samples >= least)[:, None, None], both, torch.nan)
