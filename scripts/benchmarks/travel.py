"""A metre of a shaken rail, whose advance is measured by the lines of the colours: ``+experiment=motion``, no target.

One scan is even, and its calibration's n is off by ``OFF``; the pitch of the other grows by ``STEP`` on its way.
``ratio`` is the least of what is asked over what is missed: the stretch within ``ASKED``, and the step within
``LINES_ASKED`` lines. The camera is a quarter of its size, ``--full`` takes the whole: 14 286 lines of 7142 px.
"""

import json
import math
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, fields, replace
from pathlib import Path

import torch
from torch import Tensor

from lsvision.geometry import scaled_rig
from lsvision.io import NewScan, write_calibration, write_scan
from lsvision.simulation import Acquisition, MotionConfig, SceneConfig, SensorConfig, Simulation, simulate
from lsvision.simulation.trajectory import Trajectory
from lsvision.types import Board, Calibration, Motion, Observability, Rig

FULL_RIG = Rig(7142, 10.0, 113.84, 354.0, 1042.0, 6099.0, (-4.0, 0.0, 4.0))
PITCH_MM, LENGTH_MM = 0.07, 1000.0
OFF, STEP, STEP_AT_MM = 6e-4, 5e-3, 430.0
ASKED, LINES_ASKED = 2e-4, 200
MOTION = MotionConfig(
    angle_x_deg=-1.5,
    angle_z_deg=0.8,
    stretch=1.0246,
    vibration_x_mm=0.3,
    vibration_z_mm=0.3,
    vibration_roll_deg=0.01,
)


@dataclass(frozen=True)
class Stepped(Trajectory):
    """A trajectory whose lines lie further apart from a place on, by the share ``step``."""

    step: float = 0.0

    def _wobble(self, even: Tensor) -> Tensor:
        return self.step * (even - STEP_AT_MM).clamp(min=0)


def rail(scale: int, step: float, seed: int) -> Simulation:
    """A metre of it; neighbouring colours look four lines apart at any scale."""
    rig = replace(scaled_rig(FULL_RIG, scale), color_spacing_lines=FULL_RIG.color_spacing_lines)
    lines = math.ceil(LENGTH_MM / (PITCH_MM * scale))
    scene, sensor = SceneConfig("rail", seed=seed), SensorConfig(supersampling=1, seed=seed)
    motion = replace(MOTION, seed=seed)
    whole = simulate(rig, Board(12, 9, 30.0), scene, motion, sensor, Acquisition(PITCH_MM * scale, lines=lines))
    known = {field.name: getattr(whole.trajectory, field.name) for field in fields(Trajectory)}
    return replace(whole, trajectory=Stepped(**known, step=step))


def travel_of(source: Simulation, n: Tensor, folder: Path) -> dict[str, object]:
    """What ``+experiment=motion`` says of the travel, with ``n`` as calibration."""
    images = (source.strips(camera) for camera in ("left", "right"))
    write_scan(folder / "scan", NewScan(source.rig, source.travel, *images, source.lines, color_registered=True))
    known = Motion(n, 1e-10 * torch.eye(3, dtype=torch.float64))
    write_calibration(
        Calibration("joint", known, 1.0, 0.1, (), (), Observability((), ""), source.rig), folder / "n.json"
    )
    command = [sys.executable, "-m", "lsvision.run", "+experiment=motion", f"scan={folder / 'scan'}"]
    run = folder / "run"
    subprocess.run([*command, f"calibration={folder / 'n.json'}", f"hydra.run.dir={run}"], check=True)
    found: dict[str, object] = json.loads((run / "summary.json").read_text())["travel"]
    return found


def measured(scale: int, seed: int, step: float) -> dict[str, object]:
    """What is found of a new scan that is removed afterwards."""
    with tempfile.TemporaryDirectory() as folder:
        source = rail(scale, step, seed)
        return travel_of(source, source.trajectory.n / (1 if step else 1 + OFF), Path(folder))


def run(*, full: bool = False) -> dict[str, object]:
    """Errors of the rate and of the step, and seconds."""
    torch.set_num_threads(1)
    scale, begin = (1 if full else 4), time.perf_counter()
    even, stepped = (measured(scale, seed, step) for seed, step in ((0, 0.0), (1, STEP)))
    missed = abs(even["rate"] - 1 - OFF)
    pieces, at = stepped["pieces"], STEP_AT_MM / (PITCH_MM * scale)
    found = abs(pieces[1]["first"] - at) if len(pieces) == 2 else math.inf
    return {
        "unit": "error of the rate of a metre's advance; lines by which a step of 0.5 % is missed",
        "rate": even["rate"],
        "rate_error": missed,
        "rate_sigma": even["sigma"],
        "step_at_line": round(at),
        "step_missed_by_lines": found,
        "pieces": pieces,
        "seconds": round(time.perf_counter() - begin, 1),
        "ratio": round(min(ASKED / missed, LINES_ASKED / max(found, 1)), 3),
    }
