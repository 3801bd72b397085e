"""The look that all figures share: sizes, colours, labels, scales, previews."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d import Axes3D
from torch import Tensor

# Okabe & Ito's palette: its colours stay distinct for colour-blind readers and in print.
COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
BEFORE, AFTER, TRUTH = "#d55e00", "#0072b2", "#555555"


def new_figure(
    width: float, height: float, rows: int = 1, columns: int = 1, **layout: Any
) -> tuple[Figure, list[Axes]]:
    """A figure of the given size, inches, and its axes, row by row."""
    figure = Figure(figsize=(width, height), layout="constrained")
    axes = np.atleast_1d(np.asarray(figure.subplots(rows, columns, **layout))).ravel().tolist()
    return figure, axes


def new_space() -> tuple[Figure, Axes3D]:
    """A figure of one set of axes in three dimensions, seen obliquely from above."""
    figure = Figure(figsize=(7.2, 5.4), layout="constrained")
    return figure, figure.add_subplot(projection="3d", azim=-60.0, elev=24.0)


def label_axes(axes: Axes, title: str, x: str, y: str) -> None:
    """Set the title and the labels, which end in a unit, and draw a light grid."""
    axes.set_title(title, fontsize=11)
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.grid(alpha=0.25, linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)


def label_space(axes: Axes3D, title: str, x: str, y: str, z: str) -> None:
    """Set the title and the labels, which end in a unit, of axes in three dimensions."""
    axes.set_title(title, fontsize=11)
    axes.set_xlabel(x, fontsize=9)
    axes.set_ylabel(y, fontsize=9)
    axes.set_zlabel(z, fontsize=9)
    axes.tick_params(labelsize=8)


def whole_ticks(axes: Axes) -> None:
    """Put the ticks of X at whole numbers: it counts iterations, points or jobs."""
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))


def scale_to_values(axes: Axes, values: np.ndarray) -> None:
    """Make X logarithmic if the values span decades, with whole ticks if they are counts."""
    low, high = values.min(), values.max()
    if low > 0 and high / low > 20:
        axes.set_xscale("log")
    elif values.dtype.kind == "i":
        whole_ticks(axes)


def show_a_decade(axes: Axes) -> None:
    """Widen a logarithmic Y to a decade at least: differences that are only noise stay small."""
    low, high = axes.get_ylim()
    if high / low < 10:
        middle = (low * high) ** 0.5
        axes.set_ylim(middle / 10**0.5, middle * 10**0.5)


def show_image(axes: Axes, image: Tensor, extent: tuple[float, float, float, float], **options: Any) -> Any:
    """Draw an image ``(rows, columns[, 1 or 3])`` over (left, right, bottom, top), the first row on top."""
    values = image.numpy()
    if values.ndim == 3 and values.shape[-1] == 1:
        values, options = values[..., 0], {"cmap": "gray", **options}
    if values.dtype == np.uint16:
        values = (values >> 8).astype(np.uint8)
    return axes.imshow(values, extent=extent, interpolation="antialiased", **options)


def thinned(image: Tensor, most: int = 1200) -> Tensor:
    """A preview: every k-th row and column of an image, so that no side exceeds ``most`` px."""
    step = max(1, -(-max(image.shape[:2]) // most))
    return image[::step, ::step]
