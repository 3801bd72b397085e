"""Figures of a study: accuracy over the varied conditions, convergence, consistency, and the best tilts."""

from dataclasses import dataclass

import numpy as np
import polars
from matplotlib.colors import LogNorm
from torch import Tensor

from lsvision.report.drawing import (
    AFTER,
    BEFORE,
    COLORS,
    TRUTH,
    label_axes,
    new_figure,
    scale_to_values,
    show_a_decade,
    whole_ticks,
)
from lsvision.report.pages import ReportFigure
from lsvision.report.study_curves import curves_by, omitted_curves

# Labels of the axes, by column.
AXIS_LABELS = {
    "angle_x_deg": "installation angle sideways [deg]",
    "angle_z_deg": "installation angle in depth [deg]",
    "stretch": "stretch, true over nominal travel [mm per mm]",
    "corner_sigma_mm": "noise of the corners across the line and along [mm]",
    "depth_sigma_mm": "noise of the corners' depth [mm]",
    "vibration_mm": "vibration, rms [mm]",
    "vibration_wavelength_mm": "wavelength of the vibration [mm]",
    "encoder_mm": "error of the encoder, rms [mm]",
    "encoder_wavelength_mm": "wavelength of the encoder's error [mm]",
    "prior_sigma": "σ of the prior on n [mm per mm]",
    "iterations": "most iterations allowed [count]",
    "board_count": "boards scanned [count]",
    "tilt_spread_deg": "largest angle between two boards [deg]",
}
_COMPONENTS = ("n1, sideways", "n2, along", "n3, in depth")
_FEW_STEPS = 8  # iterations over which the contraction of a slow method is averaged
_SHARES = (0.002, 0.005, 0.01, 0.02, 0.05, 0.5)  # contours of the map, in shares of the prior's sigma


@dataclass(frozen=True)
class TiltMap:
    """Bound on σ of the least known direction of n, from a flat board and a tilted one.

    ``sigma`` is ``(pitches, rolls)`` of the tilted board, at ``tilts_deg`` on both axes.
    """

    tilts_deg: Tensor
    sigma: Tensor
    prior_sigma: float


def accuracy(points: polars.DataFrame, axis: str, others: tuple[str, ...]) -> ReportFigure:
    """RMS error of each component of n over one condition, with a curve for each combination of the others."""
    figure, axes = new_figure(10.5, 4.4, 1, 3)
    for curve in curves_by(points, others):
        own = curve.points.sort(axis)
        repeated = own[axis].is_duplicated().any()
        for k, panel in enumerate(axes):
            name = curve.label if k == 0 else None
            line, dashed = ("", "_") if repeated else ("-", "--")
            panel.plot(own[axis], own[f"rms_n{k + 1}"], curve.marker, ls=line, ms=4, color=curve.color, label=name)
            panel.plot(own[axis], own[f"bound_n{k + 1}"], dashed, color=curve.color, linewidth=1, ms=11)
    for k, panel in enumerate(axes):
        panel.set_yscale("log")
        label_axes(panel, _COMPONENTS[k], AXIS_LABELS[axis], "error of n [mm per mm]" if k == 0 else "")
        panel.xaxis.label.set_fontsize(8)
        panel.set_ylabel("rms error [mm per mm]" if k == 0 else "")
        scale_to_values(panel, points[axis].to_numpy())
        show_a_decade(panel)
    axes[0].plot([], [], "--", color=TRUTH, linewidth=1, label="Cramér-Rao bound")
    figure.legend(loc="outside lower center", ncols=3, fontsize=8)
    caption = (
        "Root-mean-square error over all calibrations of a point, and the smallest error that an unbiased estimate can "
        "have (dashed, or a bar). Where both agree, only better corners or other boards help. Where the error is "
        "larger, the corners are disturbed beyond the noise that the bound knows of, or it stopped too early."
    )
    return ReportFigure(
        f"accuracy_{axis}",
        f"Accuracy over {AXIS_LABELS[axis].split(' [')[0]}",
        caption + omitted_curves(points, others),
        figure,
    )


def placings(points: polars.DataFrame) -> ReportFigure:
    """RMS error of each component of n for every set of boards, and the prior's sigma."""
    best = points.group_by("boards", maintain_order=True).first()
    figure, axes = new_figure(10.5, 1.7 + 0.32 * len(best), 1, 3, sharey=True)
    rows = range(len(best))
    colors = [BEFORE if share > 0.5 else AFTER for share in best["prior_dominated"]]
    for k, panel in enumerate(axes):
        panel.barh(rows, best[f"rms_n{k + 1}"], 0.7, color=colors)
        panel.plot(best[f"bound_n{k + 1}"], rows, "|", color="black", ms=11, label="bound" if k == 0 else None)
        panel.axvline(best["prior_sigma"][0], color=TRUTH, ls=":", label="σ of the prior" if k == 0 else None)
        panel.set_xscale("log")
        label_axes(panel, _COMPONENTS[k], "rms error [mm per mm]", "set of boards" if k == 0 else "")
    axes[0].set_yticks(rows, best["boards"])
    axes[0].invert_yaxis()
    axes[0].barh([0], [0], color=AFTER, label="determined")
    axes[0].barh([0], [0], color=BEFORE, label="prior-dominated")
    figure.legend(loc="outside lower center", ncols=4, fontsize=9)
    caption = (
        "The same number of calibrations for every set of boards. A set with orange bars does not measure one "
        "direction of n, which stays at the prior. Repeats of the same boards do not help; another tilt does."
    )
    return ReportFigure("placings", "Which boards to scan", caption, figure)


def convergence(iterations: polars.DataFrame, points: polars.DataFrame, others: tuple[str, ...]) -> ReportFigure:
    """RMSE by iteration: median and 5..95 % of the runs, one curve for each combination of conditions."""
    figure, (axes,) = new_figure(8.5, 4.8)
    for curve in curves_by(points, others):
        own = iterations.filter(polars.col("point").is_in(curve.points["point"].to_list()))
        longest = own.sort("iteration")["point"][-1]
        path = own.filter(polars.col("point") == longest)
        label = curve.label + _contraction(path["median"].to_list())
        axes.semilogy(path["iteration"], path["median"], curve.marker, ls="-", ms=4, color=curve.color, label=label)
        axes.fill_between(path["iteration"], path["low"], path["high"], color=curve.color, alpha=0.2, linewidth=0)
    label_axes(axes, "Median and 5..95 % of the runs", "iteration (0: nominal motion)", "RMSE of the corners [mm]")
    whole_ticks(axes)
    figure.legend(loc="outside lower center", ncols=2, fontsize=8)
    caption = (
        "The joint estimate reaches the floor set by the noise of the corners within two iterations. A method that "
        "alternates between poses and n leaves about a third after each iteration on one board; on several, the error "
        "of n3 then falls by less than a hundredth in each. The legend has the mean share removed in the first eight."
    )
    return ReportFigure(
        "convergence", "How fast the methods converge", caption + omitted_curves(points, others), figure
    )


def truth_and_estimate(runs: polars.DataFrame, points: polars.DataFrame, others: tuple[str, ...]) -> ReportFigure:
    """Estimated n3 over the true n3, with a colour for each combination of the other conditions."""
    figure, (axes,) = new_figure(7.5, 5.2)
    table = runs.with_columns((polars.col("n3") - polars.col("error_n3")).alias("true_n3"))
    low, high = table["true_n3"].to_numpy().min(), table["true_n3"].to_numpy().max()
    axes.plot([low, high], [low, high], color=TRUTH, linewidth=1, label="estimate = truth")
    for style, curve in enumerate(curves_by(points, others)):
        drawn = table.filter(polars.col("point").is_in(curve.points["point"].to_list()))
        by_point = drawn.group_by("point", maintain_order=True).agg(
            polars.col("true_n3").first(),
            polars.col("n3").median(),
            polars.col("sigma_n3").median(),
        )
        beside = by_point["true_n3"] + 0.008 * (high - low) * style  # so that equal estimates do not hide each other
        axes.errorbar(
            beside, by_point["n3"], 2 * by_point["sigma_n3"],
            fmt=curve.marker, ms=5, color=curve.color, capsize=3, label=curve.label,
        )  # fmt: skip
    label_axes(axes, "Median over the runs, ± 2 σ as stated", "true n3 [mm per mm]", "estimated n3 [mm per mm]")
    figure.legend(loc="outside lower center", ncols=2, fontsize=8)
    caption = (
        "n3 is the motion in depth. Estimates on the diagonal are right. Estimates in a level row do not depend on the "
        "truth: one board turned about the sensor line looks the same as another n3, so its scan only returns the "
        "prior, with bars as wide as the prior's. An estimate that stopped too early is level as well."
    )
    return ReportFigure("truth_and_estimate", "What one board cannot know: motion in depth", caption, figure)


def consistency(points: polars.DataFrame, band: tuple[float, float]) -> ReportFigure:
    """Error over the bound and normalised squared error of every point, with the ranges of a right estimate."""
    figure, axes = new_figure(9.5, 3.8, 1, 2)
    axes[0].plot(points["point"], points["error_over_bound"], "o", ms=4, color=AFTER)
    axes[0].axhspan(0.94, 1.06, color=TRUTH, alpha=0.2, linewidth=0, label="bound ± 6 %")
    axes[1].plot(points["point"], points["nees"], "o", ms=4, color=AFTER)
    axes[1].axhspan(*band, color=COLORS[2], alpha=0.25, linewidth=0, label="95 % band of a right covariance")
    for panel, name, title, y in (
        (axes[0], "error_over_bound", "Efficiency", "rms error over Cramér-Rao bound [ratio]"),
        (axes[1], "nees", "Consistency", "mean normalised squared error [ratio]"),
    ):
        values = points[name].to_numpy()
        positive = values[np.isfinite(values) & (values > 0)]
        if len(positive) and positive.max() > 5 * positive.min():
            panel.set_yscale("log")
        label_axes(panel, title, "point of the study [index]", y)
        whole_ticks(panel)
    figure.legend(loc="outside lower center", ncols=2, fontsize=9)
    caption = (
        "Left: 1 is as exact as the corners allow. Right: 3, the number of components of n, if the stated covariance "
        "is right; far above 3 the calibrations state too small a covariance."
    )
    return ReportFigure("consistency", "Do the errors agree with the stated covariance", caption, figure)


def tilt_map(tilts: TiltMap) -> ReportFigure:
    """Map of σ of the least known direction of n over pitch and roll of the second board."""
    figure, (axes,) = new_figure(7.0, 5.4)
    low, high = float(tilts.tilts_deg[0]), float(tilts.tilts_deg[-1])
    share = (tilts.sigma / tilts.prior_sigma).numpy()
    half = (high - low) / (len(share) - 1) / 2  # cells are centred on their tilts
    extent = (low - half, high + half, low - half, high + half)
    picture = axes.imshow(share, extent=extent, origin="lower", cmap="viridis", norm=LogNorm(vmax=1.0))
    lines = axes.contour(tilts.tilts_deg, tilts.tilts_deg, share, levels=_SHARES, colors="white", linewidths=0.8)
    axes.clabel(lines, fmt="%g", fontsize=8)
    label_axes(
        axes,
        "One board flat, the other tilted",
        "roll about the travel axis [deg]",
        "pitch about the sensor axis [deg]",
    )
    axes.grid(False)
    figure.colorbar(picture, ax=axes, label="σ of the least known direction over the prior's [ratio]")
    caption = (
        "Dark: the two boards determine all of n. Light: σ stays at the prior's. Keep the second board out of the "
        "light spot at the centre: a tilt of some degrees about either axis is enough, a turn in its plane is not."
    )
    return ReportFigure("tilt_map", "Map of observability over pitch and roll", caption, figure)


def _contraction(rmse_mm: list[float]) -> str:
    """The share of the error that an iteration of a slow method removes, for a legend; "" for a fast method."""
    steps = len(rmse_mm) - 1
    if steps <= _FEW_STEPS:
        return ""
    return f": -{100 * (1 - (rmse_mm[_FEW_STEPS] / rmse_mm[0]) ** (1 / _FEW_STEPS)):.0f} % per iteration"
