"""Options of the calibration."""

import math
from dataclasses import dataclass

from lsvision.types import CalibrationMethod


@dataclass(frozen=True)
class CalibrationConfig:
    """How the motion is estimated from the corners.

    ``joint`` is the iterated update over all corners of all boards; ``two_step`` alternates poses and n as the paper
    does; ``sequential`` filters corner by corner in line order; ``least_squares`` is the maximum of the posterior by
    Levenberg-Marquardt. The poses' prior lies around the poses that fit best under n = (0, 1, 0); infinite sigmas make
    it flat, so that no corner counts twice.
    """

    method: CalibrationMethod = "joint"
    prior_sigma: float = 0.05  # of each component of n about (0, 1, 0)
    rotation_sigma_rad: float = math.inf
    translation_sigma_mm: float = math.inf
    max_iterations: int = 20
    tolerance: float = 1e-6  # Kullback-Leibler divergence between two iterates, nats
    two_step_threshold_mm: float = 0.05  # RMSE below which Alg. 1 ends
    two_step_max_iterations: int = 20
    process_sigma: float = 0.0  # of the random walk of n per square root of a mm travelled; sequential only
    mounting_pitch_deg: float | None = None  # known angle of a single board's normal about the sensor axis
    mounting_pitch_sigma_deg: float = 0.1
