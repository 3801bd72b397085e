"""Options of measuring the response."""

from dataclasses import dataclass

from lsvision.schema import Checked, IntFrom2, Positive, PositiveInt


@dataclass(frozen=True)
class ResponseConfig(Checked):
    """How the response of the cameras is measured on references.

    Of each scan at most ``most_lines`` are read, in ``blocks`` of consecutive lines spread over it; one of fewer than
    ``least_lines`` is refused. A gain whose relative standard deviation, by how much the blocks differ, exceeds
    ``largest_sigma`` in most columns is refused, too.
    """

    most_lines: PositiveInt = 1024
    least_lines: PositiveInt = 64
    blocks: IntFrom2 = 8
    largest_sigma: Positive = 0.005
