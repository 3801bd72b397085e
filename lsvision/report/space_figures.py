"""Figures in three dimensions: the corners of the boards, the corrected surface."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from lsvision.geometry import displace, transform
from lsvision.report.drawing import COLORS, label_space, new_space, thinned
from lsvision.report.pages import ReportFigure
from lsvision.types import BoardCorners, Calibration

# Longest side of a drawn surface, in cells: smaller cells would be smaller than a pixel of the figure.
_SURFACE_CELLS = 48


def corners_in_space(boards: Sequence[BoardCorners], calibration: Calibration) -> ReportFigure:
    """Measured corners of all boards under the calibrated motion, and the boards that were fitted to them."""
    figure, axes = new_space()
    for index, (board, fit) in enumerate(zip(boards, calibration.boards, strict=True)):
        color = COLORS[index % len(COLORS)]
        measured = displace(board.points[board.valid], calibration.motion.n).numpy()
        axes.scatter(*_upright(measured).T, s=9, color=color, depthshade=False, label=Path(board.scan).name)
        fitted = transform(fit.pose.rotation, fit.pose.translation, board.board_points).numpy()
        axes.plot_trisurf(*_upright(fitted).T, color=color, alpha=0.25, linewidth=0)
    label_space(axes, "Corners and fitted boards", "X across [mm]", "Y along [mm]", "towards the cameras, -Z [mm]")
    figure.legend(loc="outside lower center", ncols=4, fontsize=8)
    caption = (
        "Turn the view with the slider or by dragging. The corners of each board lie on its plane. Boards whose planes "
        "cross at an angle determine the motion. Heights are stretched to fill the box."
    )
    return ReportFigure("corners_in_space", "The boards in space", caption, figure)


def surface_in_space(name: str, height: Tensor, pitch_mm: float, origin_mm: tuple[float, float]) -> ReportFigure:
    """The corrected surface, or its beginning.

    Args:
        height: ``(rows, columns)`` mm, NaN where not measured.
        origin_mm: (q_y, q_x) of the first cell.
    """
    figure, axes = new_space()
    preview = thinned(height, most=_SURFACE_CELLS)
    step = -(-max(height.shape) // _SURFACE_CELLS) * pitch_mm
    q_y, q_x = (origin + step * torch.arange(count) for origin, count in zip(origin_mm, preview.shape, strict=True))
    across, along = torch.meshgrid(q_x, q_y, indexing="xy")
    known = torch.isfinite(preview)
    if bool(known.any()):
        values = np.ma.masked_invalid(preview.numpy())
        low, high = float(preview[known].quantile(0.01)), float(preview[known].quantile(0.99))
        picture = axes.plot_surface(
            across.numpy(), along.numpy(), values, cmap="viridis", vmin=low, vmax=high,
            rcount=_SURFACE_CELLS, ccount=_SURFACE_CELLS, linewidth=0,
        )  # fmt: skip
        figure.colorbar(picture, ax=axes, label="height [mm]", shrink=0.6, pad=0.1)
    label_space(axes, "Corrected surface", "q_x across [mm]", "q_y along [mm]", "height [mm]")
    caption = (
        "Turn the view with the slider or by dragging. The surface after the correction, one cell in many: lines that "
        "the motion had bent are straight. Gaps were not measured. Heights are stretched to fill the box."
    )
    return ReportFigure(name, "The corrected surface in space", caption, figure)


def _upright(points: np.ndarray) -> np.ndarray:
    """Points (X, Y, height), with the height counted towards the cameras, which look along Z."""
    return points * [1.0, 1.0, -1.0]
