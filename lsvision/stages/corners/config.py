"""Options of the corner search."""

from dataclasses import dataclass

from lsvision.schema import Checked, NonNegative, Positive, PositiveInt


@dataclass(frozen=True)
class CornersConfig(Checked):
    """How corners of a scan are accepted.

    ``max_line_difference`` (lines) rejects a corner that the two cameras place on different lines: on a rectified rig
    both see it at the same moment. Lines by which all corners differ, since the cameras are out of step, do not count.
    ``min_corners`` is the fewest that make a board. ``depth_window_mm`` is the side of
    the patch of a depth map to which a plane is fitted where a scan has no second image.
    """

    max_line_difference: NonNegative = 1.0
    min_corners: PositiveInt = 20
    depth_window_mm: Positive = 24.0
