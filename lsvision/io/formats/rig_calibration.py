"""The file of a calibrated raw rig: ``rig_calibration.json``, with the full covariance."""

from dataclasses import asdict
from pathlib import Path

from lsvision.io.formats.calibration import motion_to_dict
from lsvision.io.formats.installation import installation_to_dict
from lsvision.io.formats.raw_rig import raw_rig_to_dict
from lsvision.io.json_file import write_json
from lsvision.types import RIG_QUANTITIES, RigBoard, RigCalibration

RIG_CALIBRATION_FORMAT = "lsvision-rig-calibration/1"


def write_rig_calibration(calibration: RigCalibration, path: Path | str) -> None:
    """Write ``rig_calibration.json``.

    Raises:
        ValueError: the calibration holds NaN or infinity.
    """
    provenance = calibration.provenance
    data = {
        "format": RIG_CALIBRATION_FORMAT,
        "verdict": calibration.verdict,
        "reasons": list(calibration.reasons),
        "advice": calibration.advice,
        "noise_scale": calibration.noise_scale,
        "errors_along_scan": [asdict(item) for item in calibration.errors_along_scan],
        "height_error_um": calibration.height_error_um,
        "rig": raw_rig_to_dict(calibration.rig),
        "motion": motion_to_dict(calibration.motion),
        "installation": installation_to_dict(calibration.installation),
        "covariance": {"of": [*RIG_QUANTITIES, "n1", "n2", "n3"], "values": calibration.covariance.tolist()},
        "unobserved": [
            {"parts": dict(item.parts), "share": item.share, "bend_um": item.bend_um} for item in calibration.unobserved
        ],
        "boards": [_board(board) for board in calibration.boards],
        "provenance": {
            "version": provenance.version,
            "config_sha256": provenance.config_sha256,
            "scans": [{"path": scan, "sha256": sha256} for scan, sha256 in provenance.scans],
        },
    }
    write_json(path, data, strict=True)


def _board(board: RigBoard) -> dict[str, object]:
    pose = {"rotation": board.pose.rotation.tolist(), "translation_mm": board.pose.translation.tolist()}
    rest = {key: value for key, value in asdict(board).items() if key != "pose"}
    return {"scan": rest.pop("scan"), **pose, **rest}
