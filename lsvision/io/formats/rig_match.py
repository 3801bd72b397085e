"""Whether a calibration was made with the rig of a scan."""

from dataclasses import fields

from lsvision.errors import CalibrationError
from lsvision.types import Calibration, Scan


def check_rig_match(calibration: Calibration, scan: Scan) -> None:
    """Check that a calibration was made with the rig of a scan.

    Raises:
        CalibrationError: the rigs differ; names the scan and the first differing entry.
    """
    for item in fields(calibration.rig):
        ours, theirs = getattr(calibration.rig, item.name), getattr(scan.rig, item.name)
        if ours != theirs:
            raise CalibrationError(
                f"{scan.path}: the calibration is for another rig: {item.name} {ours}, the scan's is {theirs}"
            )
