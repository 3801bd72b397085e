"""From light to grey values: integration over a pixel and a line, the optics' blur, noise and quantisation."""

import math

import torch
from torch import Tensor
from torch.nn.functional import conv2d

from lsvision.simulation.config import SensorConfig
from lsvision.types import CameraResponse

# The blur is cut at three sigma, where a Gaussian has fallen to a hundredth of its peak.
_BLUR_REACH = 3.0
_LEAST_GAIN = 0.05


def halo_px(sensor: SensorConfig) -> int:
    """Pixels and lines that the blur reaches beyond an image."""
    return math.ceil(_BLUR_REACH * sensor.blur_px)


def sample_offsets(first: int, count: int, sensor: SensorConfig) -> Tensor:
    """Positions, float64, of the samples of ``count`` pixels or lines from ``first`` on; centres are integers."""
    per_pixel = sensor.supersampling
    return first + (torch.arange(count * per_pixel, dtype=torch.float64) + 0.5) / per_pixel - 0.5


def integrate(samples: Tensor, sensor: SensorConfig) -> Tensor:
    """Grey values of pixels: samples weighted by the box of a pixel and line, blurred by the optics.

    Args:
        samples: ``(channels, lines, columns)`` with a halo of ``halo_px`` pixels on every side.

    Returns:
        ``(channels, lines / supersampling - 2 halo, columns / supersampling - 2 halo)``.
    """
    weights = _pixel_weights(sensor).to(samples)
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


def _pixel_weights(sensor: SensorConfig) -> Tensor:
    """Weights of samples across a pixel: its box convolved with the Gaussian of the blur, float64."""
    if sensor.blur_px == 0:
        return torch.full((sensor.supersampling,), 1.0 / sensor.supersampling, dtype=torch.float64)
    reach = halo_px(sensor)
    offset = sample_offsets(-reach, 2 * reach + 1, sensor)
    upper, lower = (torch.special.ndtr((offset + side) / sensor.blur_px) for side in (0.5, -0.5))
    return (upper - lower) / (upper - lower).sum()
