"""Options of the correction."""

from dataclasses import dataclass

from lsvision.image.resampling import Interpolation, Resampler


@dataclass(frozen=True)
class CorrectionConfig:
    """How a scan becomes a product.

    ``pitch_mm`` is the side of a product's cell; the scan's own line pitch where it is None. ``strip_rows`` are
    computed at once. A surface counts as continuous between neighbours whose disparities differ by at most ``step_px``:
    at one pixel it is so steep that one of the cameras no longer sees it. Holes of up to ``bridge_px`` samples are
    bridged for colour; their height stays invalid. Depths outside ``height_range_mm`` count as not measured; the wider
    it is, the larger the product. With ``uncertainty`` each cell also gets the standard deviation of its position;
    ``disparity_sigma_px`` is that of the matching, where the depth comes without one.
    """

    pitch_mm: float | None = None
    interpolation: Interpolation = "bicubic"
    resampler: Resampler = "grid_sample"
    strip_rows: int = 512
    step_px: float = 1.0
    bridge_px: int = 32
    height_range_mm: tuple[float, float] = (-60.0, 60.0)
    uncertainty: bool = False
    disparity_sigma_px: float = 0.09
