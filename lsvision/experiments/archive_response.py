"""``+experiment=response archive=DIR``: the response of the cameras from scans whose objects wander sideways."""

import logging
from dataclasses import dataclass
from pathlib import Path

import torch

from lsvision.archive import Found, calibration_for, find_scans, measured_line_motion, read_calibrations
from lsvision.errors import ConfigError, LsvisionError, ResponseError
from lsvision.experiments.stored_depth import stored_depth
from lsvision.geometry import Camera, object_pitch_mm
from lsvision.io import read_scan
from lsvision.stages.disparity.config import DisparityConfig
from lsvision.stages.disparity.depth import depth_of
from lsvision.stages.line_motion.config import LineMotionConfig
from lsvision.stages.response.archive import Offsets, gains_of_scan, response_of_scans
from lsvision.stages.response.config import ResponseConfig
from lsvision.stages.response.measured import MeasuredResponse
from lsvision.stages.response.wander import WanderGains

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ArchiveResponse:
    """What an archive shows: responses by camera, the scans used, their wander, px rms, and the waves it observes."""

    measured: dict[Camera, MeasuredResponse]
    scans: list[Path]
    wander_px: dict[str, float]
    observed_px: float


def measure_archive(
    archive: str, calibration: str, offsets: Offsets, config: ResponseConfig, folder: Path
) -> ArchiveResponse:
    """Measure the sideways motion of every scan on its profile, and the gains that it separates.

    Args:
        folder: where matched depth is kept while a scan is worked on.

    Raises:
        ResponseError: no scan can be used, or none wanders enough.
    """
    calibrations = read_calibrations(calibration)
    gains: dict[Camera, dict[str, WanderGains]] = {}
    scans, reasons = [], []
    for found in find_scans(archive):
        try:
            of_scan = _gains(found, calibrations, offsets, config, folder)
        except LsvisionError as error:
            reasons.append(str(error))
            log.warning("left out: %s", error)
            continue
        scans.append(found.path)
        for camera, item in of_scan.items():
            gains.setdefault(camera, {})[found.key] = item
    if not gains:
        raise ResponseError(f"archive: no scan shows how its object wanders: {'; '.join(reasons[:3]) or 'none found'}")
    widths = {camera: next(iter(found.values())).log_gain for camera, found in gains.items()}
    measured = {
        camera: response_of_scans(found, offsets.by_camera.get(camera, torch.zeros_like(widths[camera])), config)
        for camera, found in gains.items()
    }
    of_left = gains["left"]
    used = {name: item for name, item in of_left.items() if item.wander_px >= config.least_wander_px}
    wander = {name: item.wander_px for name, item in used.items()}
    return ArchiveResponse(measured, scans, wander, min(item.observed_px for item in used.values()))


def _gains(
    found: Found, calibrations: list, offsets: Offsets, config: ResponseConfig, folder: Path
) -> dict[Camera, WanderGains]:
    """The gains of one scan.

    Raises:
        LsvisionError: it cannot be read, or does not show how its object wanders.
    """
    scan = read_scan(found.path, as_taken=True)
    if scan.raw_rig is not None:
        raise ConfigError(f"archive: {found.path}: expected a rectified rig; raw cameras need references")
    motion = calibration_for(scan, calibrations).calibration.motion
    matching = DisparityConfig()
    with stored_depth(scan, depth_of(scan, matching, n=motion.n), matching, folder) as depth:
        moved = measured_line_motion(scan, depth, motion, LineMotionConfig()).motion
        sideways = next(finding for finding in moved.findings if finding.component == "dx")
        if sideways.state not in ("corrected", "absent"):
            raise ResponseError(f"{found.path}: {sideways.in_words}")
        return gains_of_scan(scan, depth, moved.values[:, 0] / object_pitch_mm(scan.rig), offsets, config.segment_mm)
