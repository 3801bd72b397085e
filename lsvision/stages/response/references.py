"""A dark and a moving white reference -> offset and gain of every column and colour of a camera.

A structure that stays in its column is gain; one that moves with the reference is dirt, which a mean without outliers
along the lines leaves out. The brightness of every line as a whole (a lamp that flickers) is taken out first. How much
the gains of separate parts of the scan differ says how well they are known.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.errors import ResponseError
from lsvision.stages.response.codes import ReferenceCodes, clipped_mean, grouped_median, median
from lsvision.stages.response.config import ResponseConfig
from lsvision.stages.response.measured import MeasuredResponse
from lsvision.types import LineImage

_CLIP = 3.0  # robust standard deviations beyond which a sample is dirt
_MEDIAN_LOSS = 1.25  # standard deviation of a median over that of a mean
_CLIPPED_SAMPLES, _CLIPPED_COLUMNS = 0.01, 0.002  # of a column that make it clipped; of the columns, a reference
_LIGHT = 0.25  # of the range that no dark reference reaches
_LEAST_CODES, _LEAST_NOISES = 4.0, 5.0  # of a white reference over the dark one
_CODE = 0.3  # standard deviation of what whole codes leave out
_BLIND = 0.05  # of the usual gain
_LEAST_TEXTURE = 0.003  # of white, from which on it shows whether the reference moves
_STANDING = 0.5  # of the texture that stays in its column over half a block
_POOLED = 33  # neighbouring columns whose blocks together show how well a gain is known


@dataclass(frozen=True)
class Reference:
    """The image of a reference, and the name that an error gives it."""

    image: LineImage
    name: str

    def fault(self, problem: str) -> ResponseError:
        """The error that refuses it."""
        return ResponseError(f"{self.name}: {problem}")


def measure_references(dark: Reference, white: Reference, config: ResponseConfig) -> MeasuredResponse:
    """The response of one camera, with gains in codes of white.

    Raises:
        ResponseError: a reference cannot be one; says why.
    """
    _check_shapes(dark, white)
    dark_codes, white_codes = (_read(reference, config) for reference in (dark, white))
    offset = grouped_median(dark_codes.codes)
    _check_dark(dark, dark_codes, offset)
    level = grouped_median(white_codes.codes) - offset
    _check_white(white, white_codes, level, dark_codes)
    even = _without_flicker(white_codes.codes - offset, level)
    gain = clipped_mean(even, level, _CLIP)
    gain = gain.masked_fill(white_codes.clipped > _CLIPPED_SAMPLES, torch.nan)
    gain = gain.masked_fill(gain < _BLIND * gain.nanmedian(), torch.nan)
    standing = _standing_blocks(even - gain, white_codes, float(gain.nanmedian()))
    if standing:
        raise white.fault(f"moves wrongly: its structure stands in its columns on lines {standing}; let it move on")
    offset_sigma = _MEDIAN_LOSS * max(dark_codes.noise, _CODE) / dark_codes.lines**0.5
    sigma = _sigma_of_gain(even, gain, white_codes.block)
    found = MeasuredResponse(
        offset,
        torch.full_like(offset, offset_sigma),
        gain,
        sigma.square().add(offset_sigma**2).sqrt(),
        (dark_codes.noise, white_codes.noise),
        (dark_codes.lines, white_codes.lines),
    )
    if found.relative_sigma > config.largest_sigma:
        raise white.fault(
            f"textured: parts of it give gains that leave {found.relative_sigma:.2%} of doubt, expected at most "
            f"{config.largest_sigma:.2%} (estimate.largest_sigma); take a plainer or longer one"
        )
    return found


def measure_dark(dark: Reference, config: ResponseConfig) -> Float[Tensor, "width channels"]:
    """The offsets of one camera by a dark reference alone, codes.

    Raises:
        ResponseError: the reference cannot be one; says why.
    """
    codes = _read(dark, config)
    offset = grouped_median(codes.codes)
    _check_dark(dark, codes, offset)
    return offset


def _read(reference: Reference, config: ResponseConfig) -> ReferenceCodes:
    lines = reference.image.shape[0]
    if lines < config.least_lines:
        problem = f"expected at least {config.least_lines} lines (estimate.least_lines), got {lines}"
        raise reference.fault(problem)
    read = ReferenceCodes.read(reference.image, config.most_lines, config.blocks)
    if read.lines < config.least_lines:
        raise reference.fault(f"expected at least {config.least_lines} lines that are there, got {read.lines}")
    return read


def _check_shapes(dark: Reference, white: Reference) -> None:
    of_dark, of_white = ((item.image.shape[1:], item.image.dtype) for item in (dark, white))
    if of_dark != of_white:
        ours, theirs = (f"{shape[0]} columns of {shape[1]} x {kind}" for shape, kind in (of_dark, of_white))
        raise dark.fault(f"expected {theirs} as the white reference has, got {ours}")


def _check_dark(dark: Reference, codes: ReferenceCodes, offset: Tensor) -> None:
    top = codes.white if codes.white > 255 else 255.0
    usual = float(offset.median())
    if usual > _LIGHT * top:
        raise dark.fault(f"expected a dark image, got a median of {usual:.0f} of {top:.0f}")
    scatter = float(codes.codes.std(0).median())
    if scatter > 3 * codes.noise + 1.0:
        raise dark.fault(f"textured: it varies by {scatter:.1f} codes along the scan, its noise is {codes.noise:.1f}")


def _check_white(white: Reference, codes: ReferenceCodes, level: Tensor, dark: ReferenceCodes) -> None:
    usual = float(level.median())
    if usual <= 0:
        raise white.fault(f"is no brighter than the dark reference: {usual:.1f} codes above it; are they exchanged?")
    if usual < max(_LEAST_CODES, _LEAST_NOISES * dark.noise):
        raise white.fault(f"empty: its median is {usual:.1f} codes above the dark reference")
    clipped = float((codes.clipped > _CLIPPED_SAMPLES).float().mean())
    if clipped > _CLIPPED_COLUMNS:
        raise white.fault(f"clipped: {clipped:.1%} of its columns are saturated; take it with less light")


def _without_flicker(values: Float[Tensor, "lines width channels"], level: Tensor) -> Tensor:
    """Values over the brightness of their line as a whole, by the median of its columns."""
    share = values / level.clamp(min=1e-3)
    brightness = median(share.flatten(1).T.contiguous())
    return values / brightness.clamp(min=1e-3)[:, None, None]


def _standing_blocks(residual: Tensor, codes: ReferenceCodes, white: float) -> str:
    """Lines on which the structure of the reference stays in its columns; empty where it moves on, or shows none."""
    found = []
    residual = residual.nan_to_num()
    for start, block in zip(codes.starts, residual.split(codes.block), strict=True):
        texture = float((block[:-1] * block[1:]).mean())  # noise is independent from line to line
        first, second = block.split(-(-len(block) // 2))
        stays = float((first.mean(0) * second.mean(0)).mean())
        if texture > (_LEAST_TEXTURE * white) ** 2 and stays > _STANDING * texture:
            found.append(f"{start}-{start + codes.block - 1}")
    return ", ".join(found)


def _sigma_of_gain(even: Tensor, gain: Tensor, block: int) -> Float[Tensor, "width channels"]:
    """Standard deviation of gains by how much those of separate blocks differ.

    A few blocks say little about one column; the variance usual around it counts for as many again, twice.
    """
    blocks = [clipped_mean(part, median(part), _CLIP) for part in even.split(block)]
    count = len(blocks)
    own = ((torch.stack(blocks) / gain).nan_to_num(1.0).var(0) / count).T
    padded = torch.nn.functional.pad(own[None], (_POOLED // 2, _POOLED // 2), mode="replicate")[0]
    of_median = (1 - 2 / (9 * (count - 1))) ** 3  # of a chi-square over its mean, by Wilson & Hilferty 1931
    usual = padded.unfold(-1, _POOLED, 1).median(-1).values / of_median
    return gain * ((own + 2 * usual) / 3).sqrt().T
