"""Options of the corner search."""

from dataclasses import dataclass


@dataclass(frozen=True)
class CornersConfig:
    """How corners of a scan are accepted.

    ``max_line_difference`` (lines) rejects a corner that the two cameras place on different lines: on a rectified rig
    both see it at the same moment. ``min_corners`` is the fewest that make a board. ``depth_window_mm`` is the side of
    the patch of a depth map to which a plane is fitted where a scan has no second image.
    """

    max_line_difference: float = 1.0
    min_corners: int = 20
    depth_window_mm: float = 24.0
