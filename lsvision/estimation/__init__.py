"""Estimation of Gaussian states: cubature regression, square-root filters, joint update, least squares, information."""

from lsvision.estimation.cubature import cubature_points, sigma_moments, slr
from lsvision.estimation.information import (
    cramer_rao_bound,
    fisher_information,
    marginal_information,
    weighed_directions,
)
from lsvision.estimation.joint import Info, Posterior, Rows, iterated_update, lower_factor, measurement, whitened_rows

__all__ = [
    "Info",
    "Posterior",
    "Rows",
    "cramer_rao_bound",
    "cubature_points",
    "fisher_information",
    "iterated_update",
    "lower_factor",
    "marginal_information",
    "measurement",
    "sigma_moments",
    "slr",
    "weighed_directions",
    "whitened_rows",
]
