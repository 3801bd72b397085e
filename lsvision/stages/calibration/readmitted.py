"""Corners that were left out though the scan is sound: where a scan shakes, whole lines of corners lie off the others.

Neighbours on a line say so only where a line of corners is one of the scan and no turn displaces it. So where many
corners of a board were left out, none of them far off, they are tried as part of a scan that shook: those stay that lie
where the errors along the scan put them.
"""

from dataclasses import replace

import torch
from jaxtyping import Bool
from torch import Tensor

from lsvision.stages.calibration.config import CalibrationConfig
from lsvision.stages.calibration.measurements import BoardMeasurements
from lsvision.stages.calibration.outliers import little_off, outlying
from lsvision.stages.calibration.solved import Solution, solve

MANY = 0.1
"""Part of a board's corners: where more were left out, the board is doubtful."""


def solve_readmitting(measured: BoardMeasurements, config: CalibrationConfig) -> Solution:
    """The solution of one problem, with the corners of lines that shook."""
    solution = solve(measured, config)
    if not _many(solution.outlying, measured.valid):
        return solution
    unlikely = solution.outlying & ~little_off(measured, solution.outlying)
    if _many(unlikely, measured.valid):
        return solution
    shaken = solve(measured, config, unlikely)
    if not bool(shaken.along_scan.found):
        return solution
    problem = shaken.problem
    moved = torch.where(problem.valid[..., None], shaken.processes(()).displaced(problem.points), 0.0)
    off = unlikely | outlying(replace(problem, points=problem.points - moved))
    if _many(off, measured.valid):
        return solution
    return shaken if torch.equal(off, unlikely) else solve(measured, config, off)


def _many(off: Bool[Tensor, "boards corners"], valid: Bool[Tensor, "boards corners"]) -> bool:
    return bool((off.sum(-1) > MANY * valid.sum(-1)).any())
