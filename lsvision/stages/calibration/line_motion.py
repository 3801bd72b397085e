"""The motion from line to line of each board scan, from its posterior given all corners of all boards.

It is published as ``LineMotion`` describes it: displaced by (δx, 0, δz) and rolled about c, travel beyond the nominal
by δy. The mean over the scan belongs to the board's pose. What is linear along a scan is shared with n: one scan alone
cannot separate them, several can, as they share n. So the values keep the trend by which a scan departs from n,
without which its board would stay sheared, and the covariance is that of what is not linear: n's covers the rest.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.geometry import middle_point
from lsvision.stages.calibration.along_scan import COMPONENTS, Processes
from lsvision.types import LINE_COMPONENTS, LineComponent, LineFinding, LineMotion, Rig

_LINES_AT_ONCE = 4096
_OBSERVED = 0.7  # share of a component's size that its sigma on the lines of the board may be
_FAINT = 0.01  # of the largest component: less may be what the corners err by together
_UNSEEN = "the rows of corners are too far apart: turn the board by 20 to 45 deg in its plane; known no"
_COMPONENT: dict[LineComponent, int] = {
    "dx": COMPONENTS.index("x"),
    "dz": COMPONENTS.index("z"),
    "roll": COMPONENTS.index("roll"),
    "dy": COMPONENTS.index("travel"),
}


@dataclass(frozen=True)
class FoundProcesses:
    """The processes of a problem's scans, and what was found of each component: rms, length, evidence.

    The tensors are in the order of ``along_scan.COMPONENTS``. A component counts where it makes the corners ``odds``
    times as probable.
    """

    processes: Processes
    rms_mm: Float[Tensor, "4"]
    length_mm: Float[Tensor, "4"]
    log_ratio: Float[Tensor, "4"]
    odds: float

    @property
    def present(self) -> list[bool]:
        """Which components, in the order of ``LINE_COMPONENTS``, the data give evidence for."""
        evident = (self.log_ratio > math.log(self.odds)) & (self.rms_mm > _FAINT * self.rms_mm.max())
        return [bool(evident[_COMPONENT[name]]) for name in LINE_COMPONENTS]

    def usual(self, name: LineComponent) -> float:
        """How large a component is in all scans together, rms, mm or rad."""
        size = self.rms_mm[_COMPONENT[name]]
        return float(size / self.processes.lever.rms_mm if name == "roll" else size)


def line_motions(found: FoundProcesses, travels_mm: Sequence[Float[Tensor, " _"]], rig: Rig) -> tuple[LineMotion, ...]:
    """The motion of each scan, given the travel of its lines."""
    return tuple(_line_motion(found, board, travel, rig) for board, travel in enumerate(travels_mm))


def _line_motion(found: FoundProcesses, board: int, travel_mm: Float[Tensor, " lines"], rig: Rig) -> LineMotion:
    to_motion = _to_motion(found.processes, board, rig)
    parts = [_at_lines(found.processes, board, to_motion, travel_mm, lines) for lines in _pieces(len(travel_mm))]
    values, covariance = (torch.cat(part) for part in zip(*parts, strict=True))
    on_board = _on_board(found.processes, board, travel_mm)
    findings = _findings(found, board, values, covariance, on_board)
    kept = torch.tensor([finding.state == "corrected" for finding in findings])
    return LineMotion(values * kept, covariance * kept[:, None] * kept, findings)


def _pieces(lines: int) -> list[slice]:
    return [slice(start, min(start + _LINES_AT_ONCE, lines)) for start in range(0, lines, _LINES_AT_ONCE)]


def _at_lines(
    processes: Processes, board: int, to_motion: Tensor, travel_mm: Tensor, lines: slice
) -> tuple[Tensor, Tensor]:
    """Values and covariance, ``(lines, 4)`` and ``(lines, 4, 4)``, of some lines of a scan."""
    level, trend = _gauge(processes, board, travel_mm)
    weights = processes.weights(board, travel_mm[lines])
    values = ((weights - level) @ processes.mean[board].mT) @ to_motion.mT
    shape = weights - level - (travel_mm[lines] - travel_mm.mean())[:, None] * trend
    by_component = shape @ processes.factor[board]  # (4, lines, columns)
    rows = torch.einsum("ij,jlc->lic", to_motion, by_component)
    return values, rows @ rows.mT


def _gauge(processes: Processes, board: int, travel_mm: Tensor) -> tuple[Tensor, Tensor]:
    """Weights of the knots, ``(knots,)`` each, in the mean over all lines and in the trend per mm."""
    centred = travel_mm - travel_mm.mean()
    level, trend = 0.0 * centred[0], 0.0 * centred[0]
    for lines in _pieces(len(travel_mm)):
        weights = processes.weights(board, travel_mm[lines])
        level, trend = level + weights.sum(0), trend + centred[lines] @ weights
    return level / len(travel_mm), trend / centred.square().sum().clamp(min=1e-12)


def _to_motion(processes: Processes, board: int, rig: Rig) -> Float[Tensor, "4 4"]:
    """What takes the components of a board's processes, mm, to (δx, δz, ρ, δy).

    Their roll is about the middle of the board's corners, in mm at the rms lever; a turn about c is the same and a
    displacement. A line that is displaced along the travel was scanned so much later.
    """
    pivot, middle, unit = middle_point(rig), processes.lever.middle[board], 1.0 / processes.lever.rms_mm
    matrix = middle.new_zeros(4, 4)
    x, travel, z, roll = (COMPONENTS.index(name) for name in ("x", "travel", "z", "roll"))
    matrix[0, x] = matrix[1, z] = 1.0
    matrix[0, roll], matrix[1, roll] = (pivot[2] - middle[2]) * unit, (middle[0] - pivot[0]) * unit
    matrix[2, roll], matrix[3, travel] = unit, -1.0
    return matrix


def _on_board(processes: Processes, board: int, travel_mm: Tensor) -> Tensor:
    """The lines that show the board's corners."""
    start = processes.travel.start_mm[board]
    return (travel_mm >= start) & (travel_mm <= start + processes.travel.extent_mm)


def _findings(
    found: FoundProcesses, board: int, values: Tensor, covariance: Tensor, on_board: Tensor
) -> tuple[LineFinding, ...]:
    """What the corners of a scan say of each component."""
    rms = values.square().mean(0).sqrt()
    sigma = covariance[on_board].diagonal(dim1=-2, dim2=-1).mean(0).sqrt()
    findings = []
    for index, (name, present) in enumerate(zip(LINE_COMPONENTS, found.present, strict=True)):
        component = _COMPONENT[name]
        evidence, length = float(found.log_ratio[component]), float(found.length_mm[component])
        size, known, usual = float(rms[index]), float(sigma[index]), found.usual(name)
        if not present:
            findings.append(LineFinding(name, "absent", sigma=known, evidence=evidence))
        elif known > _OBSERVED * usual:
            findings.append(LineFinding(name, "not observed", sigma=known, evidence=evidence, reason=_UNSEEN))
        else:
            findings.append(LineFinding(name, "corrected", size, known, length, evidence))
    return tuple(findings)
