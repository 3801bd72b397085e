"""From light to grey values: integration over a pixel and a line, the optics' blur, noise and quantisation."""

import math

import torch
from torch import Tensor
from torch.nn.functional import conv2d, pad

from lsvision.simulation.config import SensorConfig
from lsvision.simulation.surfaces import Look
from lsvision.types import CameraResponse

# The blur is cut at three sigma, where a Gaussian has fallen to a hundredth of its peak.
_BLUR_REACH = 3.0
_LEAST_GAIN = 0.05
MOST_DEFOCUS_PX = 3.0
_DEFOCUS_PX = tuple(MOST_DEFOCUS_PX * math.sqrt(share / 8) for share in range(9))


def halo_px(sensor: SensorConfig) -> int:
    """Pixels and lines that the blur reaches beyond an image."""
    most = math.hypot(sensor.blur_px, MOST_DEFOCUS_PX if sensor.defocus_px_per_mm > 0 else 0.0)
    return math.ceil(_BLUR_REACH * most)


def sample_offsets(first: int, count: int, sensor: SensorConfig) -> Tensor:
    """Positions, float64, of the samples of ``count`` pixels or lines from ``first`` on; centres are integers."""
    per_pixel = sensor.supersampling
    return first + (torch.arange(count * per_pixel, dtype=torch.float64) + 0.5) / per_pixel - 0.5


def received(seen: Look, sensor: SensorConfig, focus_mm: float) -> Tensor:
    """Grey values of pixels, as ``integrate``, blurred besides as far as their depth is out of focus.

    A pixel is interpolated, by the depth in its middle, between the two nearest of a few images that are blurred alike.

    Args:
        seen: samples with a halo of ``halo_px`` pixels on every side.
        focus_mm: depth z that is in focus.
    """
    if sensor.defocus_px_per_mm == 0:
        return integrate(seen.color, sensor)
    reach, step = halo_px(sensor) * sensor.supersampling, sensor.supersampling
    middle = slice(reach + step // 2, -reach, step)
    z = seen.z[middle, middle]
    defocus = ((z - focus_mm).abs() * sensor.defocus_px_per_mm).clamp(max=MOST_DEFOCUS_PX)
    images = torch.stack([integrate(seen.color, sensor, blur) for blur in _DEFOCUS_PX])
    place = defocus.square() * ((len(_DEFOCUS_PX) - 1) / MOST_DEFOCUS_PX**2)  # evenly spaced in the variance
    lower = place.floor().clamp(max=len(_DEFOCUS_PX) - 2).long()[None, None].expand(1, *images.shape[1:])
    below, above = (images.gather(0, index)[0] for index in (lower, lower + 1))
    return torch.lerp(below, above, (place - lower[0, 0]).to(below))


def integrate(samples: Tensor, sensor: SensorConfig, defocus_px: float = 0.0) -> Tensor:
    """Grey values of pixels: samples weighted by the box of a pixel and line, blurred by the optics.

    Args:
        samples: ``(channels, lines, columns)`` with a halo of ``halo_px`` pixels on every side.
        defocus_px: blur besides, of all pixels alike.

    Returns:
        ``(channels, lines / supersampling - 2 halo, columns / supersampling - 2 halo)``.
    """
    weights = _pixel_weights(sensor, defocus_px).to(samples)
    step = sensor.supersampling
    rows = conv2d(samples[:, None], weights[None, None, :, None], stride=(step, 1))
    return conv2d(rows, weights[None, None, None, :], stride=(1, step))[:, 0]


def expose(light: Tensor, sensor: SensorConfig, seed: int, response: CameraResponse | None = None) -> Tensor:
    """Grey values ``(lines, columns, channels)``, uint8 or uint16, of light ``(3, lines, columns)``; white is 1.

    Args:
        response: of the columns; None where they are even.
    """
    grey = light.mean(0, keepdim=True) if sensor.mono else light
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn(grey.shape, generator=generator) if sensor.noise > 0 else torch.zeros(())
    full = 2**sensor.bits - 1
    if response is not None:
        grey = grey * response.gain.T[:, None]
    value = (sensor.exposure * grey + (sensor.noise / 255.0) * noise) * full
    if response is not None:
        value += response.offset.T[:, None]
    dtype = torch.uint8 if sensor.bits == 8 else torch.uint16
    return value.round_().clamp_(0, full).permute(1, 2, 0).to(dtype).contiguous()


def true_response(sensor: SensorConfig, width: int, seed: int) -> CameraResponse:
    """Offset and gain of every column and colour of a simulated camera, whose departures are drawn from a seed."""
    generator = torch.Generator().manual_seed(seed)
    gains, offsets = torch.randn(2, width, 1 if sensor.mono else 3, generator=generator).unbind(0)
    end = torch.linspace(-1, 1, width)[:, None]
    gain = (1.0 - sensor.vignetting * end.square()) * (1.0 + sensor.gain_noise * gains).clamp(min=_LEAST_GAIN)
    full = 2**sensor.bits - 1
    return CameraResponse((sensor.offset + sensor.offset_noise * offsets) * (full / 255.0), gain)


def _pixel_weights(sensor: SensorConfig, defocus_px: float) -> Tensor:
    """Weights of samples across a pixel: its box convolved with the Gaussian of the blur, float64."""
    blur = math.hypot(sensor.blur_px, defocus_px)
    reach = halo_px(sensor)
    if blur == 0:
        box = torch.full((sensor.supersampling,), 1.0 / sensor.supersampling, dtype=torch.float64)
        return pad(box, (reach * sensor.supersampling,) * 2)
    offset = sample_offsets(-reach, 2 * reach + 1, sensor)
    upper, lower = (torch.special.ndtr((offset + side) / blur) for side in (0.5, -0.5))
    return (upper - lower) / (upper - lower).sum()
