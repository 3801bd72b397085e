"""``+experiment=calibrate``: scans of boards -> corners -> ``calibration.json`` and a report."""

import logging
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

from torch import Tensor

from lsvision import __version__
from lsvision.errors import CalibrationError, ConfigError, UnusableCalibrationError
from lsvision.experiments.settings import RunSettings, settings_sha256
from lsvision.geometry import Rectification
from lsvision.image.tiling import one_torch_thread
from lsvision.io import read_scan, scan_sha256, write_calibration, write_json, write_line_motion
from lsvision.io.formats.installation import installation_to_dict
from lsvision.report import calibration_report, calibration_summary
from lsvision.report.progress import progress_bars
from lsvision.schema import Text
from lsvision.stages.calibration.calibrate import calibrate
from lsvision.stages.calibration.config import CalibrationConfig
from lsvision.stages.corners.config import CornersConfig
from lsvision.stages.corners.edges import find_edges
from lsvision.stages.corners.find import LocatedCorners, locate_in_images, measure_corners
from lsvision.stages.corners.rows import row_difference
from lsvision.stages.installation.config import InstallationConfig
from lsvision.stages.installation.guide import Transported, installation_guide
from lsvision.types import (
    Board,
    BoardCorners,
    BoardEdges,
    Calibration,
    Installation,
    MissingLines,
    Provenance,
    RigCalibration,
    Scan,
)

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class CalibrateSettings(RunSettings):
    """Options of the experiment; ``output`` is the file to write, ``calibration.json`` in the run's folder if None.

    A scan without some of its frames or Zarr chunks is refused; with ``missing_lines`` "mark" the corners on their
    lines are not measured.
    """

    scans: list[Text] = field(default_factory=list)
    board: Board
    corners: CornersConfig
    calibration: CalibrationConfig
    installation: InstallationConfig = field(default_factory=InstallationConfig)
    missing_lines: MissingLines = "refuse"
    output: Text | None = None


def run_calibrate(settings: CalibrateSettings, folder: Path) -> None:
    """Find the board in every scan, calibrate, write the calibration and its report.

    Raises:
        UnusableCalibrationError: the calibration is inconsistent or did not converge; its files are written.
    """
    scans = read_scans(settings.scans, settings.missing_lines)
    located = locate_boards(scans, settings.board)
    boards = measure_boards(scans, located, settings)
    warn_of_lines(boards)
    calibration = calibrate_with_edges(scans, boards, settings.board, settings.calibration)
    if Rectification.of(scans[0].raw_rig) is not None:
        # The cameras look at planes of their own: the n by which the object moves from one to the other is known now.
        n = calibration.motion.n
        boards = measure_boards(scans, located, settings, n)
        calibration = calibrate_with_edges(scans, boards, settings.board, settings.calibration, n)
    provenance = Provenance(
        version=__version__,
        config_sha256=settings_sha256(settings),
        scans=tuple((str(scan.path), scan_sha256(scan.path)) for scan in scans),
    )
    target = Path(settings.output) if settings.output else folder / "calibration.json"
    guide = alignment(calibration, scans, settings.calibration.prior_sigma, settings.installation)
    calibration = replace(calibration, provenance=provenance, installation=guide, raw_rig=scans[0].raw_rig)
    calibration = write_line_motions(calibration, target)
    write_calibration(calibration, target)
    write_json(folder / "summary.json", _summary(calibration))
    calibration_report(calibration, boards, asdict(settings), folder)
    log.info("%s\nwrote %s and %s", calibration_summary(calibration), target, folder / "report.html")
    if not calibration.usable:
        raise UnusableCalibrationError(str(target), calibration.verdict, calibration.reasons)


def alignment(
    calibration: Calibration | RigCalibration, scans: Sequence[Scan], prior_sigma: float, config: InstallationConfig
) -> Installation | None:
    """How to align the cameras with the motion of the scans; None where it is not known."""
    if not calibration.usable:
        return None
    pitches = {scan.travel.line_pitch_mm for scan in scans}
    moved = Transported(pitches.pop() if len(pitches) == 1 else None, scans[0].travel.transport)
    return installation_guide(calibration.motion, prior_sigma, moved, config)


def calibrate_with_edges(
    scans: Sequence[Scan],
    boards: Sequence[BoardCorners],
    board: Board,
    config: CalibrationConfig,
    n: Tensor | None = None,
) -> Calibration:
    """Calibrate from the corners; where they show that the boards shook, from the edges on every line as well.

    On one thread: the matrices are small, and threads that wait for each other cost more than they save.

    Args:
        n: motion of the object between the planes of a raw rig's cameras; nominal if None.
    """
    with one_torch_thread():
        calibration = calibrate(boards, scans[0].rig, config)
        if not calibration.errors_along_scan or not config.corrects_lines:
            return calibration
        return calibrate(boards, scans[0].rig, config, _edges_of(scans, boards, board, n))


def _edges_of(
    scans: Sequence[Scan], boards: Sequence[BoardCorners], board: Board, n: Tensor | None
) -> list[BoardEdges | None]:
    with progress_bars() as bars:
        bar = bars.start("find edges", total=len(scans))
        edges: list[BoardEdges | None] = []
        for scan, corners in zip(scans, boards, strict=True):
            edges.append(find_edges(scan, board, corners, n))
            bars.advance(bar)
    return edges


def write_line_motions(calibration: Calibration, target: Path) -> Calibration:
    """Write the motion of every board's scan from line to line beside a calibration's file, which names them.

    ``+experiment=correct line_motion=FILE`` takes each for its own scan.
    """
    if not calibration.line_motions:
        return calibration
    boards = []
    for number, (board, motion) in enumerate(zip(calibration.boards, calibration.line_motions, strict=True), start=1):
        name = f"{target.stem}_line_motion_{number}_{Path(board.scan).name}.parquet"
        write_line_motion(motion, target.with_name(name))
        boards.append(replace(board, line_motion_file=name))
    return replace(calibration, boards=tuple(boards))


def read_scans(paths: Sequence[str], missing_lines: MissingLines = "refuse") -> list[Scan]:
    """Open scans and check that all have the same rig.

    Args:
        missing_lines: with "mark" scans may lack lines.

    Raises:
        ConfigError: the list is empty.
        CalibrationError: two scans have different rigs.
    """
    if not paths:
        raise ConfigError("scans: the list is empty; give at least one scan folder, scans=[DIR,DIR,...]")
    scans = [read_scan(path, missing_lines=missing_lines) for path in paths]
    for scan in scans[1:]:
        if (scan.rig, scan.raw_rig) != (scans[0].rig, scans[0].raw_rig):
            raise CalibrationError(f"{scan.path}: another rig than that of {scans[0].path}; calibrate each rig alone")
    for scan in scans:
        if scan.missing:
            log.warning("%s: %d of %d lines are missing: no corners there", scan.path, scan.missing_lines, scan.lines)
    return scans


def locate_boards(scans: Sequence[Scan], board: Board) -> list[LocatedCorners]:
    """Corners of the board in the images of every scan."""
    located = []
    with progress_bars() as bars:
        bar = bars.start("find corners", total=len(scans))
        for scan in scans:
            located.append(locate_in_images(scan, board))
            bars.advance(bar)
    return located


def measure_boards(
    scans: Sequence[Scan], located: Sequence[LocatedCorners], settings: CalibrateSettings, n: Tensor | None = None
) -> list[BoardCorners]:
    """What the located corners measure; see ``measure_corners``."""
    return [
        measure_corners(scan, settings.board, corners, settings.corners, n)
        for scan, corners in zip(scans, located, strict=True)
    ]


def warn_of_lines(boards: Sequence[BoardCorners]) -> None:
    """Warn of scans whose images show the corners on different lines."""
    for corners in boards:
        difference = row_difference(corners)
        if difference is not None and difference.is_systematic:
            log.warning(
                "%s: the right image shows the corners %+.2f ± %.2f lines later than the left one: the cameras are out "
                "of step or the rig is not rectified; lines are those of the left camera",
                corners.scan, difference.lines, difference.sigma,
            )  # fmt: skip


def _summary(calibration: Calibration) -> dict:
    """The figures by which calibrations are compared; ``calibration.json`` has everything."""
    return {
        "method": calibration.method,
        "boards": len(calibration.boards),
        "verdict": calibration.verdict,
        "reasons": list(calibration.reasons),
        "notes": list(calibration.notes),
        "noise_scale": calibration.noise_scale,
        "errors_along_scan": [asdict(error) for error in calibration.errors_along_scan],
        "line_motion": {
            board.line_motion_file: [finding.in_words for finding in board.line_motion]
            for board in calibration.boards
            if board.line_motion_file
        },
        "n": calibration.motion.n.tolist(),
        "sigma": calibration.motion.sigma.tolist(),
        "stretch": calibration.motion.stretch,
        "rmse_before_mm": calibration.rmse_before_mm,
        "rmse_after_mm": calibration.rmse_after_mm,
        "improvement": calibration.improvement,
        "iterations": len(calibration.iterations) - 1,
        "installation": installation_to_dict(calibration.installation),
        "converged": calibration.converged,
    }
