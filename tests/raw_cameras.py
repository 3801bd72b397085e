"""Raw cameras at full size: turned, with distortion, and looking at planes of their own."""

import math

from lsvision.types import RawCamera, RawRig, ViewPlane

TILT = math.radians(0.2)
RAW = RawRig(
    7142, 10.0, 354.0,
    RawCamera(114.1, 3571.0, 0.2212, (0.012, -0.01)),
    RawCamera(113.6, 3569.6, -0.2203, (-0.009, 0.006)),
    ViewPlane(0.25, TILT, -TILT),
)  # fmt: skip
