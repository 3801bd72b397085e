"""The calibration file: ``calibration.json``."""

import math
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from lsvision.errors import FileFormatError
from lsvision.io.formats.installation import installation_to_dict
from lsvision.io.formats.raw_rig import RawRigEntries, raw_rig_to_dict
from lsvision.io.formats.rig import RigEntries, rig_to_dict
from lsvision.io.formats.validation import Matrix, Triple, read_entries, read_json
from lsvision.io.json_file import write_json
from lsvision.schema import Checked, NonNegative, Positive, PositiveInt, Text
from lsvision.types import (
    BoardFit,
    Calibration,
    CalibrationMethod,
    ErrorAlongScan,
    Iteration,
    LineFinding,
    Motion,
    Observability,
    ObservedDirection,
    Pose,
    Provenance,
    Verdict,
)

CalibrationFormat = Literal["lsvision-calibration/1"]
CALIBRATION_FORMAT: CalibrationFormat = "lsvision-calibration/1"

# Rounding of a covariance that was computed as a product; a real fault is far larger.
_COVARIANCE_ROUNDING = 1e-9


@dataclass(frozen=True)
class MotionEntries(Checked):
    """Entry ``motion``; what follows from n is accepted whatever it says."""

    n: Triple
    covariance: Matrix
    stretch: object = None
    angles_deg: object = None
    sigma: object = None

    def motion(self, path: Path) -> Motion:
        """The motion.

        Raises:
            FileFormatError: n does not advance along Y, or the covariance is none; names ``path``.
        """
        if self.n[1] <= 0:
            raise FileFormatError(path, f"expected a number > 0, the travel along Y, got {self.n[1]}", "motion.n[1]")
        covariance = _float64(self.covariance)
        slack = _COVARIANCE_ROUNDING * float(covariance.abs().max())
        if float((covariance - covariance.mT).abs().max()) > slack:
            raise FileFormatError(path, "expected a symmetric matrix", "motion.covariance")
        if float(torch.linalg.eigvalsh(covariance).min()) < -slack:
            raise FileFormatError(path, "expected a positive semidefinite matrix", "motion.covariance")
        return Motion(_float64(self.n), covariance)


@dataclass(frozen=True)
class BoardEntries(Checked):
    """An entry of ``boards``."""

    scan: Text
    corners: PositiveInt
    rotation: Matrix
    translation_mm: Triple
    rmse_before_mm: NonNegative
    rmse_after_mm: NonNegative
    reduced_chi_square: NonNegative | None = None
    outliers: tuple[tuple[int, int], ...] = ()
    largest_residual: NonNegative | None = None
    line_motion: tuple[LineFinding, ...] = ()
    line_motion_file: str | None = None

    def fit(self) -> BoardFit:
        """The board's fit."""
        pose = Pose(_float64(self.rotation), _float64(self.translation_mm))
        rest = {item.name: getattr(self, item.name) for item in fields(BoardFit) if item.name != "pose"}
        return BoardFit(pose=pose, **rest)


@dataclass(frozen=True)
class ObservabilityEntries(Checked):
    """Entry ``observability``; its verdict follows from the directions and is accepted as it is."""

    directions: tuple[ObservedDirection, ...]
    advice: str
    verdict: object = None


@dataclass(frozen=True)
class ScanHash(Checked):
    """An entry of ``provenance.scans``."""

    path: str
    sha256: str


@dataclass(frozen=True)
class ProvenanceEntries(Checked):
    """Entry ``provenance``."""

    version: str
    config_sha256: str
    scans: list[ScanHash]


@dataclass(frozen=True)
class CalibrationEntries(Checked):
    """The entries of ``calibration.json``; the improvement and the installation follow and are accepted as they are.

    Files of earlier versions lack ``verdict``, ``reasons``, ``noise_scale`` and ``errors_along_scan``.
    """

    format: CalibrationFormat
    method: CalibrationMethod
    motion: MotionEntries
    rmse_before_mm: NonNegative
    rmse_after_mm: NonNegative
    iterations: tuple[Iteration, ...]
    boards: list[BoardEntries]
    observability: ObservabilityEntries
    rig: RigEntries
    provenance: ProvenanceEntries
    raw_rig: RawRigEntries | None = None
    verdict: Verdict | None = None
    reasons: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    noise_scale: Positive = 1.0
    errors_along_scan: tuple[ErrorAlongScan, ...] = ()
    converged: bool | None = None
    improvement: object = None
    installation: object = None


def write_calibration(calibration: Calibration, path: Path | str) -> None:
    """Write ``calibration.json``; every float64 comes back to the bit.

    Raises:
        ValueError: the calibration holds NaN or infinity.
    """
    observability, provenance = calibration.observability, calibration.provenance
    data = {
        "format": CALIBRATION_FORMAT,
        "method": calibration.method,
        "verdict": calibration.verdict,
        "reasons": list(calibration.reasons),
        "notes": list(calibration.notes),
        "converged": calibration.converged,
        "noise_scale": calibration.noise_scale,
        "errors_along_scan": [asdict(item) for item in calibration.errors_along_scan],
        "motion": motion_to_dict(calibration.motion),
        "rmse_before_mm": calibration.rmse_before_mm,
        "rmse_after_mm": calibration.rmse_after_mm,
        "improvement": calibration.improvement,
        "iterations": [asdict(item) for item in calibration.iterations],
        "boards": [_board_to_dict(board) for board in calibration.boards],
        "observability": {
            "verdict": "determined" if observability.determined else "prior-dominated",
            "directions": [asdict(item) for item in observability.directions],
            "advice": observability.advice,
        },
        "installation": installation_to_dict(calibration.installation),
        "rig": rig_to_dict(calibration.rig),
        **({} if calibration.raw_rig is None else {"raw_rig": raw_rig_to_dict(calibration.raw_rig)}),
        "provenance": {
            "version": provenance.version,
            "config_sha256": provenance.config_sha256,
            "scans": [{"path": scan, "sha256": sha256} for scan, sha256 in provenance.scans],
        },
    }
    write_json(path, data, strict=True)


def read_calibration(path: Path | str) -> Calibration:
    """Read ``calibration.json``. What follows from n (stretch, angles, sigma) is computed anew.

    Raises:
        FileFormatError: an entry is missing, unknown, not finite or out of range.
    """
    entries = read_entries(CalibrationEntries, read_json(path := Path(path)), path)
    observability = Observability(entries.observability.directions, entries.observability.advice)
    converged = entries.converged is not False
    return Calibration(
        method=entries.method,
        verdict=entries.verdict or _verdict_of_earlier_file(converged, observability),
        reasons=entries.reasons,
        notes=entries.notes,
        converged=converged,
        noise_scale=entries.noise_scale,
        errors_along_scan=entries.errors_along_scan,
        motion=entries.motion.motion(path),
        rmse_before_mm=entries.rmse_before_mm,
        rmse_after_mm=entries.rmse_after_mm,
        iterations=entries.iterations,
        boards=tuple(board.fit() for board in entries.boards),
        observability=observability,
        rig=entries.rig.rig(),
        raw_rig=None if entries.raw_rig is None else entries.raw_rig.rig(),
        provenance=Provenance(
            version=entries.provenance.version,
            config_sha256=entries.provenance.config_sha256,
            scans=tuple((scan.path, scan.sha256) for scan in entries.provenance.scans),
        ),
    )


def motion_to_dict(motion: Motion) -> dict[str, object]:
    """What a file says of a motion: n, what follows from it, and its covariance."""
    n1, n2, n3 = n = motion.n.double().tolist()
    return {
        "n": n,
        "stretch": motion.stretch,
        "angles_deg": {"x": math.degrees(math.atan2(n1, n2)), "z": math.degrees(math.atan2(n3, n2))},
        "covariance": motion.covariance.double().tolist(),
        "sigma": motion.sigma.double().tolist(),
    }


def _board_to_dict(board: BoardFit) -> dict[str, object]:
    rest = {key: value for key, value in asdict(board).items() if key != "pose"}
    rotation, translation = board.pose.rotation.double().tolist(), board.pose.translation.double().tolist()
    pose = {"rotation": rotation, "translation_mm": translation}
    return {"scan": board.scan, "corners": board.corners, **pose, **rest}


def _verdict_of_earlier_file(converged: bool, observability: Observability) -> Verdict:
    known: Verdict = "determined" if observability.determined else "prior-dominated"
    return known if converged else "not converged"


def _float64(numbers: Triple | Matrix) -> Tensor:
    return torch.tensor(numbers, dtype=torch.float64)
