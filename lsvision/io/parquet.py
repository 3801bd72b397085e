"""Tables as Parquet files."""

from pathlib import Path
from typing import TYPE_CHECKING

from lsvision.io.atomic import partial_file

if TYPE_CHECKING:
    import polars  # takes a moment, which a run that writes no table need not wait for


def write_parquet(table: "polars.DataFrame", path: Path) -> None:
    """Write a table, which appears when it is complete."""
    with partial_file(path) as partial:
        table.write_parquet(partial)
