"""The scan folder: ``scan.yaml`` with its rig, images and encoder log."""

from collections.abc import Iterable, Mapping
from json import dumps
from pathlib import Path
from types import MappingProxyType
from typing import cast

import torch
import yaml
from torch import Tensor

from lsvision.io.atomic import partial_folder, write_text
from lsvision.io.formats.encoder import read_encoder, write_encoder
from lsvision.io.formats.rig import read_rig, write_rig
from lsvision.io.formats.validation import Fields, read_yaml
from lsvision.io.images.line_image import open_line_image
from lsvision.io.images.tiff import write_line_image
from lsvision.types import DepthView, LineImage, Rig, Scan, StereoPair, Transport, Travel

SCAN_FORMAT = "lsvision-scan/1"
SCAN_FILE = "scan.yaml"
_EMPTY: Mapping = MappingProxyType({})


def read_scan(path: Path | str, *, repair_encoder: bool = False) -> Scan:
    """Open a scan; its images are read later, by line ranges.

    Args:
        path: the folder, or its ``scan.yaml``.
        repair_encoder: interpolate faulty lines of the encoder log instead of raising.

    Raises:
        FileFormatError: a file is missing, not what it should be, or does not fit the others.
    """
    path = Path(path)
    file = path if path.is_file() else path / SCAN_FILE
    fields = Fields(file, read_yaml(file))
    fields.choice("format", SCAN_FORMAT)
    rig = read_rig(fields.file("rig"))
    images = {key: open_line_image(fields.file(key)) for key in ("left", "right", "depth") if fields.has(key)}
    line_pitch_mm = fields.number("line_pitch_mm", above=0)
    encoder = fields.file("encoder") if fields.has("encoder") else None
    transport = fields.choice("transport", "forward", "reverse") if fields.has("transport") else "forward"
    attributes = fields.texts("attributes") if fields.has("attributes") else {}
    color_registered = fields.flag("color_registered") if fields.has("color_registered") else True
    fields.finish()
    _check_images(fields, rig, images)
    left = images["left"]
    pair = StereoPair(left, images["right"]) if "right" in images else DepthView(left, images["depth"])
    positions_mm = read_encoder(encoder, left.shape[0], repair=repair_encoder) if encoder else None
    travel = Travel(line_pitch_mm, positions_mm, cast(Transport, transport))
    return Scan(file.parent, rig, travel, pair, color_registered, attributes)


def write_scan(
    folder: Path | str,
    *,
    rig: Rig,
    travel: Travel,
    left: Iterable[Tensor],
    right: Iterable[Tensor] | None,
    depth: Iterable[Tensor] | None = None,
    lines: int,
    channels: int = 3,
    dtype: torch.dtype = torch.uint8,
    attributes: Mapping[str, str] = _EMPTY,
    color_registered: bool = True,
    extra_json: Mapping[str, dict] = _EMPTY,
) -> None:
    """Write a scan folder from strips; it appears under its name when complete.

    Args:
        folder: a new or empty folder, or an earlier scan to replace.
        left, right, depth: strips ``(lines, width, channels)`` of any height, each image taken to its end before the
            next; exactly one of right and depth. Depth is float32 z, mm, one channel, NaN where there is none.
        extra_json: plain data by file name, written beside the scan ("truth.json").

    Raises:
        ValueError: strips that do not add up to the image, or not exactly one of right and depth.
        FileFormatError: ``folder`` holds something else.
    """
    if (right is None) == (depth is None):
        raise ValueError("right, depth: expected exactly one of them")
    if travel.positions_mm is not None and len(travel.positions_mm) != lines:
        raise ValueError(f"travel.positions_mm: expected {lines} positions, got {len(travel.positions_mm)}")
    data = _scan_data(travel, attributes, color_registered, "depth" if right is None else "right")
    shape = (lines, rig.width_px, channels)
    with partial_folder(folder, marker=SCAN_FILE) as partial:
        write_rig(rig, partial / "rig.yaml")
        write_line_image(partial / "left.tif", left, shape, dtype)
        if right is not None:
            write_line_image(partial / "right.tif", right, shape, dtype)
        if depth is not None:
            write_line_image(partial / "depth.tif", depth, (lines, rig.width_px, 1), torch.float32)
        if travel.positions_mm is not None:
            write_encoder(travel.positions_mm, partial / "encoder.csv")
        for name, content in extra_json.items():
            write_text(partial / name, dumps(content, indent=2, allow_nan=False) + "\n")
        write_text(partial / SCAN_FILE, yaml.safe_dump(data, sort_keys=False))


def _scan_data(travel: Travel, attributes: Mapping[str, str], color_registered: bool, second: str) -> dict[str, object]:
    data: dict[str, object] = {
        "format": SCAN_FORMAT,
        "rig": "rig.yaml",
        "line_pitch_mm": float(travel.line_pitch_mm),
        "left": "left.tif",
        second: f"{second}.tif",
    }
    if travel.positions_mm is not None:
        data["encoder"] = "encoder.csv"
    if travel.transport != "forward":
        data["transport"] = travel.transport
    if not color_registered:
        data["color_registered"] = False
    if attributes:
        data["attributes"] = {name: str(value) for name, value in attributes.items()}
    return data


def _check_images(fields: Fields, rig: Rig, images: Mapping[str, LineImage]) -> None:
    if "left" not in images:
        raise fields.error("left", "missing")
    if ("right" in images) == ("depth" in images):
        raise fields.error("right", f"expected exactly one of right and depth, got {len(images) - 1}")
    lines = images["left"].shape[0]
    for key, image in images.items():
        if image.shape[1] != rig.width_px:
            raise fields.error(key, f"expected {rig.width_px} columns as the rig has, got {image.shape[1]}")
        if image.shape[0] != lines:
            raise fields.error(key, f"expected {lines} lines as left has, got {image.shape[0]}")
        if key == "depth" and (image.dtype != torch.float32 or image.shape[2] != 1):
            raise fields.error(key, f"expected one float32 channel, got {image.shape[2]} of {image.dtype}")
        if key != "depth" and image.dtype not in (torch.uint8, torch.uint16):
            raise fields.error(key, f"expected uint8 or uint16, got {image.dtype}")
