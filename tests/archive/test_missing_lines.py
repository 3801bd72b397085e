"""Scans without some of their frames or chunks: what is measured is what the whole scan shows, and the rest nothing."""

import json
from dataclasses import replace
from pathlib import Path

import imagecodecs
import pytest
import yaml
import zarr

from lsvision.archive import LEDGER_FILE, Ledger, ledger_lines, plan_one, process_one
from lsvision.errors import FileFormatError
from lsvision.experiments.calibrate import read_scans
from lsvision.experiments.correct import CorrectSettings, run_correct
from lsvision.io import read_product, read_scan
from tests.archive.archives import PROCESSING, RIG, make_calibration, make_scan, process

LINES, FRAME_LINES = 96, 12
MARK = replace(PROCESSING, missing_lines="mark")
TRILINEAR = replace(RIG, color_spacing_lines=(-6.0, 0.0, 6.0))


def as_frames(scan: Path, key: str) -> Path:
    """An image of a scan as a folder of frames, in place of the TIFF."""
    image = read_scan(scan).left.read(0, LINES).numpy()
    (scan / key).mkdir()
    for number in range(LINES // FRAME_LINES):
        frame = image[number * FRAME_LINES : (number + 1) * FRAME_LINES].copy()
        (scan / key / f"{number}.png").write_bytes(imagecodecs.png_encode(frame))
    name_image(scan, key)
    return scan


def name_image(scan: Path, key: str) -> None:
    entries = yaml.safe_load((scan / "scan.yaml").read_text())
    (scan / "scan.yaml").write_text(yaml.safe_dump(entries | {key: key}))


def product_of(scan: Path, output: Path):
    planned = plan_one(scan, make_calibration(output.with_suffix(".json"), rig=read_scan_rig(scan)), MARK)
    product = read_product(process_one(planned, MARK, output, lambda task, outcome: None).path)
    rows = product.shape[0]
    return product, product.valid(0, rows), product.color(0, rows), product.source(0, rows)


def read_scan_rig(scan: Path):
    return read_scan(scan, missing_lines="mark").rig


@pytest.mark.parametrize("options", [{}, {"rig": TRILINEAR, "color_registered": False}, {"rig": TRILINEAR}])
def test_a_missing_frame_leaves_a_hole_and_changes_nothing_else(tmp_path, options):
    scan = as_frames(make_scan(tmp_path / "a", LINES, **options), "left")
    _, whole_valid, whole_color, _ = product_of(scan, tmp_path / "whole")
    (scan / "left" / "4.png").unlink()
    product, valid, color, source = product_of(scan, tmp_path / "marked")
    assert not (valid & ~whole_valid).any()
    assert (color[valid] == whole_color[valid]).all()
    line = source[..., 0]
    reach = 8 if options.get("color_registered") is False else 2
    spoilt = (line >= 48 - reach) & (line < 60 + reach)
    assert not (valid & spoilt).any()
    far = (line < 48 - reach - 4) | (line > 60 + reach + 4)
    assert (valid == whole_valid)[far].all()
    assert valid.float().mean() > 0.5
    assert product.metadata["missing_lines"] == {"count": 12, "left": [[48, 59]]}


def test_terminal_summary_and_ledger_count_missing_lines(tmp_path, caplog, monkeypatch):
    monkeypatch.setattr("lsvision.experiments.correct.product_report", lambda *_: None)
    scan = as_frames(make_scan(tmp_path / "archive" / "a", LINES), "left")
    calibration = make_calibration(tmp_path / "n.json")
    settings = CorrectSettings(
        name="correct", scan=str(scan), calibration=str(calibration), output=str(tmp_path / "one"),
        disparity=PROCESSING.disparity, correction=PROCESSING.correction, missing_lines="mark",
        line_motion="none",
    )  # fmt: skip
    for number in (2, 3):
        (scan / "left" / f"{number}.png").unlink()
    run_correct(settings, tmp_path / "run")
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["missing_lines"] == 24
    assert "a: 24 of 96 lines are missing: not measured" in caplog.text
    process(tmp_path / "archive", calibration, tmp_path / "many", processing=MARK)
    with Ledger(tmp_path / "many" / LEDGER_FILE) as ledger:
        rows = ledger.scans()
    assert rows["a"].missing_lines == 24
    assert next(ledger_lines(rows)).endswith(", 24 lines missing")
    with pytest.raises(FileFormatError, match="frames 2-3 are missing"):
        run_correct(replace(settings, missing_lines="refuse"), tmp_path / "run")


def test_missing_lines_of_the_right_image_are_not_measured(tmp_path):
    scan = make_scan(tmp_path / "a", LINES, stereo=True)
    images = read_scan(scan).images
    zarr.create_array(scan / "right", data=images.right.read(0, LINES).numpy(), chunks=(8, 64, 3), zarr_format=2)
    name_image(scan, "right")
    (scan / "right" / "5.0.0").unlink()
    product, valid, _, source = product_of(scan, tmp_path / "marked")
    line = source[..., 0]
    assert valid.any()
    assert not (valid & (line >= 40 - 9) & (line < 48 + 9)).any()
    assert product.metadata["missing_lines"] == {"count": 8, "right": [[40, 47]]}


def test_the_option_is_part_of_the_keys(tmp_path):
    scan, calibration = make_scan(tmp_path / "a", LINES), make_calibration(tmp_path / "n.json")
    assert MARK.sha256 != PROCESSING.sha256
    planned = [plan_one(scan, calibration, processing) for processing in (PROCESSING, MARK)]
    assert planned[0].files != planned[1].files
    keys = set()
    for plan, processing in zip(planned, (PROCESSING, MARK), strict=True):
        product = process_one(plan, processing, tmp_path / "o", lambda task, outcome: None)
        keys.add(read_product(product.path).metadata["key"])
    assert len(keys) == 2


def test_scans_of_boards_may_lack_lines_where_that_is_asked_for(tmp_path, caplog):
    scan = as_frames(make_scan(tmp_path / "a", LINES), "left")
    (scan / "left" / "4.png").unlink()
    with pytest.raises(FileFormatError, match="frames 4 are missing"):
        read_scans([str(scan)])
    (opened,) = read_scans([str(scan)], "mark")
    assert opened.missing_lines == FRAME_LINES
    assert f"{FRAME_LINES} of {LINES} lines are missing: no corners there" in caplog.text
