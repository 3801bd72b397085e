"""Signals of drift of a scan, without any target.

The direction compares an object's own axis with the motion: of one that runs along its axis, as a rail on rollers,
the cameras see the same section whatever n is. Its travel shows in the lines of the colours, the synchronisation of
the cameras in the rows, their light in the gains.
"""

import logging
import math
from dataclasses import asdict, dataclass

import torch

from lsvision.archive.depth_store import open_depth_store
from lsvision.archive.identity import ScanFiles
from lsvision.archive.line_motion import DepthAlone
from lsvision.archive.opened import open_depth, open_relation, open_scan, planned_files
from lsvision.image.tiling import one_torch_thread
from lsvision.io.formats.validation import on_one_line
from lsvision.stages.disparity.config import DisparityConfig
from lsvision.stages.health.direction import NOT_SEEN, Direction, measure_direction
from lsvision.stages.line_motion.color_travel import ColorTravel
from lsvision.stages.line_motion.config import LineMotionConfig
from lsvision.stages.line_motion.measure import measure_travel
from lsvision.types import DepthSource, Motion, Scan

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ScanHealth:
    """Signals of drift of a scan and their standard deviations; None where one was not measured.

    ``askew_`` is by how much the object runs beside its motion, degrees, sideways and in depth. ``travel_rate`` is the
    true advance over what travel and calibration say. ``row_offset_lines`` is by how much the right image is late, and
    ``gain_ratio`` the brightness of the left image over that of the right one.
    """

    askew_sideways_deg: float | None = None
    askew_sideways_sigma_deg: float | None = None
    askew_in_depth_deg: float | None = None
    askew_in_depth_sigma_deg: float | None = None
    travel_rate: float | None = None
    travel_sigma: float | None = None
    row_offset_lines: float | None = None
    row_offset_sigma_lines: float | None = None
    gain_ratio: float | None = None


@dataclass(frozen=True)
class MeasureHealth:
    """Measures the signals of a scan; ``depth_store`` is None for the scan's own depth."""

    scan: ScanFiles
    depth_store: str | None
    disparity: DisparityConfig
    n: tuple[float, ...]

    def run(self) -> ScanHealth:
        """Measure; what cannot be measured is no error."""
        with planned_files(self.scan), one_torch_thread():
            scan = open_scan(self.scan)
            depth = open_depth_store(self.depth_store) if self.depth_store else open_depth(self.scan, self.disparity)
            n = torch.tensor(self.n, dtype=torch.float64)
            motion, config = Motion(n, n.diag() * 0), LineMotionConfig()
            direction = _direction(scan, depth, motion, config)
            travel = _travel(scan, depth, motion, config)
            relation = open_relation(self.scan, self.disparity)
        known = {name: _or_none(value) for name, value in _columns_of(direction).items()}
        if travel is not None and travel.is_measured:
            known |= {"travel_rate": travel.whole.rate, "travel_sigma": travel.whole.sigma}
        if relation is not None:
            gain = 1.0 if relation.exposure is None else float(relation.exposure.gain.mean())
            rows = relation.rows
            known |= {
                "row_offset_lines": _or_none(rows.lines),
                "row_offset_sigma_lines": _or_none(rows.sigma),
                "gain_ratio": gain,
            }
        return ScanHealth(**known)


def _direction(scan: Scan, depth: DepthSource, motion: Motion, config: LineMotionConfig) -> Direction:
    try:
        return measure_direction(scan, depth, motion, config)
    except (ValueError, torch.linalg.LinAlgError) as error:  # an object of next to no samples
        log.warning("%s: no direction can be measured: %s", scan.path, on_one_line(error))
        return NOT_SEEN


def _travel(scan: Scan, depth: DepthSource, motion: Motion, config: LineMotionConfig) -> ColorTravel | None:
    """The advance by the lines of the colours; None where nothing shows it."""
    try:
        return measure_travel(scan, DepthAlone(depth), motion, config)
    except (ValueError, torch.linalg.LinAlgError) as error:
        log.warning("%s: no travel can be measured: %s", scan.path, on_one_line(error))
        return None


def _columns_of(direction: Direction) -> dict[str, float]:
    return {f"askew_{name}": value for name, value in asdict(direction).items()}


def _or_none(value: float) -> float | None:
    return value if math.isfinite(value) else None
