"""What the object does from line to line besides its constant motion: vibration and uneven travel."""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.schema import NonNegative, NonNegativeInt
from lsvision.types.section import SectionFit

LineComponent = Literal["dx", "dz", "roll", "dy"]
LINE_COMPONENTS: tuple[LineComponent, ...] = ("dx", "dz", "roll", "dy")
# Unit that a reader sees, and how many of it make the internal one up.
_SHOWN = {"dx": ("mm", 1.0), "dz": ("mm", 1.0), "roll": ("deg", 180.0 / torch.pi), "dy": ("mm", 1.0)}
_NAMES = {"dx": "sideways", "dz": "in depth", "roll": "roll", "dy": "along the travel"}


@dataclass(frozen=True)
class LineFinding:
    """What was found out about one component of the motion from line to line.

    ``state`` is ``corrected``; ``absent``, where nothing above the noise was there; or ``not observed``, where the
    object's shape does not show it. ``rms`` is that of the component, ``sigma`` the rms of its standard deviations over
    the lines, and of the errors of single lines where it is not corrected, mm or rad; ``length_mm`` is the length along
    the travel over which it changes. ``evidence`` is how much better the data fit with the component than without, in
    units of the logarithm of the likelihood. ``reason`` says why nothing was observed, where that is not the object's
    shape. ``shape_rms`` is what the profile shows besides and belongs to the object's shape along its travel: it stays
    in the height. Waves up to ``separated_up_to_mm`` were separated from such shape by the colours' lines.
    ``edges`` is how many straight edges along the travel show the component, where the profile does not; ``waves`` of
    how many waves it consists, where their trend over a flat object was taken for motion.
    """

    component: LineComponent
    state: Literal["corrected", "absent", "not observed"]
    rms: NonNegative = 0.0
    sigma: NonNegative = 0.0
    length_mm: float | None = None
    evidence: float = 0.0
    reason: str = "the object's shape does not show it"
    shape_rms: NonNegative = 0.0
    separated_up_to_mm: float | None = None
    edges: NonNegativeInt = 0
    waves: NonNegativeInt = 0

    @property
    def in_words(self) -> str:
        """What was found, for a reader."""
        name, (unit, scale) = _NAMES[self.component], _SHOWN[self.component]
        shape = f"; {self.shape_rms * scale:.2g} {unit} rms are the object's shape" if self.shape_rms > 0 else ""
        edges = f", from {self.edges} straight edges along the travel" if self.edges else ""
        edges += f" and the trend of its {self.waves} waves" if self.waves else ""
        if self.state == "absent":
            return f"{name}: nothing above the errors of a line, {self.sigma * scale:.2g} {unit}{edges}{shape}"
        if self.state == "not observed":
            error = f" better than to {self.sigma * scale:.2g} {unit}" if self.sigma > 0 else ""
            return f"{name}: not observed, {self.reason}{error}"
        length = "" if self.length_mm is None else f", over lengths of {self.length_mm:.2g} mm"
        known = f"known to {self.sigma * scale:.2g} {unit}" if self.sigma > 0 else "of unknown sigma"
        known_up_to = self.separated_up_to_mm
        separated = "" if known_up_to is None else f", separated from shape up to waves of {known_up_to:.3g} mm"
        return f"{name}: {self.rms * scale:.2g} {unit} rms, {known}{edges}{length}{separated}{shape}"


@dataclass(frozen=True)
class LineMotion:
    """Displacement of the object on every line, besides n: in the order of ``LINE_COMPONENTS``.

    On line v the object is displaced by (δx, 0, δz) mm and turned by the roll ρ (rad) about Y through c = (B/2, 0, z0);
    δy, mm, is added to the nominal travel of the line. The mean and the linear trend over the travel are zero where the
    motion was estimated from its scan alone: they belong to the pose of the object and to n. Where n comes from several
    scans, as in a calibration, the trend by which a scan departs from it stays; its uncertainty is part of n's. So does
    that of δx over a flat object where it follows from the waves of the motion.

    Attributes:
        values: (δx, δz, ρ, δy) by line, float64; zero for a component that is not corrected.
        covariance: of what ``values`` err by, by line. A component that is not corrected, where others are, may be
            there: it errs by what is thought of it. All zero where nothing is corrected.
        findings: what is known about each component; empty where the motion was given from outside.
        section: where the object's nominal section lies, which the lines were compared with; None where there is none.
    """

    values: Float[Tensor, "lines 4"]
    covariance: Float[Tensor, "lines 4 4"]
    findings: tuple[LineFinding, ...] = ()
    section: SectionFit | None = None

    @property
    def lines(self) -> int:
        """Number of lines of the scan."""
        return len(self.values)

    @property
    def is_still(self) -> bool:
        """Whether no line is displaced: a product is then the same as without line motion, to the bit."""
        return not bool(self.values.any())

    @property
    def dx_mm(self) -> Float[Tensor, " lines"]:
        """Displacement sideways, along X."""
        return self.values[:, 0]

    @property
    def dz_mm(self) -> Float[Tensor, " lines"]:
        """Displacement in depth, along Z."""
        return self.values[:, 1]

    @property
    def roll_rad(self) -> Float[Tensor, " lines"]:
        """Turn about Y through c."""
        return self.values[:, 2]

    @property
    def dy_mm(self) -> Float[Tensor, " lines"]:
        """Travel beyond the nominal one."""
        return self.values[:, 3]

    @property
    def sigma(self) -> Float[Tensor, "lines 4"]:
        """Standard deviations of the values."""
        return self.covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0).sqrt()

    def at(self, line: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch 4"]:
        """Values at (fractional) lines, linear between lines and constant beyond the ends; NaN stays NaN."""
        return _interpolated(self.values, line)

    def covariance_at(self, line: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch 4 4"]:
        """Covariance at (fractional) lines; neighbouring lines err alike, so that it is interpolated as it stands."""
        return _interpolated(self.covariance, line)


def _interpolated(values: Tensor, line: Tensor) -> Tensor:
    last = len(values) - 1
    base = line.detach().nan_to_num().floor().clamp(0, max(last - 1, 0)).long()  # a NaN stays one by its weight
    part = (line - base).clamp(0, 1).to(values)[(..., *[None] * (values.ndim - 1))]
    return torch.lerp(values[base], values[(base + 1).clamp(max=last)], part)
