"""The two colours of a trilinear sensor that look furthest apart along the travel: what they see, and when."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.geometry import ProductFrame, Rectification, color_shift, registered_rows, zero_disparity_mm
from lsvision.image.resampled import ResampledImage
from lsvision.image.stereo.relation import PairRelation
from lsvision.stages.line_motion.ideal_images import ideal_images
from lsvision.types import LineImage, Scan, StereoPair


@dataclass(frozen=True)
class ObjectPlace:
    """Where the object is.

    Attributes:
        depth_mm: how far away its middle is, by line. beside_mm: how far beyond the middle each of its columns lies.
        moved_px: by how many columns it stands beside its usual place, by line. first_column: of its columns.
    """

    depth_mm: Float[Tensor, " lines"]
    beside_mm: Float[Tensor, " columns"]
    moved_px: Float[Tensor, " lines"]
    first_column: int = 0

    @property
    def columns(self) -> Float[Tensor, " columns"]:
        """Its columns, px, float64."""
        return self.first_column + torch.arange(len(self.beside_mm), dtype=torch.float64)

    @property
    def profile_mm(self) -> Float[Tensor, " columns"]:
        """How far away each of its columns is, on average."""
        return self.depth_mm.mean() + self.beside_mm


@dataclass(frozen=True)
class ColorPair:
    """The two colours of a scan that look furthest apart along Y.

    Attributes:
        images: those of the scan, or of the ideal pair that stands for a raw one. relation: of the scan's two images.
        channels: of the colour that sees a piece of the object last, and of the one that sees it first.
        shift: lines by which each colour looks beyond green at z0, by channel.
        place: of the object; the further away it is, the further apart the colours' lines look.
    """

    scan: Scan
    images: StereoPair
    frame: ProductFrame
    relation: PairRelation
    channels: tuple[int, int]
    shift: Float[Tensor, " channels"]
    place: ObjectPlace

    @property
    def shift_mm(self) -> Sequence[float]:
        """Where along Y at z0 the two colours look, beyond green."""
        return [float(self.shift[channel]) * self.scan.travel.line_pitch_mm for channel in self.channels]

    @property
    def plane_slopes(self) -> Sequence[float]:
        """Y of where the two colours look, per mm of depth."""
        return [shift / zero_disparity_mm(self.frame.rig) for shift in self.shift_mm]

    def taken(self) -> Float[Tensor, "2 lines"]:
        """The (fractional) lines on which the two colours saw what green saw on each line, at the depth of the line."""
        shift_mm = torch.tensor(self.shift_mm, dtype=torch.float64)
        seen_at = self.frame.plane_y(shift_mm[:, None], self.place.depth_mm)
        return self.frame.shifted_line(torch.arange(self.scan.lines, dtype=torch.float64), seen_at)

    def rows(self) -> Float[Tensor, "2 lines"]:
        """The (fractional) rows of the images that show it in the two colours."""
        return self.taken() + self.registered[:, None]

    @property
    def registered(self) -> Float[Tensor, "2"]:
        """Rows by which the camera has shifted the two colours."""
        return registered_rows(self.scan, self.shift)[list(self.channels)]

    def left(self, channel: int, start: int, stop: int) -> Float[Tensor, "rows width"]:
        """One colour of some rows of the left image, of 255."""
        return _read(self.images.left, channel, torch.arange(start, stop)) * self._scale

    def right(self, channel: int, start: int, stop: int) -> Float[Tensor, "rows width"]:
        """The same of the right image, where it was taken at the same moments."""
        shift = self.relation.rows.whole
        return _read(self.images.right, channel, torch.arange(start + shift, stop + shift)) * self._scale

    @property
    def _scale(self) -> float:
        return 255.0 / self.relation.levels.white


def color_pair(scan: Scan, frame: ProductFrame, relation: PairRelation | None, place: ObjectPlace) -> ColorPair | None:
    """The two colours of a scan that look furthest apart; None where all look at one line, or nothing was matched."""
    shift = color_shift(scan)
    if shift is None or relation is None or not isinstance(scan.images, StereoPair):
        return None
    channels = int(shift.argmin()), int(shift.argmax())
    if scan.travel.transport == "reverse":
        channels = channels[::-1]
    rectification, images = Rectification.of(scan.raw_rig, frame.n), scan.images
    if rectification is not None:
        images = ideal_images(scan, rectification, place.columns, place.profile_mm)
    return ColorPair(scan, images, frame, relation, channels, shift, place)


def at_rows(values: Float[Tensor, "rows ..."], row: Float[Tensor, " lines"]) -> Float[Tensor, "lines ..."]:
    """Values at fractional rows; NaN beyond the first and the last."""
    base = row.floor().clamp(0, len(values) - 2).long()
    part = row - base
    part = part.masked_fill((part < 0) | (part > 1), torch.nan).to(values)
    return torch.lerp(values[base], values[base + 1], part.view(-1, *[1] * (values.ndim - 1)))


def _read(image: LineImage, channel: int, rows: Tensor) -> Float[Tensor, "rows width"]:
    """One colour of neighbouring rows of an image; beyond its ends those are repeated."""
    inside = rows.clamp(0, image.shape[0] - 1)
    first, last = int(inside[0]), int(inside[-1])
    if isinstance(image, ResampledImage):
        shown = image.read_as(range(first, last + 1), lambda values: values[..., [channel]].float())[..., 0]
    else:
        shown = image.read(first, last + 1)[..., channel]
    return shown[inside - first].float()
