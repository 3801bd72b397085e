"""Figures in three dimensions: corners of the boards, the corrected surface."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D
from torch import Tensor

from lsvision.geometry import displace, transform
from lsvision.report.drawing import COLORS, thinned
from lsvision.report.pages import ReportFigure
from lsvision.types import BoardCorners, Calibration

# Sides of a drawn surface in cells: finer ones are smaller than a pixel of the figure.
_SURFACE_CELLS = 48


def corners_in_space(boards: Sequence[BoardCorners], calibration: Calibration) -> ReportFigure:
    """Measured corners of all boards where the calibrated motion puts them, and the boards that were fitted to them."""
    figure, axes = _new_space()
    for index, (board, fit) in enumerate(zip(boards, calibration.boards, strict=True)):
        color = COLORS[index % len(COLORS)]
        measured = displace(board.points[board.valid], calibration.motion.n).numpy()
        axes.scatter(*_upright(measured), s=9, color=color, depthshade=False, label=Path(board.scan).name)
        fitted = transform(fit.rotation, fit.translation_mm, board.board_points).numpy()
        axes.plot_trisurf(*_upright(fitted), color=color, alpha=0.25, linewidth=0)
    _label(axes, "Corners and fitted boards", "X across [mm]", "Y along [mm]", "towards the cameras, -Z [mm]")
    figure.legend(loc="outside lower center", ncols=4, fontsize=8)
    caption = (
        "Turn it with the slider or by dragging. Each board's corners lie on its plane; boards that cross at an angle "
        "are what makes the motion known. Heights are stretched to fill the box."
    )
    return ReportFigure("corners_in_space", "The boards in space", caption, figure)


def surface_in_space(name: str, height: Tensor, pitch_mm: float, origin_mm: tuple[float, float]) -> ReportFigure:
    """The corrected surface, or a part of it.

    Args:
        height: ``(rows, columns)`` mm, NaN where not measured.
        origin_mm: (q_y, q_x) of the first cell.
    """
    figure, axes = _new_space()
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
        figure.colorbar(picture, ax=axes, label="height over zero disparity [mm]", shrink=0.6, pad=0.1)
    _label(axes, "Corrected surface", "q_x across [mm]", "q_y along [mm]", "height [mm]")
    caption = (
        "Turn it with the slider or by dragging. The surface as it is after the correction, thinned, heights stretched "
        "to fill the box: what was bent along the motion is straight. Gaps were not measured."
    )
    return ReportFigure(name, "The corrected surface in space", caption, figure)


def _new_space() -> tuple[Figure, Axes3D]:
    figure = Figure(figsize=(7.2, 5.4), layout="constrained")
    return figure, figure.add_subplot(projection="3d", azim=-60.0, elev=24.0)


def _upright(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """X, Y and the height towards the cameras, which look along Z."""
    return points[:, 0], points[:, 1], -points[:, 2]


def _label(axes: Axes3D, title: str, x: str, y: str, z: str) -> None:
    axes.set_title(title, fontsize=11)
    axes.set_xlabel(x, fontsize=9)
    axes.set_ylabel(y, fontsize=9)
    axes.set_zlabel(z, fontsize=9)
    axes.tick_params(labelsize=8)
