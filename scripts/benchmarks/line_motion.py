"""``correct`` of a shaken rail with its motion from line to line measured, compared with ``correct`` without.

``ratio`` is the time without over the time with. Errors are those of the crown's height along the product, about a
straight line, and of the measured displacements, whose truth is known; ``nees`` is their mean square in units of their
covariance, 3 where it is right. The rail is a quarter of the camera's size; ``--full`` takes the whole.
"""

import math
import statistics
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import torch
from torch import Tensor

from lsvision.archive import LineMotionChoice, Processing, plan_one, process_one
from lsvision.geometry import scaled_rig, without_trend
from lsvision.image.tiling import keep_freed_memory
from lsvision.io import NewScan, Product, read_product, write_calibration, write_scan
from lsvision.simulation import Acquisition, MotionConfig, SceneConfig, SensorConfig, Simulation, simulate
from lsvision.stages.correction.config import CorrectionConfig
from lsvision.stages.disparity.config import DisparityConfig
from lsvision.types import LINE_COMPONENTS, Board, Calibration, Motion, Observability, Rig

FULL_RIG = Rig(7142, 10.0, 113.84, 354.0, 1042.0, 6099.0)
PITCH_MM = 0.07
MOTION = MotionConfig(
    angle_x_deg=-1.5,
    angle_z_deg=0.8,
    stretch=1.0246,
    vibration_x_mm=0.65,
    vibration_z_mm=0.65,
    vibration_roll_deg=0.02,
)
WITHOUT = Processing(DisparityConfig(), CorrectionConfig(), False, worker_memory_mb=4096)
CROWN_MM = 8.0  # to either side, over which its height is taken
UNITS = {"dx": ("dx_um", 1e3), "dz": ("dz_um", 1e3), "roll": ("roll_urad", 1e6)}


def shaken_rail(folder: Path, scale: int, lines: int) -> Simulation:
    """Write a scan of a rail, ``scan``, and its calibration, ``n.json``."""
    folder.mkdir(exist_ok=True)
    rail = simulate(
        scaled_rig(FULL_RIG, scale),
        Board(12, 9, 30.0),
        SceneConfig(kind="rail"),
        MOTION,
        SensorConfig(supersampling=1),
        Acquisition(PITCH_MM * scale, lines=lines),
    )
    write_with_true_n(rail, folder)
    return rail


def write_with_true_n(made: Simulation, folder: Path) -> None:
    """Write a rendered scan, ``scan``, and a calibration that knows its n, ``n.json``."""
    write_scan(folder / "scan", NewScan(made.rig, made.travel, made.strips("left"), made.strips("right"), made.lines))
    n = Motion(made.trajectory.n, 1e-10 * torch.eye(3, dtype=torch.float64))
    write_calibration(Calibration("joint", n, 1.0, 0.1, (), (), Observability((), ""), made.rig), folder / "n.json")


@dataclass(frozen=True)
class Made:
    """A product, and what it took: seconds by the clock and of the processor."""

    product: Product
    seconds: float
    processor_seconds: float


def corrected(folder: Path, processing: Processing, output: Path) -> Made:
    """Correct the scan of a folder."""
    plan = plan_one(folder / "scan", folder / "n.json", processing)
    begin, used = time.perf_counter(), time.process_time()
    made = process_one(plan, processing, output, lambda task, outcome: None)
    return Made(read_product(made.path), time.perf_counter() - begin, time.process_time() - used)


def crown_rms_mm(product: Product) -> float:
    """Rms of the crown's height along the product, about a straight line, away from the ends."""
    rows, _ = product.shape
    height = product.height(rows // 20, rows - rows // 20).double()
    top = int(height.nanmedian(0).values.nan_to_num(-torch.inf).argmax())
    reach = round(CROWN_MM / product.pitch_mm)
    crown = height[:, top - reach : top + reach + 1]
    crown = (crown - crown.nanmedian(0).values).nanmedian(1).values
    return float(without_trend(torch.arange(len(crown)).double())(crown).square().mean().sqrt())


def errors_of(product: Product, rail: Simulation) -> dict[str, object]:
    """Errors of the displacements, and what was to be found."""
    lines = torch.arange(rail.lines).double()
    truth = without_trend(lines)(rail.trajectory.vibration(lines).T)
    found = product.line_motion()
    names = {"dx": "dx_mm", "dz": "dz_mm", "roll": "roll_rad"}
    errors = torch.stack([found[names[name]] for name in UNITS]) - truth
    sigma = torch.stack([found[names[name].replace("_", "_sigma_")] for name in UNITS])

    def named(values: Tensor) -> dict[str, float]:
        rms = values.square().mean(1).sqrt().tolist()
        return {unit: round(value * scale, 1) for value, (unit, scale) in zip(rms, UNITS.values(), strict=True)}

    squares = (errors / sigma).square().mean(1)
    return {
        "displacement": named(truth),
        "displacement_errors": named(errors),
        "squares_of_errors_over_sigma": {
            name: round(float(square), 2)
            for name, square in zip(LINE_COMPONENTS, squares, strict=False)
            if math.isfinite(float(square))
        },
    }


def run(*, full: bool = False) -> dict[str, object]:
    """Seconds of both, medians of alternating turns, and the errors."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    keep_freed_memory()
    scale, lines, turns = (1, 4096, 1) if full else (4, 1024, 3)
    with_motion = replace(WITHOUT, line_motion=LineMotionChoice("auto"))
    seconds: list[tuple[float, float]] = []
    processor: list[tuple[float, float]] = []
    with tempfile.TemporaryDirectory() as temporary:
        folder, first = Path(temporary), Path(temporary) / "first"
        shaken_rail(first, 16, 128)
        corrected(first, with_motion, first / "o")  # what is imported and made once is not counted
        rail = shaken_rail(folder, scale, lines)
        for turn in range(turns):
            still = corrected(folder, WITHOUT, folder / f"without {turn}")
            steadied = corrected(folder, with_motion, folder / f"with {turn}")
            seconds.append((still.seconds, steadied.seconds))
            processor.append((still.processor_seconds, steadied.processor_seconds))
        before, after = (round(crown_rms_mm(made.product), 4) for made in (still, steadied))
        crown = {"before": before, "after": after}
        errors = errors_of(steadied.product, rail)
    ratio = statistics.median(without / measured for without, measured in seconds)
    return {
        "unit": f"seconds for {lines} lines of {rail.rig.width_px} px, matched and corrected",
        "without": round(statistics.median(pair[0] for pair in seconds), 2),
        "with": round(statistics.median(pair[1] for pair in seconds), 2),
        "ratio": round(ratio, 3),
        "processor_ratio": round(statistics.median(without / measured for without, measured in processor), 3),
        "crown_rms_mm": crown,
        **errors,
    }
