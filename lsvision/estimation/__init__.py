"""Estimation of Gaussian states: cubature regression, square-root filters, joint update, least squares, information.

The calibration uses ``iterated_update``, ``filter_sequence``, ``levenberg_marquardt``, ``slr`` and the information of a
posterior; the motion from line to line uses ``fit_signals`` and ``smooth_signals``, and with them ``matern``; to
separate it from the object's shape, ``fit_shares`` and ``smooth_shares``, and with them ``oscillation`` and ``smooth``;
an archive's health, ``changes``.
The rest is library API for other models, which the package itself does not call: ``measurement`` and ``whitened_rows``
for the joint update, ``predict`` and ``update`` for filters, ``filter_signals`` in square-root form, ``recentre`` for
rotations in a state, ``nis``, ``fisher_information`` and ``marginal_information`` for checks. ``linalg`` holds the
matrix functions that all of them use, and the rule on bits.
"""

from lsvision.estimation.bordered import (
    BorderedFit,
    BorderedState,
    block_rows,
    bordered_least_squares,
    shared_information,
)
from lsvision.estimation.consistency import chi_square_tail, mean_chi_square_band, nees, nis
from lsvision.estimation.control_chart import Change, ChangeRule, ControlChart, changes, control_chart
from lsvision.estimation.cubature import AffineModel, slr
from lsvision.estimation.derivative import jacobian
from lsvision.estimation.filtering import StateSpace, Track, Update, filter_sequence, predict, update
from lsvision.estimation.gaussian import NORMAL_OVER_MAD, Gaussian, Prior
from lsvision.estimation.information import (
    Directions,
    cramer_rao_bound,
    fisher_information,
    marginal_information,
    principal_directions,
)
from lsvision.estimation.joint import Info, Linearise, Posterior, Rows, iterated_update, measurement, whitened_rows
from lsvision.estimation.least_squares import LeastSquares, levenberg_marquardt
from lsvision.estimation.linalg import apply, lower_factor, product, solve_upper, upper_root
from lsvision.estimation.rotation import recentre
from lsvision.estimation.shared_parts import Part
from lsvision.estimation.shared_signal import SharedModel, SharedSignal, smooth_shares
from lsvision.estimation.shared_waves import SharedFit, fit_shares
from lsvision.estimation.signal_fit import SignalFit, SignalParameters, fit_signals, log_likelihood
from lsvision.estimation.signals import NoisyValues, SignalModel, filter_signals, smooth_signals
from lsvision.estimation.smoothing import smooth
from lsvision.estimation.state_space_process import Process, matern, oscillation

__all__ = [
    "NORMAL_OVER_MAD",
    "AffineModel",
    "BorderedFit",
    "BorderedState",
    "Change",
    "ChangeRule",
    "ControlChart",
    "Directions",
    "Gaussian",
    "Info",
    "LeastSquares",
    "Linearise",
    "NoisyValues",
    "Part",
    "Posterior",
    "Prior",
    "Process",
    "Rows",
    "SharedFit",
    "SharedModel",
    "SharedSignal",
    "SignalFit",
    "SignalModel",
    "SignalParameters",
    "StateSpace",
    "Track",
    "Update",
    "apply",
    "block_rows",
    "bordered_least_squares",
    "changes",
    "chi_square_tail",
    "control_chart",
    "cramer_rao_bound",
    "filter_sequence",
    "filter_signals",
    "fisher_information",
    "fit_shares",
    "fit_signals",
    "iterated_update",
    "jacobian",
    "levenberg_marquardt",
    "log_likelihood",
    "lower_factor",
    "marginal_information",
    "matern",
    "mean_chi_square_band",
    "measurement",
    "nees",
    "nis",
    "oscillation",
    "predict",
    "principal_directions",
    "product",
    "recentre",
    "shared_information",
    "slr",
    "smooth",
    "smooth_shares",
    "smooth_signals",
    "solve_upper",
    "update",
    "upper_root",
    "whitened_rows",
]
