"""Drifts of an archive: measured on every scan, kept in the ledger, and told from chance."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from lsvision.archive import (
    LEDGER_FILE,
    WORK_FOLDER,
    Ledger,
    Place,
    ScanRow,
    find_scans,
    health_in_words,
    plan_run,
    process_scans,
    read_calibrations,
)
from lsvision.archive import alarms as alarms_of
from lsvision.archive.alarms import SIGNALS
from lsvision.experiments.simulate import write_simulation
from lsvision.geometry import scaled_rig
from lsvision.report.progress import progress_bars
from lsvision.simulation import Acquisition, MotionConfig, SceneConfig, SensorConfig, simulate
from lsvision.stages.correction.config import CorrectionConfig
from lsvision.stages.disparity.config import DisparityConfig
from tests.archive.archives import PROCESSING, InProcess, make_calibration, make_scan
from tests.stages.rendered import BOARD, FULL_RIG

SCANS = 60
# Usual scatter of each signal from scan to scan: a quarter of the drift that has to be seen, or less.
SCATTER = {
    "askew_sideways_deg": 0.02, "askew_in_depth_deg": 0.02, "travel_rate": 4e-4, "row_offset_lines": 0.03,
    "gain_ratio": 0.005,
}  # fmt: skip


def archive(seed: int, drift: dict[str, float] | None = None, start: int = SCANS) -> dict[str, ScanRow]:
    """The rows of an archive whose signals scatter by chance, and drift from a scan on."""
    chance = torch.Generator().manual_seed(seed)
    noise = torch.randn(SCANS, len(SCATTER), generator=chance, dtype=torch.float64)
    level = torch.tensor([0.0, 0.0, 1.0, 0.0, 1.0], dtype=torch.float64)
    values = level + noise * torch.tensor(list(SCATTER.values()), dtype=torch.float64)
    for name, size in (drift or {}).items():
        values[start:, list(SCATTER).index(name)] += size
    rows = {}
    for number, row in enumerate(values.tolist()):
        key = f"scan_{number:03}"
        known = dict(zip(SCATTER, row, strict=True))
        day = f"2024-{1 + number // 28:02}-{1 + number % 28:02}"
        rows[key] = ScanRow(key, key, "done", calibration_sha256="a", taken=day, **known)
    return rows


@pytest.mark.slow
def test_false_alarms_are_rare():
    """At most one archive in a hundred, of five signals each."""
    assert sum(bool(alarms_of(archive(seed))) for seed in range(400)) <= 4


@pytest.mark.slow
@pytest.mark.parametrize(
    ("signal", "drift"),
    [("askew_sideways_deg", 0.1), ("askew_in_depth_deg", -0.1), ("travel_rate", 0.002), ("travel_rate", -0.002)],
)
@pytest.mark.parametrize("start", [12, 30, 50])
def test_a_drift_is_seen_within_five_scans(signal, drift, start):
    seen = 0
    for seed in range(40):
        rows = dict(list(archive(seed, {signal: drift}, start).items())[: start + 5])
        found = [alarm for alarm in alarms_of(rows) if alarm.signal.value == signal]
        seen += bool(found) and abs(int(found[0].scans[0][-3:]) - start) <= 1
    assert seen >= (36 if start == 12 else 39), seen


def test_a_slow_drift_is_seen_too():
    rows = archive(0)
    rows = {
        key: replace(row, travel_rate=row.travel_rate + 2e-4 * max(number - 20, 0))
        for number, (key, row) in enumerate(rows.items())
    }
    found = [alarm for alarm in alarms_of(rows) if alarm.signal.value == "travel_rate"]
    assert found
    assert "scan_02" in found[0].scans[0]


def test_an_alarm_names_its_scans_and_the_calibration_they_need():
    rows = archive(1, {"travel_rate": 0.003}, 40)
    (alarm,) = alarms_of(rows)
    assert alarm.scans == tuple(f"scan_{number:03}" for number in range(40, 60))
    assert alarm.in_words.startswith("advance per line changed by +0.003")
    assert "with scan_040 to scan_059 (20 scans): check the encoder, then scan boards" in alarm.in_words
    assert health_in_words(rows, [alarm]).startswith("health: 1 drift in direction sideways, direction in depth")


def test_scans_are_judged_by_calibration_and_in_order_of_time():
    rows = archive(1, {"travel_rate": 0.003}, 40)
    split = {
        key: replace(row, calibration_sha256="b" if number >= 40 else "a")
        for number, (key, row) in enumerate(rows.items())
    }
    assert alarms_of(split) == []  # after a new calibration nothing has drifted
    shuffled = {f"{-number % 61:02}{key}": replace(row, scan=f"{-number % 61:02}{key}") for number, (key, row) in
                enumerate(rows.items())}  # fmt: skip
    (alarm,) = alarms_of(shuffled)
    assert [name[-3:] for name in alarm.scans] == [f"{number:03}" for number in range(40, 60)]


def test_unsure_and_failed_scans_take_no_part():
    rows = archive(1, {"travel_rate": 0.003}, 40)
    unsure = {key: replace(row, travel_sigma=0.01) for key, row in rows.items()}
    assert alarms_of(unsure) == []
    assert "not measured: advance per line" in health_in_words(unsure, [])
    failed = {key: replace(row, status="failed") for key, row in rows.items()}
    assert alarms_of(failed) == []
    assert health_in_words(failed, []).startswith("health: no drift can be judged yet: 0 scans have a signal")


def watch(archive: Path, calibration: Path, output: Path, processing=PROCESSING) -> tuple[dict[str, ScanRow], list]:
    """The rows of an archive after a run that watches its scans, and the stages of its tasks."""
    output.mkdir(exist_ok=True)
    with Ledger(output / LEDGER_FILE) as ledger:
        calibrations = read_calibrations(calibration)
        plan = plan_run(find_scans(str(archive), output), calibrations, processing, ledger.scans(), output)
        place = Place(ledger, output, output / WORK_FOLDER, processing, watch=True)
        with InProcess() as engine:
            process_scans(plan.to_do, engine, place, lambda task, outcome: None)
        return dict(ledger.scans()), [task.strip.stage for task in engine.tasks if task.strip is not None]


def test_signals_are_kept_in_the_ledger_and_not_measured_again(tmp_path):
    for name in ("a", "b"):
        make_scan(tmp_path / "scans" / name, stereo=name == "a", attributes={"date": "2024-05-01"})
    calibration = make_calibration(tmp_path / "n.json")
    rows, stages = watch(tmp_path / "scans", calibration, tmp_path / "out")
    assert stages.count("health") == 2
    assert {row.status for row in rows.values()} == {"done"}
    assert rows["a"].taken == "2024-05-01"
    assert rows["a"].gain_ratio == pytest.approx(1.0, abs=0.05)
    assert rows["b"].gain_ratio is None  # a camera that measures depth itself
    coarser = replace(PROCESSING, correction=CorrectionConfig(strip_rows=64, pitch_mm=2.0))
    again, stages = watch(tmp_path / "scans", calibration, tmp_path / "out", coarser)
    assert stages.count("product") > 0
    assert stages.count("health") == 0
    assert again["a"].gain_ratio == rows["a"].gain_ratio


def test_every_signal_has_its_columns_and_its_tolerance():
    from lsvision.stages.health.config import HealthConfig

    for signal in SIGNALS:
        assert hasattr(ScanRow("a", "a", "done"), signal.value)
        assert signal.sigma is None or hasattr(ScanRow("a", "a", "done"), signal.sigma)
        assert getattr(HealthConfig(), signal.tolerance) > 0


@pytest.mark.slow
def test_a_rendered_archive_whose_encoder_slips(tmp_path):
    """From the eleventh of 15 scans on, the object advances by 0.2 % more than the pitch says."""
    rig = replace(scaled_rig(FULL_RIG, 8), color_spacing_lines=(-4.0, 0.0, 4.0))
    motion = MotionConfig(angle_x_deg=-1.5, angle_z_deg=0.8, stretch=1.0246)
    for number in range(15):
        true = replace(motion, stretch=1.0246 * (1.002 if number >= 10 else 1.0))
        scene, sensor = SceneConfig("rail", seed=number), SensorConfig(supersampling=2, seed=number)
        source = simulate(rig, BOARD, scene, true, sensor, Acquisition(0.56, lines=512))
        with progress_bars() as bars:
            write_simulation(source, tmp_path / "scans" / f"rail_{number:02}", bars)
    n = simulate(rig, BOARD, SceneConfig("rail"), motion, SensorConfig(), Acquisition(0.56, lines=8)).trajectory.n
    calibration = make_calibration(tmp_path / "n.json", n.tolist(), rig)
    processing = replace(PROCESSING, disparity=DisparityConfig(), correction=CorrectionConfig(pitch_mm=1.0))
    rows, _ = watch(tmp_path / "scans", calibration, tmp_path / "out", processing)
    assert [row.status for row in rows.values()] == ["done"] * 15
    assert all(abs(row.askew_sideways_deg) < 0.05 and abs(row.askew_in_depth_deg) < 0.02 for row in rows.values())
    (alarm,) = alarms_of(rows)
    assert alarm.signal.value == "travel_rate"
    assert alarm.size == pytest.approx(0.002, abs=5e-4)
    assert alarm.scans == tuple(f"rail_{number:02}" for number in range(10, 15))
