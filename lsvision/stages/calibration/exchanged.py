"""Whether the left and right images of the boards' scans were exchanged.

Exchanged, every disparity has the other sign: depth is mirrored at the plane of zero disparity, and x moves by the
disparity. No motion makes that a board, but exchanging the images back does.
"""

from collections.abc import Sequence
from dataclasses import replace

import torch

from lsvision.geometry import triangulate
from lsvision.stages.calibration.config import CalibrationConfig
from lsvision.stages.calibration.joint import joint
from lsvision.stages.calibration.measurements import BoardMeasurements, SoundProblem
from lsvision.stages.calibration.model import rmse
from lsvision.types import BoardCorners, Rig

_FAR_BETTER = 0.5  # of the RMSE


def images_exchanged(boards: Sequence[BoardCorners], rig: Rig, config: CalibrationConfig, rmse_mm: float) -> list[str]:
    """The contradiction that the boards fit far better with left and right images exchanged, or nothing.

    Args:
        rmse_mm: of the calibration as the images are.
    """
    if any(board.right_px is None for board in boards):
        return []
    posed = SoundProblem.of(BoardMeasurements.of([_exchanged(board, rig) for board in boards]), None)
    posterior = joint(posed.problem, posed.start, replace(config, method="joint").resolved())
    other_mm = float(rmse(posed.problem, posterior.mean))
    if not (bool(posed.sound) and other_mm < _FAR_BETTER * rmse_mm):
        return []
    return [
        f"the left and right images look exchanged: the RMSE is {rmse_mm:.4g} mm, and {other_mm:.4g} mm with each in "
        "the other's place"
    ]


def _exchanged(board: BoardCorners, rig: Rig) -> BoardCorners:
    """The corners as they are measured with the images in each other's place."""
    right_px = board.left_px if board.right_px is None else board.right_px
    x, z = triangulate(rig, right_px[:, 0], right_px[:, 0] - board.left_px[:, 0])
    return replace(board, points=torch.stack([x, board.points[:, 1].to(x), z], dim=-1))
