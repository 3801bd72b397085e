"""The motion from line to line of a scan: measured, or taken from a log; stored, and read by every correction."""

import hashlib
import logging
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import torch

from lsvision.archive.depth_store import open_depth_store
from lsvision.archive.identity import ScanFiles, key_of
from lsvision.archive.opened import open_depth, open_scan, planned_files
from lsvision.errors import FileFormatError, LsvisionError
from lsvision.geometry import travel_at
from lsvision.image.tiling import one_torch_thread
from lsvision.io import naming_full_disk, read_line_motion, read_section, write_line_motion
from lsvision.io.formats.validation import on_one_line, read_bytes
from lsvision.stages.disparity.config import DisparityConfig
from lsvision.stages.line_motion.config import LineMotionConfig
from lsvision.stages.line_motion.estimate import not_measured
from lsvision.stages.line_motion.measure import LineMeasurement, measure_line_motion
from lsvision.stages.line_spectrum import band_of_power
from lsvision.types import Depth, DepthSource, LineMotion, Motion, Scan, Section, Travel

log = logging.getLogger(__name__)

Origin = Literal["none", "measured", "log", "file"]


@dataclass(frozen=True)
class LineMotionChoice:
    """Where the motion from line to line of scans comes from.

    ``source`` is ``none``; ``auto``, which is a scan's own log where it has one, and its profile, measured with
    ``config`` and the ``section`` that it names, where it has none; or the path of a file with the hash ``sha256``.
    """

    source: str = "none"
    sha256: str = ""
    config: LineMotionConfig = field(default_factory=LineMotionConfig)
    section: Section | None = None

    @classmethod
    def of(cls, source: str, config: LineMotionConfig) -> "LineMotionChoice":
        """The choice of an option.

        Raises:
            FileFormatError: ``source``, or the section, is a file that cannot be read.
        """
        section = section_of(config)
        if source in ("auto", "none"):
            return cls(source, config=config, section=section)
        path = Path(source).absolute()
        return cls(str(path), hashlib.sha256(read_bytes(path)).hexdigest(), config)

    @property
    def key(self) -> str:
        """Hash of everything that it says but the name of a file."""
        if self.source != "auto":
            return key_of(self.sha256 or self.source, None)
        section = "scan" if self.section is None else asdict(self.section)
        return key_of(self.source, asdict(self.config) | {"reference": section})

    def origin(self, logged: bool) -> Origin:
        """Where the motion of a scan with a log, or without, comes from."""
        if self.source == "none":
            return "none"
        if self.source != "auto":
            return "file"
        return "log" if logged else "measured"

    def read_file(self, lines: int, travel: Travel) -> LineMotion:
        """The motion in the chosen file.

        Raises:
            FileFormatError: the file is not the chosen one any more, or does not fit the scan.
        """
        if hashlib.sha256(read_bytes(Path(self.source))).hexdigest() != self.sha256:
            raise FileFormatError(self.source, "changed while it was in use")
        return read_line_motion(self.source, lines, travel)


@dataclass(frozen=True)
class FoundLineMotion:
    """How many lines a motion was found for."""

    lines: int


@dataclass(frozen=True)
class FindLineMotion:
    """Finds the motion from line to line of a scan and stores it; ``depth_store`` is None for the scan's own depth."""

    scan: ScanFiles
    depth_store: str | None
    disparity: DisparityConfig
    n: tuple[float, ...]
    choice: LineMotionChoice
    store: str

    def run(self) -> FoundLineMotion:
        """Measure or read, and write."""
        with planned_files(self.scan):
            motion = self._find(open_scan(self.scan))
        with naming_full_disk(self.store):
            write_line_motion(motion, self.store)
        return FoundLineMotion(motion.lines)

    def _find(self, scan: Scan) -> LineMotion:
        if self.choice.source != "auto":
            return self.choice.read_file(scan.lines, scan.travel)
        if scan.line_motion is not None:
            return scan.line_motion
        depth = open_depth_store(self.depth_store) if self.depth_store else open_depth(self.scan, self.disparity)
        n = torch.tensor(self.n, dtype=torch.float64)
        return measured_line_motion(
            scan, depth, Motion(n, n.diag() * 0), self.choice.config, self.choice.section
        ).motion


def section_of(config: LineMotionConfig) -> Section | None:
    """The nominal section that options name; None for the scan's own profile.

    Raises:
        FileFormatError: it is a file that cannot be read.
    """
    return None if config.reference == "scan" else read_section(config.reference)


def measured_line_motion(
    scan: Scan, depth: DepthSource, motion: Motion, config: LineMotionConfig, section: Section | None = None
) -> LineMeasurement:
    """Measure the motion of a scan on its profile and edges, on one thread: the bits are the same wherever it runs.

    What cannot be measured is no error: the findings say why.
    """
    with one_torch_thread():
        try:
            return measure_line_motion(scan, DepthAlone(depth), motion, config, section)
        except (ValueError, torch.linalg.LinAlgError) as error:  # an object of next to no samples
            log.warning("%s: no line motion can be measured: %s", scan.path, on_one_line(error))
            reason = "the scan shows no profile that lines can be registered to"
            return LineMeasurement(not_measured(scan.lines, reason))


@dataclass(frozen=True)
class DepthAlone:
    """A depth without its sigma: so that products with and without ``uncertainty`` have the same heights."""

    depth: DepthSource

    @property
    def lines(self) -> int:
        """Number of lines of the scan."""
        return self.depth.lines

    def read(self, start: int, stop: int) -> Depth:
        """Depth of lines ``start..stop-1``."""
        return Depth(self.depth.read(start, stop).z)


@dataclass(frozen=True)
class StoredLineMotion:
    """A motion that was found, and the hash of it."""

    motion: LineMotion
    origin: Origin
    sha256: str

    @classmethod
    def read(cls, store: Path | str, origin: Origin, lines: int) -> "StoredLineMotion":
        """Read what ``FindLineMotion`` stored.

        Raises:
            FileFormatError: it is not there, or damaged.
        """
        return cls._read(str(store), origin, lines, _version(store))

    @classmethod
    @lru_cache(maxsize=1)  # planning asks before every task of a scan
    def _read(cls, store: str, origin: Origin, lines: int, version: tuple[int, int] | None) -> "StoredLineMotion":
        """Read one version of a file."""
        motion = read_line_motion(store, lines)
        content = motion.values.numpy().tobytes() + motion.covariance.numpy().tobytes()
        return cls(motion, origin, hashlib.sha256(content).hexdigest())

    def metadata(self, travel: Travel) -> dict[str, object]:
        """What a product says about it."""
        return {**line_motion_metadata(self.motion, self.origin, travel), "sha256": self.sha256}


def _version(path: Path | str) -> tuple[int, int] | None:
    """What changes when a file is written anew; None where there is none."""
    try:
        found = Path(path).stat()
    except OSError:
        return None
    return found.st_mtime_ns, found.st_size


def line_motion_metadata(motion: LineMotion, origin: Origin, travel: Travel) -> dict[str, Any]:
    """What is known about a motion, as plain data: its source, its components, and what may be shape instead."""
    lines, section = torch.arange(motion.lines, dtype=torch.float64), motion.section
    advance = float(travel_at(travel, lines).diff().abs().mean())
    band = ambiguous_band(motion, advance) if origin == "measured" else None
    return {
        "source": origin,
        "advance_mm": advance,
        "corrected": [finding.component for finding in motion.findings if finding.state == "corrected"],
        "components": [{**asdict(finding), "in_words": finding.in_words} for finding in motion.findings],
        "ambiguous_wavelengths_mm": list(band) if band else None,
        "note": ambiguity_in_words(band, any(finding.edges for finding in motion.findings)) if band else "",
        "section": None if section is None else {**asdict(section), "in_words": section.in_words},
    }


def ambiguous_band(motion: LineMotion, advance_mm: float) -> tuple[float, float] | None:
    """Shortest and longest wavelength, mm, of a motion that may be shape, beyond those that colours separated."""
    bands = []
    for index, finding in enumerate(motion.findings):
        band, known = band_of_power(motion.values[:, [index]], advance_mm), finding.separated_up_to_mm or 0.0
        if finding.component != "dy" and band is not None and band[1] > known:
            bands.append((max(band[0], known), band[1]))
    return (min(band[0] for band in bands), max(band[1] for band in bands)) if bands else None


def ambiguity_in_words(band: tuple[float, float], by_edges: bool = False) -> str:
    """Which wavelengths may be shape or vibration: a profile, or edges, alone do not show which."""
    return (
        f"wavelengths of {band[0]:.3g} to {band[1]:.3g} mm were taken for vibration: corrugation, bow or twist of the "
        "object over such lengths shows the same on its profile"
        f"{', and a sideways bend the same on its edges' if by_edges else ''}"
    )


def open_line_motion(store: str, sha256: str, scan: Scan) -> LineMotion:
    """A stored motion, for a correction.

    Raises:
        LsvisionError: it is not the one that the product was laid out with.
    """
    stored = StoredLineMotion.read(store, "file", scan.lines)
    if stored.sha256 != sha256:
        raise LsvisionError(f"{store}: changed while it was in use; the next run measures it afresh")
    return stored.motion
