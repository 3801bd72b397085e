from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lsvision.errors import FileFormatError
from lsvision.io import read_encoder, write_encoder
from lsvision.io.formats.encoder import _longest_increasing


def log(tmp_path: Path, rows: list[tuple[float, float]]) -> Path:
    file = tmp_path / "encoder.csv"
    file.write_text("line,position_mm\n" + "".join(f"{line},{position}\n" for line, position in rows))
    return file


def test_round_trip_is_exact(tmp_path: Path) -> None:
    positions = torch.rand(500, dtype=torch.float64).cumsum(0) - 3
    write_encoder(positions, tmp_path / "encoder.csv")
    assert torch.equal(read_encoder(tmp_path / "encoder.csv", 500), positions)


def test_log_may_go_on_after_the_scan(tmp_path: Path) -> None:
    file = log(tmp_path, [(0, 0.0), (1, 0.5), (2, 1.0), (3, 0.0)])
    assert read_encoder(file, 3).tolist() == [0.0, 0.5, 1.0]


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([(0, 0.0), (3, 1.5)], r"2 lines \(1, 2\) missing"),
        ([(0, 0.0), (1, 0.5), (1, 0.6), (2, 1.0), (3, 1.5)], "line 1 repeated"),
        ([(0, 0.0), (1, 0.5), (2, 0.5), (3, 1.5)], "line 2 not beyond the line before"),
        ([(0, 0.0), (1, 1.5), (3, 1.0)], "line 2 missing; line 3 not beyond"),
        ([(0, 0.0), (1, 0.5), (2, 1.0)], "ends at line 2, the scan has 4 lines"),
        ([], "is empty, the scan has 4 lines"),
        ([(0, 0.0), (0.5, 0.0)], "row 3: expected a line number"),
        ([(0, 0.0), (1, float("nan"))], "row 3: expected a line number and a finite position"),
        ([(-1, 0.0)], "row 2: expected a line number"),
    ],
)
def test_faults_are_reported_with_their_lines(tmp_path: Path, rows: list, message: str) -> None:
    with pytest.raises(FileFormatError, match=message):
        read_encoder(log(tmp_path, rows), 4)


@pytest.mark.parametrize(
    ("factor", "message"),
    [
        (1000.0, r"expected about 0.5 mm a line, the scan's line_pitch_mm, got 500 \(median\): are these um\?"),
        (1e-3, r"are these m\?"),
        (0.1, r"are these cm\?"),
        (5.0, r"got 2.5 \(median\): does the log belong to this scan"),
        (0.4, "does the log belong to this scan"),
    ],
)
@pytest.mark.parametrize("repair", [False, True])
def test_another_unit_is_refused(tmp_path: Path, factor: float, message: str, repair: bool) -> None:
    position = np.arange(100) * 0.5
    position[40:60] = position[40]  # a halt
    file = log(tmp_path, list(enumerate((factor * position).tolist())))
    with pytest.raises(FileFormatError, match=rf"encoder\.csv: .*{message}"):
        read_encoder(file, 100, line_pitch_mm=0.5, repair=repair)


def test_halts_and_other_speeds_are_no_other_unit(tmp_path: Path) -> None:
    position = np.arange(100) * 0.7
    position[10:90] = position[10]
    read_encoder(log(tmp_path, list(enumerate(position.tolist()))), 100, line_pitch_mm=0.5, repair=True)
    steps = np.floor(np.arange(100) * 0.5 / 4) * 4  # a coarse counter
    with pytest.raises(FileFormatError, match="not beyond the line before"):
        read_encoder(log(tmp_path, list(enumerate(steps.tolist()))), 100, line_pitch_mm=0.5)


@pytest.mark.parametrize("step", [1.0, 1.7, 4.0])
def test_a_coarse_counter_does_not_halt(tmp_path: Path, step: float, caplog) -> None:
    true = np.cumsum(0.5 + 0.1 * np.sin(np.arange(400) / 30))
    file = log(tmp_path, list(enumerate((np.round(true / step) * step).tolist())))
    with pytest.raises(FileFormatError, match="not beyond the line before"):
        read_encoder(file, 400, line_pitch_mm=0.5)
    repaired = read_encoder(file, 400, line_pitch_mm=0.5, repair=True).numpy()
    assert f"multiples of {step:g} mm" in caplog.text
    assert np.abs(repaired - true).max() < 0.6 * step
    assert np.abs(repaired - true)[20:-20].max() < 0.3 * step
    advance = np.diff(repaired)
    assert advance.min() > 0.2
    assert advance.max() < 1.0


def test_a_coarse_counter_that_halts(tmp_path: Path) -> None:
    true = np.arange(300) * 0.5
    true[100:200] = true[100]
    true[200:] = true[100] + 0.5 * np.arange(1, 101)
    file = log(tmp_path, list(enumerate((np.round(true / 2) * 2).tolist())))
    repaired = read_encoder(file, 300, line_pitch_mm=0.5, repair=True).numpy()
    assert (np.diff(repaired) > 0).all()
    moving = np.r_[0:100, 200:300]
    assert np.abs(repaired - true)[moving].max() < 2.0
    assert (np.diff(repaired)[110:190] < 1e-3).sum() >= 75  # nothing is taken from the halt


@pytest.mark.parametrize("at", [3, 99])
def test_a_jump_is_refused_and_repaired_only_between_good_readings(tmp_path: Path, at: int) -> None:
    position = np.arange(100) * 0.5
    file = log(tmp_path, [(line, place + 40_000 * (line == at)) for line, place in enumerate(position.tolist())])
    with pytest.raises(FileFormatError, match=f"line {at} more than 1000 times the usual advance beyond the line"):
        read_encoder(file, 100)
    if at == 99:
        with pytest.raises(FileFormatError, match="the first or the last line has no good reading"):
            read_encoder(file, 100, repair=True)
    else:
        assert read_encoder(file, 100, repair=True).tolist() == position.tolist()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0,1\n1,2\n", "expected the header line,position_mm"),
        ("", "expected the header"),
        ("line,position_mm\n0,abc\n", "expected numbers in two columns"),
        ("line,position_mm\n0,1,2\n", "expected two columns, got 3"),
    ],
)
def test_other_files_are_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "encoder.csv").write_text(text)
    with pytest.raises(FileFormatError, match=message):
        read_encoder(tmp_path / "encoder.csv", 2)


@pytest.mark.parametrize(
    "rows",
    [
        [(0, 0.0), (1, 0.5), (4, 2.0), (5, 2.5)],
        [(0, 0.0), (1, 0.5), (2, 900.0), (3, 1.5), (4, 2.0), (5, 2.5)],
        [(0, 0.0), (1, 0.5), (2, -900.0), (3, 1.5), (4, 2.0), (5, 2.5)],
        [(0, 0.0), (1, 0.5), (1, 0.9), (2, 1.0), (3, 1.5), (4, 2.0), (5, 2.5)],
    ],
)
def test_repair_interpolates_what_is_missing_or_wrong(tmp_path: Path, rows: list, caplog) -> None:
    positions = read_encoder(log(tmp_path, rows), 6, repair=True)
    torch.testing.assert_close(positions, torch.arange(6).double() * 0.5)
    assert "encoder.csv: repaired" in caplog.text


def test_repair_needs_a_good_reading_at_both_ends(tmp_path: Path) -> None:
    file = log(tmp_path, [(0, 5.0), (1, 0.5), (2, 1.0), (3, 1.5)])
    with pytest.raises(FileFormatError, match="cannot be repaired: the first or the last line"):
        read_encoder(file, 4, repair=True)


@given(st.lists(st.integers(0, 9).map(float), min_size=1, max_size=9))
def test_longest_increasing_subsequence_against_all_subsequences(values: list[float]) -> None:
    chosen = _longest_increasing(torch.tensor(values).numpy())
    picked = [values[index] for index in chosen]
    assert picked == sorted(set(picked))
    assert list(chosen) == sorted(set(chosen))
    longest = 0
    for subset in range(1, 2 ** len(values)):
        candidate = [value for index, value in enumerate(values) if subset >> index & 1]
        if all(a < b for a, b in pairwise(candidate)):
            longest = max(longest, len(candidate))
    assert len(picked) == longest


def test_nothing_is_taken_from_the_lines_of_a_halt_or_a_way_back(tmp_path: Path) -> None:
    step = 0.0625  # exact in binary: equal places have equal readings
    ahead = np.arange(50) * step
    halt = np.full(30, ahead[-1])
    back = ahead[-1] - np.arange(1, 21) * step
    again = back[-1] + np.arange(1, 61) * step
    true = np.concatenate([ahead, halt, back, again])
    repaired = read_encoder(log(tmp_path, list(enumerate(true.tolist()))), len(true), repair=True).numpy()
    advance = np.diff(repaired)
    assert (advance > 0).all()
    # Lines between which anything of the object is taken lie where they truly were, to within a line.
    used = advance > 1e-5
    assert used.sum() == pytest.approx((repaired[-1] - repaired[0]) / step, abs=1)
    assert np.abs(repaired - true)[:-1][used].max() < step + 1e-6
    assert np.abs(repaired - true)[1:][used].max() < step + 1e-6


def test_a_line_number_beyond_all_numbers(tmp_path):
    (tmp_path / "e.csv").write_text(f"line,position_mm\n0,0\n{'9' * 400},1\n")
    with pytest.raises(FileFormatError, match="row 3: expected a line number and a finite position"):
        read_encoder(tmp_path / "e.csv", 2, line_pitch_mm=1.0)
