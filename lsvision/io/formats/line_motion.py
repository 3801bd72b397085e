"""The motion from line to line as a Parquet file: a row for every line of the scan, in their order.

``line`` counts from 0. ``dx_mm``, ``dz_mm``, ``roll_rad`` and ``dy_mm`` are displacements from where n alone puts the
object; a column that is not there is a component that nobody measured, and zero. Each may have a standard deviation,
``dx_sigma_mm`` and so on, and two of them a correlation, ``dx_roll_correlation``; without sigma nothing is said about
how well a component is known. What was found out about the components stands in the file's metadata, if anywhere.
"""

import io
import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from lsvision.errors import FileFormatError
from lsvision.geometry import uneven_travel
from lsvision.io.atomic import partial_file
from lsvision.io.formats.validation import on_one_line, read_bytes, read_entries
from lsvision.io.json_file import json_text
from lsvision.schema import near_hint
from lsvision.types import LINE_COMPONENTS, LineFinding, LineMotion, SectionFit, Travel

if TYPE_CHECKING:
    import polars

VALUE_COLUMNS = ("dx_mm", "dz_mm", "roll_rad", "dy_mm")  # in the order of LINE_COMPONENTS
SIGMA_COLUMNS = ("dx_sigma_mm", "dz_sigma_mm", "roll_sigma_rad", "dy_sigma_mm")
_PAIRS = {
    f"{LINE_COMPONENTS[i]}_{LINE_COMPONENTS[j]}_correlation": (i, j)
    for i, j in combinations(range(len(LINE_COMPONENTS)), 2)
}
_COLUMNS = ("line", *VALUE_COLUMNS, *SIGMA_COLUMNS, *_PAIRS)
_FINDINGS, _SECTION = "lsvision.findings", "lsvision.section"  # keys of the file's metadata

_MOST_BYTES = 1 << 28  # a million lines with all columns
_LARGEST = {"dx_mm": 100.0, "dz_mm": 100.0, "roll_rad": 0.5}  # beyond it is a distance, or an angle in degrees
_ROUNDING = 1e-6  # of correlations that were computed from covariances


def write_line_motion(motion: LineMotion, path: Path | str) -> None:
    """Write all components, with the sigmas and correlations that are known, and the findings."""
    import polars  # takes a moment, which a scan without such a file need not wait for

    sigma = motion.sigma
    columns = {"line": torch.arange(motion.lines)}
    for name, values in (*zip(VALUE_COLUMNS, motion.values.T, strict=True), *zip(SIGMA_COLUMNS, sigma.T, strict=True)):
        columns[name] = values
    for name, (i, j) in _PAIRS.items():
        scale = sigma[:, i] * sigma[:, j]
        columns[name] = torch.where(scale > 0, motion.covariance[:, i, j] / scale, 0.0).clamp(-1, 1)
    always = ("line", *VALUE_COLUMNS)
    kept = {name: values.numpy() for name, values in columns.items() if name in always or bool(values.any())}
    found = {_FINDINGS: json_text([asdict(finding) for finding in motion.findings])} if motion.findings else {}
    if motion.section is not None:
        found[_SECTION] = json_text(asdict(motion.section))
    with partial_file(path) as partial:
        polars.DataFrame(kept).write_parquet(partial, metadata=found or None)


def read_line_motion(path: Path | str, lines: int, travel: Travel | None = None) -> LineMotion:
    """Read the motion of a scan.

    Args:
        lines: of the scan. travel: of the scan, whose lines δy must leave in their order; None where that is known.

    Raises:
        FileFormatError: no such file, other columns, a line too many or too few, or a value that is not possible; names
            the column.
    """
    path = Path(path)
    columns, found = _read_table(path, lines)
    section = _section(path, found.get(_SECTION))
    if not torch.equal(columns["line"], torch.arange(lines, dtype=torch.float64)):
        off = int((columns["line"] != torch.arange(lines)).nonzero()[0, 0])
        raise FileFormatError(path, f"expected every line in order, got {columns['line'][off]:g} in row {off}", "line")
    _check_values(path, columns)
    none = torch.zeros(lines, dtype=torch.float64)
    values = torch.stack([columns.get(name, none) for name in VALUE_COLUMNS], dim=1)
    sigma = torch.stack([columns.get(name, none) for name in SIGMA_COLUMNS], dim=1)
    covariance = sigma[:, :, None] * sigma[:, None, :] * _correlations(path, columns, lines)
    motion = LineMotion(values, covariance, _findings(path, found.get(_FINDINGS), columns), section)
    if travel is not None:
        try:
            uneven_travel(travel, motion)
        except ValueError:
            raise FileFormatError(path, "the lines would not follow each other along the travel", "dy_mm") from None
    return motion


def _read_table(path: Path, lines: int) -> tuple[dict[str, Tensor], Mapping[str, str]]:
    """The columns, float64, of a file with so many rows, and its metadata."""
    import polars

    stream = io.BytesIO(read_bytes(path, _MOST_BYTES))
    try:
        schema = polars.read_parquet_schema(stream)
        found = polars.read_parquet_metadata(stream)
        rows = polars.scan_parquet(stream).select(polars.len()).collect().item()
    except (Exception, polars.exceptions.PanicException) as error:  # a damaged file surfaces as any of a dozen types
        raise FileFormatError(path, f"expected Parquet: {on_one_line(error)}") from error
    _check_schema(path, schema)
    if rows != lines:
        raise FileFormatError(path, f"expected {lines} rows, one for every line of the scan, got {rows}", "line")
    try:
        table = polars.read_parquet(stream, columns=list(schema)).cast(polars.Float64).fill_null(float("nan"))
    except (Exception, polars.exceptions.PanicException) as error:
        raise FileFormatError(path, f"damaged: {on_one_line(error)}") from error
    if table.height != lines:
        raise FileFormatError(path, f"damaged: {table.height} of {lines} rows", "line")
    return {name: torch.from_numpy(table[name].to_numpy(writable=True)) for name in table.columns}, found


def _check_schema(path: Path, schema: "Mapping[str, polars.DataType]") -> None:
    """Check that a file has the columns of such a file, with numbers in them, and at least one component."""
    for name, kind in schema.items():
        if name not in _COLUMNS:
            raise FileFormatError(path, f"unknown column; {near_hint(name, _COLUMNS)}", on_one_line(name))
        if not (kind.is_integer() or kind.is_float()):
            raise FileFormatError(path, f"expected numbers, got {on_one_line(kind)}", name)
    for name in ("line", *(() if set(VALUE_COLUMNS) & set(schema) else ("dz_mm",))):
        if name not in schema:
            raise FileFormatError(path, f"missing; a file has line and some of {', '.join(VALUE_COLUMNS)}", name)


def _check_values(path: Path, columns: dict[str, Tensor]) -> None:
    for name, values in columns.items():
        low, high = _range_of(name)
        wrong = ~((values >= low) & (values <= high) & values.isfinite())
        if bool(wrong.any()):
            row = int(wrong.nonzero()[0, 0])
            least, most = f" >= {low:g}" if low > -torch.inf else "", f" <= {high:g}" if high < torch.inf else ""
            expected = f"a finite number{least}{' and' if least and most else ''}{most}"
            raise FileFormatError(path, f"line {row}: expected {expected}, got {values[row]:g}", name)
    for value, sigma in zip(VALUE_COLUMNS, SIGMA_COLUMNS, strict=True):
        if sigma in columns and value not in columns:
            raise FileFormatError(path, f"the standard deviation of a component without {value}", sigma)


def _range_of(column: str) -> tuple[float, float]:
    """Least and greatest value that a column may have."""
    if column in _PAIRS:
        return -1.0, 1.0
    largest = _LARGEST.get(column, torch.inf)
    return (0.0 if column in SIGMA_COLUMNS else -largest), largest


def _correlations(path: Path, columns: dict[str, Tensor], lines: int) -> Tensor:
    """Correlation matrices ``(lines, 4, 4)``."""
    matrix = torch.eye(len(LINE_COMPONENTS), dtype=torch.float64).repeat(lines, 1, 1)
    given = {name: pair for name, pair in _PAIRS.items() if name in columns}
    for name, (i, j) in given.items():
        matrix[:, i, j] = matrix[:, j, i] = columns[name]
    if given:
        impossible = torch.linalg.eigvalsh(matrix)[:, 0] < -_ROUNDING
        if bool(impossible.any()):
            line = int(impossible.nonzero()[0, 0])
            raise FileFormatError(path, f"line {line}: no covariance has such correlations", next(iter(given)))
    return matrix


def _findings(path: Path, text: str | None, columns: dict[str, Tensor]) -> tuple[LineFinding, ...]:
    """What the file says about its components, else what its values say."""
    if text is None:
        return tuple(_given(index, columns) for index in range(len(LINE_COMPONENTS)))
    entries = _from_json(path, text, _FINDINGS)
    if not isinstance(entries, list) or len(entries) > len(LINE_COMPONENTS):
        raise FileFormatError(path, "expected a list with one entry for each component", _FINDINGS)
    found = tuple(read_entries(LineFinding, entry, path, f"{_FINDINGS}[{i}]") for i, entry in enumerate(entries))
    _check_findings(path, found, columns)
    return found


def _section(path: Path, text: str | None) -> SectionFit | None:
    """Where the file says that the section lies."""
    return None if text is None else read_entries(SectionFit, _from_json(path, text, _SECTION), path, _SECTION)


def _from_json(path: Path, text: str, key: str) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise FileFormatError(path, f"expected JSON: {on_one_line(error)}", key) from error


def _check_findings(path: Path, findings: Iterable[LineFinding], columns: dict[str, Tensor]) -> None:
    """Check that exactly the components that are said to be corrected have values."""
    corrected = {finding.component for finding in findings if finding.state == "corrected"}
    for component, name in zip(LINE_COMPONENTS, VALUE_COLUMNS, strict=True):
        if (component in corrected) != (name in columns and bool(columns[name].any())):
            what = "corrected" if component in corrected else "not corrected"
            raise FileFormatError(path, f"{component} is said to be {what}, which its column contradicts", _FINDINGS)


def _given(index: int, columns: dict[str, Any]) -> LineFinding:
    """What a file from elsewhere says about a component."""
    component, name = LINE_COMPONENTS[index], VALUE_COLUMNS[index]
    if name not in columns:
        return LineFinding(component, "not observed", reason=f"the file has no {name}")
    rms, sigma = (
        0.0 if values is None else float(values.square().mean().sqrt())
        for values in (columns[name], columns.get(SIGMA_COLUMNS[index]))
    )
    return LineFinding(component, "corrected", rms, sigma) if rms > 0 else LineFinding(component, "absent", sigma=sigma)
