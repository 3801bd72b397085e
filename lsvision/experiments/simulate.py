"""``+experiment=simulate``: render a scan folder with its truth."""

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from lsvision.errors import ConfigError
from lsvision.experiments.settings import RunSettings
from lsvision.geometry import scaled_raw_rig, scaled_rig
from lsvision.io import NewScan, read_rig_pair, write_scan
from lsvision.io.formats.rig import CAMERAS
from lsvision.report.progress import ProgressBars, progress_bars
from lsvision.schema import Positive, PositiveInt, Scale, Text
from lsvision.simulation import (
    Acquisition,
    EncoderConfig,
    MotionConfig,
    SceneConfig,
    SensorConfig,
    Simulation,
    simulate,
)
from lsvision.types import Board, CameraResponse, RawRig, Rig, Transport

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class SimulateSettings(RunSettings):
    """Options of the experiment.

    ``scale`` = 1 is the full camera with the line pitch ``line_pitch_mm``; 4 means a quarter of the pixels at four
    times the pitch. If ``lines`` is None, the scan shows the whole target. ``output`` is the scan folder to write,
    ``scan`` in the run's folder if it is None. With ``depth`` the scan has the true depth map of the left image in
    place of the right image, like the scans of a camera that computes depth maps. ``rig_file``, a rig file of either
    format, takes the place of ``rig``: cameras of lsvision-rig/2 see raw images.
    """

    rig: Rig
    rig_file: Text | None = None
    board: Board
    scene: SceneConfig
    motion: MotionConfig
    sensor: SensorConfig
    encoder: EncoderConfig
    scale: Scale = 4.0
    line_pitch_mm: Positive = 0.07
    lines: PositiveInt | None = None
    transport: Transport = "forward"
    depth: bool = False
    strip_lines: PositiveInt = 256
    output: Text | None = None


def run_simulate(settings: SimulateSettings, folder: Path) -> None:
    """Render the scene and write it as a scan folder.

    Raises:
        ConfigError: a depth map of raw cameras is asked for.
    """
    rig = _scaled_rig(settings)
    if settings.depth and isinstance(rig, RawRig):
        raise ConfigError("depth: expected a rectified rig, as cameras that compute depth maps have")
    simulation = simulate(
        rig,
        settings.board,
        settings.scene,
        settings.motion,
        settings.sensor,
        Acquisition(
            settings.line_pitch_mm * settings.scale,
            lines=settings.lines,
            transport=settings.transport,
            encoder=settings.encoder,
        ),
    )
    target = Path(settings.output) if settings.output else folder / "scan"
    with progress_bars() as bars:
        write_simulation(simulation, target, bars, depth=settings.depth, strip_lines=settings.strip_lines)
    log.info("wrote %s: %d lines of %d px, %s", target, simulation.lines, simulation.width_px, settings.scene.kind)


def _scaled_rig(settings: SimulateSettings) -> Rig | RawRig:
    """The cameras, with the pixels of the scale."""
    if settings.rig_file is None:
        return scaled_rig(settings.rig, settings.scale)
    pair = read_rig_pair(settings.rig_file)
    return scaled_rig(pair.rig, settings.scale) if pair.raw is None else scaled_raw_rig(pair.raw, settings.scale)


def write_simulation(
    simulation: Simulation, target: Path, bars: ProgressBars, *, depth: bool = False, strip_lines: int = 256
) -> None:
    """Write a simulated scan with its ``truth.json``; with ``depth`` the true depth map in place of the right image.

    Where columns respond unevenly, ``true_left_response.tif`` and ``true_right_response.tif`` are written too.
    """
    bar = bars.start(f"render {target.name}", total=2 * simulation.lines)

    def counted(strips: Iterator[Tensor]) -> Iterator[Tensor]:
        for strip in strips:
            yield strip
            bars.advance(bar, strip.shape[0])

    write_scan(
        target,
        NewScan(
            rig=simulation.rig,
            travel=simulation.travel,
            left=counted(simulation.strips("left", strip_lines)),
            right=None if depth else counted(simulation.strips("right", strip_lines)),
            depth=counted(strip[..., None] for strip in simulation.depth_strips(strip_lines)) if depth else None,
            lines=simulation.lines,
            channels=simulation.channels,
            dtype=torch.uint16 if simulation.sensor.bits == 16 else torch.uint8,
            color_registered=simulation.sensor.color_registered,
            raw_rig=simulation.raw_rig,
            extra_json={"truth.json": simulation.truth()},
            responses=_true_responses(simulation),
        ),
    )


def _true_responses(simulation: Simulation) -> dict[str, CameraResponse]:
    """The responses of both cameras by file name; none of even ones."""
    if simulation.sensor.is_even:
        return {}
    return {f"true_{camera}_response.tif": simulation.response(camera) for camera in CAMERAS}
