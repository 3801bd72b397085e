"""The scan folder: ``scan.yaml`` with its rig, images and encoder log."""

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import torch
import yaml
from torch import Tensor

from lsvision.errors import FileFormatError
from lsvision.geometry import zero_disparity_mm
from lsvision.io.atomic import partial_folder, write_text
from lsvision.io.formats.encoder import read_encoder_log, write_encoder
from lsvision.io.formats.line_motion import read_line_motion, write_line_motion
from lsvision.io.formats.raw_rig import read_rig_pair, write_raw_rig
from lsvision.io.formats.response import made_even, write_response
from lsvision.io.formats.rig import write_rig
from lsvision.io.formats.validation import named_file, read_entries, read_yaml
from lsvision.io.images.depth_map import PlausibleDepth
from lsvision.io.images.line_image import open_line_image
from lsvision.io.images.tiff import write_line_image
from lsvision.io.json_file import write_json
from lsvision.schema import Checked, Positive, Says, Text
from lsvision.types import (
    CameraResponse,
    DepthView,
    LineImage,
    LineMotion,
    MissingLines,
    RawRig,
    Rig,
    Scan,
    StereoPair,
    Transport,
    Travel,
)

ScanFormat = Literal["lsvision-scan/1"]
SCAN_FORMAT: ScanFormat = "lsvision-scan/1"
SCAN_FILE = "scan.yaml"
# Entries that name a file or folder of the scan.
FILE_KEYS = ("rig", "left", "right", "depth", "encoder", "line_motion")
IMAGE_KEYS = ("left", "right", "depth")


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
    line_motion: Text | None = None
    transport: Transport | None = None
    color_registered: bool | None = None
    attributes: dict[str, Annotated[str | int | float, Says("text or a finite number")]] | None = None


@dataclass(frozen=True)
class NewScan:
    """A scan to be written.

    ``left``, ``right`` and ``depth`` are strips ``(lines, width, channels)`` of any height, each image taken to its end
    before the next; exactly one of right and depth is given. Depth is float32 z, mm, one channel, NaN where there is
    none. The images are as wide as the rig's, and those of ``raw_rig`` where there is one, which is written in place of
    ``rig``. ``extra_json`` is plain data by file name, written beside the scan ("truth.json"), ``responses`` are those
    of cameras, which nothing names.

    Raises:
        ValueError: not exactly one of right and depth, or a log of another length.
    """

    rig: Rig
    travel: Travel
    left: Iterable[Tensor]
    right: Iterable[Tensor] | None
    lines: int
    depth: Iterable[Tensor] | None = None
    channels: int = 3
    dtype: torch.dtype = torch.uint8
    attributes: Mapping[str, str] = field(default_factory=dict)
    color_registered: bool = True
    line_motion: LineMotion | None = None
    raw_rig: RawRig | None = None
    extra_json: Mapping[str, dict] = field(default_factory=dict)
    responses: Mapping[str, CameraResponse] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if (self.right is None) == (self.depth is None):
            raise ValueError("right, depth: expected exactly one of them")
        positions_mm = self.travel.positions_mm
        if positions_mm is not None and len(positions_mm) != self.lines:
            raise ValueError(f"travel.positions_mm: expected {self.lines} positions, got {len(positions_mm)}")
        if self.line_motion is not None and self.line_motion.lines != self.lines:
            raise ValueError(f"line_motion: expected {self.lines} lines, got {self.line_motion.lines}")

    @property
    def width_px(self) -> int:
        """Columns of the images."""
        return (self.raw_rig or self.rig).width_px

    def entries(self) -> ScanEntries:
        """What ``scan.yaml`` says; an entry at its default is None."""
        return ScanEntries(
            format=SCAN_FORMAT,
            rig="rig.yaml",
            line_pitch_mm=self.travel.line_pitch_mm,
            left="left.tif",
            right=None if self.right is None else "right.tif",
            depth=None if self.depth is None else "depth.tif",
            encoder=None if self.travel.positions_mm is None else "encoder.csv",
            line_motion=None if self.line_motion is None else "motion.parquet",
            transport=None if self.travel.transport == "forward" else self.travel.transport,
            color_registered=None if self.color_registered else False,
            attributes={name: str(value) for name, value in self.attributes.items()} or None,
        )


def read_scan(
    path: Path | str,
    *,
    repair_encoder: bool = False,
    missing_lines: MissingLines = "refuse",
    as_taken: bool = False,
) -> Scan:
    """Open a scan; its images are read later, by line ranges.

    Args:
        path: the folder, or its ``scan.yaml``.
        repair_encoder: interpolate faulty lines of the encoder log instead of raising.
        missing_lines: with "mark" images may lack frames or chunks, whose lines count as missing.
        as_taken: leave out the response that the rig may name: the images are the cameras' raw codes.

    Raises:
        FileFormatError: a file is missing, not what it should be, or does not fit the others.
    """
    path = Path(path)
    file = path if path.is_file() else path / SCAN_FILE
    entries = read_entries(ScanEntries, read_yaml(file), file)
    files: dict[str, Path] = {
        key: named_file(file, key, str(name)) for key in FILE_KEYS if (name := getattr(entries, key)) is not None
    }
    cameras = read_rig_pair(files["rig"])
    rig = cameras.rig
    images = {key: open_line_image(named, missing_lines) for key, named in files.items() if key in IMAGE_KEYS}
    check_images(file, cameras.image_width_px, images)
    if cameras.raw is not None and "depth" in images:
        raise FileFormatError(
            file, "expected the rectified rig that the depth was computed with, lsvision-rig/1", "rig"
        )
    if not as_taken:
        images |= made_even(files["rig"], cameras.response, images)
    left = images["left"]
    if "depth" in images:
        images["depth"] = _plausible_depth(file, rig, images["depth"])
    pitch = entries.line_pitch_mm
    log = files.get("encoder")
    read = read_encoder_log(log, left.shape[0], line_pitch_mm=pitch, repair=repair_encoder) if log else None
    travel = Travel(
        pitch,
        read.positions_mm if read else None,
        entries.transport or "forward",
        sigma_mm=read.sigma_mm if read else None,
    )
    shaken = files.get("line_motion")
    return Scan(
        path=file.parent,
        rig=rig,
        travel=travel,
        images=StereoPair(left, images["right"]) if "right" in images else DepthView(left, images["depth"]),
        color_registered=entries.color_registered is not False,
        attributes={name: str(value) for name, value in (entries.attributes or {}).items()},
        line_motion=read_line_motion(shaken, left.shape[0], travel) if shaken else None,
        raw_rig=cameras.raw,
    )


def write_scan(folder: Path | str, scan: NewScan) -> None:
    """Write a scan folder from strips; it appears under its name when complete.

    Args:
        folder: a new or empty folder, or an earlier scan to replace.

    Raises:
        ValueError: strips that do not add up to the image.
        FileFormatError: ``folder`` holds something else.
    """
    shape = (scan.lines, scan.width_px, scan.channels)
    with partial_folder(folder, marker=SCAN_FILE) as partial:
        if scan.raw_rig is None:
            write_rig(scan.rig, partial / "rig.yaml")
        else:
            write_raw_rig(scan.raw_rig, partial / "rig.yaml")
        write_line_image(partial / "left.tif", scan.left, shape, scan.dtype)
        if scan.right is not None:
            write_line_image(partial / "right.tif", scan.right, shape, scan.dtype)
        if scan.depth is not None:
            write_line_image(partial / "depth.tif", scan.depth, (scan.lines, scan.width_px, 1), torch.float32)
        if scan.travel.positions_mm is not None:
            write_encoder(scan.travel.positions_mm, partial / "encoder.csv")
        if scan.line_motion is not None:
            write_line_motion(scan.line_motion, partial / "motion.parquet")
        for name, content in scan.extra_json.items():
            write_json(partial / name, content, strict=True)
        for name, response in scan.responses.items():
            write_response(response, partial / name)
        entries = {key: value for key, value in asdict(scan.entries()).items() if value is not None}
        write_text(partial / SCAN_FILE, yaml.safe_dump(entries, sort_keys=False))


def _plausible_depth(file: Path, rig: Rig, stored: LineImage) -> PlausibleDepth:
    """A scan's depth map without what the rig cannot have seen.

    Raises:
        FileFormatError: its values are in another unit, or no depths.
    """
    depth = PlausibleDepth(stored, zero_disparity_mm(rig))
    problem = depth.unit_problem()
    if problem is not None:
        raise FileFormatError(file, problem, "depth")
    return depth


def check_images(file: Path, width_px: int, images: Mapping[str, LineImage]) -> None:
    """Check that the images of a scan, by key, fit each other and the width of the rig's.

    Raises:
        FileFormatError: they do not; names ``file`` and the key.
    """
    if ("right" in images) == ("depth" in images):
        raise FileFormatError(file, f"expected exactly one of right and depth, got {len(images) - 1}", "right")
    lines = images["left"].shape[0]
    for key, image in images.items():
        if image.shape[1] != width_px:
            raise FileFormatError(file, f"expected {width_px} columns as the rig has, got {image.shape[1]}", key)
        if image.shape[0] != lines:
            raise FileFormatError(file, f"expected {lines} lines as left has, got {image.shape[0]}", key)
        if key == "depth" and (image.dtype != torch.float32 or image.shape[2] != 1):
            raise FileFormatError(file, f"expected one float32 channel, got {image.shape[2]} of {image.dtype}", key)
        if key != "depth" and image.dtype not in (torch.uint8, torch.uint16):
            raise FileFormatError(file, f"expected uint8 or uint16, got {image.dtype}", key)
