"""The response of a camera as a file: a float32 TIFF of 2 x width x channels, offset then gain."""

from collections.abc import Mapping
from pathlib import Path

import torch
import yaml
from torch import Tensor

from lsvision.errors import FileFormatError
from lsvision.image.flat_field import FlatFieldImage
from lsvision.io.atomic import write_text
from lsvision.io.formats.raw_rig import read_rig_pair
from lsvision.io.formats.validation import named_file, read_yaml
from lsvision.io.images.line_image import open_line_image
from lsvision.io.images.tiff import write_line_image
from lsvision.types import CameraResponse, LineImage


def write_response(response: CameraResponse, path: Path | str) -> None:
    """Write a camera's response."""
    values = torch.stack([response.offset, response.gain])
    write_line_image(path, [values], (2, *response.shape), torch.float32)


def read_response(path: Path, shape: tuple[int, ...] | None = None) -> CameraResponse:
    """Read a camera's response.

    Args:
        shape: (width, channels) of the images that it is for; any if None.

    Raises:
        FileFormatError: no such file, of another kind, for other images, or values that no camera has.
    """
    image = open_line_image(path)
    lines, *found = image.shape
    if lines != 2 or image.dtype != torch.float32:
        raise FileFormatError(path, f"expected 2 float32 lines, offset and gain, got {lines} of {image.dtype}")
    if shape is not None and tuple(found) != tuple(shape):
        (width, channels), (wanted, colors) = found, shape
        problem = f"expected the response of {wanted} columns and {colors} colours as the images have"
        raise FileFormatError(path, f"{problem}, got {width} and {channels}")
    offset, gain = image.read(0, 2)
    _check(path, offset, gain)
    return CameraResponse(offset.contiguous(), gain.contiguous())


def _check(path: Path, offset: Tensor, gain: Tensor) -> None:
    """Check that a camera can have these values; a gain of NaN marks a column that does not see."""
    if not bool(offset.isfinite().all()):
        raise FileFormatError(path, "expected finite offsets")
    if not bool(((gain > 0) & gain.isfinite() | gain.isnan()).all()):
        raise FileFormatError(path, "expected gains > 0, or NaN for a column that does not see")
    if bool(gain.isnan().all()):
        raise FileFormatError(path, "all gains are NaN")


def write_rig_with_response(rig: Path, target: Path, files: Mapping[str, str]) -> None:
    """Write a rig file again with the files of the cameras' responses, by camera, relative to ``target``.

    Raises:
        FileFormatError: ``rig`` holds no keys with values.
    """
    data = read_yaml(rig)
    if not isinstance(data, Mapping):
        raise FileFormatError(rig, "expected keys with values")
    entries = {**data, "response": dict(files)}
    write_text(target, yaml.safe_dump(entries, sort_keys=False, default_flow_style=None))


def copy_response(rig: Path, folder: Path) -> dict[str, str]:
    """Copy the cameras' responses that a rig file names into a folder; their names there by camera, none of even ones.

    Raises:
        FileFormatError: the rig file or a response cannot be read.
    """
    copied = {}
    for camera, name in read_rig_pair(rig).response.items():
        copied[camera] = f"{camera}_response.tif"
        write_response(read_response(named_file(rig, f"response.{camera}", name)), folder / copied[camera])
    return copied


def made_even(rig: Path, response: Mapping[str, str], images: Mapping[str, LineImage]) -> dict[str, LineImage]:
    """The images of cameras whose response the rig file names."""
    return {
        camera: FlatFieldImage(image, read_response(named_file(rig, f"response.{camera}", name), image.shape[1:]))
        for camera, name in response.items()
        if (image := images.get(camera)) is not None
    }
