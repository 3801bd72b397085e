"""What a person types wrongly, or in another language: one line, and an exit code that says which."""

import io
import logging
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from lsvision.archive import LEDGER_FILE, Ledger, ScanRow, sole_run
from lsvision.errors import ConfigError
from lsvision.experiments.command_line import print_any_letter, quoted
from lsvision.experiments.hydra_hooks import own_folder
from lsvision.experiments.reprocess import StatusSettings, run_status
from tests.archive.archives import make_calibration, make_scan

REPROCESS = ("+experiment=reprocess", "calibration=c.json")


@pytest.mark.parametrize(
    ("overrides", "problem"),
    [
        (["+experiment=corect"], "experiment: there is no 'corect'; choose one of calibrate, "),
        (["+experiment=calibrate", "scans=DIR"], "scans: expected a list, got 'DIR'; write [DIR] for a list of one"),
        (["+experiment=calibrate", "scans=[5]"], "scans[0]: expected text, got 5"),
        (["+experiment=calibrate", "scans=5"], "scans: expected a list, got 5"),
        (["+experiment=correct", "scan=a", "calibration=c.json", "export=[obj]"], "export[0]: expected 'tiff', 'ply'"),
        ([*REPROCESS, "archive='reference://'", "output=o"], "archive: reference:// cannot be read: "),
        (
            [*REPROCESS, "archive=.", "output=o", "engine=dask", "engine.scheduler=garbage"],
            "engine.scheduler: expected an address as tcp://host:8786, got 'garbage'",
        ),
        ([*REPROCESS, "archive=.", "output=o", "engine.workers=-1"], "engine.workers: expected a whole number >= 1"),
        (["+experiment=calibrate", "scans=[a"], "scans=[a: cannot be understood; put quotes"),
        (["+experiment=correct", "scan=a(b", "calibration=c.json"], "scan=a(b: cannot be understood"),
        (["+experiment=calibrate", "calibration.metod=joint"], "Could not override 'calibration.metod'."),
        (["+experiment=calibrate", "scans=[Schiene Ä,ü]"], "Schiene Ä/scan.yaml: no such file"),
        (["+experiment=correct", "scan=Käfer", "calibration=ö.json"], "Käfer/scan.yaml: no such file"),
        (["+experiment=validate", "product=" + "x" * 300], "x: not a readable product: "),
        (["+experiment=status", "output=\udcff"], r"output=\udcff: not UTF-8"),
        ([*REPROCESS, "archive=.", "output=afile"], "afile: File exists"),
        ([*REPROCESS, "archive=.", "output=afile/o"], "afile/o: Not a directory"),
        ([*REPROCESS, "archive=" + "x" * 300, "output=o"], "archive: no such folder, list or pattern: "),
        ([*REPROCESS, "archive=latin1.txt", "output=o"], "archive: latin1.txt: expected a list as UTF-8 text"),
        ([*REPROCESS, "archive=.", "output=" + "x" * 300], "x: File name too long"),
    ],
)
def test_one_line(command, tmp_path, capsys, overrides, problem):
    make_calibration(tmp_path / "c.json")
    (tmp_path / "afile").write_text("")
    (tmp_path / "latin1.txt").write_bytes("Wärme".encode("latin-1"))
    assert command(*overrides) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: ")
    assert problem in line


def test_a_name_that_leaves_no_room_for_its_product(command, tmp_path, capsys):
    make_calibration(tmp_path / "c.json")
    make_scan(tmp_path / "archive" / ("ä" * 105), 40)
    assert command(*REPROCESS, "archive=archive", "output=o") == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "1 of 1 scans failed" in line
    with Ledger(tmp_path / "o" / LEDGER_FILE) as ledger:
        assert [row.error[-50:] for row in ledger.scans().values()] == [
            ".zarr: expected names of at most 200 bytes, got 210"[-50:]
        ]


def test_a_folder_that_cannot_be_made_for_the_run(tmp_path, monkeypatch, capsys):
    from lsvision import run

    (tmp_path / "afile").write_text("")
    monkeypatch.setattr(
        sys, "argv", ["lsvision", "+experiment=status", "output=o", f"hydra.run.dir={tmp_path}/afile/x"]
    )
    with pytest.raises(SystemExit) as stop:
        run.main()
    assert stop.value.code == 1
    assert capsys.readouterr().err == f"error: {tmp_path}/afile/x: Not a directory\n"
    assert "HYDRA_FULL_ERROR" not in os.environ


def test_a_log_that_cannot_be_written_does_not_bury_the_error(command, monkeypatch, capsys):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(logging.Handler, "format", full)
    assert command("+experiment=status", "output=nowhere") == 1
    assert capsys.readouterr().err == "error: output: no ledger in nowhere\n"


def test_letters_beyond_ascii_are_quoted():
    given = [
        "--multirun",
        "+experiment=x",
        "a.b=ä",
        "c=[a, ü b,'ö']",
        "c=[a,ü b]",
        'd="ä"',
        "e=ä,b",
        "f=choice(ä)",
        "g=a",
    ]
    assert quoted(given) == [
        "--multirun", "+experiment=x", "a.b='ä'", "c=[a, ü b,'ö']", "c=[a,'ü b']", 'd="ä"', "e='ä',b", "f=choice(ä)",
        "g=a",
    ]  # fmt: skip
    with pytest.raises(ConfigError, match="not UTF-8"):
        quoted(["a=\udcff"])


def test_a_console_of_few_letters(monkeypatch):
    for name in ("stdout", "stderr"):
        monkeypatch.setattr(sys, name, io.TextIOWrapper(io.BytesIO(), encoding="cp1252"))
    print_any_letter()
    print("Köpfe 東", flush=True)
    assert sys.stdout.buffer.getvalue() == "Köpfe \\u6771\n".encode("cp1252")


def status_lines(output: Path, caplog) -> list[str]:
    caplog.clear()
    caplog.set_level("INFO")
    run_status(StatusSettings(name="status", output=str(output)), output)
    return caplog.messages


def test_status_calls_running_only_what_a_run_is_at_work_on(tmp_path, caplog):
    with sole_run(tmp_path), Ledger(tmp_path / LEDGER_FILE) as ledger:
        ledger.put_scan(ScanRow("a", "/a", "running"))
        assert "running" in status_lines(tmp_path, caplog)[0]
    assert "stopped" in status_lines(tmp_path, caplog)[0]
    (tmp_path / ".lock").unlink(missing_ok=True)
    assert "stopped" in status_lines(tmp_path, caplog)[0]
    assert not (tmp_path / ".lock").exists()


def test_an_interruption_says_what_is_done(command, tmp_path, capsys, monkeypatch):
    from lsvision.archive.driver import Driver

    make_calibration(tmp_path / "c.json")
    for name in ("a", "b"):
        make_scan(tmp_path / "archive" / name, 40)
    take = Driver._take

    def interrupted(driver, scan, task, outcome):
        take(driver, scan, task, outcome)
        if driver._rows:
            raise KeyboardInterrupt

    monkeypatch.setattr(Driver, "_take", interrupted)
    options = (*REPROCESS, "archive=archive", "output=o", "engine.workers=1")
    assert command(*options) == 130
    assert capsys.readouterr().err.splitlines()[-1] == (
        "interrupted: 1 of 2 scans are done, and finished strips of others are kept; "
        "run the same command again to go on"
    )
    monkeypatch.setattr(Driver, "_take", take)
    assert command(*options) == 0
    assert len(list((tmp_path / "o").glob("*.zarr"))) == 2


def has_a_product(process: psutil.Process, output: Path) -> bool:
    return bool(list(output.glob("*.zarr")))


def starts_workers(process: psutil.Process, output: Path) -> bool:
    """Whether the server of workers imports what they need, for seconds."""
    return any("forkserver" in " ".join(child.cmdline()) for child in process.children())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "code", "word"), [(signal.SIGINT, 130, "interrupted: "), (signal.SIGTERM, 143, "terminated: ")]
)
@pytest.mark.parametrize("moment", [has_a_product, starts_workers])
def test_a_signal_to_all_processes_is_one_line(tmp_path, moment, number, code, word):
    make_calibration(tmp_path / "c.json")
    for index in range(20):
        make_scan(tmp_path / "archive" / f"s{index}", 400, stereo=True)
    options = [f"archive={tmp_path / 'archive'}", f"calibration={tmp_path / 'c.json'}", f"output={tmp_path / 'o'}"]
    program = [sys.executable, "-m", "lsvision.run", "+experiment=reprocess", *options, "engine.workers=1"]
    process = subprocess.Popen(
        [*program, f"hydra.run.dir={tmp_path / 'run'}"], stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    watched = psutil.Process(process.pid)
    while process.poll() is None and not moment(watched, tmp_path / "o"):
        time.sleep(0.01)
    family = [watched, *watched.children(recursive=True)]
    os.killpg(process.pid, number)
    _, errors = process.communicate(timeout=100)
    assert process.returncode == code
    assert len(errors.splitlines()) == 1
    assert errors.startswith(word)
    assert not psutil.wait_procs(family, timeout=30)[1]


def test_two_runs_within_a_second_have_a_folder_each(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert [own_folder("a/b") for _ in range(3)] == ["a/b", "a/b_2", "a/b_3"]
    (tmp_path / "file").touch()
    assert own_folder("file/b") == "file/b"  # which Hydra reports
