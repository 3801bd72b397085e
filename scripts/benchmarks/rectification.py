"""What raw cameras cost: correcting a full-size scan of a raw pair beside one of the ideal pair, by processor time.

Both pairs see the same sheet. The raw ones are turned, have distortion, and look at one plane or at two. The scans are
corrected in turns, matching and all, from memory. ``ratio`` is the processor time of the ideal pair over that of the
raw pair of two planes; ``asked`` is the least that it should be.
"""

import statistics
import time
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from lsvision.geometry import ideal_rig
from lsvision.image.tiling import keep_freed_memory
from lsvision.simulation import Acquisition, MotionConfig, SceneConfig, SensorConfig, simulate
from lsvision.stages.correction.config import CorrectionConfig
from lsvision.stages.correction.correct import correct_scan
from lsvision.stages.correction.grid import plan_product
from lsvision.stages.disparity.config import DisparityConfig
from lsvision.stages.disparity.depth import depth_of
from lsvision.types import Board, Motion, RawCamera, RawRig, Rig, Scan, StereoPair, ViewPlane

ONE_PLANE = RawRig(
    7142,
    10.0,
    354.0,
    RawCamera(114.1, 3571.0, 0.2212, (0.012, -0.01)),
    RawCamera(113.6, 3569.6, -0.2203, (-0.009, 0.006)),
)
TWO_PLANES = replace(ONE_PLANE, view_plane=ViewPlane(0.25, 0.0035, -0.0035))
PITCH_MM, LINES, TURNS = 0.07, 2560, 4
ASKED = 1 / 1.15
CONFIG = CorrectionConfig()
MATCHING = DisparityConfig()
MOTION = MotionConfig(angle_x_deg=-1.5, angle_z_deg=0.8, stretch=1.0246)


@dataclass(frozen=True)
class Stored:
    """An image in memory."""

    lines: Tensor

    @property
    def shape(self) -> tuple[int, int, int]:
        height, width, channels = self.lines.shape
        return height, width, channels

    @property
    def dtype(self) -> torch.dtype:
        return self.lines.dtype

    def read(self, start: int, stop: int) -> Tensor:
        return self.lines[start:stop]


@dataclass(frozen=True)
class Taken:
    """A scan, and the motion of what it shows."""

    scan: Scan
    motion: Motion


def taken(rig: Rig | RawRig) -> Taken:
    """A sheet that fills the lines, as a pair sees it."""
    scene, sensor = SceneConfig("sheet", sheet_width_mm=600.0, sheet_height_mm=300.0), SensorConfig(supersampling=1)
    seen = simulate(rig, Board(12, 9, 30.0), scene, MOTION, sensor, Acquisition(PITCH_MM, lines=LINES))
    left, right = (Stored(torch.cat(list(seen.strips(camera)))) for camera in ("left", "right"))
    raw = rig if isinstance(rig, RawRig) else None
    scan = Scan(Path("made"), seen.rig, seen.travel, StereoPair(left, right), raw_rig=raw)
    return Taken(scan, Motion(seen.trajectory.n, torch.zeros(3, 3, dtype=torch.float64)))


def seconds_of(what: Taken) -> float:
    """Processor time of a correction."""
    begin = time.process_time()
    grid = plan_product(what.scan, what.motion, CONFIG)
    for _ in correct_scan(what.scan, depth_of(what.scan, MATCHING, n=what.motion.n), what.motion, CONFIG, grid):
        pass
    return time.process_time() - begin


def run() -> dict[str, object]:
    """Processor seconds of each pair, and how much more the raw ones take, %."""
    torch.set_num_threads(1)
    keep_freed_memory()
    sides = {
        name: taken(rig)
        for name, rig in (("ideal", ideal_rig(TWO_PLANES)), ("one plane", ONE_PLANE), ("two planes", TWO_PLANES))
    }
    seconds: dict[str, list[float]] = {name: [] for name in sides}
    for turn in range(TURNS + 1):
        for name, what in sides.items():
            once = seconds_of(what)
            if turn > 0:
                seconds[name].append(once)
    middle = {name: statistics.median(values) for name, values in seconds.items()}
    return {
        "unit": f"processor seconds for {LINES} lines of 7142 px",
        "seconds": {name: [round(value, 2) for value in values] for name, values in seconds.items()},
        "more_percent": {
            name: round(100 * (middle[name] / middle["ideal"] - 1), 1) for name in ("one plane", "two planes")
        },
        "asked": round(ASKED, 3),
        "ratio": round(middle["ideal"] / middle["two planes"], 3),
    }
