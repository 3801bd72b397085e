"""An archive processed: the same bits whatever the engine, the workers and the strips, and nothing done twice."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
import zarr

from lsvision.archive import LEDGER_FILE, Ledger
from lsvision.archive.tasks import run_task
from lsvision.archive.work import CorrectStrip, HashInput, MatchStrip
from lsvision.io import read_calibration, read_product, read_scan
from lsvision.stages.correction.correct import correct_scan
from lsvision.stages.disparity.depth import depth_of
from tests.archive.archives import (
    PROCESSING,
    InProcess,
    assert_same_products,
    local,
    make_calibration,
    make_scan,
    process,
    with_strip_rows,
)


@pytest.fixture(scope="module")
def undisturbed(archive, calibration, tmp_path_factory):
    output = tmp_path_factory.mktemp("undisturbed")
    rows, _ = process(archive, calibration, output)
    assert {row.scan: row.status for row in rows} == dict.fromkeys(("a", "b", "2024/c", "2024/d"), "done")
    return output


def strips_of(output):
    with Ledger(output / LEDGER_FILE) as ledger:
        return ledger.strips()


def work_of(engine, kind):
    return [task for task in engine.tasks if isinstance(task.work, kind)]


@pytest.mark.parametrize("name", ["a", "b"])
def test_a_product_is_that_of_the_bare_stages(archive, calibration, undisturbed, name):
    scan, motion = read_scan(archive / name), read_calibration(calibration).motion
    strips = list(correct_scan(scan, depth_of(scan, PROCESSING.disparity), motion, PROCESSING.correction))
    product = read_product(undisturbed / f"{name}.zarr")
    for plane in ("color", "height", "valid", "source"):
        expected = torch.cat([getattr(strip, plane) for strip in strips])
        assert getattr(product, plane)(0, product.shape[0]).numpy().tobytes() == expected.numpy().tobytes()
    with Ledger(undisturbed / LEDGER_FILE) as ledger:
        row = ledger.scans()[name]
    assert row.measured_share == pytest.approx(
        sum(int(s.valid.sum()) for s in strips) / sum(s.valid.numel() for s in strips)
    )


def test_two_workers_make_the_same_products(archive, calibration, undisturbed, tmp_path):
    process(archive, calibration, tmp_path / "o", local(2))
    assert_same_products(undisturbed, tmp_path / "o")


def test_uncertainty_is_that_of_the_bare_stages(archive, calibration, tmp_path):
    processing = replace(PROCESSING, correction=replace(PROCESSING.correction, uncertainty=True))
    process(archive, calibration, tmp_path / "o", processing=processing)
    scan, motion = read_scan(archive / "b"), read_calibration(calibration).motion
    depth = depth_of(scan, PROCESSING.disparity)
    strips = correct_scan(scan, depth, motion, processing.correction)
    sigma = torch.cat([strip.sigma for strip in strips])
    assert bool(torch.isfinite(sigma).any())
    stored = np.moveaxis(zarr.open_array(tmp_path / "o" / "b.zarr" / "sigma" / "0", mode="r")[:], 0, -1)
    np.testing.assert_array_equal(stored, sigma.numpy())


def test_tasks_that_run_twice_do_no_harm(archive, calibration, undisturbed, tmp_path):
    class Twice(InProcess):
        """The first worker at every task crashes before its outcome is known."""

        def collect(self):
            run_task(self._waiting[-1])
            return super().collect()

    shutil.copytree(undisturbed, tmp_path / "o")
    other = make_calibration(tmp_path / "other.json", (-0.01, 1.01, 0.02))
    process(archive, other, tmp_path / "o", Twice())
    rows, _ = process(archive, calibration, tmp_path / "o", Twice())
    assert {row.status for row in rows} == {"done"}
    assert_same_products(undisturbed, tmp_path / "o")


def test_what_killed_writers_left_beside_a_product_goes_with_the_next(archive, calibration, undisturbed, tmp_path):
    shutil.copytree(undisturbed, tmp_path / "o")
    retired, other = tmp_path / "o" / ".a.zarr.0123.partial", tmp_path / "o" / ".ba.zarr.0123.partial"
    retired.mkdir()
    other.mkdir()
    process(archive, make_calibration(tmp_path / "other.json", (-0.01, 1.01, 0.02)), tmp_path / "o")
    assert not retired.exists()
    assert other.exists()


def test_what_killed_workers_left_of_depth_goes_with_the_next_run(archive, calibration, undisturbed, tmp_path):
    shutil.copytree(undisturbed, tmp_path / "o")
    partial = next((tmp_path / "o" / ".work").rglob("c/0")) / "0.0123.partial"
    partial.touch()
    process(archive, make_calibration(tmp_path / "other.json", (-0.01, 1.01, 0.02)), tmp_path / "o")
    assert not partial.exists()


@pytest.mark.parametrize("rows", [16, 512])
def test_strips_of_any_height_make_the_same_products(archive, calibration, undisturbed, tmp_path, rows):
    process(archive, calibration, tmp_path / "o", processing=with_strip_rows(rows))
    assert_same_products(undisturbed, tmp_path / "o")


@pytest.mark.parametrize("lines", [1, 64, 1000])
def test_disparity_strips_of_any_height_make_the_same_products(archive, calibration, undisturbed, tmp_path, lines):
    disparity = replace(PROCESSING.disparity, strip_lines=lines)
    process(archive, calibration, tmp_path / "o", processing=replace(PROCESSING, disparity=disparity))
    assert_same_products(undisturbed, tmp_path / "o")


def test_nothing_is_left_beside_products_ledger_and_depth(undisturbed):
    assert sorted(path.name for path in undisturbed.iterdir()) == [".work", "2024", "a.zarr", "b.zarr", LEDGER_FILE]
    kept = [path.name for scan in (undisturbed / ".work").iterdir() for path in scan.iterdir()]
    assert len(kept) == 2
    assert all(name.startswith("depth-") for name in kept)


def test_an_unchanged_archive_is_left_alone(archive, calibration, undisturbed):
    before = {path: path.stat().st_mtime_ns for path in undisturbed.rglob("*") if path.is_file()}
    rows, engine = process(archive, calibration, undisturbed)
    assert (rows, engine.tasks) == ([], [])
    assert {path: path.stat().st_mtime_ns for path in undisturbed.rglob("*") if path.is_file()} == before


def test_a_new_calibration_matches_nothing_again(archive, calibration, undisturbed, tmp_path):
    shutil.copytree(undisturbed, tmp_path / "o")
    other = make_calibration(tmp_path / "other.json", (-0.01, 1.01, 0.02))
    rows, engine = process(archive, other, tmp_path / "o")
    assert len(rows) == 4
    assert not work_of(engine, MatchStrip)
    assert not work_of(engine, HashInput)
    assert work_of(engine, CorrectStrip)
    process(archive, other, tmp_path / "anew")
    assert_same_products(tmp_path / "o", tmp_path / "anew")


def test_touched_files_are_hashed_and_changed_ones_redone(archive, calibration, undisturbed, tmp_path):
    shutil.copytree(archive, tmp_path / "archive")
    process(tmp_path / "archive", calibration, tmp_path / "o")
    (tmp_path / "archive" / "a" / "left.tif").touch()
    make_scan(tmp_path / "archive" / "b", 90, 7, stereo=True)
    rows, engine = process(tmp_path / "archive", calibration, tmp_path / "o")
    assert {row.scan for row in rows} == {"a", "b"}
    assert {task.scan for task in work_of(engine, HashInput)} == {"a", "b"}
    assert {task.scan for task in work_of(engine, CorrectStrip)} == {"b"}


@pytest.mark.parametrize("ended_after", [0, 9, 18, *(pytest.param(count, marks=pytest.mark.slow) for count in (3, 14))])
def test_a_run_that_was_ended_goes_on_where_it_stood(archive, calibration, undisturbed, tmp_path, ended_after):
    class EndError(Exception):
        pass

    counted = iter(range(ended_after))

    def end(task, outcome):
        if next(counted, None) is None:
            raise EndError

    with pytest.raises(EndError):
        process(archive, calibration, tmp_path / "o", on_done=end)
    before = {(strip.scan, strip.stage, strip.number) for strip in strips_of(tmp_path / "o")}
    _, engine = process(archive, calibration, tmp_path / "o")
    assert_same_products(undisturbed, tmp_path / "o")
    again = {(task.scan, task.strip.stage, task.strip.number) for task in engine.tasks if task.strip}
    assert not again & before
    assert all(strip.runs == 1 for strip in strips_of(tmp_path / "o"))


def test_a_product_that_is_gone_is_made_again_without_matching(archive, calibration, undisturbed, tmp_path):
    shutil.copytree(undisturbed, tmp_path / "o")
    shutil.rmtree(tmp_path / "o" / "b.zarr")
    rows, engine = process(archive, calibration, tmp_path / "o")
    assert [row.scan for row in rows] == ["b"]
    assert not work_of(engine, MatchStrip)
    assert_same_products(undisturbed, tmp_path / "o")


def test_depth_that_is_gone_is_matched_again(archive, calibration, undisturbed, tmp_path):
    shutil.copytree(undisturbed, tmp_path / "o")
    shutil.rmtree(tmp_path / "o" / ".work")
    other = make_calibration(tmp_path / "other.json", (-0.01, 1.01, 0.02))
    _, engine = process(archive, other, tmp_path / "o")
    assert {task.scan for task in work_of(engine, MatchStrip)} == {"b", "2024/c"}


def test_metadata_say_what_a_product_was_made_from(archive, calibration, undisturbed):
    metadata = read_product(undisturbed / "2024" / "c.zarr").metadata
    assert metadata["scan"] == str(archive / "2024" / "c")
    assert metadata["calibration"] == str(calibration)
    assert metadata["n"] == [0.02, 1.02, -0.01]
    assert json.dumps(metadata["correction"])


def test_a_faulty_strip_fails_its_scan_alone_and_is_tried_again(archive, calibration, undisturbed, tmp_path):
    shutil.copytree(archive, tmp_path / "archive")
    depth = tmp_path / "archive" / "a" / "depth.tif"
    whole = depth.read_bytes()
    depth.write_bytes(whole.replace(b"\x28\xb5\x2f\xfd", bytes(4)))  # where zstd data begin
    rows, _ = process(tmp_path / "archive", calibration, tmp_path / "o")
    status = {row.scan: row.status for row in rows}
    assert status == {"a": "failed", "b": "done", "2024/c": "done", "2024/d": "done"}
    (error,) = (row.error for row in rows if row.scan == "a")
    assert "depth.tif" in error
    assert "cannot be decoded" in error
    depth.write_bytes(whole)
    rows, _ = process(tmp_path / "archive", calibration, tmp_path / "o")
    assert [(row.scan, row.status) for row in rows] == [("a", "done")]
    assert_same_products(undisturbed, tmp_path / "o")


def test_few_scans_are_open_at_once(archive, calibration, tmp_path):
    engine = InProcess(capacity=1)
    process(archive, calibration, tmp_path / "o", engine)
    order = [task.scan for task in engine.tasks]
    assert order == sorted(order, key=list(dict.fromkeys(order)).index)
