"""Writing a product: laid out once, its rows written in any order and by any number of processes."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
import zarr
from torch import Tensor

from lsvision.errors import FileFormatError
from lsvision.image.tiling import in_parallel
from lsvision.io.atomic import partial_folder, replace_folder
from lsvision.io.product.layout import ROOT_METADATA, ProductLayout, create_images, image_names, strip_images
from lsvision.io.product.pyramid import halve
from lsvision.types import ProductStrip


class ProductRows:
    """The images of a product that is being written, in a folder that is not its final one.

    Several processes may write rows at once as long as no two share a chunk.

    Args:
        folder: the folder that ``create_product`` made.

    Raises:
        FileFormatError: the folder holds no product.
    """

    def __init__(self, folder: Path | str) -> None:
        try:
            root = zarr.open_group(folder, mode="r+")
            self._levels: dict[str, list[Any]] = {name: open_levels(root[name]) for name in image_names(root)}
        except Exception as error:  # damaged metadata surfaces as any of a dozen types
            raise FileFormatError(folder, f"not a product to be written: {error}") from error

    def write(self, strip: ProductStrip) -> None:
        """Write a strip's rows at every level of the pyramid. Strips that are whole chunks are written fastest.

        Raises:
            ValueError: images of another shape or dtype, rows outside the grid, or rows that split cells of the
                pyramid.
        """
        self._check_rows(strip)
        self._check_images(strip)
        images = strip_images(strip)
        in_parallel(
            lambda name: write_levels(self._levels[name], strip.row, images[name], average=name == "color"), images
        )

    def _check_rows(self, strip: ProductStrip) -> None:
        start, stop, grid_rows = strip.row, strip.row + len(strip.height), self._levels["height"][0].shape[0]
        if start < 0 or stop > grid_rows:
            raise ValueError(f"row: expected a block within 0..{grid_rows}, got {start}..{stop}")
        coarsest = 2 ** (len(self._levels["height"]) - 1)
        if start % coarsest or (stop != grid_rows and stop % coarsest):
            raise ValueError(f"row: expected blocks of whole groups of {coarsest} rows, got {start}..{stop}")

    def _check_images(self, strip: ProductStrip) -> None:
        if (strip.sigma is not None) != ("sigma" in self._levels):
            raise ValueError(f"sigma: the product {'has none' if strip.sigma is not None else 'needs it'}")
        for name, block in strip_images(strip).items():
            image = self._levels[name][0]
            shape = (len(strip.height), image.shape[-1], *image.shape[:-2])
            dtype = torch.from_numpy(np.empty(0, image.dtype)).dtype
            if tuple(block.shape) != shape or block.dtype != dtype:
                raise ValueError(f"{name}: expected {shape} {dtype}, got {tuple(block.shape)} {block.dtype}")


def open_levels(group: Any) -> list[Any]:
    """The levels of an image's pyramid, finest first, for writing."""
    # An empty chunk is written too: a missing chunk is then always a lost one.
    return [level.with_config({"write_empty_chunks": True}) for _, level in sorted(group.arrays())]


def write_levels(levels: Sequence[Any], row: int, block: Tensor, *, average: bool) -> None:
    """Write rows of an image, from ``row`` on, at every level of its pyramid."""
    for index, level in enumerate(levels):
        first = row >> index
        if block.ndim == 3:
            level[:, first : first + len(block)] = block.movedim(-1, 0).numpy(force=True)
        else:
            level[first : first + len(block)] = block.numpy(force=True)
        if index + 1 < len(levels):
            block = halve(block, average=average)


def create_product(folder: Path | str, layout: ProductLayout) -> ProductRows:
    """Create an empty product, every cell invalid, in a folder that takes the product's name when it is complete."""
    create_images(folder, layout)
    return ProductRows(folder)


def complete_product(folder: Path | str, target: Path | str) -> None:
    """Give a product whose rows are all written its final name; an earlier product there is replaced.

    Raises:
        FileFormatError: ``target`` holds something else.
    """
    replace_folder(folder, target, marker=ROOT_METADATA)


@contextmanager
def product_writer(target: Path | str, layout: ProductLayout) -> Iterator[ProductRows]:
    """Write a product from strips in memory; it appears under its name when the block ends without an error.

    The archive writes products strip by strip from several processes instead; this is for callers of the stages.

    Args:
        target: final folder (``<scan>.zarr``): new, empty, or an earlier product to replace.

    Raises:
        FileFormatError: ``target`` holds something else.
        WriteError: the disk is full.
    """
    with partial_folder(target, marker=ROOT_METADATA) as folder:
        yield create_product(folder, layout)
