"""Whether a calibration's sigmas of n cover its errors under vibration: ``python scripts/nees.py [--sets 400]``.

Each set is of four tilted boards under three waves of 60-300 mm, drawn anew, in x, z and roll, with corners and the
edges of squares on every line (``--corners``: corners alone). ``--random 60`` replaces the waves by random motion of a
correlation length of 60 mm. A line of output holds, for one set, the verdict, the
normalised squared error of n, 3 in the mean where the covariance is right, the error of each component over its sigma,
and the rms of the line motion's error over its sigma in dx, dz and roll on the board. The exit status is 1 where the
mean of the determined sets is outside 2.5-3.6; how many sets had which verdict is said too.

With ``--rig`` each set is a raw rig, drawn from what the calibration expects, that sees eight boards so move. A line
has the verdict, the normalised squared error of n and the baseline, 4 in the mean where the covariance is right, that
of all 17 quantities, and the rms error of heights and what is stated of it, um. The exit status is 1 where either mean
is outside what chance allows it once in 100 times.
"""

import argparse
import math
import sys
from collections import Counter
from dataclasses import dataclass

import torch

from lsvision.estimation import mean_chi_square_band, nees
from lsvision.geometry import RawPair, quantities_of, without_trend
from lsvision.simulation import BoardPose
from lsvision.stages.calibration.calibrate import calibrate
from lsvision.stages.calibration.config import CalibrationConfig
from lsvision.stages.rig.calibrate import calibrate_rig
from lsvision.stages.rig.config import RigConfig
from lsvision.stages.rig.height_shape import HeightShape
from lsvision.stages.rig.model import RigPrior
from lsvision.study.points import Conditions, exact_corners
from lsvision.study.rig_scans import RigConditions
from lsvision.study.shaken import Motion, RandomMotion, ScanNoise, ShakenScans, Vibration, shaken_scans
from lsvision.study.shaken_rigs import ShakenBoards
from lsvision.types import Board, Calibration, RawCamera, RawRig, Rig

RIG, BOARD = Rig(1786, 40.0, 113.84, 354.0, 260.125, 1524.375), Board(12, 9, 30.0)
POSES = [BoardPose(2.0, 1.5, 0.0), BoardPose(-5.0, 1.0, 6.0), BoardPose(5.0, -2.0, -8.0), BoardPose(-1.0, -3.5, 14.0)]
SIZE, SHORTEST_MM, LONGEST_MM, WAVES = (0.3, 0.3, 3e-4), 60.0, 300.0, 3
LEAST, MOST = 2.5, 3.6
TURN = math.radians(12.5227)
DATA_SHEET = RawRig(7142, 10.0, 354.0, RawCamera(113.84, 3570.5, TURN), RawCamera(113.84, 3570.5, -TURN))
BOARDS_OF_RIG = 8


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


def _waves(chance: torch.Generator, boards: int = len(POSES)) -> Vibration:
    ratio = torch.rand(WAVES, generator=chance, dtype=torch.float64)
    lengths = (SHORTEST_MM * (LONGEST_MM / SHORTEST_MM) ** ratio).tolist()
    return Vibration.drawn(SIZE, lengths, boards, chance)


def _of_lines(found: Calibration, scans: ShakenScans, motion: Motion) -> list[float]:
    ratios = []
    for index, (board, lines) in enumerate(zip(scans.corners, found.line_motions, strict=False)):
        level = without_trend(board.travel_mm)
        off = (level(lines.values.mT) - level(motion.at(index, board.travel_mm).mT)).mT[:, :3]
        travel = board.points[:, 1]
        on_board = (board.travel_mm > travel.min()) & (board.travel_mm < travel.max())
        ratios.append((off / lines.sigma[:, :3])[on_board].square().mean(0))
    return torch.stack(ratios).mean(0).sqrt().tolist() if ratios else []


@dataclass(frozen=True)
class RigOutcome:
    """Of one rig: normalised squared errors of n and the baseline, and of all; height error and that stated, um."""

    verdict: str
    n_and_scale: float
    all: float
    heights_um: float
    stated_um: float


def one_rig(seed: int, random_mm: float | None = None) -> RigOutcome:
    """Simulate and calibrate one raw rig."""
    torch.manual_seed(seed)
    chance = torch.Generator().manual_seed(seed)
    config, conditions = RigConfig(held_out=False), RigConditions(boards=BOARDS_OF_RIG)
    prior = RigPrior.of(DATA_SHEET, config)
    truth = prior.shared(torch.randn(len(prior.mean), dtype=torch.float64))
    waves = random_mm is None
    motion = _waves(chance, BOARDS_OF_RIG) if waves else RandomMotion.drawn(SIZE, random_mm, BOARDS_OF_RIG, chance)
    sightings = ShakenBoards.placed(DATA_SHEET, truth, BOARD, conditions, motion).sightings(conditions)
    found = calibrate_rig(sightings, [str(i) for i in range(BOARDS_OF_RIG)], DATA_SHEET, config)
    error = torch.cat([quantities_of(found.rig), found.motion.n]) - truth.vector
    # The plane of the found rig counts depth from its own z0.
    error[11] -= truth.quantities[13] * (RawPair.of(found.rig).z0_mm - RawPair.of(DATA_SHEET).z0_mm)
    chosen = [10, 14, 15, 16]
    of_n = error[chosen] @ torch.linalg.solve(found.covariance[chosen][:, chosen], error[chosen])
    of_all = error @ torch.linalg.solve(found.covariance, error)
    shape = HeightShape.of(DATA_SHEET, truth, prior.sigma, config.depth_range_mm)
    heights_um = 1e3 * float(shape.bend_mm(prior.over_sigma(error)))
    return RigOutcome(found.verdict, float(of_n), float(of_all), heights_um, found.height_error_um)


def _rms(values: list[float]) -> float:
    return float(torch.tensor(values).square().mean().sqrt())


def rigs(seeds: range, random_mm: float | None) -> bool:
    """Print a line for each rig, then the means; whether these are as chance allows."""
    outcomes = []
    for seed in seeds:
        one = one_rig(seed, random_mm)
        outcomes.append(one)
        print(
            f"{seed:5d} {one.verdict:15} {one.n_and_scale:7.2f} {one.all:7.2f}   "
            f"{one.heights_um:6.2f} {one.stated_um:6.2f}",
            flush=True,
        )
    used, honest = [one for one in outcomes if one.verdict != "inconsistent"], True
    for name, size in (("n_and_scale", 4), ("all", 17)):
        values = torch.tensor([getattr(one, name) for one in used])
        least, most = mean_chi_square_band(size, len(used), 0.99)
        honest &= least < float(values.mean()) < most
        print(f"{name}: mean {float(values.mean()):.2f} ({least:.2f}-{most:.2f}), median {float(values.median()):.2f}")
    heights, stated = (_rms([getattr(one, name) for one in used]) for name in ("heights_um", "stated_um"))
    print(f"heights {heights:.2f} um rms, {stated:.2f} stated")
    print(", ".join(f"{count} {verdict}" for verdict, count in Counter(one.verdict for one in outcomes).most_common()))
    return honest


def main() -> None:
    """Print a line for each set, then the mean."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--sets", type=int, default=400)
    parser.add_argument("--first", type=int, default=0, help="seed of the first set")
    parser.add_argument("--corners", action="store_true", help="corners alone")
    parser.add_argument("--random", type=float, help="correlation length of random motion instead of waves, mm")
    parser.add_argument("--rig", action="store_true", help="raw rigs in place of n alone")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    if arguments.rig:
        sys.exit(not rigs(range(arguments.first, arguments.first + arguments.sets), arguments.random))
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
