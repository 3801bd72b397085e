"""Tables as Parquet files."""

from pathlib import Path

import polars

from lsvision.io.atomic import partial_file


def write_parquet(table: polars.DataFrame, path: Path) -> None:
    """Write a table, which appears when it is complete."""
    with partial_file(path) as partial:
        table.write_parquet(partial)
