"""Motion told from shape by the lines of the colours, on rendered rails; by a stated prior, on signals."""

import dataclasses
import math
from pathlib import Path

import pytest
import torch
from torch import Tensor

from lsvision.geometry import ProductFrame, object_pitch_mm, scaled_rig, without_trend, zero_disparity_mm
from lsvision.simulation import Acquisition, MotionConfig, SceneConfig, SensorConfig, Simulation, simulate
from lsvision.simulation.rail import corrugation_mm, crown_place
from lsvision.simulation.trajectory import cast_rays
from lsvision.stages.disparity.config import DisparityConfig
from lsvision.stages.disparity.depth import depth_of as matched_depth
from lsvision.stages.disparity.depth import relation_of_scan
from lsvision.stages.line_motion.color_pair import ObjectPlace, at_rows, color_pair
from lsvision.stages.line_motion.color_registration import register_color
from lsvision.stages.line_motion.config import LineMotionConfig
from lsvision.stages.line_motion.knots import Knots
from lsvision.stages.line_motion.measure import measure_line_motion
from lsvision.stages.line_motion.profiles import LineSamples, columns_of, reference_profile
from lsvision.stages.line_motion.register import placed
from lsvision.stages.line_motion.shape import longer_waves
from lsvision.types import (
    Depth,
    DepthSource,
    LineMotion,
    Motion,
    RawRig,
    Rig,
    Scan,
    StereoPair,
    TensorImage,
)
from tests.stages.rendered import BOARD, FULL_RIG

PITCH, FIRST, WIDTH = 0.28, 620, 620  # columns of a quarter of the camera that show the rail
VIBRATION_MM, CORRUGATION_MM = 97.0, 61.0
AT_REST = MotionConfig(angle_x_deg=-1.5, angle_z_deg=0.8, stretch=1.0246)
CONFIG = LineMotionConfig()


def rig(spacing: float = 4.0):
    whole = scaled_rig(FULL_RIG, 4)
    return dataclasses.replace(
        whole,
        width_px=WIDTH,
        principal_left_px=whole.principal_left_px - FIRST,
        principal_right_px=whole.principal_right_px - FIRST,
        color_spacing_lines=(-spacing, 0.0, spacing),
    )


def rail(
    lines: int,
    vibration_mm: float,
    wave_mm: float,
    seed: int = 0,
    registered: bool = True,
    lengths_mm: tuple[float, float] = (VIBRATION_MM, CORRUGATION_MM),
    cameras: Rig | RawRig | None = None,
) -> tuple[Simulation, Scan]:
    """A rail with amplitudes of vibration in depth and of corrugation, and their wavelengths."""
    scene = SceneConfig("rail", corrugation_mm=wave_mm, corrugation_wavelength_mm=lengths_mm[1], seed=seed)
    motion = dataclasses.replace(
        AT_REST, vibration_z_mm=vibration_mm / math.sqrt(2), vibration_wavelengths_mm=lengths_mm[:1], seed=seed
    )
    sensor = SensorConfig(supersampling=2, seed=seed, color_registered=registered)
    source = simulate(cameras or rig(), BOARD, scene, motion, sensor, Acquisition(PITCH, lines=lines))
    left, right = (TensorImage(torch.cat(list(source.strips(camera)))) for camera in ("left", "right"))
    images = StereoPair(left, right)
    return source, Scan(Path("rail"), source.rig, source.travel, images, registered, raw_rig=source.raw_rig)


@dataclasses.dataclass(frozen=True)
class Plain:
    """Matched depth without its sigma, as the archive measures on."""

    depth: DepthSource

    @property
    def lines(self) -> int:
        return self.depth.lines

    def read(self, start: int, stop: int) -> Depth:
        return Depth(self.depth.read(start, stop).z)


def depth_of(scan: Scan, n: Tensor | None = None) -> Plain:
    return Plain(matched_depth(scan, n=n))


def measured(source: Simulation, scan: Scan, config: LineMotionConfig = CONFIG) -> LineMotion:
    n = source.trajectory.n
    return measure_line_motion(scan, depth_of(scan, n), Motion(n, torch.zeros(3, 3).double()), config).motion


def amplitudes(source: Simulation, values: Tensor) -> Tensor:
    """Of the waves of the vibration and of the corrugation, mm."""
    along, motion = torch.arange(len(values)).double() * PITCH, source.trajectory.motion
    angles = [
        2 * math.pi * along / motion.vibration_wavelengths_mm[0],
        2 * math.pi * along * motion.stretch / source.scene.corrugation_wavelength_mm,
    ]
    parts = [f(angle) for angle in angles for f in (torch.cos, torch.sin)]
    found = torch.linalg.lstsq(torch.stack([*parts, torch.ones_like(along), along], 1), values[:, None]).solution
    return found[:4, 0].view(2, 2).norm(dim=1)


def true_depth(source: Simulation) -> Tensor:
    """Vibration in depth without mean and trend."""
    lines = torch.arange(source.lines).double()
    return without_trend(lines)(source.trajectory.vibration(lines)[:, 1])


def true_corrugation(source: Simulation) -> Tensor:
    """Height of the rail over its mean."""
    lines = torch.arange(source.lines).double()
    rays = cast_rays(source.trajectory, "left", torch.zeros(1), lines).in_frame(source.pose)
    return corrugation_mm(source.scene, crown_place(rays))


@pytest.mark.parametrize("registered", [True, False])
def test_colors_show_what_moves_between_their_moments_and_no_shape(registered: bool) -> None:
    source, scan = rail(200, 0.8, 0.4, registered=registered)
    frame, depth = ProductFrame(scan.rig, scan.travel, source.trajectory.n), depth_of(scan)
    samples = LineSamples.of(depth.read(0, 200), frame, (-60.0, 60.0), slice(None))
    middle = samples.z[samples.z < zero_disparity_mm(scan.rig)].mean()
    far = ObjectPlace(middle.expand(200), torch.zeros(scan.rig.width_px).double(), torch.zeros(200).double())
    pair = color_pair(scan, frame, relation_of_scan(scan, DisparityConfig()), far)
    assert pair.channels == (0, 2)
    start = torch.zeros(200, 3).double()
    start[:, 1] = source.trajectory.vibration(torch.arange(200).double())[:, 1] - true_corrugation(source)
    q_x, height = placed(samples, start, frame)
    reference = reference_profile(q_x, height, object_pitch_mm(scan.rig), 40.0)
    columns = columns_of(reference, q_x, 10_000)
    shown = samples.on(columns)
    one, other = (
        at_rows(
            register_color(
                pair, channel, 0, dataclasses.replace(shown, plane_slope=slope), start, (reference, 4.0)
            ).values,
            row,
        )
        for channel, slope, row in zip(pair.channels, pair.plane_slopes, pair.rows(), strict=True)
    )
    later, earlier = pair.taken()
    true = (source.trajectory.vibration(later) - source.trajectory.vibration(earlier))[:, 1]
    error = ((one - other)[:, 1] - true)[12:-12]
    assert true.abs().max() > 0.1
    apart = 8 / 1.0246 * float(middle) / zero_disparity_mm(scan.rig)
    assert (later - earlier).mean() == pytest.approx(apart, rel=1e-3)
    assert error.std() < 0.04  # single lines
    assert error.mean().abs() < 0.006


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_corrugation_stays_in_the_height_under_vibration(seed: int) -> None:
    source, scan = rail(2800, 0.1, 0.05, seed)
    found = measured(source, scan)
    error = found.dz_mm - true_depth(source)
    vibration, wave = amplitudes(source, found.dz_mm)
    assert vibration == pytest.approx(0.1, abs=0.01)
    assert wave < 0.01
    # The height keeps what the profile shows less the motion: the corrugation less the error of the motion.
    kept = amplitudes(source, true_corrugation(source) + error)[1]
    assert kept == pytest.approx(0.05, abs=0.01)
    assert (error / found.sigma[:, 1]).square().mean() < 3.0
    finding = found.findings[1]
    assert finding.shape_rms == pytest.approx(0.05 / math.sqrt(2), abs=0.006)
    assert finding.separated_up_to_mm > 100.0
    assert "are the object's shape" in finding.in_words


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_waves_less_than_a_cycle_apart_are_separated_or_stated_as_unknown(seed: int) -> None:
    """80 and 75 mm over 800 mm: their sigma covers what is not told apart."""
    source, scan = rail(2860, 0.1, 0.05, seed, lengths_mm=(80.0, 75.0))
    found = measured(source, scan)
    error = found.dz_mm - true_depth(source)
    vibration, _ = amplitudes(source, found.dz_mm)
    _, kept = amplitudes(source, true_corrugation(source) + error)
    # 2 sigma of an amplitude whose errors are correlated all along: sqrt(2) times that of its values.
    known = 2 * math.sqrt(2) * float(found.sigma[:, 1].square().mean().sqrt())
    assert vibration == pytest.approx(0.1, abs=max(0.01, known))
    assert kept == pytest.approx(0.05, abs=max(0.01, known))
    assert known < 0.03
    assert (error / found.sigma[:, 1]).square().mean() < 4.0  # of one error, as it is one wave


@pytest.mark.slow
def test_a_corrugated_rail_at_rest_keeps_its_corrugation() -> None:
    source, scan = rail(1500, 0.0, 0.05, seed=2)
    found = measured(source, scan)
    assert found.is_still
    assert found.findings[1].state == "absent"
    assert found.findings[1].shape_rms == pytest.approx(0.05 / math.sqrt(2), rel=0.1)


def test_long_waves_are_split_off_without_end_effects() -> None:
    along = torch.arange(3000).double() * 0.5
    slow, fast = torch.sin(2 * math.pi * along / 700.0) + 0.01 * along, torch.sin(2 * math.pi * along / 100.0)
    found = longer_waves(slow + fast, 0.5, 260.0)
    assert (found - slow).abs()[200:-200].max() < 0.02
    assert (found - slow).square().mean().sqrt() < 0.12
    half = longer_waves(torch.sin(2 * math.pi * along / 260.0), 0.5, 260.0)
    assert half[1200:1800].abs().max() == pytest.approx(0.5, abs=0.02)


def test_values_of_knots_come_back_at_lines() -> None:
    knots = Knots(8, 40)
    lines = torch.arange(323).double()
    wave = torch.sin(2 * math.pi * lines / 160.0)
    means, there = knots.means(wave, lines < 310)
    assert there.tolist() == 38 * [True] + [True, False]
    back = knots.at_lines(means, 323)
    assert (back - wave)[16:280].abs().max() < 0.01
    shifted, _ = knots.means(wave, lines >= 0, -4)
    assert shifted[5] == pytest.approx(float(wave[36:44].mean()))
