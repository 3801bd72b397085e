"""Whether a calibration's sigmas of n cover its errors under vibration: ``python scripts/nees.py [--sets 400]``.

Each set is of four tilted boards under three waves of 60-300 mm, drawn anew, in x, z and roll, with corners and the
edges of squares on every line (``--corners``: corners alone). ``--random 60`` replaces the waves by random motion of a
correlation length of 60 mm. A line of output holds, for one set, the verdict, the
normalised squared error of n, 3 in the mean where the covariance is right, the error of each component over its sigma,
and the rms of the line motion's error over its sigma in dx, dz and roll on the board. The exit status is 1 where the
mean of the determined sets is outside 2.5-3.6; how many sets had which verdict is said too.
"""

import argparse
import sys
from collections import Counter
from dataclasses import dataclass

import torch

from lsvision.estimation import nees
from lsvision.geometry import without_trend
from lsvision.simulation import BoardPose
from lsvision.stages.calibration.calibrate import calibrate
from lsvision.stages.calibration.config import CalibrationConfig
from lsvision.study.points import Conditions, exact_corners
from lsvision.study.shaken import Motion, RandomMotion, ScanNoise, ShakenScans, Vibration, shaken_scans
from lsvision.types import Board, Calibration, Rig

RIG, BOARD = Rig(1786, 40.0, 113.84, 354.0, 260.125, 1524.375), Board(12, 9, 30.0)
POSES = [BoardPose(2.0, 1.5, 0.0), BoardPose(-5.0, 1.0, 6.0), BoardPose(5.0, -2.0, -8.0), BoardPose(-1.0, -3.5, 14.0)]
SIZE, SHORTEST_MM, LONGEST_MM, WAVES = (0.3, 0.3, 3e-4), 60.0, 300.0, 3
LEAST, MOST = 2.5, 3.6


@dataclass(frozen=True)
class Outcome:
    """Of one set: verdict, normalised squared error of n, its errors in sigmas, and those of the line motion, rms."""

    verdict: str
    nees: float
    in_sigmas: list[float]
    lines: list[float]


def one_set(seed: int, with_edges: bool, random_mm: float | None = None) -> Outcome:
    """Simulate and calibrate one set."""
    chance = torch.Generator().manual_seed(seed)
    conditions = Conditions("four", angle_x_deg=2.0, angle_z_deg=1.5, stretch=1.0246)
    exact = exact_corners(RIG, BOARD, {"four": POSES}, conditions)
    motion = _waves(chance) if random_mm is None else RandomMotion.drawn(SIZE, random_mm, len(POSES), chance)
    scans = shaken_scans(RIG, BOARD, exact, motion, ScanNoise(), chance)
    found = calibrate(scans.corners, RIG, CalibrationConfig(), scans.edges if with_edges else None)
    error = found.motion.n - exact.n
    squared = float(nees(error, torch.linalg.cholesky(found.motion.covariance)))
    return Outcome(found.verdict, squared, (error / found.motion.sigma).tolist(), _of_lines(found, scans, motion))


def _waves(chance: torch.Generator) -> Vibration:
    ratio = torch.rand(WAVES, generator=chance, dtype=torch.float64)
    lengths = (SHORTEST_MM * (LONGEST_MM / SHORTEST_MM) ** ratio).tolist()
    return Vibration.drawn(SIZE, lengths, len(POSES), chance)


def _of_lines(found: Calibration, scans: ShakenScans, motion: Motion) -> list[float]:
    ratios = []
    for index, (board, lines) in enumerate(zip(scans.corners, found.line_motions, strict=False)):
        level = without_trend(board.travel_mm)
        off = (level(lines.values.mT) - level(motion.at(index, board.travel_mm).mT)).mT[:, :3]
        travel = board.points[:, 1]
        on_board = (board.travel_mm > travel.min()) & (board.travel_mm < travel.max())
        ratios.append((off / lines.sigma[:, :3])[on_board].square().mean(0))
    return torch.stack(ratios).mean(0).sqrt().tolist() if ratios else []


def main() -> None:
    """Print a line for each set, then the mean."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--sets", type=int, default=400)
    parser.add_argument("--first", type=int, default=0, help="seed of the first set")
    parser.add_argument("--corners", action="store_true", help="corners alone")
    parser.add_argument("--random", type=float, help="correlation length of random motion instead of waves, mm")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    errors, verdicts = [], Counter[str]()
    for seed in range(arguments.first, arguments.first + arguments.sets):
        outcome = one_set(seed, not arguments.corners, arguments.random)
        verdicts[outcome.verdict] += 1
        if outcome.verdict == "determined":
            errors.append(outcome.nees)
        words = ("  ".join(f"{value:6.2f}" for value in values) for values in (outcome.in_sigmas, outcome.lines))
        print(f"{seed:5d} {outcome.verdict:12} {outcome.nees:7.2f}   {next(words)}   {next(words)}", flush=True)
    values = torch.tensor(errors).sort().values
    mean, spread = float(values.mean()), float(values.std() / len(values) ** 0.5)
    largest = ", ".join(f"{value:.1f}" for value in values[-5:].tolist())
    print(f"{len(values)} determined sets: mean {mean:.2f} +- {spread:.2f}, median {float(values.median()):.2f}")
    print(f"largest: {largest}")
    print(", ".join(f"{count} {verdict}" for verdict, count in verdicts.most_common()))
    sys.exit(not LEAST < mean < MOST)


if __name__ == "__main__":
    main()
