"""The scan folder: ``scan.yaml`` with its rig, images and encoder log."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Literal

import torch
import yaml
from torch import Tensor

from lsvision.errors import FileFormatError
from lsvision.io.atomic import partial_folder, write_text
from lsvision.io.formats.encoder import read_encoder, write_encoder
from lsvision.io.formats.rig import read_rig, write_rig
from lsvision.io.formats.validation import named_file, read_entries, read_yaml
from lsvision.io.images.line_image import open_line_image
from lsvision.io.images.tiff import write_line_image
from lsvision.io.json_file import write_json
from lsvision.schema import Checked, Positive, Says, Text
from lsvision.types import LineImage, Rig, Scan, Transport, Travel

ScanFormat = Literal["lsvision-scan/1"]
SCAN_FORMAT: ScanFormat = "lsvision-scan/1"
SCAN_FILE = "scan.yaml"
# Entries that name a file or folder of the scan.
FILE_KEYS = ("rig", "left", "right", "depth", "encoder")
IMAGE_KEYS = ("left", "right", "depth")
_EMPTY: Mapping = MappingProxyType({})


@dataclass(frozen=True)
class ScanEntries(Checked):
    """The entries of ``scan.yaml``."""

    format: ScanFormat
    rig: Text
    line_pitch_mm: Positive
    left: Text
    right: Text | None = None
    depth: Text | None = None
    encoder: Text | None = None
    transport: Transport | None = None
    attributes: dict[str, Annotated[str | int | float, Says("text or a finite number")]] | None = None
    color_registered: bool | None = None


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
    entries = read_entries(ScanEntries, read_yaml(file), file)
    files: dict[str, Path] = {
        key: named_file(file, key, str(name)) for key in FILE_KEYS if (name := getattr(entries, key)) is not None
    }
    rig = read_rig(files["rig"])
    images = {key: open_line_image(named) for key, named in files.items() if key in IMAGE_KEYS}
    check_images(file, rig, images)
    left = images["left"]
    encoder = files.get("encoder")
    return Scan(
        path=file.parent,
        rig=rig,
        travel=Travel(
            line_pitch_mm=entries.line_pitch_mm,
            positions_mm=read_encoder(encoder, left.shape[0], repair=repair_encoder) if encoder else None,
            transport=entries.transport or "forward",
        ),
        left=left,
        right=images.get("right"),
        depth=images.get("depth"),
        color_registered=entries.color_registered is not False,
        attributes={name: str(value) for name, value in (entries.attributes or {}).items()},
    )


def scan_files(folder: Path | str) -> list[Path]:
    """The files that make a scan, in a fixed order: ``scan.yaml``, and every file or folder that it names.

    A name whose file is missing is listed as well.

    Raises:
        FileFormatError: ``scan.yaml`` cannot be read.
    """
    folder = Path(folder)
    data = read_yaml(folder / SCAN_FILE)
    entries = data if isinstance(data, Mapping) else {}
    files = [folder / SCAN_FILE]
    for named in (folder / str(entries[key]) for key in FILE_KEYS if entries.get(key) is not None):
        files += sorted(file for file in named.rglob("*") if file.is_file()) if named.is_dir() else [named]
    return files


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
            write_json(partial / name, content, strict=True)
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


def check_images(file: Path, rig: Rig, images: Mapping[str, LineImage]) -> None:
    """Check that the images of a scan, by key, fit each other and the rig.

    Raises:
        FileFormatError: they do not; names ``file`` and the key.
    """
    if ("right" in images) == ("depth" in images):
        raise FileFormatError(file, f"expected exactly one of right and depth, got {len(images) - 1}", "right")
    lines = images["left"].shape[0]
    for key, image in images.items():
        if image.shape[1] != rig.width_px:
            raise FileFormatError(file, f"expected {rig.width_px} columns as the rig has, got {image.shape[1]}", key)
        if image.shape[0] != lines:
            raise FileFormatError(file, f"expected {lines} lines as left has, got {image.shape[0]}", key)
        if key == "depth" and (image.dtype != torch.float32 or image.shape[2] != 1):
            raise FileFormatError(file, f"expected one float32 channel, got {image.shape[2]} of {image.dtype}", key)
        if key != "depth" and image.dtype not in (torch.uint8, torch.uint16):
            raise FileFormatError(file, f"expected uint8 or uint16, got {image.dtype}", key)
