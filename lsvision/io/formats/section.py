"""The nominal section of an object: a CSV with the header ``across_mm,height_mm``, comments after #, or one by name.

Source: EN 13674-1 (``sections/EN60E1.csv``).
"""

import io
from importlib.resources import files
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lsvision.errors import FileFormatError
from lsvision.io.formats.validation import read_text
from lsvision.types import Section

HEADER = "across_mm,height_mm"
SECTIONS = ("EN60E1",)
_FEWEST_POINTS = 8
_LARGEST_MM = 1000.0  # of a coordinate: beyond it is no millimetre
_MOST_BYTES = 1 << 24


def read_section(name: Path | str) -> Section:
    """A section by its name, one of ``SECTIONS``, or from a file.

    Raises:
        FileFormatError: no such file, or its points are not an outline that goes from left to right; names the row.
    """
    if str(name) in SECTIONS:
        path = Path(str(files("lsvision.io.formats") / "sections" / f"{name}.csv"))
        across, height = _parse(path).T.tolist()
        return Section(str(name), tuple(across), tuple(height))
    across, height = _parse(Path(name)).T.tolist()
    return Section(Path(name).stem, tuple(across), tuple(height))


def _parse(path: Path) -> NDArray[np.float64]:
    """Points of a file, (across, height), mm."""
    rows = [
        (number, row.split("#")[0].strip()) for number, row in enumerate(read_text(path, _MOST_BYTES).splitlines(), 1)
    ]
    rows = [(number, row) for number, row in rows if row]
    if not rows or rows[0][1].replace(" ", "") != HEADER:
        raise FileFormatError(path, f"expected the header {HEADER}")
    numbers, texts = [number for number, _ in rows[1:]], [row for _, row in rows[1:]]
    if len(texts) < _FEWEST_POINTS:
        raise FileFormatError(path, f"expected at least {_FEWEST_POINTS} points, got {len(texts)}")
    for number, text in zip(numbers, texts, strict=True):
        if text.count(",") != 1:
            raise FileFormatError(path, f"row {number}: expected two columns, got {text.count(',') + 1}")
    try:
        points = np.loadtxt(io.StringIO("\n".join(texts)), delimiter=",", ndmin=2)
    except ValueError as error:
        raise FileFormatError(path, f"expected numbers in two columns: {error}") from error
    sound = (np.isfinite(points) & (np.abs(points) <= _LARGEST_MM)).all(1)
    if not sound.all():
        raise FileFormatError(
            path, f"row {numbers[int(np.argmin(sound))]}: expected two finite numbers of at most {_LARGEST_MM:g} mm"
        )
    rises = np.diff(points[:, 0]) > 0
    if not rises.all():
        raise FileFormatError(
            path, f"row {numbers[int(np.argmin(rises)) + 1]}: across_mm: expected more than in the row before"
        )
    return np.asarray(points, np.float64)
