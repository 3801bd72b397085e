"""Figures of a surface: the unrolled map, the gallery of candidates, its profile."""

import math
from collections.abc import Sequence

import torch
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle

from lsvision.io import Surface
from lsvision.report.drawing import AFTER, COLORS, label_axes, new_figure, show_image, thinned
from lsvision.report.pages import ReportFigure
from lsvision.stages.surface.inspect import SurfacePlan
from lsvision.types import Candidate

_MAP_ROWS = 4096  # of the level of the pyramid that is drawn, at most
_ACROSS, _MARGIN_MM, _LARGEST_MM = 6, 4.0, 60.0  # candidates a row of the gallery; about one; side of a crop, at most
_SCALE_SIGMAS = 30.0  # of the deviation's colours
_KIND_COLOR = {"dent": COLORS[1], "bump": COLORS[0], "color": COLORS[3]}


def unrolled_map(surface: Surface, candidates: Sequence[Candidate], sigma_mm: float) -> ReportFigure:
    """Colour and deviation of the whole surface, laid flat, with the candidates marked."""
    level = 0
    while surface.grid.rows >> level > _MAP_ROWS and level + 1 < surface.levels():
        level += 1
    rows = -(-surface.grid.rows >> level)
    color, deviation = surface.color(0, rows, level), surface.deviation(0, rows, level)
    grid, pitch = surface.grid, surface.grid.pitch_mm
    extent = (
        grid.origin_y_mm - pitch / 2, grid.origin_y_mm + pitch * (grid.rows - 0.5),
        grid.origin_x_mm + pitch * (grid.columns - 0.5), grid.origin_x_mm - pitch / 2,
    )  # fmt: skip
    figure, axes = new_figure(12, 6.4, 2, 1, sharex=True, sharey=True)
    show_image(axes[0], thinned(color).transpose(0, 1).contiguous(), extent, aspect="auto")
    label_axes(axes[0], "colour", "", "around from the crown [mm]")
    most = _SCALE_SIGMAS * sigma_mm
    shown = thinned(deviation - deviation.nanmedian(1, keepdim=True).values).T.contiguous()
    picture = show_image(axes[1], 1e3 * shown, extent, aspect="auto", cmap="RdBu", vmin=-1e3 * most, vmax=1e3 * most)
    label_axes(axes[1], "deviation from the profile", "along the motion [mm]", "around from the crown [mm]")
    figure.colorbar(picture, ax=axes[1], label="outwards [um]", shrink=0.9)
    for panel in axes:
        panel.grid(False)
        _mark(panel, candidates, grid.pitch_mm, grid.origin_y_mm, grid.origin_x_mm)
    caption = (
        "The surface laid flat: arc length around the profile, zero at its crown, by place along the motion. Deviation "
        "is the distance from the profile of the whole product along its normal, less the median of each row; white "
        "was not measured. Boxes: candidates, orange inwards, blue outwards, pink by colour alone."
    )
    return ReportFigure("surface_map", "The surface, unrolled", caption, figure)


def _mark(panel: Axes, candidates: Sequence[Candidate], pitch_mm: float, along_mm: float, around_mm: float) -> None:
    for candidate in candidates:
        corner = (
            along_mm + pitch_mm * (candidate.first_row - 0.5),
            around_mm + pitch_mm * (candidate.first_column - 0.5),
        )
        length = pitch_mm * (candidate.last_row - candidate.first_row + 1)
        width = pitch_mm * (candidate.last_column - candidate.first_column + 1)
        panel.add_patch(
            Rectangle(corner, length, width, fill=False, edgecolor=_KIND_COLOR[candidate.kind], linewidth=0.9)
        )


def gallery(surface: Surface, candidates: Sequence[Candidate]) -> ReportFigure:
    """Colour and deviation about each of some candidates, numbered as in the table."""
    across = min(_ACROSS, len(candidates))
    rows = math.ceil(len(candidates) / across)
    figure, axes = new_figure(2.0 * across + 0.6, 4.3 * rows, 2 * rows, across)
    for number, candidate in enumerate(candidates):
        row, column = divmod(number, across)
        above, below = (axes[(2 * row + half) * across + column] for half in (0, 1))
        color, deviation = _crop(surface, candidate)
        side = surface.grid.pitch_mm * color.shape[1], surface.grid.pitch_mm * color.shape[0]
        extent = (-side[0] / 2, side[0] / 2, side[1] / 2, -side[1] / 2)
        show_image(above, thinned(color), extent)
        label_axes(above, f"{number + 1}: {candidate.kind}", "", "along [mm]" if column == 0 else "")
        most = 1e3 * max(abs(candidate.depth_mm) if math.isfinite(candidate.depth_mm) else 0.1, 0.02)
        show_image(below, 1e3 * thinned(deviation), extent, cmap="RdBu", vmin=-most, vmax=most)
        label_axes(below, f"± {most:.0f} um", "around [mm]", "along [mm]" if column == 0 else "")
        for panel in (above, below):
            panel.grid(False)
            panel.tick_params(labelsize=7)
    for spare in range(len(candidates), rows * across):
        row, column = divmod(spare, across)
        for half in (0, 1):
            axes[(2 * row + half) * across + column].set_axis_off()
    caption = (
        "Colour, and below it deviation (orange inwards, blue outwards, to the depth over the picture), its median "
        "taken off, about the middle of each candidate, those that stand out most first."
    )
    return ReportFigure("candidates", "Candidates", caption, figure)


def _crop(surface: Surface, candidate: Candidate) -> tuple[torch.Tensor, torch.Tensor]:
    grid, half = surface.grid, round(_LARGEST_MM / 2 / surface.grid.pitch_mm)
    margin = round(_MARGIN_MM / grid.pitch_mm)
    spans = []
    for first, last, size in (
        (candidate.first_row, candidate.last_row, grid.rows),
        (candidate.first_column, candidate.last_column, grid.columns),
    ):
        middle, reach = (first + last) // 2, min((last - first) // 2 + margin, half)
        spans.append(slice(max(0, middle - reach), min(size, middle + reach + 1)))
    rows, columns = spans
    deviation = surface.deviation(rows.start, rows.stop)[:, columns]
    return (
        surface.color(rows.start, rows.stop)[:, columns],
        deviation - deviation.nanmedian(),
    )


def profile_and_scatter(plan: SurfacePlan) -> ReportFigure:
    """The profile, and how much sound surface scatters around it."""
    figure, (above, below) = new_figure(9, 5.6, 2, 1)
    above.plot(plan.profile.q_x, plan.profile.height, color=AFTER, linewidth=1.2)
    label_axes(above, "profile of the whole product", "q_x across the motion [mm]", "height [mm]")
    above.set_aspect("equal", adjustable="datalim")
    around = plan.unrolling.around
    for values, name, color in (
        (plan.sound.cell_mm, "a cell", COLORS[1]),
        (plan.sound.smooth_mm, "smoothed", COLORS[0]),
    ):
        below.plot(around, 1e3 * values, color=color, linewidth=1.0, label=name)
    below.set_ylim(bottom=0)
    label_axes(below, "scatter of sound surface", "around from the crown [mm]", "standard deviation [um]")
    below.legend(fontsize=9)
    caption = (
        "Above, the profile that all rows have in common. Below, how much the deviation of sound surface scatters: "
        "what candidates must exceed."
    )
    return ReportFigure("surface_profile", "Profile and scatter", caption, figure)
