"""A board under a motion n that is known: how well it fits once its own lines are steadied."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.geometry import displace
from lsvision.stages.calibration.calibrate import calibrate
from lsvision.stages.calibration.config import CalibrationConfig
from lsvision.types import BoardCorners, BoardEdges, Calibration, Rig

_KNOWN = 1e-7  # sigma of n, mm per mm


def calibrate_lines(
    corners: BoardCorners, edges: BoardEdges | None, n: Float[Tensor, "3"], rig: Rig, config: CalibrationConfig
) -> Calibration:
    """Pose and motion from line to line of one board, whose motion n is given.

    The scan is taken to where the object would have moved nominally: the result's n is (0, 1, 0), its RMSE and its
    line motion are those of the board under n.
    """
    seen = _moved_nominally(corners, n)
    further: Sequence[BoardEdges | None] = [None if edges is None else _edges_moved_nominally(edges, n)]
    return calibrate([seen], rig, replace(config, method="joint", prior_sigma=_KNOWN, mounting_pitch_deg=None), further)


def _edges_moved_nominally(edges: BoardEdges, n: Tensor) -> BoardEdges:
    """The same of edges; the right camera of a raw pair sees them later by the travel so stretched."""
    later_mm = None if edges.later_mm is None else edges.later_mm * n[1]
    return replace(edges, points=displace(edges.points, n), later_mm=later_mm)


def _moved_nominally(corners: BoardCorners, n: Tensor) -> BoardCorners:
    """Corners as a scan would have measured them, had the object moved by (0, 1, 0): where they lie on it."""
    matrix = torch.eye(3, dtype=n.dtype, device=n.device)
    matrix[:, 1] = n
    return replace(
        corners,
        points=displace(corners.points, n),
        covariance=matrix @ corners.covariance @ matrix.mT,
        travel_mm=None if corners.travel_mm is None else corners.travel_mm * n[1],
    )
