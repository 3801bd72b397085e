"""``+experiment=motion``: one scan and its calibration -> the motion from line to line alone, with figures."""

import logging
from dataclasses import asdict, dataclass, field
from pathlib import Path

import torch

from lsvision.archive import calibration_for, measured_line_motion, read_calibrations
from lsvision.archive.line_motion import line_motion_metadata, section_of
from lsvision.experiments.settings import RunSettings
from lsvision.experiments.stored_depth import stored_depth
from lsvision.geometry import ProductFrame, object_pitch_mm
from lsvision.image.tiling import keep_freed_memory
from lsvision.io import read_scan, write_json, write_line_motion
from lsvision.report.line_motion_figures import LineMotionView, Profiles
from lsvision.report.line_motion_pages import MeasuredMotion, motion_report
from lsvision.report.line_motion_words import line_motion_words
from lsvision.schema import Text
from lsvision.stages.disparity.config import DisparityConfig
from lsvision.stages.disparity.depth import depth_of
from lsvision.stages.line_motion.config import LineMotionConfig
from lsvision.types import MissingLines, RefusedVerdict

log = logging.getLogger(__name__)

_PARTS, _PART_LINES = 16, 16  # of a scan, whose profiles are drawn


@dataclass(frozen=True, kw_only=True)
class MotionSettings(RunSettings):
    """Options of the experiment, as those of ``correct``; the profile is measured, log of the scan or not."""

    scan: Text
    calibration: Text
    disparity: DisparityConfig
    registration: LineMotionConfig = field(default_factory=LineMotionConfig)
    repair_encoder: bool = False
    missing_lines: MissingLines = "refuse"
    accept: list[RefusedVerdict] = field(default_factory=list)


def run_motion(settings: MotionSettings, folder: Path) -> None:
    """Measure the motion; write ``line_motion.parquet``, ``summary.json`` and the report."""
    section = section_of(settings.registration)
    scan = read_scan(settings.scan, repair_encoder=settings.repair_encoder, missing_lines=settings.missing_lines)
    dated = calibration_for(scan, read_calibrations(settings.calibration, settings.accept))
    if dated.warning:
        log.warning("%s", dated.warning)
    keep_freed_memory()
    matched = depth_of(scan, settings.disparity, n=dated.calibration.motion.n)
    with stored_depth(scan, matched, settings.disparity, folder) as depth:
        measured = measured_line_motion(scan, depth, dated.calibration.motion, settings.registration, section)
        motion, travel = measured.motion, measured.travel
        still = ProductFrame(scan.rig, scan.travel, dated.calibration.motion.n)
        steadied = ProductFrame(scan.rig, scan.travel, still.n, None if motion.is_still else motion)
        lines = _spread_lines(scan.lines)
        z = torch.cat([depth.read(part.start, part.stop).z for part in lines])
        number = torch.cat([torch.arange(part.start, part.stop) for part in lines]).double()
        before, after = (_profiles(frame, z, number, settings.registration) for frame in (still, steadied))
    metadata = line_motion_metadata(motion, "measured", scan.travel)
    write_line_motion(motion, folder / "line_motion.parquet")
    stated = None if travel is None else travel.metadata(float(still.n[1]))
    summary = {"scan": str(scan.path), "lines": scan.lines, "line_motion": metadata, "travel": stated}
    write_json(folder / "summary.json", summary)
    for line in (*line_motion_words(metadata), *([] if travel is None else [travel.in_words])):
        log.info("%s", line)
    log.info("wrote %s", folder / "line_motion.parquet")
    view = LineMotionView.of(motion, metadata)
    motion_report(MeasuredMotion(str(scan.path), metadata, view, before, after), asdict(settings), folder)


def _spread_lines(lines: int) -> list[range]:
    """Some neighbouring lines at each of some places all over a scan; all lines of a short one."""
    if lines <= _PARTS * _PART_LINES:
        return [range(lines)]
    return [
        range(start, start + _PART_LINES)
        for start in (part * (lines - _PART_LINES) // (_PARTS - 1) for part in range(_PARTS))
    ]


def _profiles(frame: ProductFrame, z: torch.Tensor, line: torch.Tensor, config: LineMotionConfig) -> Profiles:
    """Heights of lines on columns that all share, as deep under the crown as the object is compared."""
    q = frame.position(torch.arange(z.shape[1]).double(), line[:, None], z.double())
    q_x, height = q[..., 0], frame.height_datum_mm - q[..., 2]
    low, high = config.height_range_mm
    there = (height >= low) & (height <= high)
    if not bool(there.any()):
        return Profiles(q_x.new_zeros(1), q_x.new_full((len(z), 1), torch.nan))
    step, origin = object_pitch_mm(frame.rig), float(q_x[there].min())
    places = int((float(q_x[there].max()) - origin) / step) + 1
    table = height.new_full((len(z), places), torch.nan)
    row = torch.arange(len(z))[:, None].expand_as(q_x)
    table[row[there], ((q_x[there] - origin) / step).long()] = height[there]
    crown = float(table.nanmedian(0).values.nan_to_num(-torch.inf).max())
    seen = table.nanmedian(0).values >= crown - config.profile_depth_mm
    seen &= table.isfinite().sum(0) >= len(z) / 2
    return Profiles((origin + step * torch.arange(places).double())[seen], table[:, seen])
