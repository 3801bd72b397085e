"""Whether sigma covers the errors of disparities under bad light: ``python scripts/honesty.py [LIGHT ...]``.

Rendered scenes are seen in every light and matched with the defaults. A row of the table holds, for one scene, light
and width, the share of pixels that count as measured, the median of |error| / sigma over that of a normal distribution,
the rms of error / sigma, and the share of errors beyond five sigma. The exit status is 1 where an rms exceeds 1.5 or a
share 0.2 %. ``--data FOLDER`` adds the scans of another renderer, as ``scans_other_renderer`` of the shared data.
"""

import argparse
import json
import math
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from lsvision.geometry import focal_length_px, scaled_rig, slope_at
from lsvision.io import read_scan
from lsvision.simulation import Acquisition, MotionConfig, SceneConfig, SensorConfig, simulate
from lsvision.stages.disparity.config import DisparityConfig
from lsvision.stages.disparity.match import measure_strip
from lsvision.types import Board, Rig

LARGEST_RMS, LARGEST_SHARE, BEYOND = 1.5, 0.002, 5.0
FULL_RIG, BOARD, LINES = Rig(7142, 10.0, 113.84, 354.0, 1042.0, 6099.0), Board(12, 9, 30.0), 400
MOTION = MotionConfig(angle_x_deg=-1.5, angle_z_deg=0.8, stretch=1.0246)
EXPOSURE = 0.25  # of the scans that are rendered without noise: 16 bits hold four times white then
SENSOR = SensorConfig(noise=0.0, exposure=EXPOSURE, bits=16, supersampling=2)
SCENES = {
    "rail": SceneConfig("rail"),
    "rail rolled": SceneConfig("rail", roll_deg=3.0),
    "bare rail": SceneConfig("rail", rail_texture=0.0),
    "board": SceneConfig("board", pitch_deg=6.0, roll_deg=-4.0, yaw_deg=92.0),
    "bare board": SceneConfig("board", pitch_deg=6.0, roll_deg=-4.0, yaw_deg=92.0, board_texture=0.0),
    "bare board rolled": SceneConfig("board", pitch_deg=-5.0, roll_deg=8.0, yaw_deg=20.0, board_texture=0.0),
    "sheet": SceneConfig("sheet", pitch_deg=2.0, roll_deg=1.5),
    "sheet rolled": SceneConfig("sheet", pitch_deg=-4.0, roll_deg=6.0),
}


@dataclass(frozen=True)
class Light:
    """What a camera makes of the light of a scene.

    Args:
        gain: grey value, of 1, of white.
        noise: standard deviation, of 255.
        blobs: bright spots, at other places for each camera; with ``along``, stripes along the motion that brighten
            what they lie on.
    """

    gain: float = 0.95
    noise: float = 1.5
    bits: int = 8
    blobs: int = 0
    along: bool = False


LIGHTS = {
    "sound": Light(),
    "clipped": Light(gain=1.9),
    "clipped twice": Light(gain=3.8),
    "dark": Light(gain=0.05, noise=1.0),
    "dark, 16 bits": Light(gain=0.05, noise=0.075, bits=16),
    "glare": Light(blobs=4),
    "specular": Light(blobs=3, along=True),
    "little noise": Light(noise=1.0),
}


@dataclass(frozen=True)
class Seen:
    """Light ``(lines, width, channels)`` that both cameras receive, white is 1, and the disparity of the left one, px.

    The disparity is NaN where it is not known.
    """

    rig: Rig
    left: Tensor
    right: Tensor
    disparity: Tensor
    noisy: bool = False

    def in_light(self, light: Light, seed: int) -> tuple[Tensor, Tensor]:
        """Both images."""
        chance = torch.Generator().manual_seed(seed)
        blobs = [torch.rand(4, generator=chance).tolist() for _ in range(light.blobs)]
        left, right = (
            self._image(received, light, _added(received, blobs, light.along, side), chance)
            for side, received in enumerate((self.left, self.right))
        )
        return left, right

    def _image(self, received: Tensor, light: Light, added: Tensor | float, chance: torch.Generator) -> Tensor:
        full = 2**light.bits - 1
        noise = 0.0 if self.noisy else light.noise / 255.0
        value = light.gain * received + added + noise * torch.randn(received.shape, generator=chance)
        return (full * value).round().clamp(0, full).to(torch.uint8 if light.bits == 8 else torch.uint16)


def _added(received: Tensor, blobs: list[list[float]], along: bool, side: int) -> Tensor | float:
    """Light of bright spots as one of the cameras sees it."""
    lines, width = received.shape[:2]
    v, u = torch.arange(lines)[:, None, None] / lines, torch.arange(width)[None, :, None] / width
    added: Tensor | float = 0.0
    for a, b, c, d in blobs:
        apart = side * (d - 0.5)  # the cameras see a gloss at other places
        if along:
            spot = (0.5 + 2 * b) * torch.exp(-((u - 0.3 - 0.4 * a - 0.1 * apart) / (0.004 + 0.02 * c)).square() / 2)
            added = added + spot * (0.5 + 0.5 * received / received.mean())
        else:
            across = (u - 0.2 - 0.6 * a - 0.3 * apart) / (0.02 + 0.06 * c)
            down = (v - b) / (0.05 + 0.2 * d)
            added = added + (0.4 + 1.2 * c) * torch.exp(-(across.square() + down.square()) / 2)
    return added


def rendered(scene: SceneConfig, width: int, seed: int) -> Seen:
    """A scene of our own renderer, in motion."""
    rig = scaled_rig(FULL_RIG, round(FULL_RIG.width_px / width))
    acquisition = Acquisition(0.07 * FULL_RIG.width_px / rig.width_px, lines=LINES)
    source = simulate(rig, BOARD, replace(scene, seed=seed), MOTION, SENSOR, acquisition)
    left, right = (torch.cat(list(source.strips(side))).float() / (65535 * EXPOSURE) for side in ("left", "right"))
    return Seen(rig, left, right, _disparity_at(rig, torch.cat(list(source.depth_strips())).double()))


def of_other_renderer(folder: Path) -> Seen:
    """A scan of a board or sheet by another renderer, with noise of its own; its plane is known within the pattern."""
    scan, truth = read_scan(folder), json.loads((folder / "truth.json").read_text())
    left, right = (image.read(0, scan.lines).float() / 255.0 for image in (scan.left, scan.images.right))
    n, rotation, translation = (torch.tensor(truth[key], dtype=torch.float64) for key in ("n", "R", "T"))
    travel = scan.travel.line_pitch_mm * torch.arange(scan.lines, dtype=torch.float64)[:, None]
    slope = slope_at(scan.rig, torch.arange(scan.rig.width_px, dtype=torch.float64))
    ray = torch.stack([slope, torch.zeros_like(slope), torch.ones_like(slope)], -1)
    normal = rotation[:, 2]
    z = (translation @ normal - travel * (n @ normal)) / (ray @ normal)
    points = (z[..., None] * ray + travel[..., None] * n - translation) @ rotation
    inside = (points[..., 0] > 0) & (points[..., 0] < 300) & (points[..., 1] > 0) & (points[..., 1] < 210)
    return Seen(scan.rig, left, right, _disparity_at(scan.rig, z.where(inside, math.nan)), noisy=True)


def _disparity_at(rig: Rig, depth: Tensor) -> Tensor:
    """Disparity, px, of depths, mm."""
    return (focal_length_px(rig) * rig.baseline_mm / depth + rig.principal_left_px - rig.principal_right_px).float()


def row_of(seen: Seen, light: Light, seed: int) -> tuple[float, float, float, float]:
    """Share of pixels measured, and of error / sigma the median, the rms, and the share beyond five."""
    match = measure_strip(*seen.in_light(light, seed), seen.rig, DisparityConfig())
    known = seen.disparity.isfinite()
    ratio = ((match.disparity - seen.disparity) / match.sigma).abs()[known]
    ratio = ratio[ratio.isfinite()]
    if not len(ratio):
        return 0.0, math.nan, 0.0, 0.0
    share, beyond = len(ratio) / int(known.sum()), float((ratio > BEYOND).float().mean())
    return share, float(ratio.median()) / 0.6745, float(ratio.square().mean().sqrt()), beyond


def scenes(arguments: argparse.Namespace) -> Iterator[tuple[str, list[Seen]]]:
    """Name and width of each scene, and how it is seen for each seed."""
    for name, scene in SCENES.items():
        for width in arguments.widths:
            yield f"{name}, {width} px", [rendered(scene, width, seed) for seed in range(arguments.seeds)]
    for folder in sorted(arguments.data.glob("*/scan.yaml")) if arguments.data else []:
        yield folder.parent.name, [of_other_renderer(folder.parent)] * arguments.seeds


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("lights", nargs="*", metavar="LIGHT", help=f"of {', '.join(LIGHTS)}; all where none is named")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--widths", type=int, nargs="+", default=[893, 1786])
    parser.add_argument("--scene", default="", help="only scenes with this in their name")
    parser.add_argument("--data", type=Path)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    failed = 0
    print(f"{'scene':26} {'light':14} measured  median   rms of each seed   beyond 5 sigma, %")
    for name, views in scenes(arguments):
        if arguments.scene not in name:
            continue
        for light in arguments.lights or LIGHTS:
            rows = [row_of(seen, LIGHTS[light], seed) for seed, seen in enumerate(views)]
            share, median, rms, beyond = zip(*rows, strict=True)
            bad = max(rms) > LARGEST_RMS or max(beyond) > LARGEST_SHARE
            failed += bad
            figures = "  ".join(
                " ".join(f"{value:6.3f}" for value in values) for values in (rms, (100 * x for x in beyond))
            )
            mean = sum(share) / len(share), sum(median) / len(median)
            print(
                f"{name:26} {light:14} {mean[0]:8.3f} {mean[1]:7.2f}   {figures}{'  too much' if bad else ''}",
                flush=True,
            )
    sys.exit(failed > 0)


if __name__ == "__main__":
    main()
