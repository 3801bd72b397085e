"""Figures of a calibration: convergence, residuals, what was observed."""

from collections.abc import Mapping, Sequence

import torch
from matplotlib.ticker import MaxNLocator
from torch import Tensor

from lsvision.geometry import displace, fit_rigid
from lsvision.report.drawing import AFTER, BEFORE, COLORS, TRUTH, label_axes, new_figure, show_image, thinned
from lsvision.report.pages import ReportFigure
from lsvision.types import BoardCorners, Calibration

_NOMINAL = (0.0, 1.0, 0.0)


def rmse_by_iteration(curves: Mapping[str, Calibration], references: Mapping[str, float] | None = None) -> ReportFigure:
    """RMSE of the corners after every iteration, for one or more calibrations by name."""
    figure, (axes,) = new_figure(7.5, 4.2)
    for color, (name, calibration) in zip(COLORS, curves.items(), strict=False):
        values = [step.rmse_mm for step in calibration.iterations]
        axes.semilogy(range(len(values)), values, "o-", ms=4, color=color, label=name)
    for name, value in (references or {}).items():
        axes.axhline(value, color=TRUTH, linestyle=":", linewidth=1, label=f"{name}: {value:.3g} mm")
    label_axes(axes, "Error by iteration", "iteration (0: nominal motion)", "RMSE of the corners [mm]")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    figure.legend(loc="outside right upper", fontsize=9)
    caption = (
        "Root-mean-square distance between measured and true corners. The joint estimate reaches its floor at once; "
        "alternating between pose and motion removes a constant share each time."
    )
    return ReportFigure("rmse_by_iteration", "RMSE by iteration", caption, figure)


def components_by_iteration(
    curves: Mapping[str, Calibration], truth: Mapping[str, Sequence[float]] | None = None
) -> ReportFigure:
    """Components n1, n2, n3 after every iteration; dashed lines show the truth where it is known."""
    figure, axes = new_figure(9.5, 3.6, 1, 3)
    for index, panel in enumerate(axes):
        for color, (name, calibration) in zip(COLORS, curves.items(), strict=False):
            values = [step.n[index] for step in calibration.iterations]
            panel.plot(range(len(values)), values, "o-", ms=3.5, color=color, label=name if index == 0 else None)
        for value in {n[index] for n in (truth or {}).values()}:
            panel.axhline(value, color=TRUTH, linestyle="--", linewidth=1, label="truth" if index == 0 else None)
        label_axes(panel, f"n{index + 1}", "iteration", f"n{index + 1} [mm per mm]")
        panel.xaxis.set_major_locator(MaxNLocator(integer=True))
    figure.legend(loc="outside lower center", ncols=3, fontsize=9)
    caption = "The displacement of the object per nominal millimetre: sideways, along and in depth."
    return ReportFigure("components_by_iteration", "Components of the motion by iteration", caption, figure)


def stretch_by_iteration(curves: Mapping[str, Calibration], truth: float | None = None) -> ReportFigure:
    """Length of n after every iteration."""
    figure, (axes,) = new_figure(7.5, 3.8)
    for color, (name, calibration) in zip(COLORS, curves.items(), strict=False):
        values = [step.stretch for step in calibration.iterations]
        axes.plot(range(len(values)), values, "o-", ms=4, color=color, label=name)
    if truth is not None:
        axes.axhline(truth, color=TRUTH, linestyle="--", linewidth=1, label=f"truth: {truth:.4f}")
    label_axes(axes, "Stretch by iteration", "iteration", "stretch, true over nominal travel [mm per mm]")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    figure.legend(loc="outside right upper", fontsize=9)
    caption = "How much further the object moved per line than the encoder or the nominal pitch says."
    return ReportFigure("stretch_by_iteration", "Stretch by iteration", caption, figure)


def corner_positions(
    corners: BoardCorners,
    calibration: Calibration,
    *,
    name: str = "corner_positions",
    label: str = "",
    magnified: float = 10.0,
) -> ReportFigure:
    """Corners of one board in its own frame, before and after, with their errors magnified."""
    figure, axes = new_figure(10.5, 4.4, 1, 2, sharey=True)
    true = corners.board_points[:, :2]
    for panel, when, n, color in (
        (axes[0], "before", torch.tensor(_NOMINAL, dtype=torch.float64), BEFORE),
        (axes[1], "after", calibration.motion.n, AFTER),
    ):
        seen = corners_in_board_frame(corners, n)
        error = seen - corners.board_points
        drawn = true + magnified * error[:, :2]
        panel.plot(*true.T, "+", color=TRUTH, ms=7, label="true" if when == "before" else None)
        panel.plot(*drawn.T, ".", color=color, ms=4, label=f"measured {when}, error x {magnified:g}")
        panel.plot(*torch.stack([true, drawn], -1).permute(1, 2, 0), color=color, linewidth=0.7)
        rms = float(error[corners.valid].square().sum(-1).mean().sqrt())
        label_axes(panel, f"{when}: rms {rms:.4f} mm", "board X [mm]", "board Y [mm]" if when == "before" else "")
        panel.set_aspect("equal")
    axes[0].invert_yaxis()
    figure.legend(loc="outside lower center", ncols=3, fontsize=9)
    caption = (
        "Measured corners in the frame of the board, best pose for each motion: with the nominal motion the board is "
        "sheared and stretched, with the calibrated one it is square."
    )
    title = "Corners against their true positions" + (f", {label}" if label else "")
    return ReportFigure(name, title, caption, figure)


def corners_on_images(before: tuple[Tensor, Tensor], after: tuple[Tensor, Tensor], pitch_mm: float) -> ReportFigure:
    """The board's image with its corner points, as scanned and as corrected; each as (image, corners px)."""
    figure, axes = new_figure(10.5, 4.8, 1, 2)
    for panel, name, (image, corners), color in (
        (axes[0], "as scanned", before, BEFORE),
        (axes[1], "corrected", after, AFTER),
    ):
        lines, width = image.shape[0] * pitch_mm, image.shape[1] * pitch_mm
        show_image(panel, thinned(image), (0, width, lines, 0))
        panel.plot(*(corners * pitch_mm).T, "o", mfc="none", mec=color, ms=5, mew=1)
        label_axes(panel, name, "across the motion [mm]", "along the motion [mm]")
        panel.grid(False)
    caption = "One pixel is drawn as one nominal pitch. The angle between the rows and columns of corners turns square."
    return ReportFigure("corners_on_images", "Image and corners before and after", caption, figure)


def observability_bars(calibration: Calibration, *, name: str = "observability", label: str = "") -> ReportFigure:
    """Prior and posterior sigma along each direction of n."""
    figure, (axes,) = new_figure(7.5, 3.4)
    directions = calibration.observability.directions
    height = 0.36
    for row, direction in enumerate(directions):
        color = AFTER if direction.observed else BEFORE
        axes.barh(row - height / 2, direction.prior_sigma, height, color="#bbbbbb", label="prior" if row == 0 else None)
        axes.barh(row + height / 2, direction.posterior_sigma, height, color=color)
    names = ["(" + ", ".join(f"{value:+.2f}" for value in direction.vector) + ")" for direction in directions]
    axes.set_yticks(range(len(directions)), names)
    axes.set_xscale("log")
    axes.invert_yaxis()
    label_axes(axes, calibration.observability.verdict, "σ of n along the direction [mm per mm]", "direction of n")
    axes.barh([0], [0], color=AFTER, label="posterior, observed")
    axes.barh([0], [0], color=BEFORE, label="posterior, repeats the prior")
    figure.legend(loc="outside lower center", ncols=3, fontsize=9)
    caption = "A direction whose σ hardly shrinks was not measured: " + (
        calibration.observability.advice or "here all were."
    )
    title = "What the boards could tell" + (f", {label}" if label else "")
    return ReportFigure(name, title, caption, figure)


def corners_in_board_frame(corners: BoardCorners, n: Tensor) -> Tensor:
    """Measured corners, mm, in the board's frame under a motion n, at the pose that fits them best."""
    points = displace(corners.points, n)
    rotation, translation = fit_rigid(corners.board_points, points, corners.valid)
    return (points - translation) @ rotation
