"""The product of a scan of an archive: where it lies, how it is laid out, and whether it is whole."""

import logging
import os
from dataclasses import asdict
from pathlib import Path

from lsvision import __version__
from lsvision.archive.line_motion import StoredLineMotion
from lsvision.archive.planned import PlannedScan, Processing
from lsvision.errors import FileFormatError
from lsvision.geometry import ProductFrame, zero_disparity_mm
from lsvision.image.stereo.relation import PairRelation
from lsvision.io import ProductLayout, check_product, read_product, read_scan
from lsvision.io.atomic import check_replaceable
from lsvision.io.inside import path_inside
from lsvision.io.product.layout import ROOT_METADATA
from lsvision.stages.correction.correct import rig_errors_of
from lsvision.stages.correction.grid import source_dtype
from lsvision.stages.correction.uncertainty import EncoderRepair, drift_per_metre
from lsvision.stages.disparity.depth import relation_of_scan
from lsvision.types import Scan

log = logging.getLogger(__name__)

_LONGEST_NAME = 200  # a product that is written has 48 characters more, and disks take 255


def product_path(output: Path, key: str) -> Path:
    """Where the product of a scan lies.

    Raises:
        FileFormatError: not below the output, or with a name that is too long for one.
    """
    length = max(len(os.fsencode(part)) for part in ("", *Path(key).parts))
    if length > _LONGEST_NAME:
        raise FileFormatError(output / f"{key}.zarr", f"expected names of at most {_LONGEST_NAME} bytes, got {length}")
    return path_inside(output, f"{key}.zarr")


def product_layout(
    planned: PlannedScan, processing: Processing, input_sha256: str, key: str, found: StoredLineMotion | None = None
) -> ProductLayout:
    """Layout of a scan's product, one chunk per strip; its metadata say everything that it was made from.

    Args:
        input_sha256: hash of the scan's files.
        key: hash of everything that the product depends on.
        found: motion from line to line; None where none is corrected.

    Raises:
        FileFormatError: the scan cannot be read any more.
    """
    scan = read_scan(
        planned.files.path, repair_encoder=processing.repair_encoder, missing_lines=processing.missing_lines
    )
    relation = relation_of_scan(scan, processing.disparity)
    _warn_of_faults(scan, relation)
    repair = EncoderRepair.of(scan.travel)
    calibration = planned.calibration.calibration
    motion = calibration.motion
    by_rig = rig_errors_of(scan, motion, planned.correction)
    sideways, in_depth = motion.drift_mm_per_m
    return ProductLayout(
        grid=planned.grid,
        channels=scan.left.shape[2],
        dtype=scan.left.dtype,
        chunk_rows=planned.correction.strip_rows,
        metadata={
            "scan": planned.files.path,
            "input_sha256": input_sha256,
            "version": __version__,
            "n": motion.n.tolist(),
            "zero_disparity_mm": zero_disparity_mm(scan.rig),
            "height_datum_mm": ProductFrame(scan.rig, scan.travel, motion.n).height_datum_mm,
            "attributes": dict(scan.attributes),
            "calibration": str(planned.calibration.path),
            "calibration_sha256": planned.calibration.sha256,
            "calibration_verdict": calibration.verdict,
            "calibration_reasons": list(calibration.reasons),
            "motion_mm_per_m": {"sideways": sideways, "in_depth": in_depth},
            "drift_sigma_mm_per_m": list(drift_per_metre(motion)),
            "disparity": asdict(processing.disparity),
            **({"pair": relation.metadata} if relation is not None else {}),
            **({"encoder_repair": asdict(repair)} if repair is not None else {}),
            **({"rig_sigma": by_rig.metadata} if by_rig is not None else {}),
            **({"missing_lines": _missing_in(scan)} if scan.missing else {}),
            "line_motion": {"source": "none"} if found is None else found.metadata(scan.travel),
            "correction": asdict(planned.correction),
            "key": key,
        },
        uncertainty=planned.correction.uncertainty,
        source_dtype=source_dtype(planned.lines),
        line_motion=None if found is None else found.motion,
    )


def _warn_of_faults(scan: Scan, relation: PairRelation | None) -> None:
    """Log what is wrong with a scan that is corrected all the same."""
    if scan.missing:
        log.warning("%s: %d of %d lines are missing: not measured", scan.path, scan.missing_lines, scan.lines)
    if relation is not None and relation.rows.whole:
        log.warning(
            "%s: the cameras are out of step by %+.2f ± %.2f lines: the right image is matched %+d lines later",
            scan.path, relation.rows.lines, relation.rows.sigma, relation.rows.whole,
        )  # fmt: skip


def _missing_in(scan: Scan) -> dict[str, object]:
    """How many lines are missing, and which, first and last, by image."""
    lines = {name: [[part.start, part.stop - 1] for part in ranges] for name, ranges in scan.missing.items()}
    return {"count": scan.missing_lines, **lines}


def check_own(target: Path, planned: PlannedScan, input_sha256: str) -> None:
    """Check that a scan's product will replace none but an earlier product of the same scan.

    That was made from the same path, though the files have changed, or from the same files, though they have moved.

    Raises:
        FileFormatError: ``target`` holds the product of another scan, or something else.
    """
    check_replaceable(target, ROOT_METADATA)
    try:
        metadata = read_product(target).metadata
    except FileFormatError:  # nothing there, or the remains of a product
        return
    other = metadata.get("scan")
    moved = metadata.get("input_sha256") == input_sha256
    # Early versions recorded relative paths, of which nothing is known any more.
    known = isinstance(other, str) and Path(other).is_absolute()
    if known and not moved and Path(str(other)).resolve() != Path(planned.files.path).resolve():
        raise FileFormatError(target, f"the product of another scan, {other}; choose another output")


def is_finished(target: Path | str, key: str) -> bool:
    """Whether the product of this key has its final name already."""
    try:
        return read_product(target).metadata.get("key") == key
    except FileFormatError:
        return False


def damage_of(path: str, measured_cells: int) -> str:
    """What is wrong with a product on disk, in words; empty where it reads and has the cells it was written with."""
    try:
        check = check_product(path)
    except FileFormatError as error:
        return str(error)
    found = round(check.valid_share * check.rows * check.columns)
    return "" if found == measured_cells else f"{path}: expected {measured_cells} measured cells, found {found}"
