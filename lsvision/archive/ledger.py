"""The ledger of an output: a row a scan and a row a strip, in SQLite beside the products."""

import sqlite3
import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Literal

from lsvision.errors import FileFormatError

LEDGER_FILE = "ledger.sqlite"

_WAIT_SECONDS = 5.0

Stage = Literal["disparity", "product"]
Status = Literal["running", "done", "failed"]

_SCHEMA = """
CREATE TABLE IF NOT EXISTS scans (
    scan TEXT PRIMARY KEY, path TEXT NOT NULL, status TEXT NOT NULL, error TEXT NOT NULL, lines INTEGER NOT NULL,
    seconds REAL NOT NULL, measured REAL NOT NULL, stamp TEXT NOT NULL, input_sha256 TEXT NOT NULL,
    calibration TEXT NOT NULL, calibration_sha256 TEXT NOT NULL, config_sha256 TEXT NOT NULL, version TEXT NOT NULL
);
CREATE TABLE IF NOT EXISTS strips (
    scan TEXT NOT NULL, stage TEXT NOT NULL, number INTEGER NOT NULL, key TEXT NOT NULL, status TEXT NOT NULL,
    error TEXT NOT NULL, lines INTEGER NOT NULL, seconds REAL NOT NULL, measured INTEGER NOT NULL,
    runs INTEGER NOT NULL,
    PRIMARY KEY (scan, stage, number)
);
"""


@dataclass(frozen=True)
class ScanRow:
    """What is known of a scan.

    ``stamp`` tells cheaply whether its files were touched (paths, sizes, times), ``input_sha256`` what is in them.
    ``seconds`` were worked on it over all strips, ``measured`` is the share of the product's cells with a height.
    """

    scan: str
    path: str
    status: Status
    error: str = ""
    lines: int = 0
    seconds: float = 0.0
    measured: float = 0.0
    stamp: str = ""
    input_sha256: str = ""
    calibration: str = ""
    calibration_sha256: str = ""
    config_sha256: str = ""
    version: str = ""


@dataclass(frozen=True)
class StripRow:
    """One strip of one stage of a scan: done for ``key``, the hash of all that it depends on, or failed.

    ``measured`` counts the cells with a value, ``runs`` how often the strip was done for this key.
    """

    scan: str
    stage: Stage
    number: int
    key: str
    status: Status
    error: str = ""
    lines: int = 0
    seconds: float = 0.0
    measured: int = 0
    runs: int = 1


class Ledger:
    """The open ledger; every call that writes is one transaction. One process writes, any number may read.

    Raises:
        FileFormatError: the file is there and is no ledger.
    """

    def __init__(self, path: Path) -> None:
        try:
            self._db = sqlite3.connect(path, isolation_level=None)
            self._db.row_factory = sqlite3.Row
            _log_ahead(self._db)
            self._db.execute("PRAGMA synchronous=NORMAL")
            self._db.executescript(_SCHEMA)
        except sqlite3.DatabaseError as error:
            raise FileFormatError(path, f"not a ledger: {error}") from error

    def __enter__(self) -> "Ledger":
        return self

    def __exit__(self, *_: object) -> None:
        self._db.close()

    def scans(self) -> dict[str, ScanRow]:
        """All scans by their key, in order."""
        rows = self._db.execute("SELECT * FROM scans ORDER BY scan")
        return {row["scan"]: ScanRow(**dict(row)) for row in rows}

    def scan(self, key: str) -> ScanRow | None:
        """The row of one scan."""
        row = self._db.execute("SELECT * FROM scans WHERE scan = ?", (key,)).fetchone()
        return ScanRow(**dict(row)) if row is not None else None

    def strips(self, scan: str | None = None) -> list[StripRow]:
        """The strips of a scan, or all, by scan, stage and number."""
        chosen, values = ("WHERE scan = ?", (scan,)) if scan is not None else ("", ())
        rows = self._db.execute(f"SELECT * FROM strips {chosen} ORDER BY scan, stage, number", values)
        return [StripRow(**dict(row)) for row in rows]

    def done(self, scan: str, stage: Stage, key: str) -> dict[int, StripRow]:
        """The strips of a stage that are done for a key, by number."""
        return {
            strip.number: strip
            for strip in self.strips(scan)
            if (strip.stage, strip.key, strip.status) == (stage, key, "done")
        }

    def put_scan(self, row: ScanRow) -> None:
        """Write a scan's row; one that says the same already is left alone."""
        if self.scan(row.scan) != row:
            self._db.execute(_upsert("scans", ScanRow), asdict(row))

    def put_strip(self, row: StripRow) -> None:
        """Write a strip's row; a strip that was done for the same key before counts one run more."""
        again = "strips.key = excluded.key AND strips.status = 'done'"
        counted = f"runs = CASE WHEN {again} THEN strips.runs + 1 ELSE 1 END"
        self._db.execute(_upsert("strips", StripRow).replace("runs = excluded.runs", counted), asdict(row))

    def forget_strips(self, scan: str, stage: Stage) -> None:
        """Drop the strips of a stage whose results are gone."""
        self._db.execute("DELETE FROM strips WHERE scan = ? AND stage = ?", (scan, stage))

    def seconds_per_line(self) -> Mapping[str, float]:
        """Mean time that a line took in each stage, over everything done so far."""
        rows = self._db.execute(
            "SELECT stage, SUM(seconds) / SUM(lines) FROM strips WHERE status = 'done' AND lines > 0 GROUP BY stage"
        )
        return {stage: float(seconds) for stage, seconds in rows}


def ledger_lines(rows: Mapping[str, ScanRow]) -> Iterator[str]:
    """The ledger in words, a line a scan."""
    width = max((len(key) for key in rows), default=0)
    for key, row in rows.items():
        told = row.error if row.status == "failed" else f"{row.lines} lines, {100 * row.measured:.1f} % measured"
        yield f"{key:{width}}  {row.status:7}  {row.seconds:8.1f} s  {told}"


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
