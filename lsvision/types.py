"""The frozen dataclasses that flow between the stages.

Units are millimetres, pixels and lines; angles are radians unless a name ends in ``_deg``. Pixel centres are integers.
Leading batch dimensions are written ``*batch``. Frames are those of the README's convention table: scan frame S, board
frame C, product frame M. One file, long as it is: it is the vocabulary that all packages share.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from lsvision.schema import Checked, IntFrom2, NonNegative, Positive, PositiveInt

Transport = Literal["forward", "reverse"]
# What is done about lines of an image that are not there: the scan is refused, or goes on without them.
MissingLines = Literal["refuse", "mark"]
CalibrationMethod = Literal["joint", "two_step", "sequential", "least_squares"]
# What a calibration is worth, the first that holds from the right: see ``Calibration``.
Verdict = Literal["determined", "prior-dominated", "inconsistent", "not converged"]
# Verdicts without a usable n, as an option names them that uses one all the same.
RefusedVerdict = Literal["inconsistent", "not_converged"]


@dataclass(frozen=True)
class Rig(Checked):
    """A rectified pair of line cameras: both sensors on one line, optical axes parallel (Eq. 2).

    ``color_spacing_lines`` is where the red, green and blue sensor lines look along Y, in nominal lines, for a
    trilinear sensor; (0, 0, 0) where all three see the same line of the object.
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
    """One pass of an object under the rig."""

    path: Path
    rig: Rig
    travel: Travel
    images: StereoPair | DepthView
    color_registered: bool = True
    attributes: Mapping[str, str] = field(default_factory=dict)

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


@dataclass(frozen=True)
class Pose:
    """Where the frame of a target stands: ``p = rotation p_frame + translation``, mm."""

    rotation: Float[Tensor, "*batch 3 3"]
    translation: Float[Tensor, "*batch 3"]


@dataclass(frozen=True)
class BoardCorners:
    """The corners of one board in one scan, measured and true.

    ``points`` are the measured ``(x, travel, z)`` of every corner in the order of ``board_points``; ``covariance`` is
    theirs, mm². A corner with ``valid`` false was not seen; its point is NaN.
    """

    scan: str
    points: Float[Tensor, "corners 3"]
    covariance: Float[Tensor, "corners 3 3"]
    valid: Bool[Tensor, " corners"]
    board_points: Float[Tensor, "corners 3"]
    left_px: Float[Tensor, "corners 2"]
    right_px: Float[Tensor, "corners 2"] | None = None


@dataclass(frozen=True)
class Motion:
    """Displacement ``n`` of the object in mm per nominal mm of travel, and how well it is known."""

    n: Float[Tensor, "3"]
    covariance: Float[Tensor, "3 3"]

    @property
    def stretch(self) -> float:
        """Length of n: true over nominal travel."""
        return float(torch.linalg.vector_norm(self.n))

    @property
    def sigma(self) -> Float[Tensor, "3"]:
        """Standard deviation of each component of n."""
        return self.covariance.diagonal(dim1=-2, dim2=-1).sqrt()

    @property
    def drift_mm_per_m(self) -> tuple[float, float]:
        """How far the object moves sideways (X) and in depth (Z) per metre along Y, mm."""
        n1, n2, n3 = self.n.tolist()
        return 1000.0 * n1 / n2, 1000.0 * n3 / n2


@dataclass(frozen=True)
class Iteration:
    """State of a calibration after one iteration."""

    rmse_mm: NonNegative
    n: tuple[float, float, float]
    stretch: Positive


@dataclass(frozen=True)
class BoardFit:
    """Pose of one board in the scan frame, and its residuals before and after calibration.

    ``corners`` is how many were used. ``reduced_chi_square`` compares their residuals after with their given
    covariance: 1 where they are as expected; ``largest_residual`` is that of one corner, in sigmas; None where they are
    not known. ``outliers`` are the corners left out, as (column, row) from 1 at the board's origin.
    """

    scan: str
    corners: int
    pose: Pose
    rmse_before_mm: float
    rmse_after_mm: float
    reduced_chi_square: float | None = None
    outliers: tuple[tuple[int, int], ...] = ()
    largest_residual: float | None = None


@dataclass(frozen=True)
class ErrorAlongScan:
    """An error that all corners of a line share, as of vibration or of the encoder, in one component of their points.

    ``length_mm`` is that of a wave along the travel whose correlation falls as fast.
    """

    component: Literal["x", "travel", "z"]
    rms_mm: Positive
    length_mm: Positive

    @property
    def in_words(self) -> str:
        """What it is, for a reader."""
        where = {"x": "sideways", "travel": "in the travel", "z": "in depth"}[self.component]
        return f"errors along the scan: {self.rms_mm:.2g} mm rms {where}, about {self.length_mm:.2g} mm long"


@dataclass(frozen=True)
class ObservedDirection:
    """A direction of n and how much the data narrowed the prior along it."""

    vector: tuple[float, float, float]
    prior_sigma: Positive
    posterior_sigma: NonNegative
    observed: bool


@dataclass(frozen=True)
class Observability:
    """Whether the boards determine n, direction by direction, and what to scan next."""

    directions: tuple[ObservedDirection, ...]
    advice: str

    @property
    def determined(self) -> bool:
        """Whether the boards show every direction."""
        return all(direction.observed for direction in self.directions)


@dataclass(frozen=True)
class Provenance:
    """What a calibration was made from: version, configuration and the scans with their hashes."""

    version: str
    config_sha256: str
    scans: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class Calibration:
    """The motion of an object under a rig, measured on one or more boards.

    The verdict is ``not converged`` where the estimate did not settle; else ``inconsistent`` where the boards
    contradict each other, what was said of them, or the model; else ``prior-dominated`` where they leave a direction of
    n to the prior; else ``determined``. ``reasons`` are the sentences that say why it is not ``determined``,
    ``notes`` what else was noticed and allowed for.
    ``noise_scale`` is how many times larger than the corners' given covariance their residuals are, 1 where they are as
    expected; the covariance of n allows for it, and for the ``errors_along_scan`` that the residuals show.
    """

    method: CalibrationMethod
    motion: Motion
    rmse_before_mm: float
    rmse_after_mm: float
    iterations: tuple[Iteration, ...]
    boards: tuple[BoardFit, ...]
    observability: Observability
    rig: Rig
    verdict: Verdict = "determined"
    reasons: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    converged: bool = True
    noise_scale: float = 1.0
    errors_along_scan: tuple[ErrorAlongScan, ...] = ()
    provenance: Provenance = field(default_factory=lambda: Provenance("", ""))

    @property
    def improvement(self) -> float:
        """Share of the RMSE that the calibration removed, 1 - after / before."""
        return 1.0 - self.rmse_after_mm / self.rmse_before_mm

    @property
    def usable(self) -> bool:
        """Whether its n may correct scans: the verdict is ``determined`` or ``prior-dominated``."""
        return self.verdict in ("determined", "prior-dominated")


@dataclass(frozen=True)
class ProductGrid:
    """Cells of a product: cell (row, column) lies at q_y = origin_y + row·pitch, q_x = origin_x + column·pitch, mm."""

    rows: int
    columns: int
    pitch_mm: float
    origin_y_mm: float
    origin_x_mm: float

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns)."""
        return self.rows, self.columns

    @property
    def origin_mm(self) -> tuple[float, float]:
        """(q_y, q_x) of the centre of cell (0, 0)."""
        return self.origin_y_mm, self.origin_x_mm

    def q_x(self, columns: slice) -> Float[Tensor, " columns"]:
        """Places of a range of columns across the motion, mm, float64."""
        return self.origin_x_mm + self.pitch_mm * torch.arange(columns.start, columns.stop).double()

    def q_y(self, row: int) -> float:
        """Place of a row along the motion, mm."""
        return self.origin_y_mm + self.pitch_mm * row


@dataclass(frozen=True)
class ProductStrip:
    """Consecutive rows of a product, the first of which is ``row``.

    Attributes:
        color: in the scan's dtype.
        height: float32, mm towards the cameras from the middle of the plane of zero disparity, NaN where not measured.
        valid: where the height was measured.
        source: (line, column) of the scan that the colour came from, NaN where no line saw the cell; float32, for long
            scans float64.
        sigma: float32, mm, standard deviations of (q_x, q_y, q_z), where they were asked for.
    """

    row: int
    color: Shaped[Tensor, "rows columns channels"]
    height: Float[Tensor, "rows columns"]
    valid: Bool[Tensor, "rows columns"]
    source: Float[Tensor, "rows columns 2"]
    sigma: Float[Tensor, "rows columns 3"] | None = None
