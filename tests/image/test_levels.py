"""White, saturation and faulty columns of line cameras, from images that are known by construction."""

import pytest
import torch

from lsvision.image.brightness import white_level
from lsvision.image.levels import CameraLevels, PairLevels
from lsvision.types import StereoPair, TensorImage

LINES, WIDTH = 160, 480


def scene(brightness: float, noise: float = 2.0, seed: int = 0) -> torch.Tensor:
    """Values (lines, width) of up to ``brightness``: a dark half, a bright half, noise."""
    generator = torch.Generator().manual_seed(seed)
    values = torch.full((LINES, WIDTH), 0.4 * brightness)
    values[:, WIDTH // 2 :] = 0.9 * brightness
    return values + noise * torch.randn(LINES, WIDTH, generator=generator)


def image(values: torch.Tensor, dtype: torch.dtype = torch.uint16) -> TensorImage:
    top = torch.iinfo(dtype).max
    return TensorImage(values.round().clamp(0, top).to(torch.int32).to(dtype)[..., None])


def with_counter(values: torch.Tensor) -> torch.Tensor:
    """The same with the line's number in the first four pixels, as some cameras write it."""
    line = torch.arange(LINES)
    counted = values.clone()
    counted[:, 0], counted[:, 1] = line // 256, (257 * line) % 65536
    counted[:, 2], counted[:, 3] = (line * 40503) % 65536, 65535 - line
    return counted


@pytest.mark.parametrize(
    ("brightness", "dtype", "white"),
    [
        (250, torch.uint8, 255),
        (120, torch.uint8, 255),
        (45, torch.uint8, 63),
        (13, torch.uint8, 15),
        (3, torch.uint8, 15),
        (1000, torch.uint16, 2047),
        (4000, torch.uint16, 8191),
        (3200, torch.uint16, 4095),
        (60000, torch.uint16, 65535),
        (30, torch.uint16, 255),
    ],
)
def test_white_has_the_bits_that_are_used(brightness, dtype, white):
    assert white_level(image(scene(brightness, noise=0.0), dtype)) == white


def test_white_of_a_pair_is_that_of_the_brighter_image():
    assert white_level(image(scene(300)), image(scene(3200))) == 4095


def test_neither_hot_pixels_nor_a_line_counter_is_white():
    values = scene(3200)
    values[0, 7] = values[LINES // 2, 90] = 65535
    assert white_level(image(with_counter(values))) == 4095


def test_levels_do_not_depend_on_lines_that_are_not_sampled():
    values = scene(3200)
    changed = values.clone()
    changed[3:8] = 60000
    levels, other = (PairLevels.of(StereoPair(image(x), image(x))) for x in (values, changed))
    assert levels.white == other.white
    assert levels.left.tops == other.left.tops


def levels_of(values: torch.Tensor, dtype: torch.dtype = torch.uint16) -> CameraLevels:
    taken = image(values, dtype)
    return CameraLevels.of(taken, white_level(taken))


@pytest.mark.parametrize(
    ("bits", "shift", "dtype"),
    [(8, 0, torch.uint8), (10, 0, torch.uint16), (12, 0, torch.uint16), (12, 4, torch.uint16)],
)
def test_saturated_are_the_largest_codes_of_the_sensor(bits, shift, dtype):
    top = 2**bits - 1
    values = scene(0.5 * top, noise=0.01 * top)
    values[40:60, 20:50] = 2 * top  # between two sampled lines as well as on them
    codes = values.round().clamp(0, top) * 2**shift
    taken = image(codes, dtype)
    unusable = levels_of(codes, dtype).unusable(taken.tensor)
    assert torch.equal(unusable, codes == top * 2**shift)


def test_a_plateau_below_the_largest_code_is_saturated_too():
    values = scene(200, noise=4.0).clamp(max=183.0)
    unusable = levels_of(values, torch.uint8).unusable(image(values, torch.uint8).tensor)
    assert torch.equal(unusable, values.round() == 183)


@pytest.mark.parametrize("noise", [0.3, 1.0, 4.0])
def test_a_bright_surface_is_no_plateau(noise):
    values = scene(220, noise=noise)
    assert levels_of(values, torch.uint8).unusable(image(values, torch.uint8).tensor) is None


def test_green_decides_for_colours():
    color = torch.full((LINES, WIDTH, 3), 100, dtype=torch.uint8)
    color[5, 6, 0] = color[5, 7, 1] = 255
    unusable = CameraLevels.of(TensorImage(color), 255.0).unusable(color)
    assert unusable.nonzero().tolist() == [[5, 7]]


def test_columns_that_are_stuck_or_count_lines_are_faulty():
    values = scene(3200)
    values[:, 100], values[:, 200] = 3000, 0
    assert levels_of(with_counter(values)).faulty.nonzero()[:, 0].tolist() == [0, 1, 2, 3, 100, 200]


def test_neither_the_rim_of_a_textured_object_nor_an_edge_is_a_fault():
    generator = torch.Generator().manual_seed(1)
    values = scene(200, noise=0.4)
    values[:, 60:97] += 40 * torch.randn(LINES, 37, generator=generator)
    assert not levels_of(values.clamp(0, 255), torch.uint8).faulty.any()


def test_an_edge_that_runs_along_a_column_is_no_fault():
    """A checkerboard that lies straight: squares of 60 px, edges as blurred as a lens leaves them."""
    lines, columns = torch.meshgrid(torch.arange(720.0), torch.arange(600.0), indexing="ij")
    across = torch.sigmoid(2.5 * torch.sin((columns + 25) * torch.pi / 60) * 60 / torch.pi)
    board = (2 * across - 1) * torch.sin(lines * torch.pi / 60).sign()
    values = 120 + 80 * board + 1.5 * torch.randn(720, 600, generator=torch.Generator().manual_seed(0))
    assert not levels_of(values.clamp(0, 255), torch.uint8).faulty.any()
    values[:, 333] = 120 + 100 * torch.randn(720, generator=torch.Generator().manual_seed(1)).clamp(-1, 1)
    assert levels_of(values.clamp(0, 255), torch.uint8).faulty.nonzero()[:, 0].tolist() == [333]
