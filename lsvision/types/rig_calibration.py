"""What a calibration of a raw rig comes to."""

from dataclasses import dataclass, field
from typing import Literal

from jaxtyping import Float
from torch import Tensor

from lsvision.types.calibration import ErrorAlongScan, Motion, Pose, Provenance
from lsvision.types.installation import Installation
from lsvision.types.raw_rig import RawRig

RigVerdict = Literal["determined", "prior-dominated", "inconsistent", "not converged"]


@dataclass(frozen=True)
class RigCombination:
    """A combination of what a calibration looks for that is known independently of the others.

    ``parts`` are its largest components by name, in sigmas of the prior; ``share`` is its sigma over the prior's, 1
    where the scans say nothing; ``bend_um`` is how far, rms, its sigma alone bends the heights of the field.
    """

    parts: tuple[tuple[str, float], ...]
    share: float
    bend_um: float

    @property
    def in_words(self) -> str:
        """Its components, the largest first."""
        return " ".join(f"{weight:+.2f} {name}" for name, weight in self.parts)


@dataclass(frozen=True)
class CameraResiduals:
    """What a rig leaves of the corners of all boards in one image, where it saw them.

    ``off`` is measured less predicted: column, px, and travel, mm; NaN where a corner was left out.
    """

    column_px: Float[Tensor, "boards corners"]
    depth_mm: Float[Tensor, "boards corners"]
    off: Float[Tensor, "boards corners 2"]


@dataclass(frozen=True)
class RigBoard:
    """How one board fits: ``rms`` of its corners' residuals in sigmas, 1 where they are as expected.

    ``held_out_rms`` is the same by the rig of all other boards, with the board's pose alone fitted; None where that was
    not asked for.
    """

    scan: str
    corners: int
    outliers: int
    pose: Pose
    rms: float
    held_out_rms: float | None = None


@dataclass(frozen=True)
class RigCalibration:
    """A raw rig and the motion, measured on scans of boards.

    ``covariance`` is of ``RIG_QUANTITIES``, in the units of the rig's file, and of n after them. ``noise_scale`` is how
    many times larger than stated the corners' errors are. ``height_error_um`` is how far, rms, the heights of the
    field may be bent by what is not known of the rig. ``unobserved`` are the combinations that the prior says more of
    than the scans. ``errors_along_scan`` are those of whole lines that were allowed for. ``installation`` is how to
    align the cameras; None where n is not usable.
    """

    rig: RawRig
    motion: Motion
    covariance: Float[Tensor, "shared shared"]
    boards: tuple[RigBoard, ...]
    residuals: tuple[CameraResiduals, CameraResiduals]
    noise_scale: float
    height_error_um: float
    unobserved: tuple[RigCombination, ...]
    advice: str
    verdict: RigVerdict
    reasons: tuple[str, ...] = ()
    errors_along_scan: tuple[ErrorAlongScan, ...] = ()
    installation: Installation | None = None
    provenance: Provenance = field(default_factory=lambda: Provenance("", ""))

    @property
    def usable(self) -> bool:
        """Whether scans may be measured with the rig."""
        return self.verdict in ("determined", "prior-dominated")
