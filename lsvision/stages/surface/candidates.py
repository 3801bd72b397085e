"""Regions that depart -> candidates with their place, size and depth in mm, and the standard deviation of each."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.stages.surface.config import SurfaceConfig
from lsvision.stages.surface.smoothed import Paraboloid
from lsvision.stages.surface.sound import SoundSurface
from lsvision.stages.surface.strips import Unrolling
from lsvision.types import Candidate, CandidateKind, HeadSide, ProductGrid

_TOP_DEG, _CORNER_DEG = 10.0, 45.0  # slope up to which a place is on top, or at a corner
_OPEN_ANGLE_DEG = 90 / math.sqrt(3)  # standard deviation of an angle of which nothing is known
_FIT_SHARE = 0.25  # of a region's width: radius of the disc that its depth is fitted over
_DARKEST = 0.1  # relative brightness that counts
_NEAR_MM = 1.0  # of a dent or bump, within which a place that differs in colour is not another


@dataclass(frozen=True)
class Measuring:
    """What turns sums over cells of the unrolled surface into mm."""

    grid: ProductGrid
    unrolling: Unrolling
    sound: SoundSurface
    fits: tuple[Paraboloid, ...]
    config: SurfaceConfig

    def candidates(self, kind: CandidateKind, table: Mapping[str, Float[Tensor, " regions"]]) -> list[Candidate]:
        """The regions that stand out and are large enough."""
        high = self.config.color_high_sigma if kind == "color" else self.config.high_sigma
        area = table["cells"] * self.grid.pitch_mm**2
        kept = ((table["ratio"] >= high) & (area >= self.config.least_area_mm2)).nonzero()[:, 0]
        return [self._candidate(kind, {name: float(of[index]) for name, of in table.items()}) for index in kept]

    def _depth(self, of: Mapping[str, float], shape: "_Ellipse") -> "_Depth":
        """By the largest paraboloid that is narrow against the region; by the smoothed value where none was fitted."""
        wide = _FIT_SHARE * self.grid.pitch_mm * shape.width
        fits = [index for index, fit in enumerate(self.fits) if math.isfinite(of[f"fit_{index}"])]
        if not fits:
            return _Depth(of["peak_value"], float(self.sound.smooth_mm.median()))
        narrow = [index for index in fits if self.fits[index].radius_mm <= wide]
        chosen = max(narrow) if narrow else min(fits)
        bright = min(max(1 + of["peak_contrast"], _DARKEST), 1.0) if math.isfinite(of["peak_contrast"]) else 1.0
        # Half of the variance is noise of the grey values, which moves the match further where these are dark.
        darker = math.sqrt((1 + bright**-2) / 2)
        return _Depth(of[f"fit_{chosen}"], darker * float(self.sound.fitted_mm[chosen]))

    def _candidate(self, kind: CandidateKind, of: Mapping[str, float]) -> Candidate:
        pitch, sound, cells = self.grid.pitch_mm, self.sound, of["cells"]
        place = min(max(round(of["value_cell"] / of["value"]), 0), self.unrolling.cells - 1)
        one, smooth = float(sound.cell_mm[place]), float(sound.smooth_mm[place])
        shape = _Ellipse.of(of)
        depth = self._depth(of, shape)
        peak = depth.value
        if kind == "color":
            one = smooth = float(sound.contrast[place])
        # A border moves by the noise over the slope there, at as many places as err apart along it.
        length, width = pitch * shape.length, pitch * shape.width
        blurred = smooth / abs(peak) * width / 2
        alike = math.sqrt(sound.cells_alike)
        around_border = math.pi * (shape.length + shape.width) / 2
        apart = max(1.0, around_border / alike)
        noise = one * math.sqrt(sound.cells_alike)
        middle = noise / abs(of["value"])
        relief = kind != "color"
        slope = math.degrees(math.atan(float(self.unrolling.slope[place])))
        return Candidate(
            kind=kind,
            along_mm=self.grid.q_y(0) + pitch * of["value_row"] / of["value"],
            along_sigma_mm=pitch * middle * math.sqrt(cells * shape.row_variance),
            around_mm=self.unrolling.origin_mm + pitch * of["value_cell"] / of["value"],
            around_sigma_mm=pitch * middle * math.sqrt(cells * shape.cell_variance),
            across_mm=float(self.unrolling.q_x[place]),
            slope_deg=slope,
            side=side_of(slope),
            depth_mm=peak if relief else math.nan,
            depth_sigma_mm=depth.sigma if relief else math.nan,
            length_mm=length,
            length_sigma_mm=blurred * math.sqrt(2),
            width_mm=width,
            width_sigma_mm=blurred * math.sqrt(2),
            angle_deg=shape.angle_deg,
            angle_sigma_deg=min(_OPEN_ANGLE_DEG, math.degrees(blurred / max(length - width, 1e-6))),
            area_mm2=pitch**2 * cells,
            area_sigma_mm2=pitch * around_border * blurred / math.sqrt(apart),
            volume_mm3=pitch**2 * of["value"] if relief else math.nan,
            volume_sigma_mm3=pitch**2 * noise * math.sqrt(cells) if relief else math.nan,
            contrast=of["contrast"] / cells,
            contrast_sigma=float(sound.contrast[place]) / math.sqrt(max(1.0, cells / sound.cells_alike)),
            ratio=of["ratio"],
            first_row=int(of["first_row"]),
            last_row=int(of["last_row"]),
            first_column=int(of["first_cell"]),
            last_column=int(of["last_cell"]),
        )


@dataclass(frozen=True)
class _Depth:
    """Of the deepest place of a region, mm."""

    value: float
    sigma: float


@dataclass(frozen=True)
class _Ellipse:
    """The ellipse with a region's second moments, in cells; its main axis from the travel, towards larger cells."""

    length: float
    width: float
    angle_deg: float
    row_variance: float
    cell_variance: float

    @classmethod
    def of(cls, sums: Mapping[str, float]) -> "_Ellipse":
        """Of sums over a region; a cell has the extent of one."""
        count = sums["cells"]
        row, cell = sums["row"] / count, sums["cell"] / count
        rows = max(sums["row_row"] / count - row * row, 0.0) + 1 / 12
        cells = max(sums["cell_cell"] / count - cell * cell, 0.0) + 1 / 12
        both = sums["row_cell"] / count - row * cell
        middle, apart = (rows + cells) / 2, math.hypot((rows - cells) / 2, both)
        angle = math.degrees(math.atan2(2 * both, rows - cells)) / 2
        return cls(4 * math.sqrt(middle + apart), 4 * math.sqrt(max(middle - apart, 0.0)), angle, rows, cells)


def side_of(slope_deg: float) -> HeadSide:
    """Where on the head a place of such a slope lies; the height falls with q_x on its right."""
    if abs(slope_deg) <= _TOP_DEG:
        return "top"
    if abs(slope_deg) <= _CORNER_DEG:
        return "right corner" if slope_deg < 0 else "left corner"
    return "right side" if slope_deg < 0 else "left side"


def without_relief(colors: list[Candidate], relief: list[Candidate], pitch_mm: float) -> list[Candidate]:
    """Candidates by colour that lie on no dent or bump."""
    if not colors or not relief:
        return colors
    near = _NEAR_MM / pitch_mm
    boxes = [torch.tensor([_box(candidate) for candidate in some], dtype=torch.float64) for some in (colors, relief)]
    (first, last), (other_first, other_last) = ((box[:, :2], box[:, 2:]) for box in boxes)
    meet = (first[:, None] - near <= other_last) & (other_first - near <= last[:, None])
    return [candidate for candidate, on in zip(colors, meet.all(-1).any(-1).tolist(), strict=True) if not on]


def _box(candidate: Candidate) -> tuple[int, ...]:
    return candidate.first_row, candidate.first_column, candidate.last_row, candidate.last_column
