"""The calibration file: ``calibration.json``."""

import json
import math
from dataclasses import fields as dataclass_fields
from pathlib import Path
from typing import Literal, cast, get_args

import torch
from torch import Tensor

from lsvision.errors import CalibrationError
from lsvision.io.atomic import write_text
from lsvision.io.formats.rig import rig_from_dict, rig_to_dict
from lsvision.io.formats.validation import Fields, read_json
from lsvision.types import (
    BoardFit,
    Calibration,
    CalibrationMethod,
    Iteration,
    Motion,
    Observability,
    ObservedDirection,
    Provenance,
    Scan,
)

CALIBRATION_FORMAT = "lsvision-calibration/1"

# Rounding of a covariance that was computed as a product; a real fault is far larger.
_COVARIANCE_ROUNDING = 1e-9


def write_calibration(calibration: Calibration, path: Path | str) -> None:
    """Write ``calibration.json``; every float64 comes back to the bit.

    Raises:
        ValueError: the calibration holds NaN or infinity.
    """
    observability, provenance = calibration.observability, calibration.provenance
    data = {
        "format": CALIBRATION_FORMAT,
        "method": calibration.method,
        "converged": calibration.converged,
        "motion": _motion_to_dict(calibration.motion),
        "rmse_before_mm": calibration.rmse_before_mm,
        "rmse_after_mm": calibration.rmse_after_mm,
        "improvement": calibration.improvement,
        "iterations": [
            {"rmse_mm": item.rmse_mm, "n": list(item.n), "stretch": item.stretch} for item in calibration.iterations
        ],
        "boards": [_board_to_dict(board) for board in calibration.boards],
        "observability": {
            "verdict": observability.verdict,
            "directions": [
                {
                    "vector": list(item.vector),
                    "prior_sigma": item.prior_sigma,
                    "posterior_sigma": item.posterior_sigma,
                    "observed": item.observed,
                }
                for item in observability.directions
            ],
            "advice": observability.advice,
        },
        "rig": rig_to_dict(calibration.rig),
        "provenance": {
            "version": provenance.version,
            "config_sha256": provenance.config_sha256,
            "scans": [{"path": scan, "sha256": sha256} for scan, sha256 in provenance.scans],
        },
    }
    write_text(path, json.dumps(data, indent=2, allow_nan=False, ensure_ascii=False) + "\n")


def read_calibration(path: Path | str) -> Calibration:
    """Read ``calibration.json``. What follows from n (stretch, angles, sigma) is computed anew.

    Raises:
        FileFormatError: an entry is missing, unknown, not finite or out of range.
    """
    path = Path(path)
    fields = Fields(path, read_json(path))
    fields.choice("format", CALIBRATION_FORMAT)
    fields.has("improvement")  # follows from the two RMSE
    calibration = Calibration(
        method=cast(CalibrationMethod, fields.choice("method", *get_args(CalibrationMethod))),
        converged=fields.flag("converged") if fields.has("converged") else True,
        motion=_read_motion(fields.section("motion")),
        rmse_before_mm=fields.number("rmse_before_mm", at_least=0),
        rmse_after_mm=fields.number("rmse_after_mm", at_least=0),
        iterations=tuple(_read_iteration(item) for item in fields.sections("iterations")),
        boards=tuple(_read_board(item) for item in fields.sections("boards")),
        observability=_read_observability(fields.section("observability")),
        rig=rig_from_dict(fields.take("rig"), path, "rig."),
        provenance=_read_provenance(fields.section("provenance")),
    )
    fields.finish()
    return calibration


def check_rig_match(calibration: Calibration, scan: Scan) -> None:
    """Check that a calibration was made with the rig of a scan.

    Raises:
        CalibrationError: the rigs differ; names the scan and the first differing entry.
    """
    for item in dataclass_fields(calibration.rig):
        ours, theirs = getattr(calibration.rig, item.name), getattr(scan.rig, item.name)
        if ours != theirs:
            raise CalibrationError(
                f"{scan.path}: the calibration is for another rig: {item.name} {ours}, the scan's is {theirs}"
            )


def _motion_to_dict(motion: Motion) -> dict[str, object]:
    n1, n2, n3 = n = motion.n.double().tolist()
    return {
        "n": n,
        "stretch": motion.stretch,
        "angles_deg": {"x": math.degrees(math.atan2(n1, n2)), "z": math.degrees(math.atan2(n3, n2))},
        "covariance": motion.covariance.double().tolist(),
        "sigma": motion.sigma.double().tolist(),
    }


def _read_motion(fields: Fields) -> Motion:
    n = fields.tensor("n", 3)
    if n[1] <= 0:
        raise fields.error("n[1]", f"expected a number > 0, the travel along Y, got {float(n[1])}")
    covariance = fields.tensor("covariance", 3, 3)
    _check_covariance(fields, covariance)
    for derived in ("stretch", "angles_deg", "sigma"):
        fields.has(derived)
    fields.finish()
    return Motion(n, covariance)


def _check_covariance(fields: Fields, covariance: Tensor) -> None:
    slack = _COVARIANCE_ROUNDING * float(covariance.abs().max())
    if float((covariance - covariance.mT).abs().max()) > slack:
        raise fields.error("covariance", "expected a symmetric matrix")
    if float(torch.linalg.eigvalsh(covariance).min()) < -slack:
        raise fields.error("covariance", "expected a positive semidefinite matrix")


def _read_iteration(fields: Fields) -> Iteration:
    iteration = Iteration(fields.number("rmse_mm", at_least=0), _triple(fields, "n"), fields.number("stretch", above=0))
    fields.finish()
    return iteration


def _board_to_dict(board: BoardFit) -> dict[str, object]:
    return {
        "scan": board.scan,
        "corners": board.corners,
        "rotation": board.rotation.double().tolist(),
        "translation_mm": board.translation_mm.double().tolist(),
        "rmse_before_mm": board.rmse_before_mm,
        "rmse_after_mm": board.rmse_after_mm,
    }


def _read_board(fields: Fields) -> BoardFit:
    board = BoardFit(
        scan=fields.text("scan"),
        corners=fields.integer("corners", at_least=1),
        rotation=fields.tensor("rotation", 3, 3),
        translation_mm=fields.tensor("translation_mm", 3),
        rmse_before_mm=fields.number("rmse_before_mm", at_least=0),
        rmse_after_mm=fields.number("rmse_after_mm", at_least=0),
    )
    fields.finish()
    return board


def _read_observability(fields: Fields) -> Observability:
    verdict = fields.choice("verdict", "determined", "prior-dominated")
    directions = []
    for item in fields.sections("directions"):
        sigmas = item.number("prior_sigma", above=0), item.number("posterior_sigma", at_least=0)
        directions.append(ObservedDirection(_triple(item, "vector"), *sigmas, item.flag("observed")))
        item.finish()
    advice = fields.text("advice", empty=True)
    fields.finish()
    return Observability(cast(Literal["determined", "prior-dominated"], verdict), tuple(directions), advice)


def _read_provenance(fields: Fields) -> Provenance:
    scans = []
    for item in fields.sections("scans"):
        scans.append((item.text("path", empty=True), item.text("sha256", empty=True)))
        item.finish()
    provenance = Provenance(fields.text("version", empty=True), fields.text("config_sha256", empty=True), tuple(scans))
    fields.finish()
    return provenance


def _triple(fields: Fields, key: str) -> tuple[float, float, float]:
    first, second, third = fields.tensor(key, 3).tolist()
    return first, second, third
