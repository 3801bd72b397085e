"""Hashes that say whether a result still follows from its inputs."""

import hashlib
import json
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from lsvision.errors import FileFormatError, ScanChangedError
from lsvision.io import scan_files
from lsvision.stages.correction.config import CorrectionConfig
from lsvision.stages.disparity.config import DisparityConfig
from lsvision.types import MissingLines


@dataclass(frozen=True)
class ScanFiles:
    """A scan on disk as every worker opens it; ``stamp`` changes with its files, ``lines`` is its length.

    ``n`` is the motion with which the images of a raw rig are rectified; None where there is nothing to rectify.
    """

    path: str
    stamp: str
    lines: int
    repair_encoder: bool
    missing_lines: MissingLines = "refuse"
    n: tuple[float, ...] | None = None

    def check_unchanged(self) -> None:
        """Check that the files are those that were planned.

        Raises:
            ScanChangedError: they are not.
            FileFormatError: ``scan.yaml`` cannot be read any more.
        """
        if stamp_of(Path(self.path)) != self.stamp:
            raise ScanChangedError(self.path)


def key_of(*values: Any) -> str:
    """SHA-256 of plain data."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


def stamp_of(folder: Path) -> str:
    """Hash of the list of a scan's files with the size, time of change and inode of each.

    Equal as long as the files are untouched: one that takes the place of another has another inode, though it may have
    been given the other's size and time.

    Raises:
        FileFormatError: ``scan.yaml`` cannot be read.
    """
    stamps = []
    try:
        for file in scan_files(folder):
            with suppress(FileNotFoundError, ValueError):  # a name with a null character is that of no file
                state = file.stat()
                stamps.append((str(file), state.st_size, state.st_mtime_ns, state.st_ino))
    except OSError as error:
        raise FileFormatError(folder, f"cannot be read: {error.strerror}") from error
    return key_of(stamps)


def depth_key(
    input_sha256: str, config: DisparityConfig, with_sigma: bool, version: str, n: tuple[float, ...] | None = None
) -> str:
    """Hash of everything that the depth of a scan's lines depends on.

    Args:
        n: the motion with which the images of a raw rig are rectified.
    """
    return key_of(input_sha256, asdict(config), with_sigma, version, *(() if n is None else (n,)))


def product_key(depth: str, calibration_sha256: str, config: CorrectionConfig, repair_encoder: bool) -> str:
    """Hash of everything that a product depends on; the height of its strips is not part of it: any gives equal bits.

    Args:
        depth: the ``depth_key``.
    """
    return key_of(depth, calibration_sha256, options_without_strips(config), repair_encoder)


def options_without_strips(config: CorrectionConfig) -> dict[str, Any]:
    """Options of a correction that a product's cells depend on."""
    options = asdict(config)
    for name in ("strip_rows", "min_measured_share"):
        del options[name]
    return options
