"""Point clouds as LAZ, the compressed form of LAS 1.4."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from torch import Tensor

from lsvision.errors import ConfigError
from lsvision.io.atomic import partial_file

_STEP_MM = 1e-3  # coordinates are whole numbers of it: 2.1 km fit
_COLORED_POINTS = 7  # point format with red, green and blue, of LAS 1.4: counts beyond 2^32


def write_laz(path: Path | str, blocks: Iterable[tuple[Float[Tensor, "points 3"], UInt8[Tensor, "points 3"]]]) -> int:
    """Write coloured points, mm, block by block, rounded to a micrometre; needs the extra ``pointcloud``.

    Args:
        path: final file; it appears when complete.
        blocks: points and their red, green, blue.

    Returns:
        Number of points written.

    Raises:
        ConfigError: laspy is not installed.
    """
    try:
        import laspy
    except ImportError as error:
        raise ConfigError("export: laz needs laspy: pip install 'lsvision[pointcloud]'") from error
    header = laspy.LasHeader(point_format=_COLORED_POINTS, version="1.4")
    header.scales, header.offsets = np.full(3, _STEP_MM), np.zeros(3)
    header.generating_software, header.system_identifier = "lsvision", "coordinates in millimetres"
    count = 0
    with (
        partial_file(path) as partial,
        partial.open("wb") as file,
        laspy.open(file, mode="w", header=header, do_compress=True, closefd=False) as writer,
    ):
        for points, colors in blocks:
            record = laspy.ScaleAwarePointRecord.zeros(len(points), header=header)
            record.x, record.y, record.z = points.numpy(force=True).T
            record.red, record.green, record.blue = colors.numpy(force=True).T.astype(np.uint16) * 257
            writer.write_points(record)
            count += len(points)
    return count
