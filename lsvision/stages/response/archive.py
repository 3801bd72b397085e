"""Scans of an archive -> gains of the columns, as far as the sideways wander of the objects separates them."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.errors import ResponseError
from lsvision.geometry import Camera, project, slope_at, zero_disparity_mm
from lsvision.image.brightness import white_level
from lsvision.image.levels import CameraLevels, as_taken
from lsvision.stages.response.config import ResponseConfig
from lsvision.stages.response.measured import MeasuredResponse
from lsvision.stages.response.wander import WanderGains, WanderSums
from lsvision.types import DepthSource, LineImage, Scan, StereoPair

_BLOCK = 256  # lines that are read at once
_CROWN_SHARE = 0.95  # of the heights: about the crown or lower
_OBJECT_MM = 40.0  # below the crown, that move with the object
_LEVEL_STRIDE = 16


@dataclass(frozen=True)
class Offsets:
    """Codes of the cameras without light, ``(width, channels)`` by camera; none where no dark reference was taken."""

    by_camera: Mapping[Camera, Tensor]

    def of(self, camera: Camera, image: LineImage) -> Tensor:
        """Those of a camera; zero where they are not known."""
        return self.by_camera.get(camera, torch.zeros(image.shape[1:]))


def gains_of_scan(
    scan: Scan, depth: DepthSource, wander_px: Float[Tensor, " lines"], offsets: Offsets, segment_mm: float
) -> dict[Camera, WanderGains]:
    """The gains that one scan shows, by camera.

    Args:
        depth: of the left image: what is seen of the object.
        wander_px: sideways displacement of the object on every line, columns.
        segment_mm: travel over which the pattern of the object is one.
    """
    images: dict[Camera, LineImage] = {"left": scan.left}
    if isinstance(scan.images, StereoPair):
        images["right"] = scan.images.right
    sums = {camera: WanderSums() for camera in images}
    levels = {camera: CameraLevels.of(as_taken(image), white_level(image)) for camera, image in images.items()}
    around = wander_px - wander_px.median()
    segment_lines = max(2, round(segment_mm / scan.travel.line_pitch_mm))
    for start, stop in _ranges(scan.lines, segment_lines):
        z = depth.read(start, stop).z
        seen: dict[Camera, Tensor] = {"left": _on_object(scan, z)}
        seen["right"] = _in_right(scan, z, seen["left"])
        for camera, image in images.items():
            raw = image.read(start, stop)
            spoiled = levels[camera].saturated(raw)
            known = seen[camera] if spoiled is None else seen[camera] & ~spoiled.any(-1)
            codes = raw.to(torch.float32) - offsets.of(camera, image)
            sums[camera].add(codes, known, around[start:stop], start // segment_lines)
    return {camera: item.gains() for camera, item in sums.items()}


def _ranges(lines: int, segment_lines: int) -> list[tuple[int, int]]:
    """Lines that are read at once, none of which are of two segments."""
    starts = sorted({*range(0, lines, segment_lines), *range(0, lines, _BLOCK)})
    return list(pairwise([*starts, lines]))


def response_of_scans(found: Mapping[str, WanderGains], offset: Tensor, config: ResponseConfig) -> MeasuredResponse:
    """The response of one camera from the gains of several scans, of waves up to the shortest that one observes.

    Scans of little wander are left out. A column that no scan shows keeps the gain 1, of which no sigma is known.

    Raises:
        ResponseError: no scan wanders enough.
    """
    used = {name: item for name, item in found.items() if item.wander_px >= config.least_wander_px}
    if not used:
        best = max(found.values(), key=lambda item: item.wander_px)
        waves = f"up to {best.observed_px:.0f} columns" if best.observed_px else "of no length"
        raise ResponseError(
            f"archive: its objects wander sideways by {best.wander_px:.2g} px rms at most, expected "
            f"{config.least_wander_px:g} (estimate.least_wander_px): waves {waves} differ from the object's own pattern"
        )
    logs = torch.stack([item.log_gain for item in used.values()])
    weight = torch.tensor([item.sigma**-2 if item.sigma > 0 else 0.0 for item in used.values()], dtype=logs.dtype)
    weights = weight[:, None, None] * ~logs.isnan()
    total = weights.sum(0)
    mean = (weights * logs.nan_to_num()).sum(0) / total
    gain, sigma = mean.exp().nan_to_num(1.0), total.rsqrt()
    sigma = sigma.masked_fill(total == 0, torch.nan)
    measured = MeasuredResponse(
        offset.double(), torch.zeros_like(gain), gain, sigma * gain, (math.nan, math.nan), (0, len(used))
    )
    if not measured.relative_sigma <= config.archive_sigma:
        raise ResponseError(
            f"archive: its gains are known to {measured.relative_sigma:.2%}, expected {config.archive_sigma:.2%} "
            "(estimate.archive_sigma); take more or longer scans"
        )
    return measured


def _on_object(scan: Scan, z: Tensor) -> Bool[Tensor, "lines width"]:
    """Samples that show the object, down to a depth below its crown: what lies deeper need not move with it."""
    height = zero_disparity_mm(scan.rig) - z
    some = height[::_LEVEL_STRIDE].flatten()
    some = some[some.isfinite()]
    if not len(some):
        return torch.zeros_like(z, dtype=torch.bool)
    crown = some.sort().values[round(_CROWN_SHARE * (len(some) - 1))]
    return height > crown - _OBJECT_MM


def _in_right(scan: Scan, z: Tensor, seen: Tensor) -> Bool[Tensor, "lines width"]:
    """The samples of the right image that show what samples of the left one show."""
    slope = slope_at(scan.rig, torch.arange(z.shape[1], dtype=torch.float64))
    depth = z.double()
    column = project(scan.rig, slope * depth, depth)[1].nan_to_num(-1.0).round().long()
    inside = seen & (column >= 0) & (column < z.shape[1])
    found = torch.zeros_like(seen)
    lines = torch.arange(len(z))[:, None].expand_as(column)
    found[lines[inside], column[inside]] = True
    return found
