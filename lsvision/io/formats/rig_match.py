"""Whether a calibration was made with the rig of a scan."""

import math
from dataclasses import fields

from lsvision.errors import CalibrationError
from lsvision.geometry import is_rectified, quantities_of
from lsvision.types import RIG_QUANTITIES, Calibration, RawRig, Scan

_ROUNDING = 1e-12  # relative: turns are in degrees in files


def check_rig_match(calibration: Calibration, scan: Scan) -> None:
    """Check that a calibration was made with the rig of a scan.

    Raises:
        CalibrationError: the rigs differ; names the scan and the first differing entry.
    """
    difference = rig_difference(calibration, scan)
    if difference is not None:
        raise CalibrationError(f"{scan.path}: the calibration is for another rig: {difference}")


def rig_difference(calibration: Calibration, scan: Scan) -> str | None:
    """The first entry in which the rigs of a calibration and of a scan differ, in words; None where they are the same.

    Raw cameras are compared where both have them: calibrations of earlier versions have the ideal pair alone.
    """
    for item in fields(calibration.rig):
        ours, theirs = getattr(calibration.rig, item.name), getattr(scan.rig, item.name)
        if ours != theirs:
            return f"{item.name} {ours}, the scan's is {theirs}"
    if calibration.raw_rig is None:
        return None
    if scan.raw_rig is None:
        return None if is_rectified(calibration.raw_rig) else "its cameras are raw, the scan's are rectified"
    return _raw_difference(calibration.raw_rig, scan.raw_rig)


def _raw_difference(ours: RawRig, theirs: RawRig) -> str | None:
    """Of cameras that have the same ideal pair."""
    values = zip(RIG_QUANTITIES, quantities_of(ours).tolist(), quantities_of(theirs).tolist(), strict=True)
    for name, one, other in values:
        if not math.isclose(one, other, rel_tol=_ROUNDING):
            return f"{name} {one:.9g}, the scan's is {other:.9g}"
    return None if ours.width_px == theirs.width_px else f"width_px {ours.width_px}, the scan's is {theirs.width_px}"
