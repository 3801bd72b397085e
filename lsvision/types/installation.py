"""How to align the cameras with the motion of the object."""

from dataclasses import dataclass
from typing import Literal

from lsvision.types.scan import Transport

InstallationVerdict = Literal["within tolerance", "outside tolerance", "not known"]


@dataclass(frozen=True)
class Turn:
    """A right-handed turn of the cameras about an axis of the scan frame, deg, with its standard deviation.

    Where it was not observed, ``angle_deg`` is what the prior left, and no advice.
    """

    axis: Literal["x", "z"]
    angle_deg: float
    sigma_deg: float
    observed: bool


@dataclass(frozen=True)
class PointShift:
    """By how much a mounting point moves, mm, along the axes of the scan frame, when the cameras are turned."""

    name: str
    position_mm: tuple[float, float, float]
    shift_mm: tuple[float, float, float]


@dataclass(frozen=True)
class LinePitch:
    """The nominal line pitch, mm, None where scans differ in it, and what stretch the object showed under it."""

    nominal_mm: float | None
    stretch: float
    stretch_sigma: float
    observed: bool

    @property
    def true_mm(self) -> float | None:
        """The pitch that the lines have on the object, mm: the one to state for them."""
        return None if self.nominal_mm is None else self.nominal_mm * self.stretch

    @property
    def encoder_ratio(self) -> float:
        """Encoder pulses per line to set, over those that are set now, for lines at the nominal pitch."""
        return 1.0 / self.stretch


@dataclass(frozen=True)
class Installation:
    """What turns the cameras onto the motion, and what was off before.

    ``angle_deg`` is between the motion and the Y axis of the scan frame. The turns are about X first, then about Z,
    each about the axis as it was. ``shifts`` are those of the mounting points by the turns that were observed, about
    their middle.
    """

    angle_deg: float
    sigma_deg: float
    tolerance_deg: float
    about_x: Turn
    about_z: Turn
    shifts: tuple[PointShift, ...]
    pitch: LinePitch
    transport: Transport = "forward"

    @property
    def verdict(self) -> InstallationVerdict:
        """Whether the angle is within the tolerance, with two standard deviations to spare."""
        if self.angle_deg + 2 * self.sigma_deg <= self.tolerance_deg:
            return "within tolerance"
        return "outside tolerance" if self.angle_deg - 2 * self.sigma_deg > self.tolerance_deg else "not known"
