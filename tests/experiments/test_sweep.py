"""Sweeps: every job is in the table and the report, with its results or the reason of its failure."""

import json
import os
import subprocess
import sys

import polars
import pytest

from lsvision.errors import CalibrationError
from lsvision.experiments.command import config_folder
from lsvision.experiments.sweep import collect_sweep
from lsvision.io import write_text

SWEEP = ("--multirun", "+experiment=study", "runs=1,2,3,4,5,6", "conditions.method=joint,two_step", "map_steps=7")


@pytest.fixture
def toy(monkeypatch):
    """A cheap experiment that fails in two of the twelve jobs, once with an expected error and once by a bug."""

    def experiment(settings, folder):
        if settings.runs == 3 and settings.conditions.method == "joint":
            raise CalibrationError("scans/a: the corners lie on one line\nand more")
        if settings.runs == 5 and settings.conditions.method == "two_step":
            raise ZeroDivisionError("division by zero")
        values = {"rmse_after_mm": 0.1 * settings.runs, "n": [0.0, 1.0, float(settings.runs)], "verdict": "determined"}
        write_text(folder / "summary.json", json.dumps({"still": values, "long": list(range(9)), "ok": True}))
        write_text(folder / "report.html", "<p>of the job</p>")

    monkeypatch.setattr("lsvision.experiments.study.run_study", experiment)


@pytest.mark.drawn
def test_twelve_jobs_of_which_two_fail(toy, command, tmp_path, capsys):
    folder = tmp_path / "sweep"
    assert command(*SWEEP, f"hydra.sweep.dir={folder}") == 1
    errors = capsys.readouterr().err.splitlines()
    assert len(errors) == 2
    assert errors[0].startswith("error: job 4 (+experiment=study runs=3 conditions.method=joint ")
    assert errors[0].endswith("): scans/a: the corners lie on one line")
    assert errors[1].endswith("ZeroDivisionError: division by zero")
    table = polars.read_parquet(folder / "sweep.parquet")
    assert table["job"].to_list() == [str(number) for number in range(12)]
    assert len(table.filter(polars.col("reason") == "")) == 10
    assert table["still.rmse_after_mm"].null_count() == 2
    assert table.row(11, named=True)["still.n.3"] == 6.0
    assert table["runs"].to_list()[:3] == ["1", "1", "2"]
    assert not any(name.startswith("long") for name in table.columns)
    page = (folder / "report.html").read_text()
    assert "scans/a: the corners lie on one line" in page
    assert "and more" not in page
    assert "ZeroDivisionError: division by zero" in page
    assert "10 jobs gave a result, 2 failed" in page
    assert page.count('href="') >= 10
    assert "Traceback" in (folder / "4" / "lsvision.log").read_text()
    assert (folder / "figures" / "results_by_job.svg").is_file()


def test_a_sweep_without_failures_exits_with_zero(toy, command, tmp_path, capsys):
    assert command("--multirun", "+experiment=study", "runs=1,2", f"hydra.sweep.dir={tmp_path / 'sweep'}") == 0
    assert capsys.readouterr().err == ""
    assert "Failed jobs" not in (tmp_path / "sweep" / "report.html").read_text()


def test_a_killed_job_is_reported_and_collected_afterwards(toy, command, tmp_path, capsys):
    folder = tmp_path / "sweep"
    assert command("--multirun", "+experiment=study", "runs=1,2", f"hydra.sweep.dir={folder}") == 0
    (folder / "1" / "job.json").unlink()
    (folder / "report.html").unlink()
    assert command("+experiment=collect", f"sweep={folder}") == 0
    assert "killed, or still running" in (folder / "report.html").read_text()
    assert collect_sweep(folder)[1].results == {}


@pytest.mark.parametrize("make", [False, True])
def test_a_folder_without_jobs_is_one_line(make, command, tmp_path, capsys):
    folder = tmp_path / "none"
    if make:
        folder.mkdir()
    assert command("+experiment=collect", f"sweep={folder}") == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert str(folder) in line


@pytest.mark.slow
@pytest.mark.parametrize("launcher", ["joblib", "submitit_local"])
def test_jobs_in_other_processes(launcher, tmp_path):
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher", reason="the extra `sweep` is not installed")
    options = ["conditions.boards=two_tilted,two_wrong", "axes.boards=null", "runs=2", "map_steps=3", "threads=1"]
    sweep = [f"hydra/launcher={launcher}", f"hydra.sweep.dir={tmp_path / 'sweep'}"]
    command = [sys.executable, "-m", "lsvision.run", "--multirun", "+experiment=study", *options, *sweep]
    environment = {**os.environ, "PYTHONPATH": str(config_folder().parent), "PYTHONWARNINGS": "ignore"}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 1, done.stderr
    assert "two_wrong" in done.stderr
    table = polars.read_parquet(tmp_path / "sweep" / "sweep.parquet")
    assert [bool(reason) for reason in table["reason"]] == [False, True]
    assert polars.read_parquet(tmp_path / "sweep" / "points.parquet")["job"].to_list() == ["0"]
