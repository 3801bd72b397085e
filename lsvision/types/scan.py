"""What is scanned, and with what: rig, board, travel, images, a scan and its depth."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.schema import Checked, IntFrom2, Positive, PositiveInt
from lsvision.types.line_motion import LineMotion
from lsvision.types.raw_rig import RawRig

Transport = Literal["forward", "reverse"]
# What is done about lines of an image that are not there: the scan is refused, or goes on without them.
MissingLines = Literal["refuse", "mark"]


@dataclass(frozen=True)
class Rig(Checked):
    """A rectified pair of line cameras: both sensors on one line, optical axes parallel (Eq. 2).

    ``color_spacing_lines`` is where the red, green and blue sensor lines of a trilinear sensor look along Y at the
    depth of zero disparity, in nominal lines; (0, 0, 0) where all three see the same line of the object.
    """

    width_px: PositiveInt
    pixel_pitch_um: Positive
    focal_length_mm: Positive
    baseline_mm: Positive
    principal_left_px: float
    principal_right_px: float
    color_spacing_lines: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        left, right = self.principal_left_px, self.principal_right_px
        if right <= left:  # no plane in front of the cameras has zero disparity
            raise self.fault("principal_right_px", f"expected a finite number > {left:g}, got {right}")


@dataclass(frozen=True)
class Board(Checked):
    """A checkerboard of ``columns x rows`` squares; the longer side, X, comes first."""

    columns: IntFrom2
    rows: IntFrom2
    square_mm: Positive

    @property
    def inner(self) -> tuple[int, int]:
        """Number of inner corners along X and along Y."""
        return self.columns - 1, self.rows - 1

    def corner_points(self) -> Float[Tensor, "corners 3"]:
        """Inner corners in the board frame, row by row from the origin, X fastest; float64, mm."""
        nx, ny = self.inner
        y, x = torch.meshgrid(
            torch.arange(ny, dtype=torch.float64), torch.arange(nx, dtype=torch.float64), indexing="ij"
        )
        return torch.stack([x, y, torch.zeros_like(x)], dim=-1).reshape(-1, 3) * self.square_mm


@dataclass(frozen=True)
class Travel:
    """Nominal travel of the object by line: constant pitch, or an encoder's position log.

    ``positions_mm`` holds one position per line, increasing, and replaces the pitch where it is given. A reversed
    transport makes later lines see smaller Y. ``sigma_mm`` is the standard deviation of the positions of a log that was
    repaired, above zero on the lines that were; None where none was.
    """

    line_pitch_mm: Positive
    positions_mm: Float[Tensor, " lines"] | None = None
    transport: Transport = "forward"
    sigma_mm: Float[Tensor, " lines"] | None = None


@runtime_checkable
class LineImage(Protocol):
    """A tall image read by line ranges; nothing ever loads the whole of it."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """(lines, width, channels)."""
        ...

    @property
    def dtype(self) -> torch.dtype:
        """uint8, uint16 or float32."""
        ...

    def read(self, start: int, stop: int) -> Tensor:
        """Lines ``start..stop-1`` as a tensor ``(stop - start, width, channels)``."""
        ...


def missing_ranges(image: LineImage) -> tuple[range, ...]:
    """Lines of an image that are not there, in order; what ``read`` gives for them means nothing."""
    ranges: tuple[range, ...] = getattr(image, "missing", ())  # only images of several files can lack some
    return ranges


@dataclass(frozen=True)
class TensorImage:
    """A ``LineImage`` of a tensor ``(lines, width, channels)`` that is in memory already."""

    tensor: Tensor

    @property
    def shape(self) -> tuple[int, int, int]:
        """(lines, width, channels)."""
        lines, width, channels = self.tensor.shape
        return lines, width, channels

    @property
    def dtype(self) -> torch.dtype:
        """The tensor's."""
        return self.tensor.dtype

    def read(self, start: int, stop: int) -> Tensor:
        """Lines ``start..stop-1``."""
        return self.tensor[start:stop]


@dataclass(frozen=True)
class StereoPair:
    """The images of a scan that two cameras took, line by line at the same moments."""

    left: LineImage
    right: LineImage


@dataclass(frozen=True)
class DepthView:
    """The image of a scan whose camera matched itself, and its depth map: float32 z, mm, NaN where not measured."""

    left: LineImage
    depth: LineImage


@dataclass(frozen=True)
class Scan:
    """One pass of an object under the rig; ``line_motion`` is what was logged of its motion from line to line.

    ``raw_rig`` are the cameras of images that are not rectified, and ``rig`` the ideal pair that follows from them;
    None where the images are those of ``rig`` itself.
    """

    path: Path
    rig: Rig
    travel: Travel
    images: StereoPair | DepthView
    color_registered: bool = True
    attributes: Mapping[str, str] = field(default_factory=dict)
    line_motion: LineMotion | None = None
    raw_rig: RawRig | None = None

    @property
    def left(self) -> LineImage:
        """The image that colours come from and positions refer to."""
        return self.images.left

    @property
    def lines(self) -> int:
        """Number of lines of the scan."""
        return self.left.shape[0]

    @property
    def missing(self) -> Mapping[str, tuple[range, ...]]:
        """The lines that are not there, by the name of the image; empty where none are missing."""
        named = {name: missing_ranges(image) for name, image in vars(self.images).items()}
        return {name: ranges for name, ranges in named.items() if ranges}

    @property
    def missing_lines(self) -> int:
        """Number of lines that are not there in at least one image."""
        return len({line for ranges in self.missing.values() for lines in ranges for line in lines})


@dataclass(frozen=True)
class Depth:
    """Depth of some scan lines.

    Attributes:
        z: mm in the scan frame, float32, NaN where not measured.
        sigma: its standard deviation, mm, or None where it is not known.
    """

    z: Float[Tensor, "lines width"]
    sigma: Float[Tensor, "lines width"] | None = None


@runtime_checkable
class DepthSource(Protocol):
    """The depth of a scan's left image, read by line ranges."""

    @property
    def lines(self) -> int:
        """Number of lines of the scan."""
        ...

    def read(self, start: int, stop: int) -> Depth:
        """Depth of lines ``start..stop-1``."""
        ...


@dataclass(frozen=True)
class StoredDepth:
    """A depth map in a file, and its standard deviation where that was stored too."""

    z: LineImage
    sigma: LineImage | None = None

    @property
    def lines(self) -> int:
        """Number of lines of the scan."""
        return self.z.shape[0]

    def read(self, start: int, stop: int) -> Depth:
        """Depth of lines ``start..stop-1``."""
        sigma = None if self.sigma is None else self.sigma.read(start, stop)[..., 0]
        return Depth(self.z.read(start, stop)[..., 0], sigma)
