"""The surface of an object in its product: what the stage reads, and what it finds."""

from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

from jaxtyping import Float, Shaped
from torch import Tensor

from lsvision.types.product import ProductGrid

CandidateKind = Literal["dent", "bump", "color"]
HeadSide = Literal["top", "left corner", "right corner", "left side", "right side"]


@runtime_checkable
class ProductSource(Protocol):
    """A product whose images are read by ranges of rows."""

    @property
    def grid(self) -> ProductGrid:
        """Its cells."""

    @property
    def has_sigma(self) -> bool:
        """Whether it holds the standard deviations of its positions."""

    def color(self, start: int, stop: int) -> Shaped[Tensor, "rows columns channels"]:
        """Colours of rows ``start..stop-1``."""

    def height(self, start: int, stop: int) -> Float[Tensor, "rows columns"]:
        """Heights, mm, of rows ``start..stop-1``; NaN where not measured."""

    def sigma(self, start: int, stop: int) -> Float[Tensor, "rows columns 3"]:
        """Standard deviations of (q_x, q_y, q_z), mm, of rows ``start..stop-1``."""


@dataclass(frozen=True)
class Candidate:
    """A place of a surface that may be a defect. Each quantity has its standard deviation in ``.._sigma_..``.

    Attributes:
        kind: dent, bump, or color, which departs from its surroundings in brightness alone.
        along_mm: q_y of its deepest place. around_mm: its arc length from the crown, growing with q_x. across_mm: q_x.
        slope_deg: of the sound surface there, above zero where the height grows with q_x. side: of the head.
        depth_mm: distance from the sound surface at its deepest place along the normal, below zero inwards; NaN of
            colours.
        length_mm, width_mm: along its main axis and across it, of the ellipse with the same second moments.
        angle_deg: of the main axis from the travel, growing towards larger ``around_mm``, -90..90.
        area_mm2: of the places that depart. volume_mm3: between them and the sound surface.
        contrast: mean relative brightness over the surroundings' less one.
        ratio: of the largest departure over its standard deviation.
        first_row, last_row, first_column, last_column: of the unrolled images, both ends included.
        group: number of the marks that repeat with it; None for a single one.
    """

    kind: CandidateKind
    along_mm: float
    along_sigma_mm: float
    around_mm: float
    around_sigma_mm: float
    across_mm: float
    slope_deg: float
    side: HeadSide
    depth_mm: float
    depth_sigma_mm: float
    length_mm: float
    length_sigma_mm: float
    width_mm: float
    width_sigma_mm: float
    angle_deg: float
    angle_sigma_deg: float
    area_mm2: float
    area_sigma_mm2: float
    volume_mm3: float
    volume_sigma_mm3: float
    contrast: float
    contrast_sigma: float
    ratio: float
    first_row: int
    last_row: int
    first_column: int
    last_column: int
    group: int | None = None


@dataclass(frozen=True)
class MarkGroup:
    """Candidates that repeat, one a turn of a roll: how many of how many turns show one, the period and its sigma.

    ``first_along_mm`` is where the first lies by all of them, ``around_mm`` and ``depth_mm`` are their means.
    """

    number: int
    kind: CandidateKind
    marks: int
    turns: int
    period_mm: float
    period_sigma_mm: float
    first_along_mm: float
    around_mm: float
    depth_mm: float


@dataclass(frozen=True)
class SectionWear:
    """How a piece of an object departs from its nominal section, mm along the normal, below zero where metal is gone.

    Attributes:
        first_mm, last_mm: q_y of the piece.
        is_section: whether half of the profile lies on the section; if not, nothing else says much.
        share: of the profile that lies on it.
        crown_mm: mean over the middle of the head. left_corner_mm, right_corner_mm: the worst 2 mm of the gauge corner
            towards smaller and larger q_x.
        width_mm: of the head 14 mm under the crown. Each is None where the profile does not reach.
        crown_sigma_mm, corner_sigma_mm, width_sigma_mm: their standard deviations.
    """

    first_mm: float
    last_mm: float
    is_section: bool
    share: float
    crown_mm: float | None
    left_corner_mm: float | None
    right_corner_mm: float | None
    width_mm: float | None
    crown_sigma_mm: float
    corner_sigma_mm: float
    width_sigma_mm: float
