"""``inspect`` of a simulated rail: which defects are found, how deep and where, and what is found that is none.

Pits are 0.2 mm deep and 4 mm wide or more, scratches 0.25 mm deep, and a damaged roll leaves a mark at each turn.
``ratio`` is the time of ``correct`` over that of ``inspect``. The rail is shaken by 0.65 mm, which is measured and
taken off; ``--glossy`` makes it specular. It is a quarter of the camera's size; ``--full`` takes the whole.
"""

import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import torch
from torch import Tensor

from lsvision.archive import LineMotionChoice
from lsvision.archive.inspection import Inspection, inspect_product
from lsvision.geometry import product_pose, scaled_rig, transform
from lsvision.image.tiling import keep_freed_memory
from lsvision.io import NewScan, write_calibration, write_scan
from lsvision.simulation import Acquisition, SceneConfig, SensorConfig, Simulation, simulate
from lsvision.simulation.defects import SCRATCH_LENGTH_MM, Cells, drawn_pits, drawn_scratches
from lsvision.stages.surface.config import SurfaceConfig
from lsvision.types import Board, Calibration, Candidate, Motion, Observability
from scripts.benchmarks.line_motion import FULL_RIG, MOTION, PITCH_MM, WITHOUT, corrected

BOARD = Board(12, 9, 30.0)
SCENE = SceneConfig(kind="rail", pit_depth_mm=(0.2, 0.2001), pit_radius_mm=(2.0, 3.0), defect_spacing_mm=100.0)
NEAR_MM, MARK_MM, ENDS_MM = 2.5, 9.0, 12.0  # of a defect; along a mark; where a product begins and ends


@dataclass(frozen=True)
class Truth:
    """Defects of a rail in its product: (q_x, q_y) of each, mm, and which of them are pits, with their depths."""

    pits: Tensor
    pit_depth_mm: Tensor
    scratches: Tensor
    marks: Tensor

    @classmethod
    def of(cls, rail: Simulation, length_mm: float) -> "Truth":
        """Those within a product's length."""
        scene, pose = rail.scene, product_pose(rail.pose, rail.trajectory.n)
        cells = Cells(torch.arange(-100, 101)[:, None, None], scene.defect_spacing_mm)
        pits, scratches = drawn_pits(scene, cells, scene.seed), drawn_scratches(cells, scene.seed)
        turns = Cells(torch.arange(-100, 101)[:, None, None], scene.roll_mark_period_mm or 1e9)

        def placed(s: Tensor, along: Tensor) -> Tensor:
            flat = torch.stack([s.flatten(), along.flatten(), torch.zeros(s.numel())], -1)
            return transform(pose.rotation, pose.translation, flat.double())[:, :2]

        half = SCRATCH_LENGTH_MM / 2
        at = placed(pits.s, pits.along)
        inside = (at[:, 1] > ENDS_MM) & (at[:, 1] < length_mm - ENDS_MM)
        middles = placed(scratches.s + scratches.skew * half, scratches.along + half)
        marks = placed(torch.full_like(turns.index.double(), 9.0), turns.index.double() * turns.spacing_mm)
        return cls(at[inside], pits.depth_mm.flatten()[inside], middles, marks)


def score(inspection: Inspection, truth: Truth, length_mm: float) -> dict[str, object]:
    """What was found of what is there."""
    relief = [candidate for candidate in inspection.marked.candidates if candidate.kind != "color"]
    color = [candidate for candidate in inspection.marked.candidates if candidate.kind == "color"]
    at = torch.tensor([(one.across_mm, one.along_mm) for one in relief], dtype=torch.float64).reshape(-1, 2)
    depth = torch.tensor([one.depth_mm for one in relief], dtype=torch.float64)
    sigma = torch.tensor([one.depth_sigma_mm for one in relief], dtype=torch.float64)

    def lone(place: Tensor) -> bool:
        """Whether no other defect lies on a pit."""
        on_scratch = _near(place, truth.scratches, 3.0 + NEAR_MM, SCRATCH_LENGTH_MM / 2 + NEAR_MM)
        on_mark = _near(place, truth.marks, 5.0 + NEAR_MM, MARK_MM + NEAR_MM)
        return not (on_scratch or on_mark)

    lonely = torch.tensor([lone(place) for place in truth.pits])
    pits, depths = truth.pits[lonely], truth.pit_depth_mm[lonely]
    off = (pits[:, None] - at).norm(dim=-1) if len(relief) else pits.new_full((len(pits), 1), torch.inf)
    nearest, which = off.min(1)
    found = nearest < NEAR_MM
    errors = -depth[which[found]] / depths[found] - 1
    inside = (truth.scratches[:, 1] > ENDS_MM + 25) & (truth.scratches[:, 1] < length_mm - ENDS_MM - 25)
    scratches = truth.scratches[inside]
    seen = [_near(place, at, 4.0, SCRATCH_LENGTH_MM / 2) for place in scratches]
    false = [
        one
        for one, place in zip(relief, at, strict=True)
        if not (
            _near(place, truth.pits, 3 + NEAR_MM, 3 + NEAR_MM)
            or _near(place, truth.scratches, 3 + NEAR_MM, SCRATCH_LENGTH_MM / 2 + NEAR_MM)
            or _near(place, truth.marks, 5 + NEAR_MM, MARK_MM + NEAR_MM)
            or not ENDS_MM < float(place[1]) < length_mm - ENDS_MM
        )
    ]
    groups = inspection.marked.groups
    return {
        "pits": len(pits),
        "pits_found": int(found.sum()),
        "scratches": len(scratches),
        "scratches_found": sum(seen),
        "false_per_metre": round(1e3 * len(false) / length_mm, 2),
        "by_color_per_metre": round(1e3 * len(color) / length_mm, 2),
        "depth_error_percent": {"mean": _rounded(errors.mean(), 100), "largest": _rounded(errors.abs().max(), 100)},
        "depth_error_over_sigma": _rounded(
            ((-depth[which[found]] - depths[found]) / sigma[which[found]]).square().mean().sqrt(), 1
        ),
        "place_error_mm": {
            "rms": _rounded(nearest[found].square().mean().sqrt(), 1),
            "largest": _rounded(nearest[found].max(), 1),
        },
        "roll_marks": [(group.marks, round(group.period_mm, 2), round(group.period_sigma_mm, 3)) for group in groups],
        "false": [_words(one) for one in false[:10]],
    }


def _near(place: Tensor, others: Tensor, across_mm: float, along_mm: float) -> bool:
    off = (others - place).abs()
    return bool(((off[:, 0] < across_mm) & (off[:, 1] < along_mm)).any())


def _rounded(value: Tensor, scale: float) -> float:
    return round(scale * float(value), 3)


def _words(one: Candidate) -> str:
    return f"{one.kind} {one.along_mm:.1f} {one.around_mm:+.1f} {one.depth_mm:+.3f} {one.area_mm2:.1f} {one.ratio:.0f}"


def rail_of(folder: Path, scale: int, lines: int, scene: SceneConfig) -> Simulation:
    """Write a scan of a rail, ``scan``, and its calibration, ``n.json``."""
    folder.mkdir(exist_ok=True, parents=True)
    rail = simulate(
        scaled_rig(FULL_RIG, scale), BOARD, scene, MOTION, SensorConfig(supersampling=1),
        Acquisition(PITCH_MM * scale, lines=lines),
    )  # fmt: skip
    write_scan(folder / "scan", NewScan(rail.rig, rail.travel, rail.strips("left"), rail.strips("right"), rail.lines))
    n = Motion(rail.trajectory.n, 1e-10 * torch.eye(3, dtype=torch.float64))
    write_calibration(Calibration("joint", n, 1.0, 0.1, (), (), Observability((), ""), rail.rig), folder / "n.json")
    return rail


def run(*, full: bool = False, glossy: bool = False, length_mm: float = 1000.0, seed: int = 0) -> dict[str, object]:
    """Simulate, correct and inspect."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    keep_freed_memory()
    scale = 1 if full else 4
    scene = replace(SCENE, seed=seed, rail_gloss=0.1 if glossy else 0.0, lights="along" if glossy else "beside")
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        rail = rail_of(folder, scale, round(length_mm / PITCH_MM / scale), scene)
        made = corrected(folder, replace(WITHOUT, line_motion=LineMotionChoice("auto")), folder / "product")
        begin = time.process_time()
        inspection = inspect_product(made.product, SurfaceConfig())
        seconds = time.process_time() - begin
        long = made.product.grid.rows * made.product.pitch_mm
        return {
            "unit": f"seconds for {rail.lines} lines of {rail.rig.width_px} px",
            "correct": round(made.processor_seconds, 2),
            "inspect": round(seconds, 2),
            "ratio": round(made.processor_seconds / seconds, 2),
            "length_mm": round(long, 1),
            **score(inspection, Truth.of(rail, long), long),
        }
