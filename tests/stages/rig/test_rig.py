"""The raw rig from boards: exact where the sightings are, honest where they are noisy, and it notices what is wrong."""

import json
import math
from dataclasses import replace

import pytest
import torch

from lsvision.geometry import RawPair, quantities_of
from lsvision.stages.rig.calibrate import calibrate_rig
from lsvision.stages.rig.data_sheet import contradicted
from lsvision.stages.rig.height_shape import HeightShape
from lsvision.stages.rig.model import QUANTITIES, RigPrior, Shared
from lsvision.stages.rig.sightings import CameraSighting, joined, sighted
from lsvision.stages.rig.solve import solve_rig
from lsvision.types import RIG_QUANTITIES, Board, Travel
from tests.stages.rig.boards import CONFIG, DATA_SHEET, PRIOR, Truth, first_of, restated


def calibrated(sightings, **options):
    names = [f"s{i}" for i in range(sightings.boards)]
    return calibrate_rig(sightings, names, DATA_SHEET, replace(CONFIG, **options))


def test_exact_sightings_give_the_rig_and_the_motion():
    truth = Truth.drawn(2)
    found = solve_rig(restated(truth.scanned(8, noise=1e-6), 1e-3 / 0.03), PRIOR, CONFIG)
    off = found.shared.vector - truth.vector
    assert bool(found.found.converged.all())
    assert float((off / found.covariance.diagonal(dim1=-2, dim2=-1).sqrt()).abs().max()) < 0.1  # the prior's pull
    assert float(shape_at(truth).bend_mm(off / PRIOR.sigma).max()) < 1e-4


def shape_at(truth: Truth) -> HeightShape:
    return HeightShape.of(DATA_SHEET, Shared(truth.quantities[0], truth.n[0]), PRIOR.sigma, 52.0)


def test_sigmas_are_those_of_the_errors():
    truth = Truth.drawn(40)
    found = solve_rig(truth.scanned(6), PRIOR, CONFIG)
    error = found.shared.vector - truth.vector
    nees = (error * torch.linalg.solve(found.covariance, error)).sum(-1)
    assert 14.2 < float(nees.mean()) < 19.8  # 17 ± 3 sqrt(2 * 17 / 40)
    assert float(found.noise_scale.max()) < 1.15


@pytest.mark.parametrize(("boards", "most_um"), [(8, 10.0), (16, 5.0)])
def test_heights_are_known_as_well_as_was_asked_for(boards, most_um):
    truth = Truth.drawn(6)
    found = solve_rig(truth.scanned(boards), PRIOR, CONFIG)
    bends = 1e3 * shape_at(truth).bend_mm((found.shared.vector - truth.vector) / PRIOR.sigma)
    stated = 1e3 * float(shape_at(truth).stated_mm(found.factor[0]))
    assert float(bends.square().mean().sqrt()) < most_um
    assert 0.4 * stated < float(bends.square().mean().sqrt()) < 1.6 * stated


def test_two_boards_leave_combinations_to_the_data_sheet():
    found = calibrated(first_of(Truth.drawn(1).scanned(2)))
    assert found.verdict == "prior-dominated"
    assert any("principal_point_px" in item.in_words for item in found.unobserved)
    assert found.advice in found.reasons
    assert found.boards[0].held_out_rms is None


def test_eight_boards_determine_the_rig():
    found = calibrated(first_of(Truth.drawn(1).scanned(8)))
    assert (found.verdict, found.reasons) == ("determined", ())
    assert all(0.7 < board.rms < 1.3 and 0.7 < board.held_out_rms < 1.4 for board in found.boards)
    assert dict(found.rig.sigma)["baseline_mm"] < 0.1


def test_corners_far_off_are_left_out():
    truth = Truth.drawn(1)
    sightings = first_of(truth.scanned(8))
    wrong = torch.rand(sightings.valid.shape) < 0.03
    moved = torch.where(wrong[..., None], 3.0, 0.0) * torch.tensor([1.0, 0.07])
    left = CameraSighting(sightings.left.position + moved, sightings.left.factor)
    found = calibrated(replace(sightings, left=left), held_out=False)
    assert sum(board.outliers for board in found.boards) == int(wrong.sum()) > 2
    off = torch.cat([quantities_of(found.rig), found.motion.n]) - truth.vector[0]
    # The plane counts depth from the z0 of the found rig.
    off[11] -= float(truth.quantities[0, 13] * (RawPair.of(found.rig).z0_mm - RawPair.of(DATA_SHEET).z0_mm))
    assert float((off / found.covariance.diagonal().sqrt()).abs().max()) < 4


@pytest.mark.slow
def test_scans_at_different_speeds_contradict_each_other():
    truth = Truth.drawn(1)
    n = truth.n[:, None].repeat(1, 8, 1)
    n[:, 0, 1] *= 1.03
    found = calibrated(first_of(truth.scanned(8, n=n)))
    assert found.verdict == "inconsistent"
    assert "its speed changed" in found.reasons[0]
    assert found.reasons[1].startswith("without s0 the others agree to 1.0 sigmas")


@pytest.mark.slow
def test_more_noise_than_stated_makes_larger_sigmas():
    truth = Truth.drawn(1)
    found = solve_rig(truth.scanned(8, noise=2.0), PRIOR, CONFIG)
    assert 1.8 < float(found.noise_scale[0]) < 2.2
    usual = solve_rig(truth.scanned(8), PRIOR, CONFIG)
    ratio = (found.covariance.diagonal(dim1=-2, dim2=-1) / usual.covariance.diagonal(dim1=-2, dim2=-1)).sqrt()
    assert 1.5 < float(ratio.median()) < 2.3


def test_the_data_sheets_own_sigmas_are_the_prior():
    rig = replace(DATA_SHEET, sigma=(("baseline_mm", 0.01), ("right.turn_deg", 0.02)))
    sigma = RigPrior.of(rig, CONFIG).sigma
    assert (float(sigma[10]), float(sigma[7])) == (0.01, 0.02)
    assert float(sigma[2]) == CONFIG.turn_sigma_deg


def test_a_bend_is_what_the_heights_of_a_plate_do():
    """Against a plate that the true rig sees, measured by a wrong one."""
    truth = Truth.drawn(1)
    shape, pair = shape_at(truth), RawPair.of(DATA_SHEET, truth.quantities[0])
    error = torch.zeros(QUANTITIES + 3, dtype=torch.float64)
    error[3] = 1e-3 / PRIOR.sigma[3]  # k1 of the left camera
    columns = torch.linspace(150, 6990, 200, dtype=torch.float64)
    z = pair.z0_mm.expand(200)
    plate = torch.stack([pair.left.slope(columns) * z, torch.zeros_like(z), z], dim=-1)
    right = pair.seen_right(plate, truth.n[0]).column
    wrong = RawPair.of(DATA_SHEET, truth.quantities[0] + PRIOR.sigma[:QUANTITIES] * error[:QUANTITIES])
    height = pair.z0_mm - wrong.meet(columns, right, truth.n[0]).z
    tilt = torch.stack([torch.ones_like(z), plate[:, 0]], dim=-1)
    bend = height - tilt @ torch.linalg.lstsq(tilt, height[:, None]).solution[:, 0]
    assert float(shape.bend_mm(error)) == pytest.approx(float(bend.square().mean().sqrt()), rel=0.15)


def test_the_proposed_scan_helps_as_much_as_it_says():
    found = calibrated(first_of(Truth.drawn(1).scanned(3)), held_out=False)
    promised = float(found.advice.split("known to ")[1].split(" um")[0])
    assert promised < 0.8 * found.height_error_um
    assert "lay the board with its longer side" in found.advice


@pytest.mark.slow
def test_another_renderers_raw_boards(shared_data):
    from lsvision.image.board.detect import detect_board
    from lsvision.io import open_line_image, read_raw_rig

    root, board, parts = shared_data / "scans_shaken_and_raw", Board(12, 9, 30.0), []
    for name in "abcdefgh":
        corners = [
            detect_board(open_line_image(root / f"raw_{name}" / f"{side}.tif"), board) for side in ("left", "right")
        ]
        parts.append(sighted(*corners, Travel(0.56), board))
    rig = read_raw_rig(root / "raw_a" / "rig.yaml")
    found = calibrate_rig(joined(parts), list("abcdefgh"), rig, CONFIG)
    truth = json.loads((root / "raw_a" / "truth.json").read_text())
    cameras = [[truth[side][key] for key in ("f_px", "c", "turn", "k1", "k2")] for side in ("left", "right")]
    optics = [(f * 0.08, c, math.degrees(turn), k1, k2) for f, c, turn, k1, k2 in cameras]
    view = truth["right"]
    true = torch.tensor([*optics[0], *optics[1], 354.0, view["s0"], view["s1"], view["s2"], *truth["n"]]).double()
    off = torch.cat([quantities_of(found.rig), found.motion.n]) - true
    off[11] += view["s2"] * (796.9 - float(RawPair.of(found.rig).z0_mm))
    assert float((off / found.covariance.diagonal().sqrt()).abs().max()) < 3
    assert found.verdict == "determined"
    assert found.noise_scale < 1.2
    shape = HeightShape.of(rig, Shared(true[:QUANTITIES], true[QUANTITIES:]), RigPrior.of(rig, CONFIG).sigma, 52.0)
    assert 1e3 * float(shape.bend_mm(off / RigPrior.of(rig, CONFIG).sigma)) < 2 * found.height_error_um


@pytest.mark.parametrize("k2", [(0.05, 0.05), (0.2, -0.1)])
def test_a_rig_that_is_off_in_k2_alone(k2):
    """It is estimated, four of the data sheet's sigmas away as well, and all that is stated holds."""
    quantities = quantities_of(DATA_SHEET)
    quantities[4], quantities[9] = k2
    truth = Truth(quantities[None], torch.tensor([[0.0, 1.0, 0.0]], dtype=torch.float64))
    found = calibrated(first_of(truth.scanned(8)), held_out=False)
    off = torch.cat([quantities_of(found.rig), found.motion.n]) - truth.vector[0]
    assert (found.verdict, found.noise_scale < 1.1) == ("determined", True)
    assert float((off / found.covariance.diagonal().sqrt()).abs().max()) < 3.5
    assert dict(found.rig.sigma)["left.distortion.1"] < 0.005
    assert 1e3 * float(shape_at(truth).bend_mm(off / PRIOR.sigma)) < min(10.0, 2.5 * found.height_error_um)


@pytest.mark.parametrize("name", ["left.distortion.1", "right.turn_deg"])
def test_a_data_sheet_that_is_sure_of_what_is_not_so(name):
    """Heights would be off by several times what is stated."""
    off = {"left.distortion.1": 0.05, "right.turn_deg": 0.2}[name]
    quantities = quantities_of(DATA_SHEET)
    quantities[RIG_QUANTITIES.index(name)] += off
    truth = Truth(quantities[None], torch.tensor([[0.0, 1.0, 0.0]], dtype=torch.float64))
    sightings = first_of(truth.scanned(8))
    sure = replace(DATA_SHEET, sigma=((name, 0.0),))
    found = calibrate_rig(sightings, list("abcdefgh"), sure, replace(CONFIG, held_out=False))
    assert found.verdict == "inconsistent"
    assert f"it says {name} " in found.reasons[-1]
    assert "exactly" in found.reasons[-1]


def test_sound_data_sheets_are_not_contradicted():
    sightings = Truth.drawn(2).scanned(6)
    for rig in range(2):
        assert contradicted(solve_rig(first_of(sightings, rig), PRIOR, CONFIG), CONFIG) is None
