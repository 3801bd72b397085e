"""All lines of a scan, registered to a reference profile a few at a time."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from lsvision.geometry import ProductFrame, depth_step_mm
from lsvision.stages.line_motion.config import LineMotionConfig
from lsvision.stages.line_motion.errors import ErrorSums, LineErrors
from lsvision.stages.line_motion.profiles import LineSamples, Reference
from lsvision.stages.line_motion.register import Registered, equations_of, register
from lsvision.types import DepthSource

_READ_LINES, _AT_ONCE = 1024, 256  # read and registered at once
_SUMMED_READS = 8  # whose residuals say how large the errors are


@dataclass(frozen=True)
class RegisteredScan:
    """The lines of a scan, and how large their errors are."""

    lines: Registered
    errors: LineErrors


def register_scan(
    frame: ProductFrame,
    depth: DepthSource,
    reference: Reference,
    columns: slice,
    config: LineMotionConfig,
    dx_mm: Float[Tensor, " lines"] | None = None,
) -> RegisteredScan:
    """Register the lines of a scan; their errors follow from what is left of them at places all over the scan.

    Args:
        columns: that show the reference.
        dx_mm: displacement sideways to start from, which stays where the reference does not show it; zero if None.
    """
    starts = range(0, depth.lines, _READ_LINES)
    summed = {i * (len(starts) - 1) // (_SUMMED_READS - 1) for i in range(_SUMMED_READS)}
    lines, sums = Registered.nothing(depth.lines), []
    for number, start in enumerate(starts):
        block = depth.read(start, min(start + _READ_LINES, depth.lines))
        samples = LineSamples.of(block, frame, config.height_range_mm, columns)
        for part in samples.split(_AT_ONCE):
            values = part.z.new_zeros(len(part.z), 3)
            if dx_mm is not None:
                values[:, 0] = dx_mm[start : start + len(part.z)]
            found = register(part, values, reference, frame, config)
            lines.put(start, found)
            start += len(part.z)
            if number in summed:
                equations = equations_of(part, found.values, reference, frame)
                sums.append(ErrorSums.of(equations, config.cut_sigma))
    return RegisteredScan(lines, LineErrors.of(ErrorSums.total(sums), depth_step_mm(frame.rig, config.common_error_px)))
