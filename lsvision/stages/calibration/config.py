"""Options of the calibration."""

import math
from dataclasses import dataclass, replace

from lsvision.schema import AcuteAngle, Checked, NonNegative, Positive, PositiveInt, PositiveOrInfinite
from lsvision.types import CalibrationMethod, WhetherLineMotion

# Random walk of n per square root of a mm travelled, where the options leave it open: 2e-5 over a board of 400 mm.
PROCESS_SIGMA: dict[CalibrationMethod, float] = {
    "joint": 0.0,
    "two_step": 0.0,
    "sequential": 1e-6,
    "least_squares": 0.0,
}
_ALL_TOGETHER = ("joint", "least_squares")  # methods that weigh all corners together
_WITHOUT_PITCH = ("two_step", "sequential")  # methods that cannot use a mounting pitch


@dataclass(frozen=True)
class CalibrationConfig(Checked):
    """How the motion is estimated from the corners.

    ``joint`` is the iterated update over all corners of all boards; ``two_step`` alternates poses and n as the paper
    does; ``sequential`` filters corner by corner in line order, so that n may drift along the scans; ``least_squares``
    is the maximum of the posterior by Levenberg-Marquardt, the reference that the filter is compared with. The poses'
    prior lies around the poses that fit best under n = (0, 1, 0); infinite sigmas make it flat, so that no corner
    counts twice. ``two_step`` ends where the RMSE is at most ``two_step_threshold_mm``, or changes by no more than the
    share ``two_step_tolerance`` in an iteration. Errors that are correlated along the scan, as of vibration or of the
    encoder, are allowed for where they make the corners ``correlated_odds`` times as probable. With ``line_motion``
    "auto" they are then part of the result of ``joint`` and ``least_squares``, line by line; with "none" they are
    noise. An option that is None
    takes the value of the method.
    """

    method: CalibrationMethod = "joint"
    prior_sigma: Positive = 0.05  # of each component of n about (0, 1, 0); finite, as few boards determine all of n
    rotation_sigma_rad: PositiveOrInfinite = math.inf
    translation_sigma_mm: PositiveOrInfinite = math.inf
    board_scale_sigma: NonNegative = 0.0  # of the board's relative size, print and temperature; 0 takes it as exact
    max_iterations: PositiveInt = 20
    tolerance: NonNegative = 1e-6  # Kullback-Leibler divergence between two iterates, nats
    two_step_threshold_mm: NonNegative = 0.0  # RMSE at or below which Alg. 1 ends
    two_step_tolerance: NonNegative = 1e-4  # relative change of the RMSE in an iteration at which Alg. 1 ends
    two_step_max_iterations: PositiveInt = 20
    process_sigma: NonNegative | None = None  # of the random walk of n per square root of a mm; sequential only
    depth_range_mm: Positive | None = None  # sharp depth, which proposed boards keep to; None: the rig's usual
    correlated_odds: PositiveOrInfinite = 50.0  # evidence from which errors along the scan are modelled; .inf: never
    line_motion: WhetherLineMotion = "auto"
    mounting_pitch_deg: AcuteAngle | None = None  # known angle of a single board's normal about the sensor axis
    mounting_pitch_sigma_deg: Positive = 0.1

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.mounting_pitch_deg is not None and self.method in _WITHOUT_PITCH:
            raise self.fault(
                "mounting_pitch_deg", f"expected null, as {self.method} cannot use it, got {self.mounting_pitch_deg}"
            )

    @property
    def corrects_lines(self) -> bool:
        """Whether the motion from line to line is part of the result where the boards show one."""
        return self.line_motion == "auto" and self.method in _ALL_TOGETHER

    def resolved(self) -> "CalibrationConfig":
        """The same with the method's own value of every option that is None."""
        if self.process_sigma is not None:
            return self
        return replace(self, process_sigma=PROCESS_SIGMA[self.method])
