"""Images made even where they are read."""

import pickle

import pytest
import torch

from lsvision.image.flat_field import FlatFieldImage
from lsvision.image.levels import as_taken
from lsvision.types import CameraResponse, TensorImage


@pytest.fixture
def response() -> CameraResponse:
    random = torch.Generator().manual_seed(1)
    return CameraResponse(5 * torch.rand(40, 3, generator=random), 0.5 + 0.5 * torch.rand(40, 3, generator=random))


@pytest.mark.parametrize(("dtype", "most"), [(torch.uint8, 120), (torch.uint16, 30_000)])
def test_values_are_those_of_the_even_camera_to_half_a_code(response, dtype, most):
    even = torch.randint(most // 10, most, (20, 40, 3), generator=torch.Generator().manual_seed(2))
    raw = (even * response.gain + response.offset).round().to(dtype)
    image = FlatFieldImage(TensorImage(raw), response)
    assert (image.shape, image.dtype, image.missing) == ((20, 40, 3), dtype, ())
    off = (image.read(0, 20).int() - even).abs() * response.gain
    assert float(off.max()) <= 0.5 + 0.5  # of the raw code, and of the even one
    assert torch.equal(image.read(7, 11), image.read(0, 20)[7:11])


def test_what_is_saturated_stays_so_whatever_the_gain(response):
    raw = torch.full((30, 40, 3), 100, dtype=torch.uint8)
    raw[3, 5:9] = 255
    brighter = CameraResponse(response.offset, torch.full_like(response.gain, 1.3))
    read = FlatFieldImage(TensorImage(raw), brighter).read(0, 30)
    assert bool((read[3, 5:9] == 255).all())
    assert int(read[raw == 100].max()) < 100


def test_values_beyond_the_range_are_clamped_and_blind_columns_are_black(response):
    gain = response.gain.clone()
    gain[4] = torch.nan
    raw = torch.full((30, 40, 3), 240, dtype=torch.uint8)
    image = FlatFieldImage(TensorImage(raw), CameraResponse(response.offset, gain))
    read = image.read(0, 30)
    assert bool((read[:, 4] == 0).all())
    assert int(read[:, [i for i in range(40) if i != 4]].min()) > 200
    assert image.blind is not None
    assert image.blind.nonzero().tolist() == [[4]]


def test_it_is_pickled_and_knows_what_the_camera_delivered(response):
    source = TensorImage(torch.randint(0, 200, (30, 40, 3), generator=torch.Generator().manual_seed(2)).to(torch.uint8))
    image = FlatFieldImage(source, response)
    again = pickle.loads(pickle.dumps(image))
    assert torch.equal(again.read(0, 30), image.read(0, 30))
    assert as_taken(image) is source
