"""Options of the correction."""

from dataclasses import dataclass

from lsvision.image.resampling import Interpolation, Resampler
from lsvision.schema import Checked, Interval, NonNegativeInt, Positive, PositiveInt, Share


@dataclass(frozen=True)
class CorrectionConfig(Checked):
    """How a scan becomes a product.

    The product is orthographic, with square cells, in the frame of the motion. ``pitch_mm`` is the side of a cell; the
    scan's own line pitch where it is None. ``resampler`` ``opencv`` gives the same as ``grid_sample`` within one grey
    value, and is faster. ``strip_rows`` are computed at once and make a chunk of the product. A surface counts as
    continuous between neighbours whose disparities differ by at most ``step_px``: at one pixel it is so steep that one
    of the cameras no longer sees it. Holes of up to ``bridge_px`` samples are bridged for colour; their height stays
    invalid. Depths outside ``height_range_mm`` count as not measured; the wider it is, the larger the product. With
    ``uncertainty`` each cell also gets the standard deviation of its position; ``disparity_sigma_px`` is that of the
    matching, where the depth comes without one. A product of which less than ``min_measured_share`` of the cells was
    measured is an error.
    """

    pitch_mm: Positive | None = None
    interpolation: Interpolation = "bicubic"
    resampler: Resampler = "grid_sample"
    strip_rows: PositiveInt = 512
    step_px: Positive = 1.0
    bridge_px: NonNegativeInt = 32
    height_range_mm: Interval = (-60.0, 60.0)
    uncertainty: bool = False
    disparity_sigma_px: Positive = 0.09
    min_measured_share: Share = 0.01
