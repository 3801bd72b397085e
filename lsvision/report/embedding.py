"""Figures in a page: drawings as vectors, images as pixels, figures in three dimensions as a ring of views."""

import base64
import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D
from PIL import Image

_DPI = 110
# A drawing of thousands of points, larger than this in bytes, is smaller as pixels.
_LARGEST_SVG = 400_000
_VIEWS = 18
_VIEW_QUALITY = 70  # of WebP; a view of a board then takes about 10 kB


@dataclass(frozen=True)
class Embedded:
    """One figure as data URIs: one picture, or one per view; ``vector`` is true for SVG."""

    uris: tuple[str, ...]
    vector: bool


def embed(figure: Figure, path: Path) -> Embedded:
    """Save a figure as ``path`` with the endings .png and .svg, and return the pictures that a page shows."""
    png, svg = _saved(figure, "png"), _saved(figure, "svg")
    path.with_name(f"{path.name}.png").write_bytes(png)
    path.with_name(f"{path.name}.svg").write_bytes(svg)
    solid = [axes for axes in figure.axes if isinstance(axes, Axes3D)]
    if solid:
        return Embedded(tuple(_uri(view, "webp") for view in _views(figure, solid)), vector=False)
    if len(svg) > _LARGEST_SVG or any(axes.images for axes in figure.axes):
        return Embedded((_uri(png, "png"),), vector=False)
    return Embedded((_uri(svg, "svg+xml"),), vector=True)


def _views(figure: Figure, solid: list[Axes3D]) -> list[bytes]:
    """Views of a figure turned in equal steps about the vertical, from its present view on."""
    figure.set_layout_engine("none")  # keep the layout: if every view had its own, the figure would jump
    figure.set_dpi(_DPI)
    canvas = FigureCanvasAgg(figure)
    views = []
    for _ in range(_VIEWS):
        canvas.draw()  # savefig would draw every view twice
        buffer = io.BytesIO()
        Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3]).save(buffer, "webp", quality=_VIEW_QUALITY)
        views.append(buffer.getvalue())
        for axes in solid:
            axes.view_init(elev=axes.elev, azim=axes.azim + 360 / _VIEWS)
    return views


def _saved(figure: Figure, kind: str) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format=kind, dpi=_DPI, metadata={"Date": None} if kind == "svg" else None)
    return buffer.getvalue()


def _uri(data: bytes, kind: str) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"
