"""The look that all figures share."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

# Okabe & Ito's palette: told apart in print and by colour-blind readers.
COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
BEFORE, AFTER, TRUTH = "#d55e00", "#0072b2", "#555555"


def new_figure(
    width: float, height: float, rows: int = 1, columns: int = 1, **layout: Any
) -> tuple[Figure, list[Axes]]:
    """A figure of a size in inches and its axes, row by row."""
    figure = Figure(figsize=(width, height), layout="constrained")
    axes = np.atleast_1d(np.asarray(figure.subplots(rows, columns, **layout))).ravel().tolist()
    return figure, axes


def label_axes(axes: Axes, title: str, x: str, y: str) -> None:
    """Title, axes with units, a light grid."""
    axes.set_title(title, fontsize=11)
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.grid(alpha=0.25, linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)


def show_image(axes: Axes, image: Tensor, extent: tuple[float, float, float, float], **options: Any) -> Any:
    """Draw an image ``(rows, columns[, 3])`` over (left, right, bottom, top), first row on top."""
    values = image.numpy()
    if values.ndim == 3 and values.shape[-1] == 1:
        values, options = values[..., 0], {"cmap": "gray", **options}
    if values.dtype == np.uint16:
        values = (values >> 8).astype(np.uint8)
    return axes.imshow(values, extent=extent, interpolation="antialiased", **options)


def thinned(image: Tensor, most: int = 1200) -> Tensor:
    """Every k-th row and column, so that no side exceeds ``most`` px: a preview."""
    step = max(1, -(-max(image.shape[:2]) // most))
    return image[::step, ::step]
