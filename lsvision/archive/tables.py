"""The tables of the ledger, and how those of earlier versions become them."""

import sqlite3

VERSION = 6  # of the tables; version 1 recorded none, versions 2 to 5 lacked the last columns of the scans

_TABLES = (
    """
    CREATE TABLE scans (
        scan TEXT PRIMARY KEY, path TEXT NOT NULL, status TEXT NOT NULL, error TEXT NOT NULL, lines INTEGER NOT NULL,
        seconds REAL NOT NULL, measured_share REAL NOT NULL, stamp TEXT NOT NULL, input_sha256 TEXT NOT NULL,
        calibration TEXT NOT NULL, calibration_sha256 TEXT NOT NULL, config_sha256 TEXT NOT NULL, version TEXT NOT NULL
    )
    """,
    """
    CREATE TABLE strips (
        scan TEXT NOT NULL, stage TEXT NOT NULL, number INTEGER NOT NULL, key TEXT NOT NULL, status TEXT NOT NULL,
        error TEXT NOT NULL, lines INTEGER NOT NULL, seconds REAL NOT NULL, measured_cells INTEGER NOT NULL,
        lowest_mm REAL NOT NULL, highest_mm REAL NOT NULL, runs INTEGER NOT NULL,
        PRIMARY KEY (scan, stage, number)
    )
    """,
)

_SINCE_VERSION_3 = (
    "verdict TEXT NOT NULL DEFAULT ''",
    "sideways_mm_per_m REAL NOT NULL DEFAULT 0.0",
    "in_depth_mm_per_m REAL NOT NULL DEFAULT 0.0",
    "drift_sigma_mm_per_m REAL NOT NULL DEFAULT 0.0",
)
_SINCE_VERSION_4 = ("missing_lines INTEGER NOT NULL DEFAULT 0",)
_SINCE_VERSION_5 = (
    "line_motion TEXT NOT NULL DEFAULT ''",
    "rms_dx_mm REAL NOT NULL DEFAULT 0.0",
    "rms_dz_mm REAL NOT NULL DEFAULT 0.0",
    "rms_roll_rad REAL NOT NULL DEFAULT 0.0",
    "rms_dy_mm REAL NOT NULL DEFAULT 0.0",
)
_SINCE_VERSION_6 = (
    "taken TEXT NOT NULL DEFAULT ''",
    "askew_sideways_deg REAL",
    "askew_sideways_sigma_deg REAL",
    "askew_in_depth_deg REAL",
    "askew_in_depth_sigma_deg REAL",
    "travel_rate REAL",
    "travel_sigma REAL",
    "row_offset_lines REAL",
    "row_offset_sigma_lines REAL",
    "gain_ratio REAL",
)
_ADDED = {3: _SINCE_VERSION_3, 4: _SINCE_VERSION_4, 5: _SINCE_VERSION_5, 6: _SINCE_VERSION_6}


def version_of(db: sqlite3.Connection) -> int:
    """Version of the tables; 0 where there are none, or those of version 1."""
    return int(db.execute("PRAGMA user_version").fetchone()[0])


def bring_up_to_date(db: sqlite3.Connection, version: int) -> bool:
    """Create the tables, or what a version lacks of them; returns whether rows of version 1 were dropped."""
    dropped = False
    if version < 2:
        old = db.execute("SELECT name FROM sqlite_master WHERE name IN ('scans', 'strips')").fetchall()
        for (name,) in old:
            db.execute(f"DROP TABLE {name}")
        for table in _TABLES:
            db.execute(table)
        dropped = bool(old)
    if version < VERSION:
        for column in (column for since, columns in _ADDED.items() if version < since for column in columns):
            db.execute(f"ALTER TABLE scans ADD COLUMN {column}")
        db.execute(f"PRAGMA user_version = {VERSION}")
    return dropped
