"""What the page knows of a product: its layers, sections of them, and its candidates."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lsvision.errors import FileFormatError, LsvisionError
from lsvision.io import Product, read_product, read_surface
from lsvision.viewer.layers import Layer

_MOST_POINTS = 2000  # of a section
_ALONG_ROWS = 512  # to either side of the cursor, over which a section along the motion reaches
_SHOWN = ("kind", "along_mm", "around_mm", "depth_mm", "depth_sigma_mm", "length_mm", "width_mm", "ratio", "side")
_BOX = ("first_row", "last_row", "first_column", "last_column")


@dataclass(frozen=True)
class ProductView:
    """A product that is looked at."""

    product: Product
    layers: dict[str, Layer]
    candidates: list[dict[str, Any]]

    @classmethod
    def of(cls, path: Path | str) -> "ProductView":
        """Open a product, and its surface where it was inspected.

        Raises:
            FileFormatError: it cannot be read.
        """
        product = read_product(path)
        folder, grid = product.path, product.grid
        layers = [
            Layer("color", "colour", "product", folder / "color", grid, "colors"),
            Layer("height", "height", "product", folder / "height", grid, "viridis", "mm"),
        ]
        candidates: list[dict[str, Any]] = []
        try:
            surface = read_surface(product)
        except FileFormatError:  # not inspected, or without a profile
            pass
        else:
            layers += [
                Layer("surface_color", "colour, unrolled", "surface", surface.path / "color", surface.grid, "colors"),
                Layer("deviation", "deviation", "surface", surface.path / "deviation", surface.grid, "RdBu", "mm"),
            ]
            candidates = _candidates_of(surface.path / "defects.parquet")
        return cls(product, {layer.name: layer for layer in layers}, candidates)

    @property
    def info(self) -> dict[str, Any]:
        """Everything that the page shows at first, as plain data."""
        return {
            "name": self.product.path.stem,
            "layers": [
                {
                    "name": layer.name, "title": layer.title, "sheet": layer.sheet, "unit": layer.unit,
                    "rows": layer.grid.rows, "columns": layer.grid.columns, "pitch_mm": layer.grid.pitch_mm,
                    "along_mm": layer.grid.origin_y_mm, "across_mm": layer.grid.origin_x_mm, "top": layer.top,
                    "span": list(layer.span),
                }
                for layer in self.layers.values()
            ],
            "candidates": self.candidates,
        }  # fmt: skip

    def section(self, name: str, row: int, column: int) -> dict[str, Any]:
        """Values along the row and about the column of a cell, mm, null where not measured.

        Raises:
            LsvisionError: there is no such layer or cell.
        """
        layer = self._measured(name, row, column)
        grid = layer.grid
        across = layer.values(range(row, row + 1), range(grid.columns))[0]
        rows = range(max(0, row - _ALONG_ROWS), min(grid.rows, row + _ALONG_ROWS + 1))
        along = layer.values(rows, range(column, column + 1))[:, 0]
        step = -(-grid.columns // _MOST_POINTS)
        return {
            "across": _line(grid.origin_x_mm, grid.pitch_mm * step, across[::step]),
            "along": _line(grid.q_y(rows.start), grid.pitch_mm, along),
            "value": _or_null(across[column]),
        }

    def _measured(self, name: str, row: int, column: int) -> Layer:
        layer = self.layers.get(name)
        if layer is None or layer.scale == "colors":
            raise LsvisionError(f"layer: expected one with values, got {name!r}")
        if not (0 <= row < layer.grid.rows and 0 <= column < layer.grid.columns):
            raise LsvisionError(f"cell: expected one within {layer.grid.rows} x {layer.grid.columns}")
        return layer


def _candidates_of(path: Path) -> list[dict[str, Any]]:
    import polars  # takes a moment, which a product without a surface need not wait for

    if not path.is_file():
        return []
    return polars.read_parquet(path, columns=[*_SHOWN, *_BOX]).to_dicts()


def _line(first_mm: float, step_mm: float, values: np.ndarray) -> dict[str, Any]:
    return {"first_mm": first_mm, "step_mm": step_mm, "values": [_or_null(value) for value in values]}


def _or_null(value: Any) -> float | None:
    return round(float(value), 5) if math.isfinite(value) else None
