"""Options of the calibration of a raw rig."""

from dataclasses import dataclass

from lsvision.schema import Checked, NonNegative, Positive, PositiveInt, PositiveOrInfinite


@dataclass(frozen=True)
class RigSigmas(Checked):
    """Standard deviations of a rig about its data sheet, where its file states none.

    ``focal_length_share`` and ``baseline_share`` are of the focal lengths and the baseline, ``distortion_sigma`` of k1
    and k2, ``plane_sigma_mm`` and ``plane_slope_sigma`` of the right camera's plane. ``motion_sigma`` is that of each
    component of n about (0, 1, 0).
    """

    focal_length_share: Positive = 0.01
    principal_sigma_px: Positive = 5.0
    turn_sigma_deg: Positive = 0.5
    distortion_sigma: Positive = 0.05
    baseline_share: Positive = 0.003
    plane_sigma_mm: Positive = 1.0
    plane_slope_sigma: Positive = 0.01
    motion_sigma: Positive = 0.05


@dataclass(frozen=True)
class RigConfig(RigSigmas):
    """How a raw rig is estimated from scans of boards.

    The rig of the data sheet is the prior, with the standard deviations of its file where it states them and those of
    ``RigSigmas`` elsewhere. A corner further off than ``outlier_sigma`` of its standard deviations, as they turn out,
    is left out. A combination of quantities counts as observed where its sigma is at most ``observed_share`` of the
    prior's, and matters where it alone bends the heights of the field by ``least_height_um`` (rms) or more.
    Errors that all corners of a line share, as of an object that shakes, are allowed for where they make the corners
    ``correlated_odds`` times as probable; infinite: never.
    """

    outlier_sigma: Positive = 5.0
    max_iterations: PositiveInt = 30
    tolerance: Positive = 0.01  # length of the last step, in sigmas; forward derivatives are good to about 1e-4 of them
    observed_share: Positive = 0.5
    least_height_um: NonNegative = 1.0
    depth_range_mm: Positive = (
        52.0  # in which the cameras see sharp: heights matter there, and proposed boards stay in it
    )
    correlated_odds: PositiveOrInfinite = 50.0
    held_out: bool = True  # whether each board is also predicted by the rig of the others; with three boards or more
