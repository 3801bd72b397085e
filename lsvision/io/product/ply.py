"""Point clouds as binary PLY."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from lsvision.io.atomic import partial_file

_VERTEX = np.dtype([("xyz", "<f8", 3), ("rgb", "u1", 3)])
_COUNT_DIGITS = 20


def write_ply(path: Path | str, blocks: Iterable[tuple[Float[Tensor, "points 3"], UInt8[Tensor, "points 3"]]]) -> int:
    """Write coloured points, mm, block by block; positions as doubles, since a long scan leaves float32's micrometres.

    Args:
        path: final file; it appears when complete.
        blocks: points and their red, green, blue.

    Returns:
        Number of points written.

    Raises:
        ValueError: points and colours of a block that do not match.
    """
    count = 0
    with partial_file(path) as partial, partial.open("wb") as file:
        file.write(_header(count))
        for points, colors in blocks:
            if points.shape != colors.shape or points.shape[1:] != (3,) or colors.dtype != torch.uint8:
                raise ValueError(
                    "blocks: expected (points, 3) and uint8 colours alike, got "
                    f"{tuple(points.shape)} and {tuple(colors.shape)} {colors.dtype}"
                )
            vertices = np.empty(len(points), _VERTEX)
            vertices["xyz"], vertices["rgb"] = points.numpy(force=True), colors.numpy(force=True)
            file.write(vertices.tobytes())
            count += len(points)
        file.seek(0)
        file.write(_header(count))
    return count


def _header(count: int) -> bytes:
    """Header of one length for every count: it is written again when the count is known."""
    padding = " " * (_COUNT_DIGITS - len(str(count)))
    properties = [f"property double {name}" for name in "xyz"]
    properties += [f"property uchar {name}" for name in ("red", "green", "blue")]
    rows = ["ply", "format binary_little_endian 1.0", f"comment millimetres{padding}", f"element vertex {count}"]
    return ("\n".join([*rows, *properties, "end_header"]) + "\n").encode("ascii")
