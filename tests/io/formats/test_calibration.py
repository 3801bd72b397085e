import json
import math
from dataclasses import fields, is_dataclass, replace
from pathlib import Path

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from lsvision.errors import FileFormatError
from lsvision.io import read_calibration, write_calibration
from lsvision.types import Calibration, LineFinding, Motion


def plain(value: object) -> object:
    """Dataclasses and tensors as nested lists, to be compared to the bit."""
    if is_dataclass(value):
        return [plain(getattr(value, field.name)) for field in fields(value)]
    if isinstance(value, torch.Tensor):
        return value.tolist()
    return [plain(item) for item in value] if isinstance(value, tuple) else value


def test_round_trip_is_exact(tmp_path: Path, calibration: Calibration) -> None:
    write_calibration(calibration, tmp_path / "calibration.json")
    assert plain(read_calibration(tmp_path / "calibration.json")) == plain(calibration)


@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    n=st.tuples(st.floats(-0.2, 0.2), st.floats(0.5, 2.0), st.floats(-0.2, 0.2)),
    variances=st.lists(st.floats(0, 1), min_size=3, max_size=3),
)
def test_any_motion_round_trips(tmp_path: Path, calibration: Calibration, n: tuple, variances: list) -> None:
    motion = Motion(torch.tensor(n, dtype=torch.float64), torch.tensor(variances, dtype=torch.float64).diag())
    write_calibration(replace(calibration, motion=motion), tmp_path / "calibration.json")
    assert plain(read_calibration(tmp_path / "calibration.json").motion) == plain(motion)


def test_file_has_the_documented_keys(tmp_path: Path, calibration: Calibration) -> None:
    motion = Motion(
        torch.tensor([0.1, 1.0, -0.2], dtype=torch.float64), torch.diag(torch.tensor([4.0, 9.0, 16.0])).double() * 1e-10
    )
    write_calibration(replace(calibration, motion=motion), tmp_path / "calibration.json")
    data = json.loads((tmp_path / "calibration.json").read_text())
    assert list(data) == [
        *(
            "format",
            "method",
            "verdict",
            "reasons",
            "notes",
            "converged",
            "noise_scale",
            "errors_along_scan",
            "motion",
            "rmse_before_mm",
            "rmse_after_mm",
            "improvement",
        ),
        *("iterations", "boards", "observability", "installation", "rig", "provenance"),
    ]
    assert list(data["motion"]) == ["n", "stretch", "angles_deg", "covariance", "sigma"]
    assert data["motion"]["stretch"] == pytest.approx(math.sqrt(1.05))
    assert data["motion"]["angles_deg"] == pytest.approx({"x": 5.710593137499643, "z": -11.309932474020213})
    assert data["motion"]["sigma"] == pytest.approx([2e-5, 3e-5, 4e-5])
    assert data["improvement"] == pytest.approx(1 - 0.8794 / 2.059)
    assert list(data["iterations"][0]) == ["rmse_mm", "n", "stretch"]
    assert list(data["boards"][0]) == [
        *("scan", "corners", "rotation", "translation_mm", "rmse_before_mm", "rmse_after_mm"),
        *("reduced_chi_square", "outliers", "largest_residual", "line_motion", "line_motion_file"),
    ]
    assert list(data["observability"]) == ["verdict", "directions", "advice"]
    assert list(data["observability"]["directions"][0]) == ["vector", "prior_sigma", "posterior_sigma", "observed"]
    assert list(data["provenance"]) == ["version", "config_sha256", "scans"]
    assert list(data["provenance"]["scans"][0]) == ["path", "sha256"]


def test_what_follows_from_n_may_be_left_out(tmp_path: Path, calibration: Calibration) -> None:
    file = tmp_path / "calibration.json"
    write_calibration(calibration, file)
    data = json.loads(file.read_text())
    for key in ("stretch", "angles_deg", "sigma"):
        del data["motion"][key]
    del data["improvement"], data["observability"]["verdict"]
    file.write_text(json.dumps(data))
    assert plain(read_calibration(file)) == plain(calibration)


@pytest.mark.parametrize(
    ("converged", "observed", "verdict"),
    [
        (True, True, "determined"),
        (None, True, "determined"),
        (None, False, "prior-dominated"),
        (False, True, "not converged"),
    ],
)
def test_files_of_earlier_versions_get_the_verdict_that_they_imply(
    tmp_path: Path, calibration: Calibration, converged: bool | None, observed: bool, verdict: str
) -> None:
    file = tmp_path / "calibration.json"
    write_calibration(calibration, file)
    data = json.loads(file.read_text())
    del data["verdict"], data["reasons"], data["noise_scale"], data["boards"][0]["reduced_chi_square"]
    del data["converged"]
    if converged is not None:
        data["converged"] = converged
    data["observability"]["directions"][0]["observed"] = observed
    file.write_text(json.dumps(data))
    found = read_calibration(file)
    assert (found.verdict, found.reasons, found.noise_scale) == (verdict, (), 1.0)
    assert found.boards[0].reduced_chi_square is None
    assert found.usable == (verdict != "not converged")


def assign(data: dict, key: str, value: object) -> None:
    *path, last = key.split(".")
    for part in path:
        data = data[int(part) if part.isdigit() else part]
    data[int(last) if last.isdigit() else last] = value


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("format", "lsvision-calibration/2", "format: expected 'lsvision-calibration/1'"),
        ("method", "guess", "method: expected 'joint', 'two_step',"),
        ("motion.n.1", math.nan, r"motion.n\[1\]: expected a finite number, got nan"),
        ("motion.n.0", math.inf, r"motion.n\[0\]: expected a finite number, got inf"),
        ("motion.n", [0.0, 1.0], r"motion.n: expected a list of 3, got \[0.0, 1.0\]"),
        ("motion.n.1", 0.0, r"motion.n\[1\]: expected a number > 0"),
        ("motion.covariance.2.1", math.nan, r"motion.covariance\[2\]\[1\]: expected a finite number, got nan"),
        ("motion.covariance", [[1, 0, 0], [1, 1, 0], [0, 0, 1]], "motion.covariance: expected a symmetric"),
        ("motion.covariance", [[1, 2, 0], [2, 1, 0], [0, 0, 1]], "motion.covariance: expected a positive semidefinite"),
        ("motion.speed", 1.0, "motion.speed: unknown key"),
        ("boards.0.rotation.1.2", math.nan, r"boards\[0\].rotation\[1\]\[2\]: expected a finite number, got nan"),
        ("boards.0.corners", 0, r"boards\[0\].corners: expected a whole number >= 1"),
        ("boards", {}, "boards: expected a list"),
        ("iterations.1.rmse_mm", -1, r"iterations\[1\].rmse_mm: expected a finite number >= 0, got -1"),
        ("rmse_after_mm", "small", "rmse_after_mm: expected a finite number >= 0, got 'small'"),
        ("verdict", "maybe", "verdict: expected 'determined', 'prior-dominated', 'inconsistent' or 'not converged'"),
        ("reasons", "none", "reasons: expected a list"),
        ("noise_scale", 0, "noise_scale: expected a finite number > 0"),
        ("observability.directions.0.observed", 1, r"observability.directions\[0\].observed: expected true or false"),
        ("rig.baseline_mm", math.nan, "rig.baseline_mm: expected a finite number > 0, got nan"),
        ("provenance.scans.0.path", None, r"provenance.scans\[0\].path: expected text, got null"),
        ("extra", 1, "extra: unknown key"),
    ],
)
def test_bad_entries_are_named(tmp_path: Path, calibration: Calibration, key: str, value: object, message: str) -> None:
    file = tmp_path / "calibration.json"
    write_calibration(calibration, file)
    data = json.loads(file.read_text())
    assign(data, key, value)
    file.write_text(json.dumps(data))
    with pytest.raises(FileFormatError, match=message):
        read_calibration(file)


@pytest.mark.parametrize("text", ["", "{", "[" * 100_000])
def test_not_json(tmp_path: Path, text: str) -> None:
    (tmp_path / "calibration.json").write_text(text)
    with pytest.raises(FileFormatError, match=r"calibration\.json: expected JSON"):
        read_calibration(tmp_path / "calibration.json")


def test_nan_is_not_written(tmp_path: Path, calibration: Calibration) -> None:
    with pytest.raises(ValueError):
        write_calibration(replace(calibration, rmse_after_mm=math.nan), tmp_path / "calibration.json")
    assert not any(tmp_path.iterdir())


def test_what_was_found_of_the_lines_comes_back(tmp_path: Path, calibration: Calibration) -> None:
    found = LineFinding("dx", "corrected", rms=0.5, sigma=0.01, length_mm=97.0, evidence=300.0)
    absent = LineFinding("dz", "absent", sigma=0.02, evidence=-1.5)
    board = replace(calibration.boards[0], line_motion=(found, absent), line_motion_file="lines.parquet")
    write_calibration(replace(calibration, boards=(board, *calibration.boards[1:])), tmp_path / "calibration.json")
    again = read_calibration(tmp_path / "calibration.json").boards[0]
    assert again.line_motion == (found, absent)
    assert again.line_motion_file == "lines.parquet"
