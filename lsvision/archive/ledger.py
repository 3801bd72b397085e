"""The ledger of an output, in SQLite beside the products: one row per scan, one row per strip."""

import logging
import sqlite3
import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Literal

from lsvision.archive.tables import VERSION, bring_up_to_date, version_of
from lsvision.errors import FileFormatError, LsvisionError, WriteError
from lsvision.io import MeasuredCells

LEDGER_FILE = "ledger.sqlite"

_WAIT_SECONDS = 5.0
_OF_THE_DISK = {
    sqlite3.SQLITE_IOERR, sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_READONLY, sqlite3.SQLITE_PERM, sqlite3.SQLITE_BUSY,
    sqlite3.SQLITE_LOCKED, sqlite3.SQLITE_NOMEM,
}  # fmt: skip

Stage = Literal["disparity", "line_motion", "health", "product", "surface"]
Status = Literal["running", "stopped", "done", "failed"]  # a scan as running while no run is at work was stopped

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ScanRow:
    """What is known of a scan.

    ``stamp`` changes when its files are touched (paths, sizes, times), ``input_sha256`` when their content changes.
    ``seconds`` is the work on all its strips, ``measured_share`` the share of the product's cells with a height.
    ``missing_lines`` counts those of ``lines`` that are not there in one of the images.
    ``verdict`` is its calibration's, empty where it is not known; ``sideways_mm_per_m`` and ``in_depth_mm_per_m`` are
    the motion that was corrected, ``drift_sigma_mm_per_m`` the largest standard deviation of a position, mm per metre.
    ``line_motion`` says where the motion from line to line came from and what was found of every component; ``rms_``
    are those of the components that were corrected, zero for the others.
    ``taken`` is the scan's attribute ``date``; what follows are its signals of drift, as ``ScanHealth``, None where
    not measured.
    """

    scan: str
    path: str
    status: Status
    error: str = ""
    lines: int = 0
    seconds: float = 0.0
    measured_share: float = 0.0
    stamp: str = ""
    input_sha256: str = ""
    calibration: str = ""
    calibration_sha256: str = ""
    config_sha256: str = ""
    version: str = ""
    verdict: str = ""
    sideways_mm_per_m: float = 0.0
    in_depth_mm_per_m: float = 0.0
    drift_sigma_mm_per_m: float = 0.0
    missing_lines: int = 0
    line_motion: str = ""
    rms_dx_mm: float = 0.0
    rms_dz_mm: float = 0.0
    rms_roll_rad: float = 0.0
    rms_dy_mm: float = 0.0
    taken: str = ""
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
class StripRow:
    """One strip of one stage of a scan: finished for ``key``, the hash of everything it depends on, or failed.

    ``lines`` are those of the scan, or rows of the product. ``measured_cells`` of them have a depth, or a height;
    ``lowest_mm`` and ``highest_mm`` are the range of the heights. ``runs`` counts how often it was finished for its
    key.
    """

    scan: str
    stage: Stage
    number: int
    key: str
    status: Status
    error: str = ""
    lines: int = 0
    seconds: float = 0.0
    measured_cells: int = 0
    lowest_mm: float = MeasuredCells.lowest_mm
    highest_mm: float = MeasuredCells.highest_mm
    runs: int = 1


class Ledger:
    """The open ledger; every call that writes is one transaction. One process writes, any number may read.

    A ledger of version 1 is emptied: what it recorded was made by an earlier version and is made again. One of
    a later version gets the columns that it lacks.

    Raises:
        FileFormatError: the file is no ledger, or one of a later version.
        WriteError: by every call, when the disk is full or fails.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            self._db = sqlite3.connect(path, isolation_level=None)
            self._db.row_factory = sqlite3.Row
            _log_ahead(self._db)
            self._db.execute("PRAGMA synchronous=NORMAL")
            self._create_tables()
        except sqlite3.DatabaseError as error:
            raise self._fault(error) from error

    def __enter__(self) -> "Ledger":
        return self

    def __exit__(self, *_: object) -> None:
        self._db.close()

    def scans(self) -> dict[str, ScanRow]:
        """All scans by their key, in order."""
        rows = self._read("SELECT * FROM scans ORDER BY scan")
        return {row["scan"]: ScanRow(**dict(row)) for row in rows}

    def scan(self, key: str) -> ScanRow | None:
        """The row of one scan."""
        rows = self._read("SELECT * FROM scans WHERE scan = ?", (key,))
        return ScanRow(**dict(rows[0])) if rows else None

    def strips(self, scan: str | None = None) -> list[StripRow]:
        """The strips of a scan, or all, by scan, stage and number."""
        chosen, values = ("WHERE scan = ?", (scan,)) if scan is not None else ("", ())
        rows = self._read(f"SELECT * FROM strips {chosen} ORDER BY scan, stage, number", values)
        return [StripRow(**dict(row)) for row in rows]

    def finished_strips(self, scan: str, stage: Stage, key: str) -> dict[int, StripRow]:
        """The strips of a stage that are finished for a key, by number."""
        return {
            strip.number: strip
            for strip in self.strips(scan)
            if (strip.stage, strip.key, strip.status) == (stage, key, "done")
        }

    def put_scan(self, row: ScanRow) -> None:
        """Write a scan's row, unless the ledger holds the same already."""
        if self.scan(row.scan) != row:
            self._write(_upsert("scans", ScanRow), asdict(row))

    def put_strip(self, row: StripRow) -> None:
        """Write a strip's row; a strip that was finished for the same key before counts one run more."""
        again = "strips.key = excluded.key AND strips.status = 'done'"
        counted = f"runs = CASE WHEN {again} THEN strips.runs + 1 ELSE 1 END"
        self._write(_upsert("strips", StripRow).replace("runs = excluded.runs", counted), asdict(row))

    def forget_strips(self, scan: str, stage: Stage) -> None:
        """Drop the strips of a stage whose results are gone."""
        self._write("DELETE FROM strips WHERE scan = ? AND stage = ?", (scan, stage))

    def seconds_per_line(self) -> Mapping[str, float]:
        """Mean time of a line in each stage, over all finished strips."""
        rows = self._read(
            "SELECT stage, SUM(seconds) / SUM(lines) FROM strips WHERE status = 'done' AND lines > 0 GROUP BY stage"
        )
        return {stage: float(seconds) for stage, seconds in rows}

    def _create_tables(self) -> None:
        """Create the tables where there are none of this version."""
        if version_of(self._db) == VERSION:
            return
        self._db.execute("BEGIN IMMEDIATE")  # of several that open it at once, one creates them
        with self._db:
            version = version_of(self._db)
            if version > VERSION:
                raise FileFormatError(self._path, f"made by a later version: {version}, expected up to {VERSION}")
            if bring_up_to_date(self._db, version):
                log.warning("%s is of an earlier version and starts anew: its scans are made again", self._path)

    def _write(self, statement: str, values: Mapping[str, Any] | tuple[Any, ...]) -> None:
        try:
            self._db.execute(statement, values)
        except sqlite3.DatabaseError as error:
            raise self._fault(error) from error

    def _read(self, query: str, values: tuple[Any, ...] = ()) -> list[sqlite3.Row]:
        try:
            return self._db.execute(query, values).fetchall()
        except sqlite3.DatabaseError as error:
            raise self._fault(error) from error

    def _fault(self, error: sqlite3.DatabaseError) -> LsvisionError:
        """SQLite's error as ours: the disk's, or the file's."""
        code = getattr(error, "sqlite_errorcode", None)
        if code == sqlite3.SQLITE_FULL:
            return WriteError(f"{self._path}: cannot be written: the disk is full")
        if code is not None and code & 0xFF in _OF_THE_DISK:  # the lower byte is the kind, the upper its details
            return WriteError(f"{self._path}: cannot be read or written: {error}")
        return FileFormatError(self._path, f"not a ledger: {error}")


def measured_cells(strips: Iterable[StripRow]) -> MeasuredCells:
    """The measured cells of a product by its strips."""
    return MeasuredCells.total(
        MeasuredCells(strip.measured_cells, strip.lowest_mm, strip.highest_mm) for strip in strips
    )


def ledger_lines(rows: Mapping[str, ScanRow]) -> Iterator[str]:
    """The ledger in words, one line per scan."""
    width = max((len(key) for key in rows), default=0)
    for key, row in rows.items():
        result = (
            row.error if row.status == "failed" else f"{row.lines} lines, {100 * row.measured_share:.1f} % measured"
        )
        if row.missing_lines and row.status != "failed":
            result += f", {row.missing_lines} lines missing"
        known = row.verdict and row.status != "failed"
        drift = f"{row.verdict} to ±{row.drift_sigma_mm_per_m:.2g} mm/m, " if known else ""
        yield f"{key:{width}}  {row.status:7}  {row.seconds:8.1f} s  {drift}{result}"


def _upsert(table: str, schema: type) -> str:
    names = [item.name for item in fields(schema)]
    changes = ", ".join(f"{name} = excluded.{name}" for name in names)
    values = ", ".join(f":{name}" for name in names)
    return f"INSERT INTO {table} ({', '.join(names)}) VALUES ({values}) ON CONFLICT DO UPDATE SET {changes}"


def _log_ahead(db: sqlite3.Connection) -> None:
    """Let others read while one writes. Where two ask for that at once, SQLite refuses one instead of waiting."""
    last = time.monotonic() + _WAIT_SECONDS
    while True:
        try:
            db.execute("PRAGMA journal_mode=WAL")
            return
        except sqlite3.OperationalError as error:
            if error.sqlite_errorcode != sqlite3.SQLITE_BUSY or time.monotonic() > last:
                raise
            time.sleep(0.01)
