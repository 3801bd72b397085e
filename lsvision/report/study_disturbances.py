"""Figures of disturbances that a study's calibrations have to detect: does σ cover them, and what is left of them."""

import polars
from matplotlib.axes import Axes

from lsvision.report.drawing import TRUTH, label_axes, new_figure, scale_to_values, show_a_decade
from lsvision.report.pages import ReportFigure
from lsvision.report.study_curves import curves_by, omitted_curves
from lsvision.report.study_figures import AXIS_LABELS

# Conditions that the calibration does not know and has to detect.
DISTURBANCES = ("vibration_mm", "vibration_wavelength_mm", "encoder_mm", "encoder_wavelength_mm")
_STYLES = {"auto": "-", "none": "--"}
_MEANING = {"auto": "motion from line to line measured", "none": "corners alone"}


def coverage(points: polars.DataFrame, axis: str, others: tuple[str, ...]) -> ReportFigure:
    """Normalised squared error of n over one disturbance, and the share of runs that noticed it."""
    figure, axes = new_figure(9.5, 4.2, 1, 2)
    _draw(axes[0], points, axis, others, "nees")
    _draw(axes[1], points, axis, others, "along_scan")
    axes[0].axhline(3.0, color=TRUTH, linewidth=1, label="a right covariance")
    axes[0].set_yscale("log")
    show_a_decade(axes[0])
    label_axes(axes[0], "Errors over stated σ", AXIS_LABELS[axis], "mean normalised squared error [ratio]")
    label_axes(axes[1], "Runs that found errors along the scan", AXIS_LABELS[axis], "share of the runs [ratio]")
    axes[1].set_ylim(-0.05, 1.05)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=8)
    caption = (
        "Left: 3 where the stated covariance is right, above where n is farther off than it says, below where it says "
        "too much. Waves longer than a board look like n; those of a few lines average out. Right: how many runs found "
        "the disturbance and allowed for it; what too few find is not in σ."
    )
    title = f"Does σ cover it: {AXIS_LABELS[axis].split(' [')[0]}"
    return ReportFigure(f"coverage_{axis}", title, caption + omitted_curves(points, _without(others)), figure)


def what_is_left(points: polars.DataFrame, axis: str, others: tuple[str, ...]) -> ReportFigure:
    """RMSE of the corners after the calibration over one disturbance, with the motion from line to line and without."""
    figure, (axes,) = new_figure(8.5, 4.8)
    _draw(axes, points, axis, others, "rmse_after_mm")
    axes.set_yscale("log")
    show_a_decade(axes)
    scale_to_values(axes, points[axis].to_numpy())
    label_axes(axes, "Mean over the runs", AXIS_LABELS[axis], "RMSE of the corners after calibration [mm]")
    figure.legend(loc="outside lower center", ncols=2, fontsize=8)
    caption = (
        "From the corners alone (dashed) the disturbance stays in the RMSE, whatever n is. Once the motion from line "
        "to line is measured on the edges of the squares and taken away, the noise of the corners is left."
    )
    title = f"What is left of it: {AXIS_LABELS[axis].split(' [')[0]}"
    return ReportFigure(f"left_{axis}", title, caption + omitted_curves(points, _without(others)), figure)


def _draw(panel: Axes, points: polars.DataFrame, axis: str, others: tuple[str, ...], column: str) -> None:
    """Curves of a column: a colour for each combination of the others, dashed where the corners were alone."""
    both = "line_motion" in others
    for curve in curves_by(points, _without(others)):
        for motion, style in _STYLES.items():
            own = curve.points.filter(polars.col("line_motion") == motion).sort(axis)
            label = curve.label if len(own) and (motion == "auto" or not both) else None
            shape = style if both else "-"
            panel.plot(own[axis], own[column], curve.marker, ls=shape, ms=4, color=curve.color, label=label)
    for motion, style in _STYLES.items() if both else ():
        panel.plot([], [], color=TRUTH, ls=style, label=_MEANING[motion])


def _without(others: tuple[str, ...]) -> tuple[str, ...]:
    """The varied conditions but line motion, which is a style of line."""
    return tuple(name for name in others if name != "line_motion")
