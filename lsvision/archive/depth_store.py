"""The depth of a matched scan on disk: written strip by strip by the matching, read by every correction."""

import shutil
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from zarr.codecs import ZstdCodec

from lsvision.io import open_line_image
from lsvision.types import Depth, StoredDepth

_DEPTH, _SIGMA = "depth.zarr", "sigma.zarr"


def create_depth_store(path: Path, lines: int, width: int, strip_lines: int, *, with_sigma: bool) -> None:
    """Create an empty store, float32 mm, NaN for none, one chunk per strip; it appears whole or not at all."""
    partial = path.with_name(f"{path.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    for name in (_DEPTH, _SIGMA) if with_sigma else (_DEPTH,):
        zarr.create_array(
            partial / name,
            shape=(lines, width),
            chunks=(min(strip_lines, lines), width),
            dtype=np.float32,
            fill_value=np.nan,
            compressors=[ZstdCodec(level=1, checksum=True)],
        )
    partial.rename(path)


def write_depth(path: str, start: int, depth: Depth, *, with_sigma: bool) -> None:
    """Write a strip's depth, with its standard deviation where the store keeps that, from line ``start`` on."""
    lines = slice(start, start + len(depth.z))
    _open_array(f"{path}/{_DEPTH}")[lines] = depth.z.numpy()
    if with_sigma and depth.sigma is not None:
        _open_array(f"{path}/{_SIGMA}")[lines] = depth.sigma.numpy()


def open_depth_store(path: str) -> StoredDepth:
    """Open a store for reading."""
    sigma = Path(path, _SIGMA)
    return StoredDepth(open_line_image(Path(path, _DEPTH)), open_line_image(sigma) if sigma.is_dir() else None)


def remove_partial_chunks(store: Path | str) -> None:
    """Remove half-written chunks of killed workers from a Zarr store that no other process is writing."""
    for partial in Path(store).rglob("*.partial"):
        partial.unlink(missing_ok=True)


@lru_cache(maxsize=4)
def _open_array(path: str) -> Any:
    return zarr.open_array(path, mode="r+")
