"""Hashes that tell whether a result still follows from what is there."""

import hashlib
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from lsvision.errors import FileFormatError
from lsvision.io.formats.scan import FILE_KEYS
from lsvision.io.formats.validation import read_yaml
from lsvision.stages.correction.config import CorrectionConfig
from lsvision.stages.disparity.config import DisparityConfig


def stamp_of(folder: Path) -> str:
    """Hash of path, size and time of change of every file of a scan: equal as long as nobody touched them.

    Raises:
        FileFormatError: ``scan.yaml`` cannot be read.
    """
    data = read_yaml(folder / "scan.yaml")
    named = [folder / str(data[key]) for key in FILE_KEYS if key in data] if isinstance(data, dict) else []
    files = [folder / "scan.yaml"]
    for entry in named:
        files += sorted(file for file in entry.rglob("*") if file.is_file()) if entry.is_dir() else [entry]
    try:
        states = [(str(file), file.stat().st_size, file.stat().st_mtime_ns) for file in files if file.exists()]
    except OSError as error:
        raise FileFormatError(folder, f"cannot be read: {error.strerror}") from error
    return key_of(states)


def key_of(*values: Any) -> str:
    """SHA-256 of plain data."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


def disparity_key(input_sha256: str, config: DisparityConfig, with_sigma: bool, version: str) -> str:
    """What the depth of a scan's lines depends on."""
    return key_of(input_sha256, asdict(config), with_sigma, version)


def product_key(depth_key: str, calibration_sha256: str, config: CorrectionConfig, repair_encoder: bool) -> str:
    """What a product depends on; the height of its strips is not among it, they give the same bits at any."""
    options = asdict(config)
    del options["strip_rows"]
    return key_of(depth_key, calibration_sha256, options, repair_encoder)
