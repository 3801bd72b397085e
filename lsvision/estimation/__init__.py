"""Estimation of Gaussian states: cubature regression, square-root filters, joint update, least squares, information."""

from lsvision.estimation.consistency import mean_chi_square_band, nees, nis
from lsvision.estimation.cubature import slr
from lsvision.estimation.derivative import jacobian
from lsvision.estimation.filtering import Track, Update, filter_sequence, predict, update
from lsvision.estimation.information import (
    cramer_rao_bound,
    fisher_information,
    marginal_information,
    weighed_directions,
)
from lsvision.estimation.joint import Info, Posterior, Rows, iterated_update, measurement, whitened_rows
from lsvision.estimation.least_squares import LeastSquares, levenberg_marquardt
from lsvision.estimation.rotation import recentre
from lsvision.estimation.smoothing import smooth
from lsvision.estimation.triangular import apply, lower_factor, solve_upper, upper_root

__all__ = [
    "Info",
    "LeastSquares",
    "Posterior",
    "Rows",
    "Track",
    "Update",
    "apply",
    "cramer_rao_bound",
    "filter_sequence",
    "fisher_information",
    "iterated_update",
    "jacobian",
    "levenberg_marquardt",
    "lower_factor",
    "marginal_information",
    "mean_chi_square_band",
    "measurement",
    "nees",
    "nis",
    "predict",
    "recentre",
    "slr",
    "smooth",
    "solve_upper",
    "update",
    "upper_root",
    "weighed_directions",
    "whitened_rows",
]
