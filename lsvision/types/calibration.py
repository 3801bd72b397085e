"""What a calibration starts from and comes to: corners, motion, poses, verdict."""

from dataclasses import dataclass, field
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lsvision.schema import NonNegative, Positive
from lsvision.types.installation import Installation
from lsvision.types.line_motion import LineFinding, LineMotion
from lsvision.types.raw_rig import RawRig
from lsvision.types.scan import Rig

CalibrationMethod = Literal["joint", "two_step", "sequential", "least_squares"]
# Whether the motion from line to line is part of a calibration where the boards show one.
WhetherLineMotion = Literal["auto", "none"]
# What a calibration is worth, the first that holds from the right: see ``Calibration``.
Verdict = Literal["determined", "prior-dominated", "inconsistent", "not converged"]
# Verdicts without a usable n, as an option names them that uses one all the same.
RefusedVerdict = Literal["inconsistent", "not_converged"]


@dataclass(frozen=True)
class Pose:
    """Where the frame of a target stands: ``p = rotation p_frame + translation``, mm."""

    rotation: Float[Tensor, "*batch 3 3"]
    translation: Float[Tensor, "*batch 3"]


@dataclass(frozen=True)
class BoardCorners:
    """The corners of one board in one scan, measured and true.

    ``points`` are the measured ``(x, travel, z)`` of every corner in the order of ``board_points``; ``covariance`` is
    theirs, mm². A corner with ``valid`` false was not seen; its point is NaN. ``left_px`` and ``right_px`` are where
    both images show them, (column, line); of a raw rig, the images of its ideal pair.
    ``travel_mm`` is the travel of every line of the scan, where that is known. ``by_rig`` is how far points are off,
    mm, by each of the independent errors of a raw rig, of one sigma, which all its scans share. ``later_mm`` is the
    travel after which the right camera of a raw rig saw the corner; None where both see it at once.
    """

    scan: str
    points: Float[Tensor, "corners 3"]
    covariance: Float[Tensor, "corners 3 3"]
    valid: Bool[Tensor, " corners"]
    board_points: Float[Tensor, "corners 3"]
    left_px: Float[Tensor, "corners 2"]
    right_px: Float[Tensor, "corners 2"] | None = None
    travel_mm: Float[Tensor, " lines"] | None = None
    by_rig: Float[Tensor, "corners 3 modes"] | None = None
    later_mm: Float[Tensor, " corners"] | None = None


@dataclass(frozen=True)
class BoardEdges:
    """Where lines of a scan cross the edges of a board's squares, in both images.

    A crossing is a point of the straight edge from ``start`` to ``stop`` in the board frame, mm, but it is not known
    which. ``points`` are the measured (x, travel, z), mm; ``by_column`` is the derivative of (x, z) by the mean of the
    columns in both images and by the disparity, mm/px; ``sigma_px`` is how well single crossings are located, up to a
    common factor. ``segment`` is a number of the edge, ``line`` that of the line. ``later_mm`` is the travel after
    which the right camera saw the point; None where both see it at once.
    """

    scan: str
    points: Float[Tensor, "crossings 3"]
    by_column: Float[Tensor, "crossings 2 2"]
    sigma_px: Float[Tensor, " crossings"]
    start: Float[Tensor, "crossings 3"]
    stop: Float[Tensor, "crossings 3"]
    segment: Int[Tensor, " crossings"]
    line: Int[Tensor, " crossings"]
    later_mm: Float[Tensor, " crossings"] | None = None


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
    not known. ``outliers`` are the corners left out, as (column, row) from 1 at the board's origin. ``line_motion`` is
    what was found of the motion from line to line, and empty where there is none; its values are in the file of that
    name.
    """

    scan: str
    corners: int
    pose: Pose
    rmse_before_mm: float
    rmse_after_mm: float
    reduced_chi_square: float | None = None
    outliers: tuple[tuple[int, int], ...] = ()
    largest_residual: float | None = None
    line_motion: tuple[LineFinding, ...] = ()
    line_motion_file: str | None = None


@dataclass(frozen=True)
class ErrorAlongScan:
    """An error that all corners of a line share, as of vibration or of the encoder, in one component of their points.

    Of a turn about the travel (``roll``), ``rms_mm`` is that of what it displaces the corners by. ``length_mm`` is that
    of a wave along the travel whose correlation falls as fast.
    """

    component: Literal["x", "travel", "z", "roll"]
    rms_mm: Positive
    length_mm: Positive

    @property
    def in_words(self) -> str:
        """What it is, for a reader."""
        words = {"x": "sideways", "travel": "in the travel", "z": "in depth", "roll": "by a turn about the travel"}
        size = f"{self.rms_mm:.2g} mm rms {words[self.component]}"
        return f"errors along the scan: {size}, about {self.length_mm:.2g} mm long"


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
    ``line_motions`` are these line by line, for every board's scan, and empty where they are not part of the result;
    the RMSE after is then without them. ``raw_rig`` are the cameras where they are raw, ``rig`` their ideal pair then.
    ``installation`` is how to align the cameras; None where n is not usable.
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
    line_motions: tuple[LineMotion, ...] = ()
    raw_rig: RawRig | None = None
    installation: Installation | None = None
    provenance: Provenance = field(default_factory=lambda: Provenance("", ""))

    @property
    def improvement(self) -> float:
        """Share of the RMSE that the calibration removed, 1 - after / before."""
        return 1.0 - self.rmse_after_mm / self.rmse_before_mm

    @property
    def usable(self) -> bool:
        """Whether its n may correct scans: the verdict is ``determined`` or ``prior-dominated``."""
        return self.verdict in ("determined", "prior-dominated")
