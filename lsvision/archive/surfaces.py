"""The candidates of all products of an archive as one table, and how many each product has."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from lsvision.archive.product import product_path
from lsvision.io import surface_metadata, write_parquet
from lsvision.io.product.surface import SURFACE_GROUP

if TYPE_CHECKING:
    import polars  # takes a moment, which a run that inspects nothing need not wait for

ALL_DEFECTS = "defects.parquet"
KINDS = ("dent", "bump", "color")
_TABLE = "defects.parquet"


@dataclass(frozen=True)
class InspectedScan:
    """The surface of a scan: its length, its candidates and why it was not inspected; empty where it was."""

    scan: str
    length_mm: float = 0.0
    dents: int = 0
    bumps: int = 0
    colors: int = 0
    worst: float = 0.0
    problem: str = ""

    @property
    def per_metre(self) -> float:
        """Dents and bumps."""
        return 1e3 * (self.dents + self.bumps) / self.length_mm if self.length_mm > 0 else 0.0


def gather_surfaces(output: Path, scans: Iterable[str]) -> list[InspectedScan]:
    """Write the candidates of scans into one table, ``defects.parquet``, those that stand out most first.

    Args:
        output: of the archive, below which the products lie.

    Returns:
        One entry for every scan, in order.
    """
    import polars

    found, tables = [], []
    for scan in scans:
        product = product_path(output, scan)
        metadata, table = surface_metadata(product), product / SURFACE_GROUP / _TABLE
        if "length_mm" not in metadata or not table.is_file():
            found.append(InspectedScan(scan, problem=str(metadata.get("problem") or "not inspected")))
            continue
        candidates = polars.read_parquet(table)
        dents, bumps, colors = (len(candidates.filter(polars.col("kind") == kind)) for kind in KINDS)
        worst = candidates["ratio"].to_list()[:1]  # they are sorted by it
        found.append(InspectedScan(scan, float(metadata["length_mm"]), dents, bumps, colors, *worst))
        tables.append(candidates.select(polars.lit(scan).alias("scan"), polars.all()))
    if tables:
        every = polars.concat(tables).sort(["ratio", "scan", "along_mm"], descending=[True, False, False])
        write_parquet(every, output / ALL_DEFECTS)
    return found


def worst_candidates(output: Path, count: int) -> "polars.DataFrame":
    """The first rows of the table of an archive."""
    import polars

    return polars.scan_parquet(output / ALL_DEFECTS).head(count).collect()
