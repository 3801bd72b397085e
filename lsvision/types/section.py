"""The nominal section of an object that is the same all along, and where a scan's own profile shows it."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.schema import NonNegative, Share


@dataclass(frozen=True)
class Section:
    """Upper side of a section: ``height_mm`` by place ``across_mm``, strictly rising, about an origin of its own."""

    name: str
    across_mm: tuple[float, ...]
    height_mm: tuple[float, ...]

    @property
    def outline(self) -> Float[Tensor, "points 2"]:
        """(across, height) of its points, mm, float64."""
        return torch.tensor([self.across_mm, self.height_mm], dtype=torch.float64).T


@dataclass(frozen=True)
class SectionFit:
    """Where the origin of a section lies in the product of a scan, how it is rolled there, and what departs from it.

    Attributes:
        x_mm, height_mm: the origin, as q_x and height of the product. roll_rad: from +q_x towards +height.
        x_sigma_mm, height_sigma_mm, roll_sigma_rad: standard deviations of these, the scan's frame taken as known.
        share: of the profile that lies on the section, but for its errors and ``within_mm``.
        within_mm: distance, mm, along the normal, up to which the profile counts as on the section.
        departure_rms_mm: distance of the profile from the section, rms.
        departure_most_mm: the largest, above zero outside; ``departure_across_mm`` is where on the section.
        is_reference: whether the lines were compared with it; with the scan's own profile if it is another section.
    """

    name: str
    x_mm: float
    height_mm: float
    roll_rad: float
    x_sigma_mm: NonNegative
    height_sigma_mm: NonNegative
    roll_sigma_rad: NonNegative
    share: Share
    within_mm: NonNegative
    departure_rms_mm: NonNegative
    departure_most_mm: float
    departure_across_mm: float
    is_reference: bool

    @property
    def in_words(self) -> str:
        """What was found, for a reader."""
        departs = (
            f"the profile departs from it by {self.departure_rms_mm:.2g} mm rms, by {self.departure_most_mm:+.2g} mm "
            f"{self.departure_across_mm:+.3g} mm across"
        )
        if not self.is_reference:
            return (
                f"section {self.name}: {100 * self.share:.0f} % of the profile lie on it to {self.within_mm:.2g} mm, "
                f"it is another section or badly worn; {departs}; the scan's own profile is the reference"
            )
        roll, roll_sigma = math.degrees(self.roll_rad), math.degrees(self.roll_sigma_rad)
        return (
            f"section {self.name}: at q_x {self.x_mm:.3f} ± {self.x_sigma_mm:.2g} mm, height {self.height_mm:.3f} ± "
            f"{self.height_sigma_mm:.2g} mm, rolled by {roll:.3f} ± {roll_sigma:.2g} deg; {100 * self.share:.0f} % of "
            f"the profile lie on it to {self.within_mm:.2g} mm; {departs}"
        )
