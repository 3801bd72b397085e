"""Figures of a product: its colour and heights, a profile, correspondences with a printed sheet."""

import torch
from matplotlib.collections import LineCollection
from torch import Tensor

from lsvision.report.drawing import AFTER, BEFORE, TRUTH, label_axes, new_figure, show_image, thinned
from lsvision.report.pages import ReportFigure


def product_images(
    name: str, title: str, color: Tensor, height: Tensor, pitch_mm: float, origin_mm: tuple[float, float]
) -> ReportFigure:
    """Colour and height of a product, or of a part of it, in mm of the product frame.

    Args:
        color: ``(rows, columns, channels)``. height: ``(rows, columns)`` mm, NaN where not measured.
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
    figure.colorbar(picture, ax=axes[1], label="height over zero disparity [mm]", shrink=0.8)
    for panel in axes:
        panel.grid(False)
    caption = "Orthographic colour and height, square cells. White: not measured."
    return ReportFigure(name, title, caption, figure)


def height_profile(name: str, title: str, height: Tensor, pitch_mm: float, origin_x_mm: float) -> ReportFigure:
    """Median cross-section of a product that is constant along the motion, with the spread of its rows."""
    figure, (axes,) = new_figure(8.5, 3.6)
    q_x = origin_x_mm + pitch_mm * torch.arange(height.shape[1])
    low, middle, high = (height.nanquantile(q, dim=0) for q in (0.1, 0.5, 0.9))
    axes.fill_between(q_x, low, high, color=AFTER, alpha=0.25, linewidth=0, label="10..90 % of the rows")
    axes.plot(q_x, middle, color=AFTER, linewidth=1.2, label="median")
    label_axes(axes, title, "q_x across the motion [mm]", "height over zero disparity [mm]")
    figure.legend(loc="outside lower center", ncols=2, fontsize=9)
    caption = "Heights of all rows over each other: what repeats along the rail is its profile."
    return ReportFigure(name, title, caption, figure)


def sheet_correspondences(
    before: tuple[Tensor, Tensor],
    after: tuple[Tensor, Tensor],
    images: tuple[Tensor, Tensor],
    pitch_mm: float,
    magnified: float = 5.0,
) -> ReportFigure:
    """The sheet as scanned and corrected, and where its points came to lie against the artwork.

    Args:
        before, after: points on the artwork and as measured, ``(points, 2)`` each, mm in the sheet's frame.
        images: the scan's image and the product's.
        pitch_mm: side of a pixel.
    """
    figure, axes = new_figure(10.5, 8.6, 2, 2)
    cases = (("before", before, images[0], BEFORE), ("after", after, images[1], AFTER))
    for column, (name, (true_mm, measured_mm), image, color) in enumerate(cases):
        show_image(axes[column], thinned(image), (0, image.shape[1] * pitch_mm, image.shape[0] * pitch_mm, 0))
        label_axes(axes[column], f"sheet {name}", "across the motion [mm]", "along the motion [mm]")
        axes[column].grid(False)
        panel = axes[2 + column]
        error = measured_mm - true_mm
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
    caption = "Points of the printed sheet found in the image, at the best pose, against where they are on the artwork."
    return ReportFigure("sheet_correspondences", "The sheet before and after", caption, figure)
