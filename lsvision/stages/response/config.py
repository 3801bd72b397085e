"""Options of measuring the response."""

from dataclasses import dataclass

from lsvision.schema import Checked, IntFrom2, Positive, PositiveInt


@dataclass(frozen=True)
class ResponseConfig(Checked):
    """How the response of the cameras is measured on references.

    Of each scan at most ``most_lines`` are read, in ``blocks`` of consecutive lines spread over it; one of fewer than
    ``least_lines`` is refused. A gain whose relative standard deviation, by how much the blocks differ, exceeds
    ``largest_sigma`` in most columns is refused, too.

    Scans of an archive are used whose object wanders sideways by ``least_wander_px`` (rms) or more within
    ``segment_mm`` of its travel, over which its pattern across the travel counts as one. Gains that all of them leave
    unknown by more than ``archive_sigma`` in most columns are refused.
    """

    most_lines: PositiveInt = 1024
    least_lines: PositiveInt = 64
    blocks: IntFrom2 = 8
    largest_sigma: Positive = 0.005
    least_wander_px: Positive = 1.5
    segment_mm: Positive = 110.0
    archive_sigma: Positive = 0.01
