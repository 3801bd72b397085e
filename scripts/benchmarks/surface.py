"""``inspect`` of rendered rails: which defects are found, how deep and where, and what is found that is none.

Pits are 0.2 mm deep and 4 mm wide or more, scratches 0.25 mm deep, and a damaged roll leaves a mark every 150 mm. A
rail is matt, one glossy; both are shaken by 0.65 mm, which is measured and taken off. ``ratio`` is the time of
``correct`` over that of ``inspect``. The rails are a quarter of the camera's size; ``--full`` takes the whole.
"""

import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import torch
from line_motion import FULL_RIG, MOTION, PITCH_MM, WITHOUT, corrected, write_with_true_n
from torch import Tensor

from lsvision.archive import LineMotionChoice
from lsvision.archive.inspection import inspect_product
from lsvision.geometry import product_pose, scaled_rig, transform
from lsvision.image.tiling import keep_freed_memory
from lsvision.simulation import Acquisition, SceneConfig, SensorConfig, Simulation, simulate
from lsvision.simulation.defects import SCRATCH_LENGTH_MM, Cells, drawn_pits, drawn_scratches
from lsvision.stages.surface.config import SurfaceConfig
from lsvision.stages.surface.marks import MarkedSurface
from lsvision.types import Board, Candidate

SCENE = SceneConfig(kind="rail", pit_depth_mm=(0.2, 0.2001), pit_radius_mm=(2.0, 3.0), defect_spacing_mm=100.0)
RAILS = {"matt": SCENE, "glossy": replace(SCENE, seed=1, rail_gloss=0.1, lights="along")}
LENGTH_MM, ENDS_MM = 1000.0, 12.0  # of a rail; where a product begins and ends, which is not counted
PIT_MM, SCRATCH_MM, MARK_MM = (5.5, 5.5), (5.5, 25.0), (7.5, 11.5)  # across and along: half a defect, and its blur
MARK_S_MM = 9.0
CELLS = torch.arange(-100, 101)[:, None, None]


@dataclass(frozen=True)
class Truth:
    """Defects of a rail in its product: (q_x, q_y) of each, mm, and the depths of the pits."""

    pits: Tensor
    pit_depth_mm: Tensor
    scratches: Tensor
    marks: Tensor

    @classmethod
    def of(cls, rail: Simulation) -> "Truth":
        """All of a long rail; scratches and marks by their middles."""
        scene, pose, half = rail.scene, product_pose(rail.pose, rail.trajectory.n), SCRATCH_LENGTH_MM / 2
        cells, turns = Cells(CELLS, scene.defect_spacing_mm), Cells(CELLS, scene.roll_mark_period_mm)
        pits, scratches = drawn_pits(scene, cells, scene.seed), drawn_scratches(cells, scene.seed)

        def placed(s: Tensor, along: Tensor) -> Tensor:
            flat = torch.stack([s.flatten(), along.flatten(), torch.zeros(s.numel())], -1)
            return transform(pose.rotation, pose.translation, flat.double())[:, :2]

        return cls(
            placed(pits.s, pits.along),
            pits.depth_mm.flatten(),
            placed(scratches.s + scratches.skew * half, scratches.along + half),
            placed(torch.full_like(turns.index.double(), MARK_S_MM), turns.index.double() * turns.spacing_mm),
        )

    def is_defect(self, place: Tensor) -> bool:
        """Whether a place lies on any of them."""
        return any(
            on(place, some, reach)
            for some, reach in ((self.pits, PIT_MM), (self.scratches, SCRATCH_MM), (self.marks, MARK_MM))
        )

    def is_lone(self, pit: Tensor) -> bool:
        """Whether no scratch or mark lies on a pit."""
        return not (on(pit, self.scratches, SCRATCH_MM) or on(pit, self.marks, MARK_MM))


def on(place: Tensor, others: Tensor, reach_mm: tuple[float, float]) -> bool:
    """Whether one of the others lies within a reach across and along."""
    return bool(((others - place).abs() < torch.tensor(reach_mm)).all(-1).any())


def within(places: Tensor, length_mm: float, ends_mm: float) -> Tensor:
    """Which of some places a product shows, away from its ends."""
    return (places[:, 1] > ends_mm) & (places[:, 1] < length_mm - ends_mm)


def rms(values: Tensor) -> float | None:
    """Root of the mean square; None of nothing."""
    return round(float(values.square().mean().sqrt()), 4) if len(values) else None


def score(found: MarkedSurface, truth: Truth, length_mm: float) -> dict[str, object]:
    """What was found of what is there."""
    relief = [candidate for candidate in found.candidates if candidate.kind != "color"]
    at = torch.tensor([(one.across_mm, one.along_mm) for one in relief], dtype=torch.float64).reshape(-1, 2)
    seen = within(truth.scratches, length_mm, ENDS_MM + SCRATCH_MM[1])
    scratches = [on(place, at, SCRATCH_MM) for place in truth.scratches[seen]]
    inside = within(at, length_mm, ENDS_MM).tolist()
    false = [not truth.is_defect(place) for place, here in zip(at, inside, strict=True) if here]
    return {
        **score_pits(relief, at, truth, length_mm),
        "scratches": len(scratches),
        "scratches_found": sum(scratches),
        "false_per_metre": round(1e3 * sum(false) / length_mm, 2),
        "by_color_per_metre": round(1e3 * (len(found.candidates) - len(relief)) / length_mm, 2),
        "roll_marks": [
            {"marks": group.marks, "period_mm": round(group.period_mm, 3), "sigma": round(group.period_sigma_mm, 3)}
            for group in found.groups
        ],
    }


def score_pits(relief: list[Candidate], at: Tensor, truth: Truth, length_mm: float) -> dict[str, object]:
    """Of the pits that no other defect lies on: how many are found, how deep, and where."""
    lone = torch.tensor([truth.is_lone(pit) for pit in truth.pits]) & within(truth.pits, length_mm, ENDS_MM)
    pits, depths = truth.pits[lone], truth.pit_depth_mm[lone]
    off = torch.cat([(pits[:, None] - at).norm(dim=-1), torch.full((len(pits), 1), torch.inf)], 1)
    nearest, which = off.min(1)
    seen = nearest < PIT_MM[0] / 2
    chosen = [relief[index] for index in which[seen].tolist()]
    error = -torch.tensor([one.depth_mm for one in chosen], dtype=torch.float64) - depths[seen]
    sigma = torch.tensor([one.depth_sigma_mm for one in chosen], dtype=torch.float64)
    return {
        "pits": len(pits),
        "pits_found": int(seen.sum()),
        "depth_error_mm": {"mean": round(float(error.mean()), 4) if len(error) else None, "rms": rms(error)},
        "depth_error_over_sigma": rms(error / sigma),
        "place_error_mm": rms(nearest[seen]),
    }


def rail_of(folder: Path, scale: int, scene: SceneConfig) -> Simulation:
    """Write a scan of a rail, ``scan``, and its calibration, ``n.json``."""
    folder.mkdir(parents=True)
    pitch = PITCH_MM * scale
    acquisition = Acquisition(pitch, lines=round(LENGTH_MM / pitch))
    board, sensor = Board(12, 9, 30.0), SensorConfig(supersampling=1)
    rail = simulate(scaled_rig(FULL_RIG, scale), board, scene, MOTION, sensor, acquisition)
    write_with_true_n(rail, folder)
    return rail


def run(*, full: bool = False) -> dict[str, object]:
    """Render, correct and inspect both rails."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    keep_freed_memory()
    steadied, scores, seconds = replace(WITHOUT, line_motion=LineMotionChoice("auto")), {}, []
    with tempfile.TemporaryDirectory() as temporary:
        for name, scene in RAILS.items():
            folder = Path(temporary) / name
            rail = rail_of(folder, 1 if full else 4, scene)
            made = corrected(folder, steadied, folder / "product")
            begin = time.process_time()
            found = inspect_product(made.product, SurfaceConfig()).marked
            seconds.append((made.processor_seconds, time.process_time() - begin))
            scores[name] = score(found, Truth.of(rail), made.product.grid.rows * made.product.pitch_mm)
    correct, inspect = (sum(part) for part in zip(*seconds, strict=True))
    return {
        "unit": f"seconds of the processor for 2 rails of {LENGTH_MM:g} mm, {rail.rig.width_px} px",
        "correct": round(correct, 2),
        "inspect": round(inspect, 2),
        "ratio": round(correct / inspect, 2),
        **scores,
    }
