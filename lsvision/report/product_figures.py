"""Figures of a product: colour and height, a cross-section, the points of a printed sheet."""

from dataclasses import dataclass

import torch
from matplotlib.collections import LineCollection
from torch import Tensor

from lsvision.report.drawing import AFTER, BEFORE, TRUTH, label_axes, new_figure, show_image, thinned
from lsvision.report.pages import ReportFigure


@dataclass(frozen=True)
class SheetView:
    """An image of a printed sheet, and points of the sheet on the artwork and as measured, ``(points, 2)`` mm each."""

    image: Tensor
    true_mm: Tensor
    measured_mm: Tensor


def product_images(
    name: str, title: str, color: Tensor, height: Tensor, pitch_mm: float, origin_mm: tuple[float, float]
) -> ReportFigure:
    """Colour and height of a product, or of its beginning, in mm of the product frame.

    Args:
        color: ``(rows, columns, channels)``.
        height: ``(rows, columns)`` mm, NaN where not measured.
        origin_mm: (q_y, q_x) of the first cell.
    """
    rows, columns = height.shape
    q_y, q_x = origin_mm
    left, top = q_x - pitch_mm / 2, q_y - pitch_mm / 2  # the origin is the centre of the first cell
    extent = (left, left + columns * pitch_mm, top + rows * pitch_mm, top)
    figure, axes = new_figure(11, 0.9 + 5.0 * min(max(rows / columns, 0.35), 1.4), 1, 2, sharex=True, sharey=True)
    show_image(axes[0], thinned(color), extent)
    label_axes(axes[0], "colour", "q_x across the motion [mm]", "q_y along the motion [mm]")
    preview = thinned(height)
    known = preview[torch.isfinite(preview)]
    low, high = (known.quantile(q) for q in (0.01, 0.99)) if known.numel() else (torch.tensor(0.0), torch.tensor(1.0))
    picture = show_image(axes[1], preview, extent, cmap="viridis", vmin=float(low), vmax=float(high))
    label_axes(axes[1], "height", "q_x across the motion [mm]", "")
    figure.colorbar(picture, ax=axes[1], label="height [mm]", shrink=0.8)
    for panel in axes:
        panel.grid(False)
    caption = (
        "Orthographic colour and height in square cells. Height is zero at the middle of the plane of zero disparity "
        "and grows towards the cameras; white cells were not measured."
    )
    return ReportFigure(name, title, caption, figure)


def height_profile(name: str, title: str, height: Tensor, pitch_mm: float, origin_x_mm: float) -> ReportFigure:
    """Cross-section of an object that is the same all along the motion: median and 10..90 % of the rows."""
    figure, (axes,) = new_figure(8.5, 3.6)
    q_x = origin_x_mm + pitch_mm * torch.arange(height.shape[1])
    low, middle, high = (height.nanquantile(q, dim=0) for q in (0.1, 0.5, 0.9))
    axes.fill_between(q_x, low, high, color=AFTER, alpha=0.25, linewidth=0, label="10..90 % of the rows")
    axes.plot(q_x, middle, color=AFTER, linewidth=1.2, label="median")
    label_axes(axes, title, "q_x across the motion [mm]", "height [mm]")
    figure.legend(loc="outside lower center", ncols=2, fontsize=9)
    caption = (
        "Median height of every column over all rows, with the band that holds 80 % of the rows: the profile that all "
        "rows share. The band is wide where the rows differ."
    )
    return ReportFigure(name, title, caption, figure)


def sheet_correspondences(before: SheetView, after: SheetView, pitch_mm: float, magnified: float = 5.0) -> ReportFigure:
    """The sheet as scanned and as corrected, and the errors of its points, enlarged.

    Args:
        before, after: the scan and the product; the measured points in the sheet's frame.
        pitch_mm: side of a pixel.
        magnified: factor on the errors drawn.
    """
    figure, axes = new_figure(10.5, 8.6, 2, 2)
    for column, (name, view, color) in enumerate((("before", before, BEFORE), ("after", after, AFTER))):
        image, true_mm = view.image, view.true_mm
        show_image(axes[column], thinned(image), (0, image.shape[1] * pitch_mm, image.shape[0] * pitch_mm, 0))
        label_axes(axes[column], f"sheet {name}", "across the motion [mm]", "along the motion [mm]")
        axes[column].grid(False)
        panel = axes[2 + column]
        error = view.measured_mm - true_mm
        drawn = true_mm + magnified * error
        panel.plot(*true_mm.T, "+", color=TRUTH, ms=5, label="artwork" if column == 0 else None)
        lines = torch.stack([true_mm, drawn], dim=1).numpy()
        panel.add_collection(LineCollection(list(lines), colors=color, linewidths=0.8))
        panel.plot(*drawn.T, ".", color=color, ms=4, label=f"measured {name}, error x {magnified:g}")
        rms = float(error.square().sum(-1).mean().sqrt())
        label_axes(panel, f"in the plane: rms {rms:.3f} mm", "sheet X [mm]", "sheet Y [mm]")
        panel.set_aspect("equal")
        panel.invert_yaxis()
    figure.legend(loc="outside lower center", ncols=3, fontsize=9)
    caption = (
        "Above, the images. Below, points of the sheet found in them, in the pose that fits best; lines from their "
        "places on the artwork show the errors, enlarged."
    )
    return ReportFigure("sheet_correspondences", "The sheet before and after", caption, figure)
