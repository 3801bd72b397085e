"""Which side of a step places lie on, of pairs whose step is known."""

import pytest
import torch

from lsvision.image.stereo.residuals import Misfit
from lsvision.image.stereo.steps import step_evidence

LINES, WIDTH, HEIGHT = 48, 200, 14
UPPER = slice(90, 150)  # columns of the upper side in the left image
LOWEST = -30.0


def pair(lower_contrast: float = 20.0) -> tuple[torch.Tensor, torch.Tensor]:
    """A textured strip of disparity 14 over a ground of disparity 0, with noise."""
    ground, strip = 100 + lower_contrast * torch.randn(LINES, WIDTH), 100 + 20 * torch.randn(LINES, 60)
    left, right = ground.clone(), ground.clone()
    left[:, UPPER] = strip
    right[:, UPPER.start - HEIGHT : UPPER.stop - HEIGHT] = strip
    return tuple(image + torch.randn(LINES, WIDTH) for image in (left, right))


def disparity(wider_px: int = 0) -> torch.Tensor:
    """The true one, or one whose upper side reaches some pixels too far on either side."""
    values = torch.zeros(LINES, WIDTH)
    values[:, UPPER.start - wider_px : UPPER.stop + wider_px] = HEIGHT
    return values


def sigma(left, right, values: torch.Tensor, block: int = 1) -> torch.Tensor:
    """By column of a line in the middle, px."""
    values = values[::block, ::block].contiguous()
    return step_evidence(left, right, values, torch.full_like(values, 2.0), LOWEST).variance[12].sqrt()


@pytest.mark.parametrize("block", [1, 2])
@pytest.mark.parametrize("lower_contrast", [20.0, 0.0])
def test_a_rim_that_reaches_too_far_may_be_what_lies_behind(block, lower_contrast):
    found = sigma(*pair(lower_contrast), disparity(wider_px=4), block)
    wide, narrow = (slice((UPPER.start + shift) // block, (UPPER.start + 4 + shift) // block) for shift in (-4, 12))
    assert (found[wide] > 0.2 * HEIGHT).all()
    assert (found[narrow] < 0.1).all()
    assert (found[: (UPPER.start - 40) // block] == 0).all()


def test_texture_up_to_the_rim_proves_all_but_the_rim():
    found = sigma(*pair(), disparity())
    assert (found[UPPER.start + 5 : UPPER.stop - 5] < 0.1).all()
    assert (found[UPPER.stop + 5 : UPPER.stop + 12] < 0.1).all()
    assert found[UPPER.start] > 1.0


def test_where_neither_side_has_texture_nothing_is_proven_near_a_step():
    left, right = (100 + torch.randn(LINES, WIDTH) for _ in range(2))
    found = sigma(left, right, disparity())
    assert (found[UPPER.start : UPPER.start + 10] > 0.2 * HEIGHT).all()
    assert (found[UPPER.start + 20 : UPPER.stop - 20] == 0).all()


def test_a_gap_at_the_end_of_a_line_may_be_as_low_as_the_range_allows():
    left, right = (100 + torch.randn(LINES, WIDTH) for _ in range(2))
    values = torch.zeros(LINES, WIDTH)
    values[:, :60] = torch.nan
    assert sigma(left, right, values)[60] > 0.2 * abs(LOWEST)
    values[:, :60] = 0.0
    values[:, 80:100] = torch.nan  # a gap within a surface belongs to it
    assert not sigma(left, right, values)[20:180].any()


def test_a_low_step_counts_where_windows_fit_the_other_side_better():
    left, right = pair()
    right[:, UPPER.start - HEIGHT : UPPER.stop] = left[:, UPPER.start - HEIGHT : UPPER.stop]  # in truth there is none
    values = disparity() * (2.5 / HEIGHT)
    found = sigma(left, right, values)
    assert (found[UPPER.start : UPPER.start + 3] > 0.2 * 2.5).all()
    assert (found[UPPER.start + 20 : UPPER.stop - 20] == 0).all()
    left, right = (100 + torch.randn(LINES, WIDTH) for _ in range(2))
    noise = sigma(left, right, values)  # fits both sides
    assert noise[UPPER.start - 5 : UPPER.start + 5].median() < 0.1 * 2.5


def test_neither_a_slope_nor_a_small_step_counts():
    slope = (0.15 * torch.arange(WIDTH).float()).expand(LINES, WIDTH).contiguous()
    left, right = pair()
    assert not sigma(left, right, slope)[:-12].any()
    assert not sigma(left, right, disparity() / HEIGHT)[:-12].any()


@pytest.mark.parametrize("side", [-1, 1])
def test_partners_beyond_the_right_image(side):
    left, right = pair()
    values = torch.full((LINES, WIDTH), torch.nan)
    values[:, 60:140] = torch.where(torch.arange(60, 140) < 100, side * 190.0, side * 180.0)
    assert step_evidence(left, right, values, torch.ones_like(values), -190.0).variance.isfinite().all()


@pytest.mark.parametrize("block", [1, 2])
def test_a_rim_whose_own_texture_is_that_of_the_ground_is_refuted(block):
    left, right = pair()
    rim = slice((UPPER.stop + 4) // block, (UPPER.stop + 7) // block)
    for wider_px, wrong in ((8, True), (0, False)):
        values = disparity(wider_px)[::block, ::block].contiguous()
        refuted = step_evidence(left, right, values, torch.full_like(values, 2.0), LOWEST).refuted
        assert refuted[:, rim].float().mean() > 0.9 if wrong else not refuted[:, rim].any()
        assert not refuted[:, (UPPER.start + 6) // block : (UPPER.stop - 6) // block].any()


def test_what_fits_neither_side_is_not_refuted():
    left, right = (100 + 20 * torch.randn(LINES, WIDTH) for _ in range(2))
    values = disparity()
    assert not step_evidence(left, right, values, torch.full_like(values, 2.0), LOWEST).refuted.any()


def test_beyond_the_last_line_lies_what_is_seen_beside():
    left, right = (100 + torch.randn(LINES, WIDTH) for _ in range(2))
    values = torch.full_like(left, torch.nan)
    values[:, : UPPER.start] = 0.0
    values[:, UPPER] = HEIGHT
    column = UPPER.start + 20  # farther from the step than any window reaches
    found = step_evidence(left, right, values, torch.full_like(values, 2.0), LOWEST).variance[:, column].sqrt()
    assert (found[[0, 3, -4, -1]] > 0.2 * HEIGHT).all()
    assert not found[16:-16].any()


def test_nothing_known_is_no_step():
    nothing = torch.full((8, 8), torch.nan)
    assert not step_evidence(torch.zeros(8, 8), torch.zeros(8, 8), nothing, torch.ones(8, 8), LOWEST).variance.any()


def test_misfit_is_counted_from_the_usual_variance():
    variance = torch.full((128, 256), 2.0)
    variance[:, 144:] = 6.0  # a brighter part, with noise of its own
    variance[40:44, 40:44] = variance[40:44, 240:244] = 96.0
    misfit = Misfit.of(variance, 1)
    assert misfit.noise_variance[41, 41] == 2.0
    assert misfit.noise_variance[41, 241] == 6.0
    assert misfit.factor[41, 41] == 2.0
    assert misfit.factor[0, 0] == misfit.factor[0, 200] == 1.0
