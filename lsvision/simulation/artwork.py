"""The printed sheet: fine coloured grain under a few marks, one raster of dots for each scene."""

from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from lsvision.simulation.config import SceneConfig
from lsvision.simulation.noise import Nodes, Raster, lattice_hash, octaves, value_noise

_GRAIN_OCTAVES = 6
_COLOR_CELLS = 5  # the hue has no finer octave than that of 2**5 dots
_RINGS, _CROSSES = 8, 8
_FRAME_MM, _FRAME_INSET_MM = 1.2, 6.0
_RULER_STEP_MM = 5.0
_BLACK = (0.04, 0.04, 0.05)
_RING_INKS = ((0.70, 0.10, 0.10), (0.08, 0.22, 0.62), (0.05, 0.45, 0.18))


@dataclass(frozen=True)
class Marks:
    """Centres of printed marks and their sizes (arm of a cross, radius of a ring), each ``(count, 1, 1)`` mm."""

    center_x: Tensor
    center_y: Tensor
    size: Tensor


def artwork(scene: SceneConfig, points_mm: Tensor) -> Tensor:
    """Colour of the printed sheet at points of its frame.

    Args:
        scene: gives the size, dot spacing and seed of the sheet.
        points_mm: ``(*batch, 2 or 3)``, mm from the corner of the sheet, X along its width, Y along its height.

    Returns:
        Reflectance ``(*batch, 3)``, 0..1, float32; NaN beyond the sheet.
    """
    x, y = points_mm[..., 0], points_mm[..., 1]
    on_sheet = (x >= 0) & (x <= scene.sheet_width_mm) & (y >= 0) & (y <= scene.sheet_height_mm)
    flat = sheet_raster(scene).at(x.reshape(1, -1).float(), y.reshape(1, -1).float())
    color = flat[:, 0].T.reshape(*x.shape, 3)
    return torch.where(on_sheet[..., None], color, torch.nan)


@lru_cache(maxsize=2)
def sheet_raster(scene: SceneConfig) -> Raster:
    """Reflectance of every printed dot, ``(3, rows, columns)``; dots are ``texture_mm`` apart."""
    spacing = scene.texture_mm
    count_x, count_y = (round(size / spacing) + 3 for size in (scene.sheet_width_mm, scene.sheet_height_mm))
    nodes = Nodes(-1, -1, count_x, count_y, spacing)
    grain = value_noise(nodes, octaves(_GRAIN_OCTAVES), scene.seed * 8)
    coarse = octaves(_GRAIN_OCTAVES + 2)[_COLOR_CELLS:]
    hue = torch.stack([value_noise(nodes, coarse, scene.seed * 8 + channel) for channel in (1, 2, 3)])
    color = (0.48 + 0.21 * grain + 0.09 * hue).clamp_(0.06, 0.92)
    x, y = (axis.float() for axis in nodes.grid())
    if scene.sheet_frame:
        color = _print(color, _border(scene, x, y), _BLACK)
    color = _print(color, _crosses(scene, x, y), _BLACK)
    for index, ink in enumerate(_RING_INKS):
        color = _print(color, _rings(scene, x, y)[index :: len(_RING_INKS)].amax(0), ink)
    return Raster(color, nodes)


def _print(color: Tensor, share: Tensor, ink: tuple[float, float, float]) -> Tensor:
    """Print an ink over a share of every dot."""
    return torch.lerp(color, color.new_tensor(ink)[:, None, None].expand_as(color), share[None])


def _stroke(distance: Tensor, width: float, dot: float) -> Tensor:
    """Share of a dot that a stroke covers, from its distance to the middle of the stroke; all in mm."""
    return ((width / 2 - distance) / dot + 0.5).clamp(0.0, 1.0)


def _border(scene: SceneConfig, x: Tensor, y: Tensor) -> Tensor:
    """A frame, and a ruler inside its lower edge with longer ticks at every second and tenth step."""
    width, height, dot = scene.sheet_width_mm, scene.sheet_height_mm, scene.texture_mm
    to_edge = torch.minimum(torch.minimum(x, width - x), torch.minimum(y, height - y)) - _FRAME_INSET_MM
    tick = (x / _RULER_STEP_MM).round()
    length = torch.where(tick.remainder(10) == 0, 9.0, torch.where(tick.remainder(2) == 0, 6.0, 3.5))
    above = height - _FRAME_INSET_MM - y
    on_ruler = (above > 0) & (above < length) & (to_edge > -_FRAME_MM / 2)
    ticks = _stroke((x - tick * _RULER_STEP_MM).abs(), 0.8, dot) * on_ruler
    return torch.maximum(_stroke(to_edge.abs(), _FRAME_MM, dot), ticks)


def _crosses(scene: SceneConfig, x: Tensor, y: Tensor) -> Tensor:
    marks = _scattered(scene, _CROSSES, stream=1)
    along_x, along_y = (x - marks.center_x).abs(), (y - marks.center_y).abs()
    near, far = torch.minimum(along_x, along_y), torch.maximum(along_x, along_y)
    return (_stroke(near, 1.2, scene.texture_mm) * (far < marks.size)).amax(0)


def _rings(scene: SceneConfig, x: Tensor, y: Tensor) -> Tensor:
    marks = _scattered(scene, _RINGS, stream=2)
    distance = (torch.hypot(x - marks.center_x, y - marks.center_y) - marks.size).abs()
    return _stroke(distance, 1.6, scene.texture_mm)


def _scattered(scene: SceneConfig, count: int, stream: int) -> Marks:
    """Marks at random places that do not touch the sheet's frame."""
    index = torch.arange(count)
    across, down, size = ((lattice_hash(index, 8 * stream + k, scene.seed) + 1.0) / 2 for k in range(3))
    clear = 28.0
    center_x = clear + across * (scene.sheet_width_mm - 2 * clear)
    center_y = clear + down * (scene.sheet_height_mm - 2 * clear)
    return Marks(*(value[:, None, None] for value in (center_x, center_y, 5.0 + 9.0 * size)))
