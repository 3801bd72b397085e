"""Figures of a study: accuracy against what was varied, convergence, consistency, and which tilts tell most."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import polars
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.ticker import MaxNLocator
from torch import Tensor

from lsvision.report.drawing import AFTER, BEFORE, COLORS, TRUTH, label_axes, new_figure
from lsvision.report.pages import ReportFigure

# What a column is called on an axis.
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
_MOST_CURVES = len(COLORS)
_MARKERS = "osD^vP*X"
_FEW_STEPS = 8  # iterations over which the contraction of a slow method is told
_SHARES = (0.002, 0.005, 0.01, 0.02, 0.05, 0.5)  # of the prior's sigma, where the map has a contour


@dataclass(frozen=True)
class TiltMap:
    """Bound on σ of n's least known direction from a flat board and a second one, by the second's pitch and roll.

    ``sigma`` is ``(pitches, rolls)`` over ``tilts_deg`` in both directions.
    """

    tilts_deg: Tensor
    sigma: Tensor
    prior_sigma: float


def accuracy(points: polars.DataFrame, axis: str, others: tuple[str, ...]) -> ReportFigure:
    """RMS error of each component of n against one numeric column, a curve for each combination of the others."""
    figure, axes = new_figure(10.5, 4.4, 1, 3)
    for style, (label, own) in enumerate(_curves(points, others)):
        color, marker, own = COLORS[style % len(COLORS)], _MARKERS[style], own.sort(axis)
        repeated = own[axis].is_duplicated().any()
        for k, panel in enumerate(axes):
            name = label if k == 0 else None
            line, dashed = ("", "_") if repeated else ("-", "--")
            panel.plot(own[axis], own[f"rms_n{k + 1}"], marker, ls=line, ms=4, color=color, label=name)
            panel.plot(own[axis], own[f"bound_n{k + 1}"], dashed, color=color, linewidth=1, ms=11)
    for k, panel in enumerate(axes):
        panel.set_yscale("log")
        label_axes(panel, _COMPONENTS[k], AXIS_LABELS[axis], "error of n [mm per mm]" if k == 0 else "")
        panel.xaxis.label.set_fontsize(8)
        panel.set_ylabel("rms error [mm per mm]" if k == 0 else "")
        _spread_axis(panel, points[axis].to_numpy())
        _at_least_a_decade(panel)
    axes[0].plot([], [], "--", color=TRUTH, linewidth=1, label="Cramér-Rao bound")
    figure.legend(loc="outside lower center", ncols=3, fontsize=8)
    caption = (
        "Root-mean-square error over all calibrations of a point, and the smallest that any unbiased estimate could "
        "have (dashed, or a bar). Where they meet only better corners or other boards help; where the error stands "
        "above, something disturbs the corners that the calibration does not know of, or it was stopped too early."
    )
    return ReportFigure(
        f"accuracy_{axis}",
        f"Accuracy against {AXIS_LABELS[axis].split(' [')[0]}",
        caption + _left_out(points, others),
        figure,
    )


def placings(points: polars.DataFrame) -> ReportFigure:
    """RMS error of each component of n for every set of boards, beside the prior's sigma."""
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
        "The same number of calibrations for every set of boards. A set whose bars are orange leaves a direction of n "
        "at the prior: no number of repeats of it helps, another tilt does."
    )
    return ReportFigure("placings", "Which boards to scan", caption, figure)


def convergence(iterations: polars.DataFrame, points: polars.DataFrame, others: tuple[str, ...]) -> ReportFigure:
    """RMSE by iteration: median and 5..95 % of the runs, one curve for each combination of conditions."""
    figure, (axes,) = new_figure(8.5, 4.8)
    for style, (label, own) in enumerate(_curves(points, others)):
        longest = iterations.filter(polars.col("point").is_in(own["point"].to_list())).sort("iteration")["point"][-1]
        path = iterations.filter(polars.col("point") == longest)
        color = COLORS[style % len(COLORS)]
        label += _contraction(path["median"].to_list())
        axes.semilogy(path["iteration"], path["median"], _MARKERS[style], ls="-", ms=4, color=color, label=label)
        axes.fill_between(path["iteration"], path["low"], path["high"], color=color, alpha=0.2, linewidth=0)
    label_axes(axes, "Median and 5..95 % of the runs", "iteration (0: nominal motion)", "RMSE of the corners [mm]")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    figure.legend(loc="outside lower center", ncols=2, fontsize=8)
    caption = (
        "The joint estimate stands on the floor that the corners' noise leaves after two iterations. Alternating "
        "between poses and n takes off the share in the legend each time: stopped early, it is far from done."
    )
    return ReportFigure("convergence", "How fast the methods converge", caption + _left_out(points, others), figure)


def truth_and_estimate(runs: polars.DataFrame, points: polars.DataFrame, others: tuple[str, ...]) -> ReportFigure:
    """Estimated n3 of every calibration against the true one, a colour for each combination of the other conditions."""
    figure, (axes,) = new_figure(7.5, 5.2)
    table = runs.with_columns((polars.col("n3") - polars.col("error_n3")).alias("true_n3"))
    low, high = table["true_n3"].to_numpy().min(), table["true_n3"].to_numpy().max()
    axes.plot([low, high], [low, high], color=TRUTH, linewidth=1, label="estimate = truth")
    for style, (label, own) in enumerate(_curves(points, others)):
        drawn = table.filter(polars.col("point").is_in(own["point"].to_list()))
        by_point = drawn.group_by("point", maintain_order=True).agg(
            polars.col("true_n3").first(),
            polars.col("n3").median(),
            polars.col("sigma_n3").median(),
        )
        spread = 2 * by_point["sigma_n3"]
        color = COLORS[style % len(COLORS)]
        beside = by_point["true_n3"] + 0.008 * (high - low) * style  # so that equal estimates do not hide each other
        axes.errorbar(beside, by_point["n3"], spread, fmt=_MARKERS[style], ms=5, color=color, capsize=3, label=label)
    label_axes(axes, "Median over the runs, ± 2 σ as claimed", "true n3 [mm per mm]", "estimated n3 [mm per mm]")
    figure.legend(loc="outside lower center", ncols=2, fontsize=8)
    caption = (
        "n3 says how fast the object rises towards the cameras. Estimates on the diagonal know it. A level row says "
        "the same whatever the truth is: turning one board about the sensor line looks just like another n3, so its "
        "scan only gives back the prior, and the wide bars admit it. An unfinished estimate is level as well."
    )
    return ReportFigure("truth_and_estimate", "What one board cannot know: motion in depth", caption, figure)


def consistency(points: polars.DataFrame, band: tuple[float, float]) -> ReportFigure:
    """Error over the bound and normalised squared error of every point, with what they ought to be."""
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
        panel.xaxis.set_major_locator(MaxNLocator(integer=True))
    figure.legend(loc="outside lower center", ncols=2, fontsize=9)
    caption = (
        "Left: 1 is as exact as the corners allow. Right: 3, the number of components of n, where the calibrations "
        "claim the covariance that they have; far above, they are surer than they should be."
    )
    return ReportFigure("consistency", "Are the errors what they should be", caption, figure)


def tilt_map(tilts: TiltMap) -> ReportFigure:
    """Map of the least known direction of n over pitch and roll of the second board."""
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
    figure.colorbar(picture, ax=axes, label="σ over the prior's, least known direction [ratio]")
    caption = (
        "Dark: the pair determines all of n. Light: σ stays at the prior's. Keep the second board out of the light "
        "spot round the centre: some degrees about either axis do, a turn in the board's plane does not."
    )
    return ReportFigure("tilt_map", "Map of observability over pitch and roll", caption, figure)


def _curves(points: polars.DataFrame, others: tuple[str, ...]) -> Iterator[tuple[str, polars.DataFrame]]:
    """Points by combination of columns, at most as many as a figure can tell apart, and what they have in common."""
    if not others:
        yield "rms error", points
        return
    for key, own in list(points.group_by(*others, maintain_order=True))[:_MOST_CURVES]:
        yield ", ".join(_in_words(name, value) for name, value in zip(others, key, strict=True)), own


def _left_out(points: polars.DataFrame, others: tuple[str, ...]) -> str:
    """A caption's last words where a figure does not show every combination."""
    count = points.select(others).unique().height if others else 1
    return f" Shown are the first {_MOST_CURVES} of {count} combinations." if count > _MOST_CURVES else ""


def _in_words(name: str, value: object) -> str:
    if name in ("boards", "method"):
        return str(value).replace("_", " ")
    return f"{name} {value:g}" if isinstance(value, float) else f"{name} {value}"


def _contraction(rmse_mm: list[float]) -> str:
    """What each iteration takes off, in words, where there are many."""
    steps = len(rmse_mm) - 1
    if steps <= _FEW_STEPS:
        return ""
    return f": -{100 * (1 - (rmse_mm[_FEW_STEPS] / rmse_mm[0]) ** (1 / _FEW_STEPS)):.0f} % an iteration"


def _at_least_a_decade(panel: Axes) -> None:
    """Keep a logarithmic axis from blowing up differences that are only noise."""
    low, high = panel.get_ylim()
    if high / low < 10:
        middle = (low * high) ** 0.5
        panel.set_ylim(middle / 10**0.5, middle * 10**0.5)


def _spread_axis(panel: Axes, values: np.ndarray) -> None:
    """A logarithmic axis where the values span decades, whole ticks where they are counts."""
    low, high = values.min(), values.max()
    if low > 0 and high / low > 20:
        panel.set_xscale("log")
    elif values.dtype.kind == "i":
        panel.xaxis.set_major_locator(MaxNLocator(integer=True))
