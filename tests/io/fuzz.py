"""Reads damaged files of every kind, within 2 GB and ten seconds each: ``python -m tests.io.fuzz FOLDER NUMBER``.

Prints, as JSON, how many inputs were read or refused by one error of ours, and whatever else came of any.
"""

import json
import logging
import random
import resource
import signal
import struct
import sys
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import google_crc32c
import numpy as np
import psutil
import tifffile
import torch
import zarr
from PIL import Image

from lsvision.errors import LsvisionError
from lsvision.io import (
    ProductLayout,
    check_product,
    export_product,
    product_writer,
    read_calibration,
    read_encoder,
    read_line_motion,
    read_product,
    read_rig,
    read_scan,
    scan_sha256,
    write_encoder,
    write_line_motion,
)
from lsvision.types import LineMotion, ProductGrid, ProductStrip
from tests.archive.archives import make_calibration, make_scan
from tests.io.formats.test_mutated import mutated
from tests.memory import peak_memory_mb

MOST_BYTES = 2**31
MOST_SECONDS = 10
LINES = 40


@dataclass(frozen=True)
class Target:
    """A file to be damaged, what reads it, and whether its last four bytes are a checksum, which is made right."""

    file: Path
    read: Callable[[], object]
    with_checksum: bool = False


def read_whole(folder: Path) -> None:
    """What ``correct`` does with a scan's files."""
    scan = read_scan(folder)
    scan_sha256(folder)
    images = (scan.images.left, getattr(scan.images, "right", None) or scan.images.depth)
    for image in images:
        for start in range(0, image.shape[0], 512):
            image.read(start, min(start + 512, image.shape[0]))


def scan_with(folder: Path, image: Callable[[Path, np.ndarray], Path]) -> tuple[Path, Path]:
    """A scan whose colours another program stored; its folder and the image."""
    make_scan(folder, LINES)
    pixels = tifffile.imread(folder / "left.tif")
    stored = image(folder, pixels)
    text = (folder / "scan.yaml").read_text().replace("left.tif", stored.name)
    (folder / "scan.yaml").write_text(text)
    return folder, stored


def as_tiff(**options: object) -> Callable[[Path, np.ndarray], Path]:
    def write(folder: Path, pixels: np.ndarray) -> Path:
        tifffile.imwrite(folder / "other.tif", pixels, photometric="rgb", metadata=None, **options)
        return folder / "other.tif"

    return write


def as_zarr(folder: Path, pixels: np.ndarray) -> Path:
    image = zarr.create_array(folder / "left.zarr", shape=pixels.shape, chunks=(20, *pixels.shape[1:]), dtype="uint8")
    image[:] = pixels
    return folder / "left.zarr"


def as_frames(folder: Path, pixels: np.ndarray) -> Path:
    (folder / "left").mkdir()
    for number, part in enumerate(np.split(pixels, 2)):
        Image.fromarray(part).save(folder / "left" / f"{number}.png")
    return folder / "left"


def product(path: Path) -> Path:
    """A small product, of two strips."""
    layout = ProductLayout(
        ProductGrid(8, 6, 0.5, 0.0, 0.0), 3, torch.uint8, 4, {"n": [0.0, 1.0, 0.0], "height_datum_mm": 790.0}
    )
    with product_writer(path, layout) as writer:
        for row in (0, 4):
            cells, colors = torch.rand(4, 6), torch.zeros(4, 6, 3, dtype=torch.uint8)
            writer.write(ProductStrip(row, colors, cells, torch.isfinite(cells), torch.zeros(4, 6, 2)))
    return path


def targets(root: Path) -> dict[str, Target]:
    """A file of every kind that a command reads."""
    made = product(root / "p.zarr")
    log, scan = root / "encoder.csv", make_scan(root / "scan", LINES)
    write_encoder(torch.arange(20.0).double(), log)
    calibration, motion = make_calibration(root / "calibration.json"), root / "motion.parquet"
    values = 0.1 * torch.rand(LINES, 4, dtype=torch.float64)
    write_line_motion(LineMotion(values, torch.diag_embed(values.square())), motion)

    def use_product() -> None:
        check_product(made)
        opened = read_product(made)
        opened.read(0, 1)
        for kind in ("tiff", "ply"):
            export_product(opened, kind, root / "exported")

    found = {
        "rig": Target(scan / "rig.yaml", lambda: read_rig(scan / "rig.yaml")),
        "scan": Target(scan / "scan.yaml", lambda: read_whole(scan)),
        "left": Target(scan / "left.tif", lambda: read_whole(scan)),
        "depth": Target(scan / "depth.tif", lambda: read_whole(scan)),
        "encoder": Target(log, lambda: read_encoder(log, 20, line_pitch_mm=1.0)),
        "repaired": Target(log, lambda: read_encoder(log, 20, line_pitch_mm=1.0, repair=True)),
        "calibration": Target(calibration, lambda: read_calibration(calibration)),
        "line motion": Target(motion, lambda: read_line_motion(motion, LINES)),
    }
    kinds = {
        "plain": as_tiff(), "deflate": as_tiff(compression="zlib", rowsperstrip=8), "lzw": as_tiff(compression="lzw"),
        "jpeg": as_tiff(compression="jpeg"), "tiles": as_tiff(compression="zstd", tile=(16, 16), bigtiff=True),
    }  # fmt: skip
    for name, kind in kinds.items():
        folder, image = scan_with(root / name, kind)
        found[name] = Target(image, lambda folder=folder: read_whole(folder))
    folder, image = scan_with(root / "zarr", as_zarr)
    found["zarr metadata"] = Target(image / "zarr.json", lambda folder=folder: read_whole(folder))
    found["zarr chunk"] = Target(image / "c" / "1" / "0" / "0", lambda folder=folder: read_whole(folder))
    folder, image = scan_with(root / "frames", as_frames)
    found["frame"] = Target(image / "1.png", lambda folder=folder: read_whole(folder))
    for name in ("zarr.json", "height/zarr.json", "color/0/zarr.json", "source/0/zarr.json", "valid/0/zarr.json"):
        found[f"product {name}"] = Target(made / name, use_product)
    for name in ("color/0/c/0/1/0", "height/0/c/1/0", "valid/0/c/0/0", "source/0/c/0/0/0"):
        found[f"product {name}"] = Target(made / name, use_product)
        found[f"product {name}, its checksum right"] = Target(made / name, use_product, with_checksum=True)
    return found


def damaged(content: bytes, target: Target, chance: random.Random) -> bytes:
    """The content of a target with random damage, every other time to its head alone, which is what is believed."""
    if not target.with_checksum:
        head = 256 if chance.random() < 0.5 else len(content)
        return mutated(content[:head], chance) + content[head:]
    body = mutated(content[:-4], chance)
    return body + struct.pack("<I", google_crc32c.value(body))


def fault_of(read: Callable[[], object]) -> str | None:
    """What came of reading, other than success or one line of ours."""
    signal.setitimer(signal.ITIMER_REAL, MOST_SECONDS)
    try:
        read()
    except LsvisionError as error:
        return None if len(str(error).splitlines()) == 1 else f"several lines: {str(error)[:200]!r}"
    except Exception as error:
        return f"{type(error).__name__}: {str(error)[:200]}"
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
    return None


def late(*_: object) -> None:
    raise TimeoutError(f"more than {MOST_SECONDS} s")


def main(root: Path, number: int) -> None:
    """Damage every target in turn, so often that there are so many inputs, with the same seed every time."""
    warnings.simplefilter("ignore")
    logging.getLogger("tifffile").setLevel(logging.CRITICAL)  # as the commands do
    signal.signal(signal.SIGALRM, late)
    found = targets(root)
    for target in found.values():
        target.read()
    used = psutil.Process().memory_info().vms
    resource.setrlimit(resource.RLIMIT_AS, (used + MOST_BYTES, used + MOST_BYTES))
    faults, inputs = [], 0
    for name, target in found.items():
        whole, chance = target.file.read_bytes(), random.Random(f"{name} {number}")
        for _ in range(-(-number // len(found))):
            target.file.write_bytes(damaged(whole, target, chance))
            fault = fault_of(target.read)
            inputs += 1
            if fault is not None:
                faults.append(f"{name}: {fault}")
        target.file.write_bytes(whole)
    print(json.dumps({"inputs": inputs, "faults": faults, "peak_mb": round(peak_memory_mb())}))


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
