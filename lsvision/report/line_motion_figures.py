"""Figures of the motion from line to line: by line, by wavelength, and what it did to the object's profile."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, cast

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.io import Product
from lsvision.io.formats.line_motion import SIGMA_COLUMNS, VALUE_COLUMNS
from lsvision.report.drawing import AFTER, BEFORE, COLORS, label_axes, new_figure
from lsvision.report.pages import ReportFigure
from lsvision.stages.line_spectrum import LineSpectrum
from lsvision.types import LINE_COMPONENTS, LineComponent, LineMotion

_SHOWN_LINES = 4000  # of a scan, from its start: more would be a band of ink
_NAMES = ("sideways δx", "in depth δz", "roll ρ", "along the travel δy")
_UNITS = (("mm", 1.0), ("mm", 1.0), ("deg", 180.0 / math.pi), ("mm", 1.0))
_BAND_SIGMAS = 2
_LEAST_AMPLITUDE = 1e-4  # of the largest; less is rounding
_SHORTEST = 0.8  # of the shortest wavelength that is drawn, where the axis begins


@dataclass(frozen=True)
class LineMotionView:
    """Motion from line to line as it is drawn: (δx, δz, ρ, δy) and sigma of lines ``pitch_mm`` apart, mm and rad."""

    values: Float[Tensor, "lines 4"]
    sigma: Float[Tensor, "lines 4"]
    pitch_mm: float
    ambiguous_mm: tuple[float, float] | None = None

    @classmethod
    def of(cls, motion: LineMotion, metadata: Mapping[str, Any]) -> "LineMotionView":
        """A motion and what was found about it, as a product's metadata say it."""
        band = metadata.get("ambiguous_wavelengths_mm")
        return cls(motion.values, motion.sigma, float(metadata["advance_mm"]), tuple(band) if band else None)

    @property
    def moving(self) -> list[int]:
        """The components that are not zero."""
        return [index for index in range(len(_NAMES)) if bool(self.values[:, index].any())]


def product_motion_figures(product: Product) -> list[ReportFigure]:
    """The figures of a product; none where it was not corrected for such a motion."""
    if not product.has_line_motion:
        return []
    columns = product.line_motion()
    values, sigma = (torch.stack([columns[name] for name in names], 1) for names in (VALUE_COLUMNS, SIGMA_COLUMNS))
    band = product.line_motion_metadata.get("ambiguous_wavelengths_mm")
    advance = float(product.line_motion_metadata["advance_mm"])
    return line_motion_figures(LineMotionView(values, sigma, advance, tuple(band) if band else None))


def line_motion_figures(view: LineMotionView) -> list[ReportFigure]:
    """Both figures of a motion; none where nothing moves."""
    return [motion_by_line(view), motion_spectrum(view)] if view.moving else []


def motion_by_line(view: LineMotionView) -> ReportFigure:
    """Every component that moves along the travel, with the band of two sigmas."""
    shown = slice(0, min(len(view.values), _SHOWN_LINES))
    along = view.pitch_mm * torch.arange(shown.stop)
    figure, axes = new_figure(10, 0.8 + 2.4 * len(view.moving), len(view.moving), 1, sharex=True)
    for panel, index in zip(axes, view.moving, strict=True):
        unit, scale = _UNITS[index]
        value, band = scale * view.values[shown, index], _BAND_SIGMAS * scale * view.sigma[shown, index]
        panel.fill_between(along, value - band, value + band, color=COLORS[index], alpha=0.3, linewidth=0)
        panel.plot(along, value, color=COLORS[index], linewidth=0.9)
        label_axes(panel, _NAMES[index], "travel [mm]", f"displacement [{unit}]")
    part = "" if len(view.values) <= _SHOWN_LINES else f" The first {_SHOWN_LINES} of {len(view.values)} lines."
    caption = (
        "How far the object was displaced or turned on each line besides its constant motion, with a band of two "
        f"standard deviations to either side; in the product it is not.{part} Mean and trend belong to its pose and n."
    )
    return ReportFigure("line_motion", "Motion from line to line", caption, figure)


def motion_spectrum(view: LineMotionView) -> ReportFigure:
    """Amplitude by wavelength of every component that moves, over the amplitude that its errors have."""
    units = list(dict.fromkeys(_UNITS[index][0] for index in view.moving))
    figure, axes = new_figure(10, 3.6, 1, len(units))
    spectrum = LineSpectrum.of(view.values, view.pitch_mm)
    for index in view.moving:
        unit, scale = _UNITS[index]
        panel = axes[units.index(unit)]
        amplitude = scale * spectrum.amplitude[:, index]
        panel.loglog(spectrum.wavelength_mm, amplitude, color=COLORS[index], linewidth=1.0, label=_NAMES[index])
        panel.set_ylim(bottom=max(panel.get_ylim()[0], _LEAST_AMPLITUDE * float(amplitude.max())))
        panel.set_xlim(left=_SHORTEST * float(spectrum.wavelength_mm[amplitude > panel.get_ylim()[0]].min()))
        title = "roll" if unit == "deg" else "displacement"
        label_axes(panel, title, "wavelength along the travel [mm]", f"amplitude of a sine [{unit}]")
    for panel in axes:
        if view.ambiguous_mm is not None:
            panel.axvspan(*view.ambiguous_mm, color="#999999", alpha=0.2, linewidth=0)
        panel.legend(fontsize=9)
    grey = (
        " Grey: wavelengths that hold nine tenths of it; corrugation, bow or twist of the object over such lengths "
        "shows the same on its profile."
        if view.ambiguous_mm is not None
        else ""
    )
    caption = f"A vibration of one wavelength is a peak as high as its amplitude.{grey}"
    return ReportFigure("line_motion_spectrum", "Spectrum of the motion from line to line", caption, figure)


@dataclass(frozen=True)
class Profiles:
    """Heights of some lines, mm, by place across the motion, NaN where not measured; all in the same columns."""

    q_x: Float[Tensor, " places"]
    height: Float[Tensor, "lines places"]


def profiles_before_and_after(before: Profiles, after: Profiles) -> ReportFigure:
    """The profile that all lines share, and how far lines lie off it, with and without their own motion."""
    figure, axes = new_figure(10, 3.8, 1, 2)
    for profiles, color, label in ((before, BEFORE, "before"), (after, AFTER, "after")):
        median = profiles.height.nanmedian(dim=0).values
        axes[0].plot(profiles.q_x, median, color=color, linewidth=1.1, label=label)
        off = (profiles.height - median).abs().nanquantile(0.68, dim=0)
        axes[1].plot(profiles.q_x, off, color=color, linewidth=1.1, label=label)
    label_axes(axes[0], "median height", "q_x across the motion [mm]", "height [mm]")
    label_axes(axes[1], "spread of the lines", "q_x across the motion [mm]", "off the median, 68 % [mm]")
    axes[1].set_yscale("log")
    for panel in axes:
        panel.legend(fontsize=9)
    caption = (
        "Left, the median height of lines from all over the scan. Right, how far two thirds of the lines lie off it at "
        "most: what is left after is what the object's own shape, the matching and the steps of a depth map leave."
    )
    return ReportFigure("line_motion_profile", "The object's profile before and after", caption, figure)


def component_name(component: str) -> str:
    """Name and symbol of a component."""
    return _NAMES[_index_of(component)]


def in_shown_units(component: str, value: float, template: str) -> str:
    """A value of a component, mm or rad, as text in the unit that readers see."""
    unit, scale = _UNITS[_index_of(component)]
    return f"{template % (scale * value)} {unit}"


def _index_of(component: str) -> int:
    return [*LINE_COMPONENTS].index(cast(LineComponent, component))
