"""simulate -> calibrate -> correct -> validate with raw cameras, through files, at an eighth of the pixels."""

import json

import pytest
import torch

from lsvision.archive import Processing, plan_one
from lsvision.geometry import ideal_rig, scaled_raw_rig
from lsvision.io import read_calibration, read_product, read_scan, write_raw_rig, write_rig
from lsvision.stages.correction.config import CorrectionConfig
from lsvision.stages.correction.correct import correct_scan
from lsvision.stages.disparity.config import DisparityConfig
from lsvision.stages.disparity.depth import depth_of
from lsvision.types import RawCamera, RawRig, Rig
from tests.archive.archives import make_calibration
from tests.raw_cameras import RAW

TILTS = {"a": (2.0, 1.5), "b": (-5.0, 1.0), "c": (4.0, -3.0)}


@pytest.mark.slow
def test_raw_scans_are_calibrated_corrected_and_validated(command, tmp_path):
    write_raw_rig(RAW, tmp_path / "rig.yaml")
    for name, (pitch, roll) in TILTS.items():
        options = (f"scene.pitch_deg={pitch}", f"scene.roll_deg={roll}", f"output={tmp_path / name}")
        assert command("+experiment=simulate", "scale=8", f"rig_file={tmp_path / 'rig.yaml'}", *options) == 0
    scan = read_scan(tmp_path / "b")
    scaled = scaled_raw_rig(RAW, 8)
    assert scan.raw_rig.view_plane == scaled.view_plane
    assert scan.rig == ideal_rig(scan.raw_rig)
    listed = ",".join(str(tmp_path / name) for name in TILTS)
    assert command("+experiment=calibrate", f"scans=[{listed}]", folder="calibrated") == 0
    file = tmp_path / "calibrated" / "calibration.json"
    calibration = read_calibration(file)
    assert calibration.verdict == "determined"
    assert calibration.rig == scan.rig
    truth = torch.tensor(json.loads((tmp_path / "a" / "truth.json").read_text())["n"], dtype=torch.float64)
    assert ((calibration.motion.n - truth).abs() < 4 * calibration.motion.sigma).all()

    options = (f"scan={tmp_path / 'b'}", f"calibration={file}", "line_motion=none", "correction.uncertainty=true")
    assert command("+experiment=correct", *options, folder="corrected") == 0
    product = read_product(tmp_path / "corrected" / "b.zarr")
    assert abs(product.metadata["pair"]["row_offset_lines"]) < 0.05
    source = product.source(0, product.shape[0])
    assert source[..., 1].nan_to_num().max() <= 893  # columns of the image that was taken

    # The archive's road gives what the stages give.
    n = calibration.motion.n
    depth = depth_of(scan, DisparityConfig(), n=n)
    processing = Processing(DisparityConfig(), CorrectionConfig(), repair_encoder=False, worker_memory_mb=None)
    planned = plan_one(str(tmp_path / "b"), str(file), processing, ())
    strips = list(correct_scan(scan, depth, calibration.motion, CorrectionConfig(), planned.grid))
    assert torch.equal(torch.cat([strip.color for strip in strips]), product.color(0, product.shape[0]))
    height = torch.cat([strip.height for strip in strips])
    torch.testing.assert_close(height, product.height(0, product.shape[0]), rtol=0, atol=0, equal_nan=True)

    path = tmp_path / "corrected" / "b.zarr"
    assert command("+experiment=validate", f"product={path}", folder="validated") == 0
    board = json.loads((tmp_path / "validated" / "summary.json").read_text())["board"]
    assert board["corners"] >= 60  # black squares have no texture; of a rectified pair 69 are measured
    assert board["distance_rms_mm"] < 0.08


def test_a_batch_of_raw_scans_gives_the_products_of_correct(command, tmp_path):
    write_raw_rig(RAW, tmp_path / "rig.yaml")
    rig = ("scale=16", f"rig_file={tmp_path / 'rig.yaml'}")
    scene = ("scene=sheet", "scene.sheet_height_mm=60", "scene.margin_mm=5", f"output={tmp_path / 'in/s'}")
    assert command("+experiment=simulate", *rig, *scene) == 0
    scan = read_scan(tmp_path / "in" / "s")
    make_calibration(tmp_path / "calibration.json", (0.02, 1.02, -0.01), scan.rig)
    options = (f"calibration={tmp_path / 'calibration.json'}", "line_motion=none")
    assert command("+experiment=correct", f"scan={tmp_path / 'in/s'}", *options, folder="one") == 0
    batch = (f"archive={tmp_path / 'in'}", f"output={tmp_path / 'out'}", "engine=local", "engine.workers=1")
    assert command("+experiment=reprocess", *batch, *options, folder="many") == 0
    one, other = read_product(tmp_path / "one" / "s.zarr"), read_product(tmp_path / "out" / "s.zarr")
    rows = one.shape[0]
    assert torch.equal(one.color(0, rows), other.color(0, rows))
    torch.testing.assert_close(one.height(0, rows), other.height(0, rows), rtol=0, atol=0, equal_nan=True)


def test_rectified_cameras_of_either_format_give_the_same_product(command, tmp_path):
    rig = Rig(893, 80.0, 113.84, 354.0, 130.0, 762.0)
    raw = RawRig(893, 80.0, 354.0, RawCamera(113.84, 130.0), RawCamera(113.84, 762.0))
    write_rig(rig, tmp_path / "rig.yaml")
    scene = ("scene=sheet", "scene.sheet_height_mm=60", "scene.margin_mm=5", "scale=1", "line_pitch_mm=0.56")
    assert command("+experiment=simulate", *scene, f"rig_file={tmp_path / 'rig.yaml'}", f"output={tmp_path / 's'}") == 0
    make_calibration(tmp_path / "calibration.json", (0.02, 1.02, -0.01), rig)
    options = (f"scan={tmp_path / 's'}", f"calibration={tmp_path / 'calibration.json'}", "line_motion=none")
    assert command("+experiment=correct", *options, folder="one") == 0
    write_raw_rig(raw, tmp_path / "s" / "rig.yaml")
    assert read_scan(tmp_path / "s").raw_rig == raw
    assert command("+experiment=correct", *options, folder="two") == 0
    one, two = (read_product(tmp_path / name / "s.zarr") for name in ("one", "two"))
    rows = one.shape[0]
    assert torch.equal(one.color(0, rows), two.color(0, rows))
    for image in ("height", "source"):
        torch.testing.assert_close(
            getattr(one, image)(0, rows), getattr(two, image)(0, rows), rtol=0, atol=0, equal_nan=True
        )


@pytest.mark.parametrize("depth", [True, False])
def test_depth_maps_are_those_of_rectified_cameras(command, tmp_path, capsys, depth):
    write_raw_rig(scaled_raw_rig(RAW, 16), tmp_path / "rig.yaml")
    options = ("scale=1", f"rig_file={tmp_path / 'rig.yaml'}", "depth=true") if depth else ("rig_file=nothing.yaml",)
    assert command("+experiment=simulate", *options, f"output={tmp_path / 's'}") == 1
    message = "depth: expected a rectified rig" if depth else "nothing.yaml: no such file"
    assert message in capsys.readouterr().err
