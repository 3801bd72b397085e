"""Scans that change while a run is at work: never a product of two contents, and the next run starts them afresh."""

import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import tifffile
import torch
import zarr

from lsvision.archive import LEDGER_FILE, WORK_FOLDER, Ledger, Place, find_scans, opened, plan_run, process_scans
from lsvision.archive import read_calibrations as read_all
from lsvision.archive.identity import ScanFiles, stamp_of
from lsvision.archive.tasks import Outcome, Task
from lsvision.archive.work import CorrectStrip, HashInput, MatchStrip
from lsvision.errors import LsvisionError, ScanChangedError
from lsvision.io import read_product
from tests.archive.archives import PROCESSING, InProcess, assert_same_products, make_scan, process, with_strip_rows
from tests.combinations import crossed

CHANGED = "changed while it was being read; the next run starts it afresh"
SMALL = replace(with_strip_rows(16), disparity=replace(PROCESSING.disparity, block_lines=16, strip_lines=16))


@pytest.fixture
def root(tmp_path) -> Path:
    return tmp_path / "archive"


def uncompressed(folder: Path) -> Path:
    """A scan's colours as a TIFF of which any lines can be read: another of its size decodes as well."""
    image = tifffile.imread(folder / "left.tif")
    tifffile.imwrite(folder / "left.tif", image, compression=None)
    return folder


def scan(root: Path, lines: int = 48, seed: int = 0, *, stereo: bool = False) -> Path:
    return uncompressed(make_scan(root / "s", lines, seed, stereo=stereo))


def put_over(source: Path, target: Path) -> None:
    """Replace a scan's files by another's, with the same times: size and time of an image stay the same."""
    for file in source.iterdir():
        times = (target / file.name).stat()
        copy = shutil.copy(file, target / f".{file.name}")
        os.utime(copy, ns=(times.st_atime_ns, times.st_mtime_ns))
        os.replace(copy, target / file.name)


def after(number: int, kind: type, change: Callable[[], object]) -> Callable[[Task, Outcome], None]:
    """Change something once so many tasks of a kind are done."""
    done = []

    def call(task: Task, outcome: Outcome) -> None:
        if isinstance(task.work, kind):
            done.append(task)
            if len(done) == number:
                change()

    return call


def assert_made_afresh(root: Path, calibration: Path, output: Path, processing=SMALL) -> None:
    """The next run makes what a run that nothing disturbs makes, and nothing has to be deleted by hand."""
    rows, _ = process(root, calibration, output, processing=processing)
    assert [(row.status, row.error) for row in rows] == [("done", "")]
    opened.forget()  # as in a process of its own
    process(root, calibration, output.with_name("undisturbed"), processing=processing)
    assert_same_products(output.with_name("undisturbed"), output)


def failed_as_changed(rows) -> bool:
    (row,) = rows
    return row.status == "failed" and row.error.endswith(CHANGED)


@crossed("stereo lines", [False, True], [32, 64])
def test_grown_or_shrunk_between_planning_and_its_turn(root, calibration, tmp_path, stereo, lines):
    scan(root, stereo=stereo)
    output = tmp_path / "o"
    output.mkdir()
    with Ledger(output / LEDGER_FILE) as ledger:
        plan = plan_run(find_scans(str(root)), read_all(calibration), SMALL, {}, output)
        scan(root, lines, stereo=stereo)
        place = Place(ledger, output, output / WORK_FOLDER, SMALL)
        assert failed_as_changed(process_scans(plan.to_do, InProcess(), place))
    assert not list(output.glob("*.zarr"))
    assert_made_afresh(root, calibration, output)
    assert read_product(output / "s.zarr").shape[0] >= lines


@pytest.mark.parametrize(
    ("kind", "number"),
    [
        (HashInput, 1),
        (MatchStrip, 3),
        (CorrectStrip, 4),
        pytest.param(MatchStrip, 1, marks=pytest.mark.slow),
        pytest.param(CorrectStrip, 2, marks=pytest.mark.slow),
    ],
)
def test_an_image_replaced_by_one_of_its_size_and_time(root, calibration, tmp_path, kind, number):
    scan(root, stereo=True)
    other = scan(tmp_path / "other", seed=5, stereo=True)
    change = after(number, kind, lambda: put_over(other, root / "s"))
    rows, engine = process(root, calibration, tmp_path / "o", processing=SMALL, on_done=change)
    assert failed_as_changed(rows)
    assert len([task for task in engine.tasks if isinstance(task.work, kind)]) >= number
    assert not list((tmp_path / "o").glob("*.zarr"))
    assert_made_afresh(root, calibration, tmp_path / "o")


def test_other_content_of_a_killed_run_is_not_kept_when_the_original_is_back(root, calibration, tmp_path):
    """Moved aside and back, the original has its size, time and inode again."""
    scan(root, 600)
    scan(tmp_path / "other", 600, seed=5)
    processing = with_strip_rows(128)  # of several pieces that are read one by one

    class KilledError(Exception):
        pass

    def swap() -> None:
        (root / "s").rename(tmp_path / "aside")
        (tmp_path / "other" / "s").rename(root / "s")

    def killed(task: Task, outcome: Outcome) -> None:
        swapping(task, outcome)
        if len(engine.tasks) == 4:
            raise KilledError

    swapping, engine = after(1, CorrectStrip, swap), InProcess()
    with pytest.raises(KilledError):
        process(root, calibration, tmp_path / "o", engine, processing, killed)
    shutil.rmtree(root / "s")
    (tmp_path / "aside").rename(root / "s")
    assert_made_afresh(root, calibration, tmp_path / "o", processing)


def test_what_was_decoded_of_other_content_is_forgotten(root, calibration, tmp_path):
    """One strip sees another image; the next ones, in the same process, the original again."""
    scan(root)
    other = scan(tmp_path / "other", seed=5)
    (planned,) = plan_run(find_scans(str(root)), read_all(calibration), SMALL, {}, tmp_path / "o").to_do
    left = root / "s" / "left.tif"

    class Swapped(InProcess):
        def collect(self):
            if len(self.tasks) != 2:
                return super().collect()
            left.rename(tmp_path / "left.tif")
            shutil.copy(other / "left.tif", left)
            result = super().collect()
            (tmp_path / "left.tif").replace(left)
            return result

    rows, _ = process(root, calibration, tmp_path / "o", Swapped(capacity=1), SMALL)
    assert failed_as_changed(rows)
    planned.files.check_unchanged()
    assert_made_afresh(root, calibration, tmp_path / "o")


def test_a_chunk_of_a_zarr_image_and_an_encoder_log_are_part_of_the_scan(root, calibration, tmp_path):
    folder = scan(root)
    left = zarr.create_array(folder / "left.zarr", shape=(48, 64, 3), chunks=(16, 64, 3), dtype="uint8")
    left[:] = tifffile.imread(folder / "left.tif")
    log = folder / "encoder.csv"
    log.write_text("line,position_mm\n" + "".join(f"{line},{1.12 * line}\n" for line in range(48)))
    text = (folder / "scan.yaml").read_text().replace("left.tif", "left.zarr")
    (folder / "scan.yaml").write_text(f"{text}encoder: encoder.csv\n")

    def change_chunk() -> None:
        left[32:] = 255 - left[32:]

    for change in (change_chunk, lambda: log.write_text(log.read_text().replace("47,52.", "47,53."))):
        rows, _ = process(root, calibration, tmp_path / "o", processing=SMALL, on_done=after(2, CorrectStrip, change))
        assert failed_as_changed(rows)
    assert_made_afresh(root, calibration, tmp_path / "o")


def test_changed_between_its_reading_and_its_stamp(root, calibration, tmp_path, monkeypatch):
    """What was planned from one content and stamped with another is not made."""
    scan(root)

    def late(folder: Path) -> str:
        scan(root, 64)
        return stamp_of(folder)

    monkeypatch.setattr("lsvision.archive.planned.stamp_of", late)
    rows, _ = process(root, calibration, tmp_path / "o", processing=SMALL)
    assert failed_as_changed(rows)
    monkeypatch.undo()
    assert_made_afresh(root, calibration, tmp_path / "o")


def test_a_scan_that_goes_away_is_a_row(root, calibration, tmp_path):
    scan(root)
    gone = after(2, CorrectStrip, lambda: (root / "s").rename(tmp_path / "elsewhere"))
    ((row),), _ = process(root, calibration, tmp_path / "o", processing=SMALL, on_done=gone)
    assert row.status == "failed"
    assert "scan.yaml: no such file" in row.error


def test_the_error_travels_between_processes(tmp_path):
    import pickle

    error = ScanChangedError(tmp_path)
    assert str(pickle.loads(pickle.dumps(error))) == str(error) == f"{tmp_path}: {CHANGED}"


def test_one_scan_alone(root, calibration, tmp_path):
    from lsvision.archive import plan_one, process_one

    folder = scan(root)
    other = scan(tmp_path / "other", seed=5)
    change = after(2, CorrectStrip, lambda: put_over(other, folder))
    with pytest.raises(LsvisionError, match=CHANGED):
        process_one(plan_one(folder, calibration, SMALL), SMALL, tmp_path / "o", change)
    assert list((tmp_path / "o").iterdir()) == []
    process_one(plan_one(folder, calibration, SMALL), SMALL, tmp_path / "o", lambda task, outcome: None)
    assert bool(torch.isfinite(read_product(tmp_path / "o" / "s.zarr").height(24, 25)).any())
    assert isinstance(plan_one(folder, calibration, PROCESSING).files, ScanFiles)
