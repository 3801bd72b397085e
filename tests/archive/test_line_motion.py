"""The motion from line to line in products: measured once, stored, resumed, recorded, and the same bits anywhere."""

import json
import logging
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import zarr

from lsvision.archive import LEDGER_FILE, Engine, EngineConfig, Ledger, LineMotionChoice, plan_one, process_one
from lsvision.archive.line_motion import FindLineMotion, line_motion_metadata
from lsvision.archive.work import CorrectStrip, MatchStrip
from lsvision.errors import FileFormatError, ScansFailedError
from lsvision.experiments.correct import CorrectSettings, run_correct
from lsvision.experiments.reprocess import ReprocessSettings, run_reprocess
from lsvision.geometry import zero_disparity_mm
from lsvision.io import NewScan, check_product, read_product, write_line_motion, write_scan
from lsvision.simulation import Acquisition, MotionConfig, SceneConfig, SensorConfig, simulate
from lsvision.stages.line_motion.config import LineMotionConfig
from lsvision.stages.line_motion.estimate import not_measured
from lsvision.stages.line_motion.measure import LineMeasurement
from lsvision.types import LineFinding, LineMotion, Travel
from tests.archive.archives import (
    PROCESSING,
    RIG,
    WIDTH,
    InProcess,
    assert_same_products,
    local,
    make_calibration,
    make_scan,
    process,
    shaken,
)
from tests.stages.rendered import BOARD, SMALL_RIG

AUTO = replace(PROCESSING, line_motion=LineMotionChoice("auto"))
pytestmark = pytest.mark.usefixtures("quick_reports")


@pytest.fixture
def measured(monkeypatch) -> list[int]:
    """The measurement answers at once; the list gets the threads that each had."""
    threads = []

    def measure(scan, depth, motion, config, section):
        threads.append(torch.get_num_threads())
        assert depth.read(0, 2).sigma is None  # heights must not depend on whether the sigma is stored
        return LineMeasurement(shaken(depth.lines))

    monkeypatch.setattr("lsvision.archive.line_motion.measure_line_motion", measure)
    return threads


def planes(product) -> dict[str, bytes]:
    names = ("color", "height", "valid", "source")
    return {name: getattr(product, name)(0, product.shape[0]).numpy().tobytes() for name in names}


def ignore(task: object, outcome: object) -> None:
    pass


def test_it_is_found_between_matching_and_correcting(archive, calibration, tmp_path, measured):
    order = []
    threads = torch.get_num_threads()
    rows, _ = process(
        archive, calibration, tmp_path / "o", InProcess(1), AUTO, on_done=lambda task, _: order.append(task)
    )
    assert {row.status for row in rows} == {"done"}
    kinds = [type(task.work) for task in order if task.scan == "b"]
    found = kinds.index(FindLineMotion)
    assert kinds.count(FindLineMotion) == 1
    assert MatchStrip not in kinds[found:]
    assert CorrectStrip not in kinds[:found]
    assert measured == [1, 1, 1, 1]
    assert torch.get_num_threads() == threads
    with Ledger(tmp_path / "o" / LEDGER_FILE) as ledger:
        row, strips = ledger.scans()["b"], ledger.strips("b")
        assert ledger.seconds_per_line().keys() == {"disparity", "line_motion", "product"}
    assert row.line_motion.startswith("measured: sideways: 0.28 mm rms, known to 0.06 mm; in depth")
    motion = shaken(row.lines)
    assert row.rms_dz_mm == pytest.approx(float(motion.dz_mm.square().mean().sqrt()), rel=1e-12)
    assert row.rms_roll_rad > 0 == row.rms_dy_mm
    assert [(strip.number, strip.lines, strip.runs) for strip in strips if strip.stage == "line_motion"] == [(0, 90, 1)]
    product = read_product(tmp_path / "o" / "b.zarr")
    columns = product.line_motion()
    torch.testing.assert_close(columns["dz_mm"], motion.dz_mm, rtol=0, atol=0)
    torch.testing.assert_close(columns["roll_sigma_rad"], motion.sigma[:, 2], rtol=1e-12, atol=0)
    stated = product.metadata["line_motion"]
    assert stated["source"] == "measured"
    assert stated["corrected"] == ["dx", "dz", "roll"]
    assert stated["components"][1]["rms"] == pytest.approx(row.rms_dz_mm)
    shortest, longest = stated["ambiguous_wavelengths_mm"]
    assert 2 * 1.12 <= shortest < longest <= 90 * 1.12
    assert "were taken for vibration" in stated["note"]
    check_product(product.path)


def test_no_bit_depends_on_strips_or_workers(archive, calibration, tmp_path):
    """With motions of logs, which differ between the scans; the measurement runs on one thread anywhere."""
    for name, lines in (("a", 150), ("b", 90), ("2024/c", 40), ("2024/d", 96)):
        make_scan(tmp_path / "s" / name, lines, lines, stereo=lines < 95, line_motion=shaken(lines))
    process(tmp_path / "s", calibration, tmp_path / "o", InProcess(3), AUTO)
    small = replace(AUTO, correction=replace(AUTO.correction, strip_rows=32))
    process(tmp_path / "s", calibration, tmp_path / "p", local(1), small)
    assert_same_products(tmp_path / "o", tmp_path / "p")
    process(tmp_path / "s", calibration, tmp_path / "q", InProcess(1), PROCESSING)
    corrected, still = (planes(read_product(tmp_path / out / "a.zarr")) for out in "oq")
    assert corrected["height"] != still["height"]


def test_correct_and_reprocess_agree(archive, calibration, tmp_path, measured):
    one = process_one(plan_one(archive / "b", calibration, AUTO), AUTO, tmp_path / "one", ignore)
    process(archive, calibration, tmp_path / "many", processing=AUTO)
    assert planes(read_product(one.path)) == planes(read_product(tmp_path / "many" / "b.zarr"))
    assert [path.name for path in (tmp_path / "one").iterdir()] == ["b.zarr"]


def test_a_run_that_was_ended_measures_nothing_twice(archive, calibration, tmp_path, measured):
    planned = plan_one(archive / "b", calibration, AUTO)

    def interrupt(task, outcome):
        if isinstance(task.work, CorrectStrip):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        process_one(planned, AUTO, tmp_path / "o", interrupt)
    process_one(planned, AUTO, tmp_path / "o", ignore)
    assert len(measured) == 1
    process_one(planned, AUTO, tmp_path / "undisturbed", ignore)
    assert_same_products(tmp_path / "undisturbed", tmp_path / "o")


def test_another_pitch_takes_the_motion_that_is_known(archive, calibration, tmp_path, measured):
    """As the matched depth; options of the registration make it new, and a store that was damaged or lost."""
    process(archive / "b", calibration, tmp_path / "o", processing=AUTO)
    coarse = replace(AUTO, correction=replace(AUTO.correction, pitch_mm=2.0, uncertainty=True))
    process(archive / "b", calibration, tmp_path / "o", processing=coarse)
    assert len(measured) == 1
    other = replace(coarse, line_motion=LineMotionChoice("auto", config=LineMotionConfig(samples=100)))
    _, engine = process(archive / "b", calibration, tmp_path / "o", processing=other)
    assert MatchStrip not in {type(task.work) for task in engine.tasks}
    assert len(measured) == 2
    (store,) = (tmp_path / "o" / ".work").rglob("line_motion-*.parquet")
    store.write_bytes(store.read_bytes()[:100])
    finer = replace(other, correction=replace(AUTO.correction, pitch_mm=0.9, uncertainty=True))
    rows, _ = process(archive / "b", calibration, tmp_path / "o", processing=finer)
    assert [row.status for row in rows] == ["done"]
    assert len(measured) == 3


def test_where_nothing_moves_the_product_is_that_of_none(archive, calibration, tmp_path, monkeypatch):
    still = LineMotion(torch.zeros(150, 4).double(), torch.zeros(150, 4, 4).double(), (LineFinding("dz", "absent"),))
    monkeypatch.setattr("lsvision.archive.line_motion.measure_line_motion", lambda *_: LineMeasurement(still))
    auto = process_one(plan_one(archive / "a", calibration, AUTO), AUTO, tmp_path / "auto", ignore)
    none = process_one(plan_one(archive / "a", calibration, PROCESSING), PROCESSING, tmp_path / "none", ignore)
    assert planes(read_product(auto.path)) == planes(read_product(none.path))
    assert read_product(auto.path).metadata["line_motion"]["corrected"] == []
    assert read_product(none.path).metadata["line_motion"] == {"source": "none"}


def test_uncertainty_changes_no_height_and_covers_the_motion(archive, calibration, tmp_path, measured):
    sure = replace(AUTO, correction=replace(AUTO.correction, uncertainty=True))
    with_sigma = process_one(plan_one(archive / "a", calibration, sure), sure, tmp_path / "sigma", ignore)
    plain = process_one(plan_one(archive / "a", calibration, AUTO), AUTO, tmp_path / "plain", ignore)
    product = read_product(with_sigma.path)
    assert planes(product) == planes(read_product(plain.path))
    none = replace(sure, line_motion=LineMotionChoice())
    still = read_product(process_one(plan_one(archive / "a", calibration, none), none, tmp_path / "o", ignore).path)
    wider, narrower = (each.sigma(0, each.shape[0])[..., 2].nanmedian() for each in (product, still))
    assert float(wider) > float(narrower.hypot(torch.tensor(0.07)))


def backwards() -> LineMotion:
    """Lines that go back by more than a pitch."""
    return LineMotion(20 * shaken(96, "dy").values, torch.zeros(96, 4, 4).double())


def log_of(folder: Path, lines: int, *components: str) -> Path:
    write_line_motion(shaken(lines, *components), folder / "motion.parquet")
    return folder / "motion.parquet"


def correct(scan: Path, calibration: Path, output: Path, **options) -> dict:
    settings = CorrectSettings(
        name="correct", scan=str(scan), calibration=str(calibration), output=str(output),
        disparity=PROCESSING.disparity, correction=PROCESSING.correction, **options,
    )  # fmt: skip
    folder = output.with_name(f"{output.name}-run")
    run_correct(settings, folder)
    return json.loads((folder / "summary.json").read_text())["line_motion"]


def test_a_file_and_a_log_say_the_same(calibration, tmp_path, caplog, measured):
    caplog.set_level(logging.INFO)
    scan = make_scan(tmp_path / "a", 96, 4)
    file = log_of(tmp_path, 96)
    given = correct(scan, calibration, tmp_path / "given", line_motion=str(file))
    assert "motion from line to line: from the given file\n" in caplog.text
    assert "in depth: 0." in caplog.text
    logged = make_scan(tmp_path / "logged" / "a", 96, 4, line_motion=shaken(96))
    stated = correct(logged, calibration, tmp_path / "log")
    assert (given["source"], stated["source"]) == ("file", "log")
    assert given["sha256"] == stated["sha256"]
    assert given["ambiguous_wavelengths_mm"] is None
    assert_same_products(tmp_path / "given", tmp_path / "log")
    assert correct(logged, calibration, tmp_path / "none", line_motion="none") == {"source": "none"}
    assert measured == []


@pytest.mark.parametrize(
    ("harm", "problem"),
    [
        (lambda file: file.unlink(), r"motion\.parquet: no such file"),
        (lambda file: write_line_motion(shaken(95), file), r"motion\.parquet: line: expected 96 rows"),
        (lambda file: file.write_text("no"), r"motion\.parquet: expected Parquet"),
        (lambda file: write_line_motion(backwards(), file), r"motion\.parquet: dy_mm: the lines would not follow"),
    ],
)  # fmt: skip
def test_a_file_that_does_not_fit_is_one_line_and_leaves_nothing(harm, problem, archive, calibration, tmp_path):
    file = log_of(tmp_path, 96)
    harm(file)
    with pytest.raises(FileFormatError, match=problem):
        correct(archive / "2024" / "d", calibration, tmp_path / "o", line_motion=str(file))
    assert not (tmp_path / "o").exists()


def test_reprocess_takes_a_file_for_the_scans_that_it_fits(archive, calibration, tmp_path):
    file = log_of(tmp_path, 96, "dz")
    settings = ReprocessSettings(
        name="reprocess", archive=str(archive), calibration=str(calibration), output=str(tmp_path / "o"),
        engine=EngineConfig(workers=1), disparity=PROCESSING.disparity, correction=PROCESSING.correction,
        line_motion=str(file),
    )  # fmt: skip
    with pytest.raises(ScansFailedError):
        run_reprocess(settings, tmp_path / "run")
    with Ledger(tmp_path / "o" / LEDGER_FILE) as ledger:
        rows = ledger.scans()
    assert {key for key, row in rows.items() if row.status == "done"} == {"2024/d"}
    assert "expected 150 rows, one for every line of the scan, got 96" in rows["a"].error
    assert rows["2024/d"].line_motion.startswith("file: ")
    assert rows["2024/d"].rms_dz_mm > 0.2


def test_a_new_content_of_the_file_makes_a_new_product(archive, calibration, tmp_path):
    file = log_of(tmp_path, 96, "dz")
    first = replace(PROCESSING, line_motion=LineMotionChoice.of(str(file), LineMotionConfig()))
    root = archive / "2024" / "d"
    process(root, calibration, tmp_path / "o", processing=first)
    assert process(root, calibration, tmp_path / "o", processing=first)[0] == []
    log_of(tmp_path, 96, "dx")
    second = replace(PROCESSING, line_motion=LineMotionChoice.of(str(file), LineMotionConfig()))
    assert len(process(root, calibration, tmp_path / "o", processing=second)[0]) == 1
    assert first.line_motion.key != second.line_motion.key
    with pytest.raises(FileFormatError, match="changed while it was in use"):
        first.line_motion.read_file(96, Travel(1.12))


def test_what_cannot_be_measured_is_corrected_without(calibration, tmp_path, caplog, monkeypatch):
    """The reason stands in summary, metadata and ledger."""
    caplog.set_level(logging.INFO)
    blind = not_measured(30, "30 of 30 lines show the profile")
    monkeypatch.setattr("lsvision.archive.line_motion.measure_line_motion", lambda *_: LineMeasurement(blind))
    make_scan(tmp_path / "s" / "a", 30, 4)
    stated = correct(tmp_path / "s" / "a", calibration, tmp_path / "o")
    assert stated["corrected"] == []
    assert all(component["state"] == "not observed" for component in stated["components"])
    assert "in depth: not observed, 30 of 30 lines show the profile" in caplog.text
    process(tmp_path / "s", calibration, tmp_path / "p", processing=AUTO)
    with Ledger(tmp_path / "p" / LEDGER_FILE) as ledger:
        assert "not observed, " in ledger.scans()["a"].line_motion
    process(tmp_path / "s", calibration, tmp_path / "q")
    assert_same_products(tmp_path / "p", tmp_path / "q")


def narrow(folder: Path, columns: slice) -> Path:
    """A scan of which a few columns alone were measured."""
    depth = torch.full((200, WIDTH, 1), torch.nan)
    depth[:, columns] = zero_disparity_mm(RIG)
    left = torch.full((200, WIDTH, 3), 90, dtype=torch.uint8)
    write_scan(folder, NewScan(RIG, Travel(1.12), [left], None, 200, depth=[depth]))
    return folder


@pytest.mark.parametrize("columns", [slice(30, 30), slice(30, 31), slice(30, 33)])
def test_next_to_nothing_to_measure_on_is_no_failure(columns, calibration, tmp_path):
    few = replace(AUTO, correction=replace(AUTO.correction, min_measured_share=0.0))
    made = process_one(plan_one(narrow(tmp_path / "a", columns), calibration, few), few, tmp_path / "o", ignore)
    stated = read_product(made.path).metadata["line_motion"]
    assert {component["state"] for component in stated["components"]} == {"not observed"}


HARMS = {
    "gone": (lambda group: (group / "dz_mm" / "zarr.json").unlink(), "line_motion/dz_mm: missing or damaged"),
    "not finite": (lambda group: overwrite(group, "dz_mm", float("nan")), "line_motion/dz_mm: expected finite"),
    "negative sigma": (lambda group: overwrite(group, "dx_sigma_mm", -1.0), "line_motion/dx_sigma_mm: expected finite"),
    "a flipped bit": (lambda group: flip(group / "dx_mm" / "c" / "0"), "line_motion/dx_mm: missing or damaged"),
    "unit": (lambda group: edit(group / "roll_rad" / "zarr.json", "radian", "degree"), "expected the unit radian"),
    "no group": (lambda group: rename(group), "line_motion: expected one as the metadata say"),
}


def overwrite(group: Path, name: str, value: float) -> None:
    zarr.open_array(group / name, mode="r+")[3] = value


def flip(chunk: Path) -> None:
    data = bytearray(chunk.read_bytes())
    data[20] ^= 4
    chunk.write_bytes(data)


def edit(file: Path, old: str, new: str) -> None:
    file.write_text(file.read_text().replace(old, new))


def rename(group: Path) -> None:
    group.rename(group.with_name("other"))


@pytest.mark.parametrize("harm", HARMS)
def test_validate_checks_the_motion(harm, archive, calibration, tmp_path, measured):
    made = process_one(plan_one(archive / "a", calibration, AUTO), AUTO, tmp_path / "o", ignore)
    do, problem = HARMS[harm]
    do(made.path / "line_motion")
    with pytest.raises(FileFormatError, match=problem):
        check_product(made.path)


def test_units_stand_with_the_arrays(archive, calibration, tmp_path, measured):
    made = process_one(plan_one(archive / "a", calibration, AUTO), AUTO, tmp_path / "o", ignore)
    stated = json.loads((made.path / "line_motion" / "roll_sigma_rad" / "zarr.json").read_text())
    assert stated["attributes"] == {"unit": "radian"}
    assert stated["dimension_names"] == ["line"]


@pytest.fixture(scope="module")
def rail(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A shaken rail with a depth map, ``scans/rail``, and its ``n.json``."""
    folder = tmp_path_factory.mktemp("rail")
    shaken_in_depth = MotionConfig(angle_x_deg=-1.5, stretch=1.02, vibration_z_mm=0.5)
    rendered = simulate(
        SMALL_RIG, BOARD, SceneConfig(kind="rail"), shaken_in_depth, SensorConfig(supersampling=1),
        Acquisition(1.12, lines=200),
    )  # fmt: skip
    depth = (strip[..., None] for strip in rendered.depth_strips())
    scan = NewScan(rendered.rig, rendered.travel, rendered.strips("left"), None, rendered.lines, depth=depth)
    write_scan(folder / "scans" / "rail", scan)
    make_calibration(folder / "n.json", rendered.trajectory.n.tolist(), rendered.rig)
    return folder


@pytest.fixture(scope="module")
def steadied(rail: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The rail's product, measured and corrected in this process."""
    output = tmp_path_factory.mktemp("steadied") / "o"
    process(rail / "scans", rail / "n.json", output, InProcess(1), AUTO)
    return output


def two_on_dask() -> Engine:
    pytest.importorskip("distributed")
    from lsvision.archive.engines.dask import DaskEngine

    return DaskEngine(None, 2, PROCESSING.worker_memory_mb)


@pytest.mark.slow
@pytest.mark.parametrize("engine", [lambda: local(2), two_on_dask], ids=["two workers", "a Dask cluster"])
def test_workers_change_no_bit_of_what_is_measured(engine, rail, steadied, tmp_path):
    other = replace(AUTO, correction=replace(AUTO.correction, strip_rows=96))
    process(rail / "scans", rail / "n.json", tmp_path / "o", engine(), other)
    assert_same_products(steadied, tmp_path / "o")
    one, two = (read_product(output / "rail.zarr").metadata for output in (steadied, tmp_path / "o"))
    assert one["line_motion"] == two["line_motion"]
    assert "dz" in one["line_motion"]["corrected"]


@pytest.mark.slow
@pytest.mark.parametrize("last", [FindLineMotion, CorrectStrip])
def test_what_was_ended_after_a_step_is_the_same_in_the_end(last, rail, steadied, tmp_path):
    def interrupt(task, outcome):
        if isinstance(task.work, last):
            raise KeyboardInterrupt

    planned = plan_one(rail / "scans" / "rail", rail / "n.json", AUTO)
    with pytest.raises(KeyboardInterrupt):
        process_one(planned, AUTO, tmp_path / "o", interrupt)
    process_one(planned, AUTO, tmp_path / "o", ignore)
    assert_same_products(steadied, tmp_path / "o")


@pytest.mark.slow
def test_what_is_measured_is_the_same_anywhere(rail, tmp_path):
    """On two threads of this process or in another, in other strips; and the crown stands still."""
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        process(rail / "scans", rail / "n.json", tmp_path / "o", InProcess(1), AUTO)
    finally:
        torch.set_num_threads(threads)
    other = replace(AUTO, correction=replace(AUTO.correction, strip_rows=32))
    process(rail / "scans", rail / "n.json", tmp_path / "p", local(1), other)
    assert_same_products(tmp_path / "o", tmp_path / "p")
    one, two = (read_product(tmp_path / out / "rail.zarr") for out in "op")
    assert one.metadata["line_motion"] == two.metadata["line_motion"]
    assert "dz" in one.metadata["line_motion"]["corrected"]
    process(rail / "scans", rail / "n.json", tmp_path / "q", InProcess(1))
    before, after = (wander_of_crown(tmp_path / out / "rail.zarr") for out in "qo")
    assert after < 0.03 < 0.3 < before


def wander_of_crown(path: Path) -> float:
    """Rms about a straight line of the height of a rail's crown along it, mm, away from the ends."""
    product = read_product(path)
    height = product.height(40, product.shape[0] - 40).double()
    top = int(height.nanmedian(0).values.nan_to_num(-torch.inf).argmax())
    crown = height[:, top - 3 : top + 4].nanmedian(1).values
    row = torch.linspace(-1, 1, len(crown), dtype=torch.float64)
    line = torch.stack([torch.ones_like(row), row], dim=1)
    return float((crown - line @ torch.linalg.lstsq(line, crown[:, None]).solution[:, 0]).square().mean().sqrt())


def test_what_the_colors_have_told_is_not_ambiguous():
    """Waves of 30 mm in x and of 200 mm in z; the colours tell the short one, or both."""
    along = torch.arange(2000).double()
    values = torch.zeros(2000, 4, dtype=torch.float64)
    values[:, 0], values[:, 1] = torch.sin(2 * torch.pi * along / 30.0), torch.sin(2 * torch.pi * along / 200.0)

    def band(*told):
        findings = tuple(
            LineFinding(name, "corrected", 0.7, 0.1, separated_up_to_mm=length)
            for name, length in zip(("dx", "dz"), told, strict=True)
        )
        motion = LineMotion(values, torch.zeros(2000, 4, 4, dtype=torch.float64), findings)
        stated = line_motion_metadata(motion, "measured", Travel(1.0))
        assert bool(stated["note"]) == bool(stated["ambiguous_wavelengths_mm"])
        return stated["ambiguous_wavelengths_mm"]

    assert band(None, None) == pytest.approx([30.0, 200.0], rel=0.15)
    assert band(100.0, 100.0) == pytest.approx([200.0, 200.0], rel=0.15)
    assert band(100.0, 400.0) is None
