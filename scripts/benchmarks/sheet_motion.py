"""Errors of shaken sheets, which their profile and their straight edges steady, against their artwork.

Points of the artwork in the product are off by ``artwork_mm`` (rms), by n alone and with ``line_motion=auto``, which
``median``, ``worst`` and ``ratio`` are of: how far the largest lies inside of ``ASKED_MM``. Edges do not show the trend
of δx over a sheet, which looks like a shear: ``sheared`` is what an exact log without it leaves, ``steady`` the error
with ``auto`` but for a shear. ``waves`` counts those that show the trend. ``dx_over_sigma`` is the rms of the errors of
δx, but for their mean, over their standard deviations on lines that show the sheet. ``still`` counts the still sheets
whose product is the same as by n alone, to the bit. Sheets are a quarter of the camera's size, some of
them without a printed frame; ``--full`` takes one of the whole.
"""

import statistics
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import torch
from line_motion import FULL_RIG, PITCH_MM, WITHOUT, corrected, write_with_true_n
from torch import Tensor
from torch.nn.functional import pad

from lsvision.archive import LineMotionChoice
from lsvision.geometry import scaled_rig, without_trend
from lsvision.image.tiling import keep_freed_memory
from lsvision.io import Product, write_line_motion
from lsvision.simulation import Acquisition, MotionConfig, SceneConfig, SensorConfig, Simulation, simulate
from lsvision.simulation.sheet_points import points_in_product
from lsvision.stages.line_motion.config import LineMotionConfig
from lsvision.types import Board, LineMotion, TensorImage

ASKED_MM = 0.05
MOTION = MotionConfig(angle_x_deg=2.0, angle_z_deg=1.5, stretch=1.0246)
# Vibration in x and z, mm, yaw, and whether a frame is printed along the sides.
SHAKEN = (
    (0.65, 0.65, 0.0, True),
    (0.65, 0.65, 0.0, False),
    (0.5, 0.65, 0.5, True),
    (0.3, 0.4, 1.0, True),
    (0.3, 0.4, 1.0, False),
    (0.65, 0.5, 2.0, True),
    (0.4, 0.3, -1.5, True),
    (0.4, 0.3, -1.5, False),
)
STILL = 10


def sheet(folder: Path, scale: int, scene: SceneConfig, motion: MotionConfig) -> Simulation:
    """Write a scan of a sheet, ``scan``, and its calibration, ``n.json``."""
    folder.mkdir(exist_ok=True)
    made = simulate(
        scaled_rig(FULL_RIG, scale),
        Board(12, 9, 30.0),
        replace(scene, kind="sheet", pitch_deg=2.0, roll_deg=1.5),
        motion,
        SensorConfig(seed=scene.seed),
        Acquisition(PITCH_MM * scale),
    )
    write_with_true_n(made, folder)
    return made


@dataclass(frozen=True)
class Off:
    """Rms error of points of the artwork, and what of it is no shear of the sheet along its travel, mm."""

    rms_mm: float
    steady_mm: float

    @classmethod
    def of(cls, product: Product, made: Simulation) -> "Off":
        """That of a sheet's product."""
        rows = product.shape[0]
        color, height = TensorImage(product.color(0, rows)), TensorImage(product.height(0, rows)[..., None])
        points = points_in_product(color, height, product.grid, made.trajectory.n, made)
        return cls(points.rms_mm, points.unsheared_rms_mm)


def true_motion(folder: Path, made: Simulation) -> LineMotionChoice:
    """An exact log without mean and trend over the sheet."""
    lines = torch.arange(made.lines).double()
    values = pad(without_trend(lines, lines_of_sheet(made))(made.trajectory.vibration(lines).T).T, (0, 1))
    write_line_motion(LineMotion(values, values.new_zeros(len(values), 4, 4)), folder / "log.parquet")
    return LineMotionChoice.of(str(folder / "log.parquet"), LineMotionConfig())


def lines_of_sheet(made: Simulation) -> Tensor:
    """Lines that show most of the sheet."""
    shown = torch.cat(list(made.depth_strips())) < made.pose.translation[2] + 13.0
    return shown.double().mean(1) > 0.3


def dx_over_sigma(product: Product, made: Simulation) -> float:
    """Rms of errors of δx, but for the mean, over their standard deviations, on lines that show most of the sheet."""
    lines = torch.arange(made.lines).double()
    seen = lines_of_sheet(made)
    found = product.line_motion()
    error = found["dx_mm"] - made.trajectory.vibration(lines)[:, 0]
    error = error[seen] - error[seen].mean()
    return float((error / found["dx_sigma_mm"][seen]).square().mean().sqrt())


def is_left_alone(folder: Path, scale: int, seed: int) -> bool:
    """Whether the product of a still sheet is the same with its motion measured."""
    sheet(folder, scale, SceneConfig(yaw_deg=(0.0, 0.5, 1.0, 2.0, -1.5)[seed % 5], sheet_frame=seed % 2 == 0), MOTION)
    auto = replace(WITHOUT, line_motion=LineMotionChoice("auto"))
    still, steadied = (corrected(folder, each, folder / str(i)).product for i, each in enumerate((WITHOUT, auto)))
    rows = still.shape[0]
    same = torch.equal(still.height(0, rows).nan_to_num(), steadied.height(0, rows).nan_to_num())
    return same and torch.equal(still.color(0, rows), steadied.color(0, rows))


def shaken(folder: Path, scale: int, seed: int, case: tuple[float, float, float, bool]) -> dict[str, Any]:
    """Errors of one sheet."""
    x, z, yaw, frame = case
    motion = replace(MOTION, vibration_x_mm=x, vibration_z_mm=z, vibration_roll_deg=0.02, seed=seed)
    made = sheet(folder, scale, SceneConfig(yaw_deg=yaw, sheet_frame=frame, seed=seed), motion)
    choices = {"none": WITHOUT.line_motion, "sheared": true_motion(folder, made), "auto": LineMotionChoice("auto")}
    products = {
        name: corrected(folder, replace(WITHOUT, line_motion=choice), folder / name).product
        for name, choice in choices.items()
    }
    off = {name: Off.of(product, made) for name, product in products.items()}
    return {
        "artwork_mm": {
            **{name: round(each.rms_mm, 4) for name, each in off.items()},
            "steady": round(off["auto"].steady_mm, 4),
        },
        "edges": products["auto"].metadata["line_motion"]["components"][0]["edges"],
        "waves": products["auto"].metadata["line_motion"]["components"][0]["waves"],
        "dx_over_sigma": round(dx_over_sigma(products["auto"], made), 2),
    }


def run(*, full: bool = False) -> dict[str, object]:
    """Errors of all sheets."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    keep_freed_memory()
    scale, cases, still = (1, SHAKEN[:1], 0) if full else (4, SHAKEN, STILL)
    sheets = []
    for seed, case in enumerate(cases):
        with tempfile.TemporaryDirectory() as temporary:
            sheets.append(shaken(Path(temporary), scale, seed, case))
    alone = 0
    for seed in range(still):
        with tempfile.TemporaryDirectory() as temporary:
            alone += is_left_alone(Path(temporary), scale, seed)
    errors = [each["artwork_mm"]["auto"] for each in sheets]
    return {
        "unit": "mm rms between points of a sheet's product and its artwork",
        "artwork_mm": [each["artwork_mm"] for each in sheets],
        "median": round(statistics.median(errors), 4),
        "worst": round(max(errors), 4),
        "edges": [each["edges"] for each in sheets],
        "waves": [each["waves"] for each in sheets],
        "dx_over_sigma": [each["dx_over_sigma"] for each in sheets],
        "still": f"{alone} of {still}",
        "ratio": round(ASKED_MM / max(errors), 3),
    }
