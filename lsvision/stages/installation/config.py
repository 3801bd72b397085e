"""Options of the installation guide."""

from dataclasses import dataclass

from lsvision.schema import Checked, Positive

Point = tuple[float, float, float]
_USUAL_POINTS: dict[str, Point] = {
    "smaller columns": (-200.0, 0.0, 0.0),
    "larger columns": (200.0, 0.0, 0.0),
    "smaller Y": (0.0, -100.0, 0.0),
    "larger Y": (0.0, 100.0, 0.0),
}


@dataclass(frozen=True)
class InstallationConfig(Checked):
    """How well the cameras must be aligned with the motion, and where they are held.

    ``tolerance_deg`` is the largest angle between the motion and the cameras' Y axis. ``mounting_points`` are points of
    the mount by name, (x, y, z) mm along the axes of the scan frame from anywhere: how far each moves is stated. If
    None, they are 200 mm either way along the sensor and 100 mm either way along Y.
    """

    tolerance_deg: Positive = 3.0
    mounting_points: dict[str, Point] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.mounting_points is not None and len(self.mounting_points) < 2:
            raise self.fault("mounting_points", f"expected two points or more, got {len(self.mounting_points)}")

    @property
    def points(self) -> dict[str, Point]:
        """The mounting points, or the usual ones."""
        return self.mounting_points or _USUAL_POINTS
