"""Files of responses, and the rig that names them."""

from pathlib import Path

import pytest
import torch
import yaml

from lsvision.errors import FileFormatError
from lsvision.io import (
    NewScan,
    read_response,
    read_scan,
    rig_file,
    scan_files,
    scan_sha256,
    write_raw_rig,
    write_response,
    write_rig_with_response,
    write_scan,
)
from lsvision.types import CameraResponse, Travel
from tests.archive.archives import RIG, WIDTH
from tests.io.formats.test_raw_rig import RIG as RAW_RIG


def drawn(seed: int, width: int = WIDTH, channels: int = 3) -> CameraResponse:
    random = torch.Generator().manual_seed(seed)
    offset, gain = torch.rand(2, width, channels, generator=random)
    return CameraResponse(3 * offset, 0.5 + 0.4 * gain)


@pytest.fixture
def scan(tmp_path: Path) -> Path:
    """A scan whose rig names the responses of both cameras, which lie beside it."""
    image = torch.randint(10, 110, (40, WIDTH, 3), generator=torch.Generator().manual_seed(0)).to(torch.uint8)
    write_scan(tmp_path / "scan", NewScan(RIG, Travel(1.0), [image], [image.flip(0)], 40))
    for seed, camera in enumerate(("left", "right")):
        write_response(drawn(seed), tmp_path / "scan" / f"{camera}.tif.response")
    files = {camera: f"{camera}.tif.response" for camera in ("left", "right")}
    write_rig_with_response(tmp_path / "scan" / "rig.yaml", tmp_path / "scan" / "rig.yaml", files)
    return tmp_path / "scan"


def test_round_trip(tmp_path):
    response = drawn(3, 50, 1)
    response.gain[7] = torch.nan
    write_response(response, tmp_path / "r.tif")
    back = read_response(tmp_path / "r.tif", (50, 1))
    assert torch.equal(back.offset, response.offset)
    assert torch.equal(back.gain.nan_to_num(), response.gain.nan_to_num())
    assert back.blind.nonzero().tolist() == [[7]]


def test_images_are_read_even_and_as_taken_on_request(scan):
    even, raw = read_scan(scan), read_scan(scan, as_taken=True)
    for seed, camera in enumerate(("left", "right")):
        ours, theirs = (getattr(item.images, camera).read(0, 40) for item in (even, raw))
        expected = ((theirs - drawn(seed).offset) / drawn(seed).gain).round().clamp(0, 255).to(torch.uint8)
        assert torch.equal(ours, expected)


def test_one_camera_alone_may_be_uneven(scan):
    data = yaml.safe_load((scan / "rig.yaml").read_text())
    (scan / "rig.yaml").write_text(yaml.safe_dump({**data, "response": {"right": "right.tif.response"}}))
    even, raw = read_scan(scan), read_scan(scan, as_taken=True)
    assert torch.equal(even.images.left.read(0, 40), raw.images.left.read(0, 40))
    assert not torch.equal(even.images.right.read(0, 40), raw.images.right.read(0, 40))


def test_the_response_belongs_to_the_scan_and_its_hash(scan):
    before = scan_sha256(scan)
    assert scan / "left.tif.response" in scan_files(scan)
    assert rig_file(scan) == scan / "rig.yaml"
    write_response(drawn(9), scan / "left.tif.response")
    assert scan_sha256(scan) != before


def test_a_raw_rig_names_responses_too(scan):
    write_raw_rig(RAW_RIG, scan / "raw.yaml")
    write_rig_with_response(scan / "raw.yaml", scan / "rig.yaml", {"left": "left.tif.response"})
    with pytest.raises(FileFormatError, match="expected 7142 columns"):  # the images are narrower
        read_scan(scan)


def test_a_response_of_other_images_is_one_line(scan):
    write_response(drawn(0, WIDTH + 1), scan / "left.tif.response")
    with pytest.raises(FileFormatError) as caught:
        read_scan(scan)
    expected = "expected the response of 64 columns and 3 colours as the images have, got 65 and 3"
    assert str(caught.value) == f"{scan / 'left.tif.response'}: {expected}"


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda r: r.gain.__setitem__((3, 0), 0.0), "expected gains > 0"),
        (lambda r: r.gain.__setitem__((3, 0), torch.inf), "expected gains > 0"),
        (lambda r: r.gain.fill_(torch.nan), "all gains are NaN"),
        (lambda r: r.offset.__setitem__((3, 0), torch.nan), "expected finite offsets"),
    ],
)
def test_values_that_no_camera_has(tmp_path, change, problem):
    response = drawn(0)
    change(response)
    write_response(response, tmp_path / "r.tif")
    with pytest.raises(FileFormatError, match=problem):
        read_response(tmp_path / "r.tif")


def test_files_that_are_none(scan):
    (scan / "left.tif.response").unlink()
    with pytest.raises(FileFormatError, match=r"rig\.yaml: response\.left: no such file or folder"):
        read_scan(scan)
    with pytest.raises(FileFormatError, match=r"expected 2 float32 lines, offset and gain, got 40 of torch\.uint8"):
        read_response(scan / "left.tif")
    data = yaml.safe_load((scan / "rig.yaml").read_text())
    for value, problem in (
        ({"middle": "x"}, "response.middle: unknown key"),
        ({"left": 3}, r"response\.left: expected"),
    ):
        (scan / "rig.yaml").write_text(yaml.safe_dump({**data, "response": value}))
        with pytest.raises(FileFormatError, match=problem):
            read_scan(scan)
