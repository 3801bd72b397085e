"""The file of the motion from line to line: exact, strict, and one line where anything is wrong."""

import random
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import polars
import pytest
import torch
import yaml

from lsvision.errors import FileFormatError
from lsvision.io import read_line_motion, read_scan, scan_files, scan_sha256, write_line_motion
from lsvision.types import LineFinding, LineMotion, SectionFit, Travel
from tests.io.fuzz import fault_of

LINES = 300  # of the fixture's scans
TRAVEL = Travel(0.56)


def motion(lines: int = LINES, seed: int = 0, findings: tuple[LineFinding, ...] = ()) -> LineMotion:
    """Everything moves but the travel; sideways motion and roll are correlated."""
    random = torch.Generator().manual_seed(seed)
    values = torch.randn(lines, 4, generator=random, dtype=torch.float64) * torch.tensor([0.1, 0.2, 0.001, 0.0])
    root = torch.diag(torch.tensor([0.01, 0.02, 0.0001, 0.0], dtype=torch.float64))
    root[2, 0] = 0.0002
    return LineMotion(values, (root @ root.T).repeat(lines, 1, 1), findings)


def table(**columns: object) -> polars.DataFrame:
    return polars.DataFrame({"line": range(LINES), "dz_mm": [0.1] * LINES, **columns})


def test_round_trip(tmp_path):
    found = (
        LineFinding("dx", "corrected", 0.1, 0.01, 12.0, 30.0),
        LineFinding("dz", "corrected", 0.2),
        LineFinding("roll", "corrected", 1e-3),
        LineFinding("dy", "not observed", reason="nobody looked"),
    )
    laid = SectionFit("EN60E1", 177.0, 22.0, -1e-3, 0.01, 2e-3, 1e-4, 0.97, 0.3, 0.05, -0.4, 12.0, True)
    made = replace(motion(findings=found), section=laid)
    write_line_motion(made, tmp_path / "m.parquet")
    read = read_line_motion(tmp_path / "m.parquet", LINES, TRAVEL)
    assert torch.equal(read.values, made.values)
    torch.testing.assert_close(read.covariance, made.covariance, rtol=1e-12, atol=0)
    assert read.findings == found
    assert read.section == laid


def test_columns_that_are_missing_are_zero_and_unknown(tmp_path):
    table(dx_mm=[0.0] * LINES, dx_sigma_mm=[0.5] * LINES).write_parquet(tmp_path / "m.parquet")
    read = read_line_motion(tmp_path / "m.parquet", LINES, TRAVEL)
    assert read.dz_mm.unique().tolist() == [0.1]
    assert not read.roll_rad.any()
    assert read.sigma[0].tolist() == [0.5, 0.0, 0.0, 0.0]
    states = {finding.component: finding.state for finding in read.findings}
    assert states == {"dx": "absent", "dz": "corrected", "roll": "not observed", "dy": "not observed"}
    assert "of unknown sigma" in read.findings[1].in_words
    assert "the file has no roll_rad" in read.findings[2].in_words


line = list(range(LINES))
FAULTS = {
    "gap": ({"line": [*line[:7], *line[8:], LINES]}, "line: expected every line in order, got 8 in row 7"),
    "not in order": ({"line": [1, 0, *line[2:]]}, "line: expected every line in order, got 1 in row 0"),
    "text": ({"dx_mm": ["0.1"] * LINES}, "dx_mm: expected numbers, got String"),
    "lists": ({"dx_mm": [[0.1]] * LINES}, r"dx_mm: expected numbers, got List\(Float64\)"),
    "NaN": ({"dx_mm": [0.0] * 9 + [float("nan")] * (LINES - 9)}, "dx_mm: line 9: expected a finite number"),
    "null": ({"dx_mm": [0.0, None] * (LINES // 2)}, "dx_mm: line 1: expected a finite number .* got nan"),
    "infinite": ({"dy_mm": [float("inf")] * LINES}, "dy_mm: line 0: expected a finite number, got inf"),
    "a distance": ({"dz_mm": [796.9] * LINES}, "dz_mm: line 0: expected a finite number >= -100 and <= 100, got 796.9"),
    "degrees": ({"roll_rad": [1.5] * LINES}, "roll_rad: line 0: expected"),
    "a negative sigma": ({"dz_sigma_mm": [-0.1] * LINES}, "dz_sigma_mm: line 0: expected a finite number >= 0"),
    "a sigma alone": ({"dx_sigma_mm": [0.1] * LINES}, "dx_sigma_mm: the standard deviation of a component without"),
    "another name": ({"dx_m": [0.1] * LINES}, "dx_m: unknown column; did you mean 'dx_mm'"),
    "line break": ({"d\nx": [0.1] * LINES}, "unknown column"),
    "backwards": ({"dy_mm": [0.0, 1.0] * (LINES // 2)}, "dy_mm: the lines would not follow each other"),
    "correlations": (
        {f"{pair}_correlation": [r] * LINES for pair, r in (("dx_dz", 0.99), ("dx_roll", 0.99), ("dz_roll", -0.99))},
        "line 0: no covariance has such correlations",
    ),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_names_file_and_column(fault, tmp_path):
    columns, problem = FAULTS[fault]
    table(**columns).write_parquet(tmp_path / "m.parquet")
    with pytest.raises(FileFormatError, match=rf"^[^\n]*m\.parquet: [^\n]*{problem}[^\n]*$"):
        read_line_motion(tmp_path / "m.parquet", LINES, TRAVEL)


@pytest.mark.parametrize(
    ("written", "problem"),
    [
        (table().drop("dz_mm"), "dz_mm: missing"),
        (table().drop("line"), "line: missing"),
        (table().head(20), "line: expected 300 rows, one for every line of the scan, got 20"),
    ],
)
def test_other_tables(written, problem, tmp_path):
    written.write_parquet(tmp_path / "m.parquet")
    with pytest.raises(FileFormatError, match=problem):
        read_line_motion(tmp_path / "m.parquet", LINES, TRAVEL)


@pytest.mark.parametrize(
    ("found", "problem"),
    [
        ("{", "lsvision.findings: expected JSON"),
        ("{}", "lsvision.findings: expected a list"),
        ('[{"component": "dz", "state": "gone"}]', r"lsvision\.findings\[0\]\.state: expected 'corrected'"),
        ('[{"component": "dz", "state": "absent"}]', "dz is said to be not corrected"),
        ('[{"component": "dz", "state": "corrected"}, {"component": "dx", "state": "corrected"}]', "dx is said to be"),
        ("[" * 100000, "lsvision.findings: expected JSON"),
    ],
)
def test_findings_are_checked(found, problem, tmp_path):
    table().write_parquet(tmp_path / "m.parquet", metadata={"lsvision.findings": found})
    with pytest.raises(FileFormatError, match=problem):
        read_line_motion(tmp_path / "m.parquet", LINES, TRAVEL)


def test_what_is_no_file(tmp_path):
    (tmp_path / "text").write_text("line,dz_mm\n0,1\n")
    for name, problem in (("text", "expected Parquet"), ("none", "no such file"), ("", "expected a file")):
        with pytest.raises(FileFormatError, match=problem):
            read_line_motion(tmp_path / name, LINES, TRAVEL)


def test_damage_is_one_line(tmp_path, capfd):
    """Where it is noticed at all: Parquet has no checksum."""
    file, chance = tmp_path / "m.parquet", random.Random(1)
    write_line_motion(motion(), file)
    whole = file.read_bytes()
    for _ in range(150):
        data = bytearray(whole)
        for _ in range(chance.randint(1, 4)):
            at = chance.randrange(len(data)) if chance.random() < 0.5 else -chance.randrange(1, 1500)
            data[at] = chance.randrange(256)
        file.write_bytes(data[: chance.choice([len(data), len(data), chance.randrange(len(data))])])
        assert fault_of(lambda: read_line_motion(file, LINES, TRAVEL)) is None


def test_a_scan_names_its_log(make_scan: Callable[..., Path]):
    folder = make_scan(line_motion=motion())
    scan = read_scan(folder)
    assert torch.equal(scan.line_motion.values, motion().values)
    assert folder / "motion.parquet" in scan_files(folder)
    before = scan_sha256(folder)
    write_line_motion(motion(seed=1), folder / "motion.parquet")
    assert scan_sha256(folder) != before
    entries = yaml.safe_load((folder / "scan.yaml").read_text())
    (folder / "scan.yaml").write_text(yaml.safe_dump({**entries, "line_motion": "gone.parquet"}))
    with pytest.raises(FileFormatError, match=r"scan\.yaml: line_motion: no such file"):
        read_scan(folder)
    with pytest.raises(ValueError, match="line_motion: expected 300 lines, got 9"):
        make_scan(line_motion=motion(9))
