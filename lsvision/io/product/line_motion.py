"""The motion from line to line that a product was corrected for: a value and a sigma by line of the scan."""

from typing import Any

import numpy as np
import torch
import zarr
from torch import Tensor
from zarr.codecs import Crc32cCodec, ZstdCodec

from lsvision.errors import FileFormatError
from lsvision.io.formats.line_motion import SIGMA_COLUMNS, VALUE_COLUMNS
from lsvision.types import LineMotion

LINE_MOTION_GROUP = "line_motion"
_CHUNK_LINES = 1 << 16
_COLUMNS = (*VALUE_COLUMNS, *SIGMA_COLUMNS)
_CODECS = (ZstdCodec(level=3), Crc32cCodec())


def create_line_motion(root: Any, motion: LineMotion) -> None:
    """Write the group ``line_motion`` of a product: ``dx_mm``, .. and ``dx_sigma_mm``, .., float64, with units."""
    group = root.create_group(LINE_MOTION_GROUP)
    for name, values in zip(_COLUMNS, torch.cat([motion.values, motion.sigma], dim=1).T, strict=True):
        array = group.create_array(
            name,
            shape=values.shape,
            chunks=(min(_CHUNK_LINES, len(values)),),
            dtype=np.float64,
            fill_value=np.nan,
            compressors=_CODECS,
            dimension_names=("line",),
            attributes={"unit": _unit_of(name)},
            config={"write_empty_chunks": True},
        )
        array[:] = values.numpy()


def read_columns(root: Any) -> dict[str, Tensor]:
    """The arrays of the group by name, ``(lines,)``.

    Raises:
        KeyError: the product has no such group, or it lacks an array.
    """
    return {name: torch.from_numpy(np.asarray(root[f"{LINE_MOTION_GROUP}/{name}"][:])) for name in _COLUMNS}


def check_line_motion(path: Any, root: zarr.Group, expected: bool) -> None:
    """Check that a product has the motion from line to line that its metadata speak of, and that it is possible.

    Args:
        path: of the product, for errors. expected: whether the metadata speak of one.

    Raises:
        FileFormatError: it has none, or an array that is missing, damaged, of another length or unit, or not finite.
    """
    if (LINE_MOTION_GROUP in root) != expected:
        raise FileFormatError(path, f"expected {'one' if expected else 'none'} as the metadata say", LINE_MOTION_GROUP)
    lines = None
    for name in _COLUMNS if expected else ():
        key = f"{LINE_MOTION_GROUP}/{name}"
        try:
            array: Any = root[key]
            values = np.asarray(array[:])
        except Exception as error:  # on damaged data each codec raises a type of its own
            raise FileFormatError(path, f"missing or damaged: {error}", key) from error
        lines = values.shape if lines is None else lines
        if values.ndim != 1 or values.shape != lines:
            raise FileFormatError(path, f"expected a value for each line, got {values.shape} values", key)
        if array.attrs.get("unit") != _unit_of(name):
            raise FileFormatError(path, f"expected the unit {_unit_of(name)}", key)
        if not np.isfinite(values).all() or (name in SIGMA_COLUMNS and (values < 0).any()):
            raise FileFormatError(path, "expected finite numbers, and sigmas from 0 on", key)


def _unit_of(name: str) -> str:
    return "radian" if name.endswith("_rad") else "millimeter"
