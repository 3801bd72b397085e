"""Lines of an object that are aligned by their crowns: where registering them to each other starts."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from lsvision.geometry import ProductFrame
from lsvision.stages.line_motion.config import LineMotionConfig
from lsvision.stages.line_motion.profiles import LineSamples
from lsvision.stages.line_motion.register import placed
from lsvision.types import Depth

_CROWN_SHARE, _CROWN_COLUMNS = 0.95, 512  # of the heights of a line: about its crown, or lower; of columns that do
_BELOW_MM = 5.0  # of the profile's depth, from where on samples take no part


@dataclass(frozen=True)
class CrownedLines:
    """Samples of lines down to the profile's depth below their crowns, and by how much each line is displaced."""

    samples: LineSamples
    values: Float[Tensor, "lines 3"]

    @classmethod
    def of(cls, depth: Depth, frame: ProductFrame, config: LineMotionConfig) -> "CrownedLines":
        """Those of lines of a scan; values are (δx, δz, ρ), of which δz alone is not zero."""
        samples = LineSamples.of(depth, frame, config.height_range_mm, slice(None))
        values = samples.z.new_zeros(len(samples.z), 3)
        height = placed(samples, values, frame)[1]
        crown = height[:, :: max(1, height.shape[1] // _CROWN_COLUMNS)].nanquantile(_CROWN_SHARE, dim=1)
        values[:, 1] = (crown - crown.nanmedian()).nan_to_num()
        return cls(samples.among(~(height < crown[:, None] - config.profile_depth_mm - _BELOW_MM)), values)
