"""``+experiment=rig``: raw scans of boards -> ``rig.yaml``, ``rig_calibration.json`` and a report."""

import logging
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

from lsvision import __version__
from lsvision.errors import ConfigError, UnusableCalibrationError
from lsvision.experiments.calibrate import alignment, locate_boards, read_scans
from lsvision.experiments.settings import RunSettings, settings_sha256
from lsvision.io import (
    copy_response,
    read_raw_rig,
    rig_file,
    scan_sha256,
    write_raw_rig,
    write_rig_calibration,
)
from lsvision.report.rig_pages import rig_report, rig_summary
from lsvision.schema import Text
from lsvision.stages.installation.config import InstallationConfig
from lsvision.stages.rig.calibrate import calibrate_rig
from lsvision.stages.rig.config import RigConfig
from lsvision.stages.rig.sightings import Sightings, joined, sighted
from lsvision.types import Board, MissingLines, Provenance, RawRig, Scan

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class RigSettings(RunSettings):
    """Options of the experiment; ``data_sheet`` is the file of the rig to start from, that of the first scan if None.

    A rig that was calibrated before is known by its full covariance: its boards count again with those of the scans.
    The cameras' responses are those that the data sheet names, or else the first scan's rig.
    A scan without some of its frames or Zarr chunks is refused; with ``missing_lines`` "mark" the corners on their
    lines are not measured.
    """

    scans: list[Text] = field(default_factory=list)
    data_sheet: Text | None = None
    board: Board
    estimate: RigConfig
    installation: InstallationConfig = field(default_factory=InstallationConfig)
    missing_lines: MissingLines = "refuse"


def run_rig(settings: RigSettings, folder: Path) -> None:
    """Find the board in both images of every scan, calibrate, write the rig, its responses, covariance and a report.

    Raises:
        UnusableCalibrationError: the scans contradict each other or the estimate did not converge; its files are
            written.
    """
    scans = read_scans(settings.scans, settings.missing_lines)
    start = _data_sheet(scans[0], settings.data_sheet)
    responses = _kept_responses(scans[0], settings.data_sheet, folder)
    sightings = find_sightings(scans, settings.board)
    calibration = calibrate_rig(sightings, [str(scan.path) for scan in scans], start, settings.estimate)
    provenance = Provenance(
        version=__version__,
        config_sha256=settings_sha256(settings),
        scans=tuple((str(scan.path), scan_sha256(scan.path)) for scan in scans),
    )
    guide = alignment(calibration, scans, settings.estimate.motion_sigma, settings.installation)
    calibration = replace(calibration, provenance=provenance, installation=guide)
    write_rig_calibration(calibration, folder / "rig_calibration.json")
    write_raw_rig(calibration.rig, folder / "rig.yaml", responses)
    rig_report(calibration, start, asdict(settings), folder)
    log.info("%s\nwrote %s and %s", rig_summary(calibration), folder / "rig.yaml", folder / "report.html")
    if not calibration.usable:
        raise UnusableCalibrationError(str(folder / "rig_calibration.json"), calibration.verdict, calibration.reasons)


def find_sightings(scans: list[Scan], board: Board) -> Sightings:
    """Corners of the board in both images of every scan.

    Raises:
        ConfigError: a scan without a second image.
    """
    parts = []
    for scan, located in zip(scans, locate_boards(scans, board), strict=True):
        if located.right is None:
            raise ConfigError(f"scans: {scan.path} has a depth map in place of the right image")
        parts.append(sighted(located.left, located.right, scan.travel, board))
    return joined(parts)


def _kept_responses(scan: Scan, data_sheet: str | None, folder: Path) -> dict[str, str]:
    of_sheet = {} if data_sheet is None else copy_response(Path(data_sheet), folder)
    return of_sheet or copy_response(rig_file(scan.path), folder)


def _data_sheet(scan: Scan, path: str | None) -> RawRig:
    rig = scan.raw_rig if path is None else read_raw_rig(path)
    if rig is None:
        raise ConfigError(f"data_sheet: {scan.path} has a rectified rig; name the file of the raw one, data_sheet=FILE")
    return rig
