"""Candidates on a surface as Parquet, CSV and GeoJSON: a row or a feature for each, in the order of ``Candidate``.

Wear of its pieces is a CSV in the order of ``SectionWear``.

The GeoJSON's coordinates are (q_x, q_y) of the product, mm, not degrees: a polygon about the ellipse of each candidate.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, get_type_hints

from lsvision.io.atomic import partial_file
from lsvision.io.json_file import write_json
from lsvision.types import Candidate, SectionWear

TABLE, TEXT, SHAPES, WEAR = "defects.parquet", "defects.csv", "defects.geojson", "wear.csv"
_CORNERS = 24  # of a polygon


def write_candidates(candidates: Sequence[Candidate], folder: Path) -> None:
    """Write all three files into a folder."""
    import polars  # takes a moment, which a run that writes no table need not wait for

    kinds: dict[Any, Any] = {float: polars.Float64, int: polars.Int64, int | None: polars.Int64}
    schema = {name: kinds.get(kind, polars.String) for name, kind in get_type_hints(Candidate).items()}
    rows = [_finite(candidate) for candidate in candidates]
    table = polars.DataFrame(rows, schema=schema, orient="row")
    with partial_file(folder / TABLE) as partial:
        table.write_parquet(partial)
    with partial_file(folder / TEXT) as partial:
        table.write_csv(partial)
    features = [
        {
            "type": "Feature",
            "id": number,
            "properties": row,
            "geometry": {"type": "Polygon", "coordinates": [_outline(candidate)]},
        }
        for number, (candidate, row) in enumerate(zip(candidates, rows, strict=True))
    ]
    write_json(folder / SHAPES, {"type": "FeatureCollection", "unit": "mm", "features": features})


def write_wear(pieces: Sequence[SectionWear], folder: Path) -> None:
    """Write how each piece of an object departs from its section."""
    import polars

    kinds: dict[Any, Any] = {bool: polars.Boolean}
    schema = {name: kinds.get(kind, polars.Float64) for name, kind in get_type_hints(SectionWear).items()}
    with partial_file(folder / WEAR) as partial:
        polars.DataFrame([asdict(piece) for piece in pieces], schema=schema, orient="row").write_csv(partial)


def _finite(candidate: Candidate) -> dict[str, object]:
    """Its entries; None for what it has not."""
    entries = asdict(candidate)
    return {
        name: None if isinstance(value, float) and not math.isfinite(value) else value
        for name, value in entries.items()
    }


def _outline(candidate: Candidate) -> list[list[float]]:
    """Its ellipse in the product, seen from above."""
    angle, flat = math.radians(candidate.angle_deg), math.cos(math.radians(candidate.slope_deg))
    points = []
    for corner in (*range(_CORNERS), 0):
        turn = 2 * math.pi * corner / _CORNERS
        ahead, aside = candidate.length_mm / 2 * math.cos(turn), candidate.width_mm / 2 * math.sin(turn)
        along = candidate.along_mm + ahead * math.cos(angle) - aside * math.sin(angle)
        around = ahead * math.sin(angle) + aside * math.cos(angle)
        points.append([round(candidate.across_mm + around * flat, 4), round(along, 4)])
    return points
