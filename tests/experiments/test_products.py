"""correct and validate through files: exports, uncertainty, and every failure one line that leaves nothing behind."""

import errno
import json
import shutil
from dataclasses import replace
from pathlib import Path

import laspy
import plyfile
import pytest
import tifffile
import torch
import zarr.storage._local

from lsvision.archive import Ledger
from lsvision.io import NewScan, read_calibration, read_product, read_scan, write_calibration, write_encoder, write_scan
from lsvision.simulation import Acquisition, SceneConfig, SensorConfig, Simulation, simulate
from lsvision.types import Calibration, Motion, Observability
from tests.stages.rendered import BOARD, MOTION, PITCH, SMALL_RIG

SIGMA = (2e-4, 1e-4, 3e-4)


def calibration_of(simulation: Simulation) -> Calibration:
    """The true motion with a covariance."""
    covariance = torch.diag(torch.tensor(SIGMA, dtype=torch.float64).square())
    motion = Motion(simulation.trajectory.n, covariance)
    return Calibration("joint", motion, 1.0, 0.1, (), (), Observability((), ""), simulation.rig)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A depth-map scan of a tilted board, ``scan``, and its ``calibration.json``."""
    folder = tmp_path_factory.mktemp("made")
    board = SceneConfig(pitch_deg=3.0, roll_deg=2.0)
    simulation = simulate(SMALL_RIG, BOARD, board, MOTION, SensorConfig(supersampling=3), Acquisition(PITCH))
    write_scan(
        folder / "scan",
        NewScan(
            rig=simulation.rig,
            travel=simulation.travel,
            left=simulation.strips("left"),
            right=None,
            depth=(strip[..., None] for strip in simulation.depth_strips()),
            lines=simulation.lines,
        ),
    )
    write_calibration(calibration_of(simulation), folder / "calibration.json")
    return folder


def correct(made: Path, *options: str) -> tuple[str, ...]:
    return (
        "+experiment=correct",
        f"scan={made / 'scan'}",
        f"calibration={made / 'calibration.json'}",
        "correction.height_range_mm=[-30,30]",
        "line_motion=none",
        *options,
    )


def test_a_product_in_every_form_and_its_check(made, command, tmp_path, capsys):
    options = ("export=[tiff,ply,laz]", "correction.uncertainty=true", "correction.strip_rows=128")
    assert command(*correct(made, *options)) == 0
    product = read_product(tmp_path / "run" / "scan.zarr")
    rows, columns = product.shape
    count = int(product.valid(0, rows).sum())
    assert len(plyfile.PlyData.read(tmp_path / "run" / "scan.ply")["vertex"]) == count
    cloud = laspy.read(tmp_path / "run" / "scan.laz")
    assert len(cloud.x) == count
    # Millimetres: the board and the conveyor lie some 0.8 m before the cameras, the field is half a metre wide.
    assert 740 < cloud.header.mins[2] < cloud.header.maxs[2] < 830
    assert 400 < cloud.header.maxs[0] - cloud.header.mins[0] < 560
    assert tifffile.imread(tmp_path / "run" / "scan_height.tif").shape == (rows, columns)
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    motion = read_calibration(made / "calibration.json").motion
    assert summary["drift_mm_per_m"] == pytest.approx([1000 * sigma / motion.stretch for sigma in SIGMA], rel=0.01)
    sigma = product.sigma(0, rows)[product.valid(0, rows)]
    assert 0.01 < float(sigma[:, 2].min()) < float(sigma[:, 2].max()) < 1.0

    assert command("+experiment=validate", f"product={product.path}", folder="checked") == 0
    assert "is whole" in capsys.readouterr().out
    checked = json.loads((tmp_path / "checked" / "summary.json").read_text())
    assert checked["board"]["corners"] == 88
    assert checked["board"]["distance_rms_mm"] < 0.1
    assert checked["valid_share"] == pytest.approx(count / (rows * columns))


def test_a_damaged_product_fails_its_check(made, command, tmp_path, capsys):
    assert command(*correct(made)) == 0
    capsys.readouterr()
    (chunk,) = (tmp_path / "run" / "scan.zarr" / "height" / "0" / "c" / "0").iterdir()
    data = bytearray(chunk.read_bytes())
    data[1000] ^= 4
    chunk.write_bytes(data)
    assert command("+experiment=validate", f"product={chunk.parents[4]}", folder="checked") == 1
    (told,) = capsys.readouterr().err.splitlines()
    assert "height/0: rows 0-" in told
    assert not (tmp_path / "checked" / "summary.json").exists()


def truncate(scan: Path) -> None:
    data = (scan / "left.tif").read_bytes()
    (scan / "left.tif").write_bytes(data[: len(data) // 2])


def one_line(scan: Path) -> None:
    read = read_scan(scan)
    left, depth = [read.left.read(0, 1)], [read.images.depth.read(0, 1)]
    write_scan(scan, NewScan(rig=read.rig, travel=read.travel, left=left, right=None, depth=depth, lines=1))


def short_log(scan: Path) -> None:
    write_encoder(torch.arange(100).double(), scan / "encoder.csv")
    (scan / "scan.yaml").write_text((scan / "scan.yaml").read_text() + "encoder: encoder.csv\n")


def not_a_number(scan: Path) -> None:
    file = scan.parent / "calibration.json"
    data = json.loads(file.read_text())
    data["motion"]["n"][1] = float("nan")
    file.write_text(json.dumps(data))


FAULTS = {
    "truncated TIFF": (truncate, ("left.tif", "cut short")),
    "one line": (one_line, ("scan", "at least two lines")),
    "short encoder log": (short_log, ("encoder.csv", "ends at line 99")),
    "NaN in the calibration": (not_a_number, ("calibration.json", "motion.n")),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_one_line_and_leaves_nothing(fault, made, command, tmp_path, capsys):
    harm, told = FAULTS[fault]
    shutil.copytree(made, tmp_path / "harmed")
    harm(tmp_path / "harmed" / "scan")
    assert command(*correct(tmp_path / "harmed")) == 1
    (error,) = capsys.readouterr().err.splitlines()
    assert all(part in error for part in told)
    assert sorted(path.name for path in (tmp_path / "run").iterdir()) == [".hydra", "lsvision.log"]


@pytest.mark.parametrize("writes", [0, 5, 40])
def test_a_full_disk_is_one_line_and_leaves_nothing(writes, made, command, tmp_path, capsys, monkeypatch):
    put, done = zarr.storage._local._put, []

    def full(*args, **kwargs):
        done.append(args)
        if len(done) > writes:
            raise OSError(errno.ENOSPC, "No space left on device")
        return put(*args, **kwargs)

    monkeypatch.setattr(zarr.storage._local, "_put", full)
    assert command(*correct(made, "correction.strip_rows=64")) == 1
    (error,) = capsys.readouterr().err.splitlines()
    assert "scan.zarr: cannot be written: No space left on device" in error
    assert sorted(path.name for path in (tmp_path / "run").iterdir()) == [".hydra", "lsvision.log"]


def test_a_full_disk_during_an_export_keeps_the_product(made, command, tmp_path, capsys, monkeypatch):
    def full(*args, **kwargs):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(laspy.LasWriter, "write_points", full)
    assert command(*correct(made, "export=[laz]")) == 1
    assert "scan.laz: cannot be written" in capsys.readouterr().err
    assert not list((tmp_path / "run").glob("*.laz"))
    assert not list((tmp_path / "run").glob(".*partial"))
    assert read_product(tmp_path / "run" / "scan.zarr").shape[0] > 0


@pytest.fixture
def unusable(made: Path, tmp_path: Path) -> Path:
    """A calibration that did not converge."""
    calibration = replace(
        read_calibration(made / "calibration.json"), verdict="not converged", reasons=("it had not settled",)
    )
    write_calibration(calibration, tmp_path / "unusable.json")
    return tmp_path / "unusable.json"


def test_a_calibration_without_a_usable_n_corrects_only_where_it_is_accepted(made, unusable, command, tmp_path, capsys):
    asked = (*correct(made), f"calibration={unusable}")
    assert command(*asked) == 1
    assert capsys.readouterr().err.splitlines() == [
        f"error: {unusable}: the calibration is not converged: it had not settled"
    ]
    assert not (tmp_path / "run" / "scan.zarr").exists()
    assert command(*asked, "accept=[inconsistent]", folder="other") == 1
    assert command(*asked, "accept=[not_converged]", folder="accepted") == 0
    said = capsys.readouterr().out
    assert "the calibration is not converged: it had not settled" in said
    assert "mm per metre sideways" in said
    metadata = read_product(tmp_path / "accepted" / "scan.zarr").metadata
    n1, n2, n3 = metadata["n"]
    assert metadata["calibration_verdict"] == "not converged"
    assert metadata["calibration_reasons"] == ["it had not settled"]
    assert metadata["motion_mm_per_m"] == pytest.approx({"sideways": 1000 * n1 / n2, "in_depth": 1000 * n3 / n2})
    assert max(metadata["drift_sigma_mm_per_m"]) == pytest.approx(0.3, rel=0.1)
    summary = json.loads((tmp_path / "accepted" / "summary.json").read_text())
    assert summary["verdict"] == "not converged"


def test_reprocess_refuses_it_too_and_records_the_verdict_of_what_it_uses(made, unusable, command, tmp_path):
    shutil.copytree(made / "scan", tmp_path / "archive" / "scan")
    asked = (
        "+experiment=reprocess", f"archive={tmp_path / 'archive'}", f"calibration={unusable}",
        f"output={tmp_path / 'products'}", "engine.workers=1", "correction.height_range_mm=[-30,30]",
        "line_motion=none",
    )  # fmt: skip
    assert command(*asked) == 1
    assert command(*asked, "accept=[not_converged]", folder="accepted") == 0
    with Ledger(tmp_path / "products" / "ledger.sqlite") as ledger:
        row = ledger.scans()["scan"]
    assert row.verdict == "not converged"
    assert row.drift_sigma_mm_per_m == pytest.approx(0.3, rel=0.1)
    assert "not converged" in (tmp_path / "accepted" / "report.html").read_text(encoding="utf-8")
