"""Strips that fit the memory, what a run takes, and the ledger that says what is done."""

import sqlite3
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, replace

import pytest

from lsvision.archive import Ledger, ScanRow, StripRow, find_scans, ledger_lines, read_calibrations
from lsvision.archive.health import ScanHealth
from lsvision.archive.plan import plan_run, predicted_bytes, predicted_seconds
from lsvision.archive.planned import IDLE_BYTES, rows_for_memory
from lsvision.errors import FileFormatError, WriteError
from tests.archive.archives import PROCESSING


@pytest.mark.parametrize(
    ("megabytes", "rows"), [(2_000, 512), (650, 512), (600, 256), (560, 128), (540, 64), (530, 32)]
)
def test_rows_fit_the_memory(megabytes, rows):
    most = 512
    memory = megabytes * 2**20
    found = rows_for_memory(1786, 100, most, memory)
    assert found == rows
    assert IDLE_BYTES + (found + 100) * 1786 * 120 <= memory


def test_too_little_memory_says_how_much_it_takes():
    with pytest.raises(ValueError, match=r"a worker needs 607 MB for 32 rows of 7142 px, it may take 600 MB"):
        rows_for_memory(7142, 100, 512, 600 * 2**20)


def test_a_scan_too_wide_for_a_worker_is_faulty(archive, calibration, tmp_path):
    small = replace(PROCESSING, worker_memory_mb=100)
    plan = plan_run(find_scans(str(archive)), read_calibrations(calibration), small, {}, tmp_path)
    assert not plan.to_do
    assert all("MB" in problem for problem in plan.faulty.values())


def test_time_and_size_before_it_starts(archive, calibration, tmp_path):
    plan = plan_run(find_scans(str(archive)), read_calibrations(calibration), PROCESSING, {}, tmp_path)
    rows = sum(scan.grid.rows for scan in plan.to_do)
    assert predicted_seconds(plan, {"disparity": 0.5, "product": 2.0}, 2) == (0.5 * (90 + 40) + 2.0 * rows) / 2
    cells = sum(scan.grid.rows * scan.grid.columns for scan in plan.to_do)
    assert predicted_bytes(plan) == 16 * cells + 4 * 64 * (90 + 40)


def test_rows_come_back_and_runs_of_a_strip_are_counted(tmp_path):
    scan = ScanRow("ä/1", "/ä/1", "done", lines=7, seconds=0.1 + 0.2, measured_share=0.5, stamp="s", input_sha256="i")
    strip = StripRow(
        "ä/1", "product", 3, "key", "done", lines=7, seconds=0.25, measured_cells=11, lowest_mm=-0.5, highest_mm=2.25
    )
    with Ledger(tmp_path / "ledger.sqlite") as ledger:
        ledger.put_scan(scan)
        ledger.put_strip(strip)
        ledger.put_strip(strip)
    with Ledger(tmp_path / "ledger.sqlite") as ledger:
        assert ledger.scans() == {"ä/1": scan}
        assert ledger.scan("other") is None
        assert ledger.strips() == [replace(strip, runs=2)]
        assert list(ledger.finished_strips("ä/1", "product", "key")) == [3]
        assert not ledger.finished_strips("ä/1", "product", "another key")
        assert ledger.seconds_per_line() == {"product": 0.25 / 7}
        ledger.put_strip(replace(strip, key="another key"))
        assert ledger.strips()[0].runs == 1
        ledger.forget_strips("ä/1", "product")
        assert not ledger.strips()


def test_a_ledger_that_several_open_while_it_is_made(tmp_path):
    with ThreadPoolExecutor(4) as pool:
        for number in range(30):
            together = threading.Barrier(4)

            def scans(path, together=together):
                together.wait()
                with Ledger(path) as ledger:
                    return ledger.scans()

            assert list(pool.map(scans, [tmp_path / f"{number}.sqlite"] * 4)) == [{}] * 4


def test_a_ledger_in_words():
    rows = {
        "a": ScanRow("a", "/a", "done", lines=7, measured_share=0.5),
        "bb": ScanRow("bb", "/bb", "failed", error="why"),
        "c": ScanRow("c", "/c", "done", lines=7, verdict="prior-dominated", drift_sigma_mm_per_m=48.8),
    }
    lines = list(ledger_lines(rows))
    assert lines.pop() == "c   done          0.0 s  prior-dominated to ±49 mm/m, 7 lines, 0.0 % measured"
    assert lines == [
        "a   done          0.0 s  7 lines, 50.0 % measured",
        "bb  failed        0.0 s  why",
    ]


def test_a_ledger_of_an_earlier_version_starts_anew(tmp_path, caplog):
    with sqlite3.connect(tmp_path / "ledger.sqlite") as db:  # as version 1 made it, which recorded no version
        db.execute("CREATE TABLE scans (scan TEXT PRIMARY KEY, measured REAL)")
        db.execute("INSERT INTO scans VALUES ('a', 0.5)")
    db.close()
    with Ledger(tmp_path / "ledger.sqlite") as ledger:
        assert ledger.scans() == {}
        ledger.put_scan(ScanRow("b", "/b", "done"))
    assert "of an earlier version and starts anew" in caplog.text
    with Ledger(tmp_path / "ledger.sqlite") as ledger:
        assert list(ledger.scans()) == ["b"]


@pytest.mark.parametrize("version", [2, 3, 4, 5])
def test_a_ledger_of_a_version_before_keeps_its_rows_and_gets_the_new_columns(tmp_path, caplog, version):
    path, row = tmp_path / "ledger.sqlite", ScanRow("a", "/a", "done", lines=7, version="v")
    with Ledger(path) as ledger:
        ledger.put_scan(row)
    with sqlite3.connect(path) as db:
        since = {
            3: ("verdict", "sideways_mm_per_m", "in_depth_mm_per_m", "drift_sigma_mm_per_m"),
            4: ("missing_lines",),
            5: ("line_motion", "rms_dx_mm", "rms_dz_mm", "rms_roll_rad", "rms_dy_mm"),
            6: ("taken", *(item.name for item in fields(ScanHealth))),
        }
        for column in (column for later, columns in since.items() if later > version for column in columns):
            db.execute(f"ALTER TABLE scans DROP COLUMN {column}")
        db.execute(f"PRAGMA user_version = {version}")
    db.close()
    with Ledger(path) as ledger:
        assert ledger.scans() == {"a": row}
        known = replace(row, verdict="determined", sideways_mm_per_m=-25.0, drift_sigma_mm_per_m=0.3, rms_dz_mm=0.2)
        ledger.put_scan(known)
        assert ledger.scan("a") == known
    assert not caplog.text


def test_a_ledger_of_a_later_version_is_refused(tmp_path):
    with sqlite3.connect(tmp_path / "ledger.sqlite") as db:
        db.execute("PRAGMA user_version = 99")
    db.close()
    with pytest.raises(FileFormatError, match="made by a later version: 99"):
        Ledger(tmp_path / "ledger.sqlite")


def test_what_is_no_ledger(tmp_path):
    (tmp_path / "ledger.sqlite").write_text("something else, long enough to be read as the head of a database")
    with pytest.raises(FileFormatError, match="not a ledger"):
        Ledger(tmp_path / "ledger.sqlite")


def test_a_full_disk_and_a_damaged_ledger_are_one_line(tmp_path):
    path = tmp_path / "ledger.sqlite"
    with Ledger(path) as ledger:
        for number in range(200):
            ledger.put_scan(ScanRow(f"s{number}", "/s", "done", error="x" * 500))
        ledger._db.execute("PRAGMA max_page_count = 1")  # no smaller than it is now: it cannot grow
        with pytest.raises(WriteError, match=r"ledger\.sqlite: cannot be written: the disk is full"):
            ledger.put_scan(ScanRow("large", "/s", "done", error="x" * 100_000))
        ledger._db.execute("PRAGMA query_only = ON")
        with pytest.raises(WriteError, match=r"ledger\.sqlite: cannot be read or written"):
            ledger.put_scan(ScanRow("other", "/s", "done"))
    content = path.read_bytes()
    path.write_bytes(content[:8192] + b"\xff" * (len(content) - 8192))
    with pytest.raises(FileFormatError, match=r"ledger\.sqlite: not a ledger"), Ledger(path) as ledger:
        ledger.scans()
    path.unlink()
    path.mkdir()
    with pytest.raises(WriteError, match=r"ledger\.sqlite: cannot be read or written: unable to open"):
        Ledger(path)
