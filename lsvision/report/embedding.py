"""Figures in a page: drawings as vectors, images as pixels, figures in three dimensions as a ring of views."""

import base64
import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
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
    canvas = _drawn(figure)
    figure.set_layout_engine("none")  # it is laid out: the next drawings keep that
    png, svg = _encoded(canvas, "png"), _as_svg(figure)
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
    views = []
    for _ in range(_VIEWS):
        views.append(_encoded(_drawn(figure), "webp", quality=_VIEW_QUALITY))
        for axes in solid:
            axes.view_init(elev=axes.elev, azim=axes.azim + 360 / _VIEWS)
    return views


def _drawn(figure: Figure) -> FigureCanvasAgg:
    """A figure as pixels. ``savefig`` would lay it out and draw it twice."""
    figure.set_dpi(_DPI)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return canvas


def _encoded(canvas: FigureCanvasAgg, kind: str, **options: int) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3]).save(buffer, kind, **options)
    return buffer.getvalue()


def _as_svg(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    FigureCanvasSVG(figure).print_svg(buffer, metadata={"Date": None})
    return buffer.getvalue()


def _uri(data: bytes, kind: str) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"
