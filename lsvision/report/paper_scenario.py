"""Results of one scenario of the paper's experiment, and the paper's own numbers."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor

from lsvision.io import Product
from lsvision.report.calibration_figures import BoardView
from lsvision.simulation.sheet_points import SheetPoints
from lsvision.types import BoardCorners, Calibration, Scan

# Wang et al. 2024, section 5: RMSE before and after, its improvement, iterations and stretch.
PAPER = {"rmse_before_mm": 2.059, "rmse_after_mm": 0.8794, "improvement": 0.573, "iterations": 5, "stretch": 1.0246}

NOMINAL = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)  # motion n
HELD_OUT = "held_out"  # the scan of a board that calibrates nothing


@dataclass(frozen=True)
class Trial:
    """A calibration of simulated scans, the true motion, and the RMSE of a board that it has not seen, mm."""

    result: Calibration
    n_true: Tensor
    held_out_mm: float = math.nan

    def summary(self) -> dict:
        """Plain values for ``summary.json``."""
        result = self.result
        return {
            "rmse_before_mm": result.rmse_before_mm,
            "rmse_after_mm": result.rmse_after_mm,
            "improvement": result.improvement,
            "iterations": len(result.iterations) - 1,
            "rmse_by_iteration_mm": [step.rmse_mm for step in result.iterations],
            "held_out_rmse_mm": self.held_out_mm,
            "stretch": result.motion.stretch,
            "n": result.motion.n.tolist(),
            "n_true": self.n_true.tolist(),
            "sigma": result.motion.sigma.tolist(),
            "verdict": result.verdict,
            "noise_scale": result.noise_scale,
        }


@dataclass(frozen=True)
class BoardCheck:
    """Rms errors of the distances between a board's corners, mm, as scanned and in the product.

    Attributes:
        corners: number of corners found in the product; 0 if it does not show the board.
        neighbours_before_mm, neighbours_after_mm: errors between neighbouring corners.
        pairs_before_mm, pairs_after_mm: errors between all pairs of corners.
        points: corners in the product frame ``(corners, 3)``, mm.
    """

    corners: int
    neighbours_before_mm: float
    pairs_before_mm: float
    neighbours_after_mm: float = math.nan
    pairs_after_mm: float = math.nan
    points: Tensor | None = None


@dataclass(frozen=True)
class SheetCheck:
    """Rms error of points of the sheet in a product, mm, in all, and along X, Y and Z of the sheet.

    ``unsheared_mm`` is that in all but for a shear along the travel. ``not_seen`` names the components of the motion
    from line to line that were not observed.
    """

    points: int
    rms_mm: float
    by_axis_mm: tuple[float, ...]
    not_seen: tuple[str, ...]
    unsheared_mm: float

    @classmethod
    def of(cls, points: SheetPoints, line_motion: Mapping[str, Any]) -> "SheetCheck":
        """That of the points in a product, of whose metadata ``line_motion`` is an entry."""
        error = points.measured_mm - points.true_mm
        found = line_motion.get("components", ())
        not_seen = tuple(each["component"] for each in found if each["state"] == "not observed")
        by_axis = tuple(error.square().mean(0).sqrt().tolist())
        return cls(len(error), points.rms_mm, by_axis, not_seen, points.unsheared_rms_mm)


@dataclass(frozen=True)
class Steadied:
    """A scenario with the motion from line to line taken away: the calibration, boards by name, the sheet by source."""

    trial: Trial
    checks: Mapping[str, BoardCheck]
    sheets: Mapping[str, SheetCheck]

    def summary(self) -> dict:
        """Plain values for ``summary.json``."""
        return {
            "board_distance_rms_mm": {
                name: {"corners": check.corners, "before": check.pairs_before_mm, "after": check.pairs_after_mm}
                for name, check in self.checks.items()
            },
            "sheet": {source: asdict(check) for source, check in self.sheets.items()},
        }


@dataclass(frozen=True)
class Scenario:
    """Everything that one scenario produced, by name of the scan or of the method.

    ``held_out_before_mm`` is the RMSE of the board that was held out under the nominal motion.
    """

    trials: Mapping[str, Trial]
    held_out_before_mm: float
    boards: Mapping[str, BoardCorners]
    checks: Mapping[str, BoardCheck]
    sheet_before: SheetPoints
    sheet_after: SheetPoints
    scans: Mapping[str, Scan]
    products: Mapping[str, Product]
    steadied: Steadied | None = None

    def summary(self) -> dict:
        """Plain values for ``summary.json``."""
        methods = {method: trial.summary() for method, trial in self.trials.items()}
        products = {
            "board_distance_rms_mm": {
                name: {"corners": check.corners, "before": check.pairs_before_mm, "after": check.pairs_after_mm}
                for name, check in self.checks.items()
            },
            "sheet_rms_mm": {"before": self.sheet_before.rms_mm, "after": self.sheet_after.rms_mm},
            "sheet_shift_px": {
                "rms": float(self.sheet_after.shift_px.square().mean().sqrt()),
                "max": float(self.sheet_after.shift_px.max()),
                "points": len(self.sheet_after.shift_px),
            },
        }
        steadied = {} if self.steadied is None else {"with_line_motion": self.steadied.summary()}
        return {**methods, "held_out_rmse_before_mm": self.held_out_before_mm, "products": products, **steadied}

    def image(self, name: str) -> Tensor:
        """The whole left image of a scan."""
        scan = self.scans[name]
        return scan.left.read(0, scan.lines)

    def scanned_board(self, name: str) -> BoardView:
        """A board's scan with the corners found in it."""
        return BoardView(self.image(name), self.boards[name].left_px)

    def corrected_board(self, name: str) -> BoardView:
        """A board's product with the corners found in it."""
        product, points = self.products[name], self.checks[name].points
        color = product.color(0, product.shape[0])
        if points is None:
            return BoardView(color, torch.empty(0, 2))
        origin_y, origin_x = product.origin_mm
        return BoardView(color, (points[:, :2] - torch.tensor([origin_x, origin_y])) / product.pitch_mm)
