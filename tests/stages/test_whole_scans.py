"""Products of scans larger than a tile: strips, resamplers, coarser cells, other cameras' scans and encoder logs."""

import dataclasses
from pathlib import Path

import pytest
import torch
from torch import Tensor

from lsvision.errors import FileFormatError
from lsvision.io import read_encoder
from lsvision.stages.correction.config import CorrectionConfig
from lsvision.stages.correction.correct import correct_scan
from lsvision.stages.correction.grid import plan_product
from lsvision.stages.disparity.depth import depth_of
from lsvision.types import DepthView, Motion, Rig, Scan, TensorImage, Travel
from tests.combinations import crossed
from tests.stages.rendered import motion_of

PITCH = 0.56
# An eighth of the camera's pixels, and a field of two tiles.
RIG = Rig(700, 80.0, 113.84, 354.0, 129.8, 761.9)
LINES = 400
CONFIG = CorrectionConfig(height_range_mm=(-30.0, 30.0), strip_rows=10_000)
PARTS = ("color", "height", "valid", "source")


ASKEW = motion_of(-0.045, 0.98, 0.05)


def rough_scan(travel: Travel, rig: Rig = RIG, dtype: torch.dtype = torch.uint8, channels: int = 3) -> Scan:
    """A wavy surface with a raised block, holes and noise, in random colours."""
    u, v = torch.arange(rig.width_px), torch.arange(LINES)[:, None]
    depth = 797.0 + 6 * torch.sin(v / 60.0) + 0.004 * u + 0.02 * torch.randn(LINES, rig.width_px)
    depth[:, 200:340] -= 20.0
    depth[torch.rand(depth.shape) < 0.01] = torch.nan
    top = torch.iinfo(dtype).max
    color = torch.randint(0, top + 1, (LINES, rig.width_px, channels)).to(dtype)
    return Scan(Path("rough"), rig, travel, DepthView(TensorImage(color), TensorImage(depth.float()[..., None])))


def product(scan: Scan, config: CorrectionConfig, motion: Motion = ASKEW) -> dict[str, Tensor]:
    strips = list(correct_scan(scan, depth_of(scan), motion, config))
    return {part: torch.cat([getattr(strip, part) for strip in strips]) for part in PARTS}


def assert_same(found: dict[str, Tensor], expected: dict[str, Tensor]) -> None:
    for part in PARTS:
        assert torch.equal(found[part].nan_to_num(nan=-1.0), expected[part].nan_to_num(nan=-1.0)), part


OPTIONS = {
    "bicubic": {},
    "bilinear": {"interpolation": "bilinear"},
    "coarser": {"pitch_mm": 1.9 * PITCH},
    "finer": {"pitch_mm": 0.7 * PITCH},
    "opencv": {"resampler": "opencv", "interpolation": "bilinear"},
}


@crossed("options rig", list(OPTIONS), [RIG, dataclasses.replace(RIG, color_spacing_lines=(-2.0, 0.0, 2.0))])
def test_strips_of_any_height_and_threads_change_no_bit(options, rig):
    config = dataclasses.replace(CONFIG, **OPTIONS[options])
    scan = rough_scan(Travel(PITCH), rig)
    whole = product(scan, config)
    assert whole["color"].shape[0] > 192
    assert whole["color"].shape[1] > 480 or options == "coarser"
    assert whole["valid"].float().mean() > 0.5
    torch.set_num_threads(2)
    for rows in (64, 257, 1024):
        assert_same(product(scan, dataclasses.replace(config, strip_rows=rows)), whole)
    assert torch.get_num_threads() == 2


@pytest.mark.parametrize("interpolation", ["bilinear", "bicubic"])
@pytest.mark.parametrize("pitch", [PITCH, 2 * PITCH])
def test_opencv_gives_the_same_within_a_grey_value(interpolation, pitch):
    scan = rough_scan(Travel(PITCH))
    config = dataclasses.replace(CONFIG, interpolation=interpolation, pitch_mm=pitch)
    ours, theirs = product(scan, config), product(scan, dataclasses.replace(config, resampler="opencv"))
    assert (ours["color"].int() - theirs["color"].int()).abs().max() <= 1
    for part in PARTS[1:]:
        assert torch.equal(ours[part].nan_to_num(nan=-1.0), theirs[part].nan_to_num(nan=-1.0))


def test_coarser_cells_show_no_false_pattern():
    # Stripes two pixels wide average to grey; without smoothing they beat against the cells.
    scan = rough_scan(Travel(PITCH))
    stripes = ((torch.arange(700) % 2) * 200).to(torch.uint8).expand(LINES, 700)[..., None].expand(-1, -1, 3)
    flat = torch.full((LINES, 700, 1), 796.9)
    scan = dataclasses.replace(scan, images=DepthView(TensorImage(stripes), TensorImage(flat)))
    coarse = product(scan, dataclasses.replace(CONFIG, pitch_mm=3.1 * PITCH), motion_of(0.0, 1.0, 0.0))
    inner = coarse["color"][20:-20, 40:-40][coarse["valid"][20:-20, 40:-40]].float()
    assert (inner - 100).abs().max() <= 3
    fine = product(scan, CONFIG, motion_of(0.0, 1.0, 0.0))
    assert fine["color"][fine["valid"]].float().std() > 40


@pytest.mark.parametrize(("dtype", "channels"), [(torch.uint16, 1), (torch.uint8, 1), (torch.uint16, 3)])
def test_mono_and_sixteen_bit_scans(dtype, channels):
    scan = rough_scan(Travel(PITCH), dtype=dtype, channels=channels)
    made = product(scan, CONFIG)
    assert made["color"].dtype == dtype
    assert made["color"].shape[2] == channels
    assert made["color"].int().max() > 0.9 * torch.iinfo(dtype).max
    # Colour does not move anything.
    images = DepthView(rough_scan(Travel(PITCH)).left, scan.images.depth)
    colored = product(dataclasses.replace(scan, images=images), CONFIG)
    assert torch.equal(colored["source"].nan_to_num(nan=-1.0), made["source"].nan_to_num(nan=-1.0))


def test_depths_out_of_range_are_not_measured():
    scan = rough_scan(Travel(PITCH))
    scan.images.depth.tensor[200:300, 400:600] = 700.0
    made = product(scan, CONFIG)
    assert float(made["height"].nan_to_num().max()) < 30.0
    line, column = made["source"].unbind(-1)
    assert not bool(((line > 201) & (line < 299) & (column > 440) & (column < 560)).any())


def test_a_scan_of_one_line_is_refused():
    scan = rough_scan(Travel(PITCH))
    images = DepthView(TensorImage(scan.left.tensor[:1]), TensorImage(scan.images.depth.tensor[:1]))
    short = dataclasses.replace(scan, images=images)
    with pytest.raises(FileFormatError, match="rough: expected at least two lines"):
        plan_product(short, ASKEW, CONFIG)


def object_scan(position: Tensor, travel: Travel) -> Scan:
    """A flat object whose brightness tells the place along it, as lines taken at some positions see it."""
    shade = (position / PITCH * 100).round().to(torch.int32).clamp(0, 65535).to(torch.uint16)
    color = shade[:, None, None].expand(-1, RIG.width_px, 1)
    depth = torch.full((len(position), RIG.width_px, 1), 796.9)
    return Scan(Path("object"), RIG, travel, DepthView(TensorImage(color), TensorImage(depth)))


def test_an_encoder_log_with_a_halt_a_way_back_a_gap_and_another_pitch(tmp_path):
    steps = torch.full((450,), PITCH, dtype=torch.float64)
    steps[100:130] = 0.0  # the object stands
    steps[180:200] = -PITCH  # and goes back
    steps[300:] = 1.3 * PITCH  # the camera falls back to free running
    steps[420] = 12 * PITCH  # lines were lost
    position = steps.cumsum(0)
    rows = "".join(f"{line},{at!r}\n" for line, at in enumerate(position.tolist()) if line not in (50, 51))
    (tmp_path / "encoder.csv").write_text("line,position_mm\n" + rows)
    log = read_encoder(tmp_path / "encoder.csv", 450, repair=True)
    scan = object_scan(position, Travel(PITCH, log))
    # Bilinear: a bicubic kernel bends a ramp a little.
    made = product(scan, dataclasses.replace(CONFIG, interpolation="bilinear"), motion_of(0.0, 1.0, 0.0))
    grid = plan_product(scan, motion_of(0.0, 1.0, 0.0), CONFIG)
    q_y = grid.origin_y_mm + grid.pitch_mm * torch.arange(grid.rows, dtype=torch.float64)
    seen = made["valid"][:, 300]
    assert float(seen.float().mean()) > 0.95
    place = made["color"][:, 300, 0].double() / 100 * PITCH
    inner = seen & (q_y > position[2]) & (q_y < position[-3])
    error = (place - q_y)[inner].abs()
    edge = torch.zeros_like(error, dtype=torch.bool)
    for at in (position[99], position[199], position[179], position[420], position[419]):
        edge |= (q_y[inner] - at).abs() < 2 * PITCH
    assert error[~edge].max() < 0.03 * PITCH
    assert error.max() < PITCH
