"""The sigma of repaired lines against the error of their repair, on logs whose true travel is known."""

from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from lsvision.io.formats.encoder import EncoderLog, read_encoder_log
from lsvision.io.formats.encoder_sigma import interpolation_sigma

LINES, PITCH = 4000, 0.5
LINE = np.arange(LINES)


def repaired(tmp_path: Path, position: NDArray, lost: NDArray | None = None) -> EncoderLog:
    file = tmp_path / "encoder.csv"
    kept = LINE if lost is None else np.setdiff1d(LINE, lost)
    rows = zip(kept.tolist(), position[kept].tolist(), strict=True)
    file.write_text("line,position_mm\n" + "".join(f"{line},{place!r}\n" for line, place in rows))
    return read_encoder_log(file, LINES, line_pitch_mm=PITCH, repair=True)


def error_over_sigma(log: EncoderLog, true: NDArray) -> NDArray:
    """Of the repaired lines, relative to the first line."""
    sigma = log.sigma_mm.numpy()
    error = log.positions_mm.numpy() - true
    return ((error - error[0]) / np.where(sigma > 0, sigma, 1.0))[sigma > 0]


def rms(values: NDArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def speeds(random: np.random.Generator) -> dict[str, NDArray]:
    """Over the usual one: smooth, slowly drifting, independent from line to line, wandering, with a jump."""
    wander = np.convolve(0.03 * random.standard_normal(LINES), 0.98 ** np.arange(200))[:LINES]
    return {
        "wave": 1 + 0.2 * np.sin(LINE * 2 * np.pi / 60),
        "long wave": 1 + 0.3 * np.sin(LINE * 2 * np.pi / 1500),
        "jitter": 1 + 0.1 * random.standard_normal(LINES).clip(-3, 3),
        "wander": 1 + wander.clip(-0.8, 0.8),
        "jump": np.where(LINE < LINES // 2, 0.8, 1.2),
    }


@pytest.mark.parametrize("lengths", [[1] * 60, [20] * 15, [150] * 4 + [5] * 10, [1500]], ids=["1", "20", "150", "1500"])
@pytest.mark.parametrize("speed", ["wave", "long wave", "jitter", "wander", "jump"])
def test_sigma_covers_lost_readings_under_uneven_speed(tmp_path: Path, speed: str, lengths: list[int]) -> None:
    for seed in range(3):
        random = np.random.default_rng(seed)
        true = np.cumsum(PITCH * speeds(random)[speed])
        starts = [int(random.integers(1, LINES - length - 1)) for length in lengths]
        lost = np.unique(np.concatenate([np.arange(s, s + n) for s, n in zip(starts, lengths, strict=True)]))
        log = repaired(tmp_path, true, lost)
        assert np.array_equal(np.flatnonzero(log.sigma_mm.numpy()), lost)
        assert rms(error_over_sigma(log, true)) < 1.5


def test_sigma_is_that_of_a_brownian_bridge_where_steps_are_independent() -> None:
    true = np.cumsum(1 + 0.1 * np.random.default_rng(1).standard_normal(200_000).clip(-3, 3))
    line = np.delete(np.arange(len(true)), slice(1001, 1100))
    sigma = interpolation_sigma(line, true[line], np.zeros(len(line) - 1, dtype=bool))
    weight = np.arange(1, 100) / 100
    np.testing.assert_allclose(sigma[1001:1100], 0.1 * np.sqrt(100 * weight * (1 - weight)), rtol=0.15)


@pytest.mark.parametrize("step", [1.0, 1.7, 4.0])
@pytest.mark.parametrize("count", [np.round, np.floor])
def test_every_line_of_a_coarse_counter_has_the_sigma_of_its_step(tmp_path: Path, step: float, count) -> None:
    true = np.cumsum(PITCH * (1 + 0.2 * np.sin(LINE / 10)))
    log = repaired(tmp_path, count(true / step) * step)
    assert float(log.sigma_mm.min()) >= step / np.sqrt(12) - 1e-9
    assert rms(error_over_sigma(log, true)) < 1.5


def test_a_halt_in_a_gap_is_covered(tmp_path: Path) -> None:
    true = np.cumsum(np.where((LINE > 1000) & (LINE < 1100), 0.0, PITCH))
    for lost in (np.arange(950, 1050), np.arange(990, 1110), np.arange(800, 1200)):
        assert rms(error_over_sigma(repaired(tmp_path, true, lost), true)) < 1.5


def test_a_sound_log_has_no_sigma(tmp_path: Path) -> None:
    log = repaired(tmp_path, PITCH * LINE.astype(float))
    assert log.sigma_mm is None
    assert torch.equal(log.positions_mm, PITCH * torch.arange(LINES, dtype=torch.float64))
