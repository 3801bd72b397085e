"""One scan: the same product as from an archive, byte for byte, and never in the place of another scan's."""

import json
import logging
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from lsvision.archive import EngineConfig, one_scan, plan_one, process_one, sole_run
from lsvision.archive.work import CorrectStrip, FinishProduct
from lsvision.errors import LsvisionError, ScansFailedError
from lsvision.experiments.correct import CorrectSettings, run_correct
from lsvision.experiments.reprocess import ReprocessSettings, run_reprocess
from lsvision.io import read_product, write_encoder
from tests.archive.archives import (
    PROCESSING,
    assert_same_products,
    make_calibration,
    make_scan,
    process,
    with_strip_rows,
)


def correct(scan: Path, calibration: Path, output: Path, **options) -> None:
    settings = CorrectSettings(
        name="correct",
        scan=str(scan),
        calibration=str(calibration),
        output=str(output),
        disparity=PROCESSING.disparity,
        correction=options.pop("correction", PROCESSING.correction),
        line_motion=options.pop("line_motion", "none"),
        **options,
    )
    run_correct(settings, output.with_name(f"{output.name}-run"))


def reprocess(archive: Path, calibration: Path, output: Path) -> None:
    settings = ReprocessSettings(
        name="reprocess",
        archive=str(archive),
        calibration=str(calibration),
        output=str(output),
        engine=EngineConfig(workers=1),
        disparity=PROCESSING.disparity,
        correction=PROCESSING.correction,
        line_motion="none",
    )
    run_reprocess(settings, output.with_name(f"{output.name}-run"))


pytestmark = pytest.mark.usefixtures("quick_reports")


def ignore(task: object, outcome: object) -> None:
    pass


def interrupt_at_once(task: object, outcome: object) -> None:
    raise KeyboardInterrupt


def content(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("name", ["a", "b"])
def test_correct_and_reprocess_make_the_same_files(archive, calibration, tmp_path, monkeypatch, name):
    monkeypatch.chdir(archive.parent)
    correct(archive.relative_to(archive.parent) / name, calibration, tmp_path / "one")
    reprocess(archive / name, calibration, tmp_path / "many")
    one, many = content(tmp_path / "one" / f"{name}.zarr"), content(tmp_path / "many" / f"{name}.zarr")
    assert len(one) > 10
    assert one == many
    assert [path.name for path in (tmp_path / "one").iterdir()] == [f"{name}.zarr"]


@pytest.mark.parametrize("recorded_strips", [0, 3])
def test_an_interrupted_run_goes_on_where_it_stood(archive, calibration, tmp_path, monkeypatch, recorded_strips):
    processing, run, strips = with_strip_rows(16), CorrectStrip.run, []
    planned = plan_one(archive / "b", calibration, processing)
    left = iter(range(1 + recorded_strips))  # the hash of the files comes first

    def interrupt(task, outcome):
        if next(left, None) is None:
            raise KeyboardInterrupt

    def noted(work):
        strips.append(work.number)
        return run(work)

    monkeypatch.setattr(CorrectStrip, "run", noted)
    with pytest.raises(KeyboardInterrupt):
        process_one(planned, processing, tmp_path / "o", interrupt)
    assert strips == list(range(recorded_strips + 1))
    assert [path.name for path in (tmp_path / "o").iterdir()] == [".work"]
    strips.clear()
    process_one(planned, processing, tmp_path / "o", ignore)
    assert strips == list(range(recorded_strips, planned.product_strips))
    assert [path.name for path in (tmp_path / "o").iterdir()] == ["b.zarr"]
    process_one(planned, processing, tmp_path / "undisturbed", ignore)
    assert_same_products(tmp_path / "undisturbed", tmp_path / "o")


def test_what_a_killed_run_left_goes_with_the_next(archive, calibration, tmp_path):
    """That of another scan; one that is at work stays."""
    planned = plan_one(archive / "a", calibration, PROCESSING)
    with pytest.raises(KeyboardInterrupt):
        process_one(planned, PROCESSING, tmp_path / "o", interrupt_at_once)
    work = tmp_path / "o" / ".work"
    (left,) = work.glob("correct-*")
    (work / "correct-0123").mkdir()
    with sole_run(tmp_path / "o", work / "correct-0123.lock"):
        process_one(plan_one(archive / "b", calibration, PROCESSING), PROCESSING, tmp_path / "o", ignore)
        assert not left.exists()
        assert (work / "correct-0123").is_dir()
    process_one(plan_one(archive / "b", calibration, PROCESSING), PROCESSING, tmp_path / "o", ignore)
    assert [path.name for path in (tmp_path / "o").iterdir()] == ["b.zarr"]


def test_runs_that_start_and_end_together_do_not_refuse_each_other(tmp_path):
    """Scans of one output, each in its own thread, as the paper's are: each looks after what the others left."""
    work = tmp_path / "o" / ".work"

    def start_and_end(name: str) -> None:
        for _ in range(60):
            own = work / f"correct-{name}"
            with sole_run(tmp_path / "o", own.with_suffix(".lock")), one_scan._temporary(own, own.with_suffix(".lock")):
                one_scan._remove_abandoned(own)
                assert own.is_dir()

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(start_and_end, "abcdefgh"))
    assert not work.exists()


def test_a_product_is_replaced_by_one_of_the_same_scan_only(calibration, tmp_path):
    for folder, seed in (("one", 1), ("other", 2)):
        make_scan(tmp_path / folder / "rail", 96, seed)
    correct(tmp_path / "one" / "rail", calibration, tmp_path / "o")
    before = content(tmp_path / "o")
    with pytest.raises(LsvisionError, match=r"rail\.zarr: the product of another scan, .*one/rail; choose another"):
        correct(tmp_path / "other" / "rail", calibration, tmp_path / "o")
    with pytest.raises(ScansFailedError):
        reprocess(tmp_path / "other", calibration, tmp_path / "o")
    assert content(tmp_path / "o" / "rail.zarr") == {name[10:]: data for name, data in before.items()}
    make_scan(tmp_path / "one" / "rail", 96, 3)  # the same scan, taken anew
    correct(tmp_path / "one" / "rail", calibration, tmp_path / "o")
    (tmp_path / "one" / "rail").rename(tmp_path / "rail")  # the same scan, moved
    correct(tmp_path / "rail", make_calibration(tmp_path / "n.json", (0.0, 1.0, 0.0)), tmp_path / "o")
    assert read_product(tmp_path / "o" / "rail.zarr").metadata["n"] == [0.0, 1.0, 0.0]


def test_what_is_no_product_is_not_replaced_and_nothing_is_computed(archive, calibration, tmp_path, monkeypatch):
    (tmp_path / "o" / "a.zarr").mkdir(parents=True)
    (tmp_path / "o" / "a.zarr" / "notes.txt").write_text("keep")
    monkeypatch.delattr(CorrectStrip, "run")
    with pytest.raises(LsvisionError, match=r"a\.zarr: expected a new or empty folder, or one with zarr.json"):
        correct(archive / "a", calibration, tmp_path / "o")
    assert content(tmp_path / "o") == {"a.zarr/notes.txt": b"keep"}


def test_a_product_of_which_nothing_was_measured_is_an_error(archive, calibration, tmp_path):
    """Surfaces outside the height range: a failed row in an archive, an exception for one scan, and no product."""
    unseen = replace(PROCESSING, correction=replace(PROCESSING.correction, height_range_mm=(30.0, 60.0)))
    message = r"b: 0\.00% of the product's cells were measured, expected at least 1\.00% \(correction\.min_measured"
    with pytest.raises(LsvisionError, match=message):
        process_one(plan_one(archive / "b", calibration, unseen), unseen, tmp_path / "one", ignore)
    assert list((tmp_path / "one").iterdir()) == []
    rows, _ = process(archive, calibration, tmp_path / "many", processing=unseen)
    assert {row.status for row in rows} == {"failed"}
    assert not list((tmp_path / "many").glob("*.zarr"))
    # Wanted all the same, it is there without computing anything again.
    wanted = replace(unseen, correction=replace(unseen.correction, min_measured_share=0.0))
    rows, engine = process(archive, calibration, tmp_path / "many", processing=wanted)
    assert {row.status for row in rows} == {"done"}
    assert {type(task.work) for task in engine.tasks} == {FinishProduct}


def test_a_scan_file_stands_for_its_folder(archive, calibration, tmp_path):
    planned = plan_one(archive / "a" / "scan.yaml", calibration, PROCESSING)
    assert planned.files == plan_one(archive / "a", calibration, PROCESSING).files
    assert process_one(planned, PROCESSING, tmp_path, ignore).path == tmp_path / "a.zarr"


def test_a_repaired_encoder_log_is_stated_and_part_of_sigma(tmp_path, caplog):
    scan, calibration = make_scan(tmp_path / "a"), make_calibration(tmp_path / "calibration.json")
    line = torch.arange(96).double()
    write_encoder(1.12 * (line + 2 * torch.sin(line / 5)), scan / "encoder.csv")
    rows = (scan / "encoder.csv").read_text().splitlines()
    (scan / "encoder.csv").write_text("\n".join(rows[:41] + rows[51:]) + "\n")  # without lines 40 to 49
    (scan / "scan.yaml").write_text((scan / "scan.yaml").read_text() + "encoder: encoder.csv\n")
    caplog.set_level(logging.INFO)
    correction = replace(PROCESSING.correction, uncertainty=True)
    correct(scan, calibration, tmp_path / "out", correction=correction, repair_encoder=True)
    repair = json.loads((tmp_path / "out-run" / "summary.json").read_text())["encoder_repair"]
    assert repair["repaired_lines"] == 10
    assert "travel of 10 lines interpolated, known to" in caplog.text
    product = read_product(tmp_path / "out" / "a.zarr")
    assert product.metadata["encoder_repair"] == repair
    sigma, line = (product.sigma(0, product.shape[0])[..., 1], product.source(0, product.shape[0])[..., 0])
    largest = repair["largest_sigma_mm"]
    assert float(sigma[(line - 44.5).abs() < 3].nanquantile(0.9)) > 0.6 * largest
    assert float(sigma[(line < 38) | (line > 52)].nanquantile(0.9)) < 0.3 * largest
