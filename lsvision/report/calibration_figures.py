"""Figures of a calibration: convergence, residuals, observed directions."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from lsvision.geometry import displace, fit_rigid
from lsvision.report.drawing import (
    AFTER,
    BEFORE,
    COLORS,
    TRUTH,
    label_axes,
    new_figure,
    show_image,
    thinned,
    whole_ticks,
)
from lsvision.report.pages import ReportFigure
from lsvision.types import BoardCorners, Calibration

_NOMINAL = (0.0, 1.0, 0.0)


@dataclass(frozen=True)
class BoardView:
    """An image of a board, ``(rows, columns, channels)``, and the positions of its corners, ``(corners, 2)`` px."""

    image: Tensor
    corners_px: Tensor


def rmse_by_iteration(curves: Mapping[str, Calibration], references: Mapping[str, float] | None = None) -> ReportFigure:
    """RMSE of the corners after every iteration, for one or more calibrations by name."""
    figure, (axes,) = new_figure(7.5, 4.2)
    for color, (name, calibration) in zip(COLORS, curves.items(), strict=False):
        values = [step.rmse_mm for step in calibration.iterations]
        axes.semilogy(range(len(values)), values, "o-", ms=4, color=color, label=name)
    for name, value in (references or {}).items():
        axes.axhline(value, color=TRUTH, linestyle=":", linewidth=1, label=f"{name}: {value:.3g} mm")
    label_axes(axes, "Error by iteration", "iteration (0: nominal motion)", "RMSE of the corners [mm]")
    whole_ticks(axes)
    figure.legend(loc="outside right upper", fontsize=9)
    caption = (
        "Root-mean-square distance between measured and true corners. The joint estimate is down at its floor after a "
        "few iterations; a method that alternates between pose and motion leaves about a third of the error in each, "
        "but for that of n3, which several boards show: it falls far more slowly."
    )
    return ReportFigure("rmse_by_iteration", "RMSE by iteration", caption, figure)


def components_by_iteration(
    curves: Mapping[str, Calibration], truth: Mapping[str, Sequence[float]] | None = None
) -> ReportFigure:
    """Components n1, n2, n3 after every iteration, with the truth as a dashed line if it is known."""
    figure, axes = new_figure(9.5, 3.6, 1, 3)
    for index, panel in enumerate(axes):
        for color, (name, calibration) in zip(COLORS, curves.items(), strict=False):
            values = [step.n[index] for step in calibration.iterations]
            panel.plot(range(len(values)), values, "o-", ms=3.5, color=color, label=name if index == 0 else None)
        for value in {n[index] for n in (truth or {}).values()}:
            panel.axhline(value, color=TRUTH, linestyle="--", linewidth=1, label="truth" if index == 0 else None)
        label_axes(panel, f"n{index + 1}", "iteration", f"n{index + 1} [mm per mm]")
        whole_ticks(panel)
    figure.legend(loc="outside lower center", ncols=3, fontsize=9)
    caption = (
        "True displacement of the object per nominal millimetre of travel: sideways (n1), along (n2), in depth (n3). A "
        "curve that is still moving at its right end has not converged."
    )
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
    whole_ticks(axes)
    figure.legend(loc="outside right upper", fontsize=9)
    caption = "Length of n: how far the object really moves per millimetre that the pitch or the encoder reports."
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
        "Measured corners in the frame of the board, in the pose that fits best, errors enlarged. With the nominal "
        "motion the board is sheared and stretched; with the calibrated motion it is square."
    )
    title = "Corners and their true positions" + (f", {label}" if label else "")
    return ReportFigure(name, title, caption, figure)


def corners_on_images(before: BoardView, after: BoardView, pitch_mm: float) -> ReportFigure:
    """The board with its corners marked, as scanned and as corrected; a pixel is ``pitch_mm`` wide."""
    figure, axes = new_figure(10.5, 4.8, 1, 2)
    for panel, name, view, color in ((axes[0], "as scanned", before, BEFORE), (axes[1], "corrected", after, AFTER)):
        length, width = view.image.shape[0] * pitch_mm, view.image.shape[1] * pitch_mm
        show_image(panel, thinned(view.image), (0, width, length, 0))
        panel.plot(*(view.corners_px * pitch_mm).T, "o", mfc="none", mec=color, ms=5, mew=1)
        label_axes(panel, name, "across the motion [mm]", "along the motion [mm]")
        panel.grid(False)
    caption = (
        "A pixel is drawn as one nominal pitch. As scanned, rows and columns of corners meet at a skew angle, after "
        "the correction at a right angle."
    )
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
    label_axes(axes, calibration.verdict, "σ of n along the direction [mm per mm]", "direction of n")
    axes.barh([0], [0], color=AFTER, label="posterior, observed")
    axes.barh([0], [0], color=BEFORE, label="posterior, as wide as the prior")
    figure.legend(loc="outside lower center", ncols=3, fontsize=9)
    caption = "Where the coloured bar is as long as the grey one, the boards did not measure that direction of n. " + (
        calibration.observability.advice or "Here they measured all."
    )
    title = "What the boards measured" + (f", {label}" if label else "")
    return ReportFigure(name, title, caption, figure)


def corners_in_board_frame(corners: BoardCorners, n: Tensor) -> Tensor:
    """Measured corners, mm, in the board's frame under a motion n, at the pose that fits them best."""
    points = displace(corners.points, n)
    pose = fit_rigid(corners.board_points, points, corners.valid)
    return (points - pose.translation) @ pose.rotation
