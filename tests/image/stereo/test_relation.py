"""Lines out of step and brightness of a pair with disparity: measured from bands, whatever the other difference is."""

import math

import pytest
import torch

from lsvision.image.stereo.relation import measure_relation
from lsvision.image.stereo.rows import Tiles, row_offset
from lsvision.types import TensorImage
from tests.image.stereo.test_coarse_to_fine import textured
from tests.image.stereo.test_sgbm import search


def pair(offset: float, disparity: int = 11, gain: float = 1.0) -> tuple[TensorImage, TensorImage]:
    """Strips of a plane; the right camera sees a line of the object ``offset`` lines later."""
    wide = textured(200, 360)[..., 0].float()
    line = (torch.arange(160) + 20 - offset).clamp(0, 199)
    whole, part = line.floor().long(), (line - line.floor())[:, None]
    right = (1 - part) * wide[whole] + part * wide[(whole + 1).clamp(max=199)]
    left, right = wide[20:180, 40:320], gain * right[:, 40 + disparity : 320 + disparity]
    noisy = (image + 1.5 * torch.randn(image.shape) for image in (left, right))
    left, right = (image.clamp(0, 255).round().to(torch.uint8)[..., None] for image in noisy)
    return TensorImage(left), TensorImage(right)


@pytest.mark.parametrize(("offset", "gain"), [(0, 1.0), (0, 0.7), (1, 0.7), (-2, 1.0), (9, 1.0)])
def test_lines_out_of_step_are_counted(offset, gain):
    relation = measure_relation(*pair(offset, gain=gain), search(-40, 40), 2.0, 1)
    assert relation.rows.whole == offset
    assert relation.rows.lines == pytest.approx(offset, abs=0.05)
    assert (relation.exposure is None) == (gain == 1.0)


@pytest.mark.parametrize("offset", [0.25, -0.4])
def test_a_fraction_of_a_line_is_measured(offset):
    rows = measure_relation(*pair(offset), search(-40, 40), 2.0, 1).rows
    assert rows.whole == 0
    assert rows.lines == pytest.approx(offset, abs=0.12)
    assert 0 < rows.sigma < 0.05


def test_on_a_smaller_copy_lines_are_those_of_the_images():
    relation = measure_relation(*pair(3), search(-40, 40), 2.0, 2)
    assert relation.rows.whole == 3
    assert relation.metadata["row_offset_used_lines"] == 3
    assert relation.metadata["right_gain"] == [1.0, 1.0]


def test_where_nothing_matches_nothing_is_known():
    left, right = pair(0)[0], TensorImage(textured(160, 280))
    for other in (right, TensorImage(torch.zeros(160, 280, 1, dtype=torch.uint8))):
        rows = measure_relation(left, other, search(-40, 40), 2.0, 1).rows
        assert math.isnan(rows.lines)
        assert rows.whole == 0


def test_images_of_few_lines_are_in_step():
    left, right = (TensorImage(image.read(0, 6)) for image in pair(0))
    assert measure_relation(left, right, search(-40, 40), 2.0, 4).rows.whole == 0


def test_tiles_of_a_known_shift():
    """left - right = r s_v, with a factor of brightness and an error of the disparity beside it."""
    v, u = torch.meshgrid(torch.arange(66.0), torch.arange(90.0), indexing="ij")

    def image(down: float, right: float) -> torch.Tensor:
        return 100 + 30 * torch.sin((v + down) / 2.3 + u / 9) + 30 * torch.cos((u + right) / 2.9 - (v + down) / 7)

    left, warped = image(0.0, 0.0), 0.9 * image(-0.2, 0.1) + 4
    tiles = Tiles.of(left, warped, torch.ones(66, 90, dtype=torch.bool))
    found = row_offset(tiles)
    assert found.lines == pytest.approx(0.2, abs=0.02)
    assert tiles.score > 0.98
    assert len(tiles.offset) == 8 * 11
    half = Tiles.of(left, warped, u < 45)
    assert half.score == pytest.approx(0.5, abs=0.06)
