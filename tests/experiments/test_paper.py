"""The paper's experiment from start to end."""

import json

import pytest

pytestmark = [pytest.mark.slow, pytest.mark.drawn]


def _check(summary, *, sheet_px, numbers_rel, lines_mm, product_mm):
    paper, still, vibrating = summary["paper"], summary["still"], summary["vibrating"]
    joint, two_step = still["joint"], still["two_step"]
    floor = [abs(n - true) for n, true in zip(joint["n"], joint["n_true"], strict=True)]
    assert joint["verdict"] == "determined"
    assert joint["iterations"] <= 3
    assert joint["rmse_after_mm"] <= 0.06
    assert all(error <= bound for error, bound in zip(floor, (1.5e-4, 5e-5, 5e-4), strict=True))
    assert all(error <= 3 * sigma for error, sigma in zip(floor, joint["sigma"], strict=True))
    assert two_step["improvement"] > paper["improvement"]
    assert two_step["verdict"] == "prior-dominated"
    for method in ("joint", "two_step"):
        assert vibrating[method]["improvement"] >= paper["improvement"]
        assert vibrating[method]["rmse_after_mm"] == pytest.approx(paper["rmse_after_mm"], rel=0.2)
    for scenario, bound in ((still, 0.06), (vibrating, paper["rmse_after_mm"])):
        assert scenario["joint"]["held_out_rmse_mm"] < bound < 2.0 < scenario["held_out_rmse_before_mm"]
    lines = vibrating["joint with line motion"]
    assert lines["verdict"] == "determined"
    assert max(lines["rmse_after_mm"], lines["held_out_rmse_mm"]) <= lines_mm
    off = [abs(n - true) / sigma for n, true, sigma in zip(lines["n"], lines["n_true"], lines["sigma"], strict=True)]
    assert max(off) < 3
    numbers = summary["paper_numbers"]
    for key in ("rmse_before_mm", "rmse_after_mm", "stretch"):
        assert numbers[key] == pytest.approx(paper[key], rel=numbers_rel)
    assert numbers["iterations"] == paper["iterations"]
    products = still["products"]
    for board in products["board_distance_rms_mm"].values():
        assert board["corners"] == 88
        assert board["after"] <= 0.06 < 1.0 < board["before"]
    assert products["sheet_shift_px"]["points"] > 150
    assert products["sheet_shift_px"]["max"] <= sheet_px
    assert products["sheet_rms_mm"]["after"] < 0.1 < 1.0 < products["sheet_rms_mm"]["before"]
    _check_steadied(vibrating, lines_mm=product_mm)


def _check_steadied(vibrating, *, lines_mm):
    steadied, shaken = vibrating["with_line_motion"], vibrating["products"]["board_distance_rms_mm"]
    assert steadied["board_distance_rms_mm"].keys() == shaken.keys()
    for name, board in steadied["board_distance_rms_mm"].items():
        assert board["corners"] == 88
        assert board["after"] <= lines_mm < 0.4 < shaken[name]["after"]
    none, profile, log = (steadied["sheet"][source] for source in ("none", "auto", "log"))
    assert log["rms_mm"] <= lines_mm
    assert log["not_seen"] == []
    # The profile of a flat sheet shows depth, its straight edges what lines do sideways, and the waves their trend.
    assert "dx" not in profile["not_seen"]
    assert profile["by_axis_mm"][2] < 0.1 < 0.5 < none["by_axis_mm"][2]
    assert profile["by_axis_mm"][0] < 0.05 < 0.4 < none["by_axis_mm"][0]
    assert max(profile["rms_mm"], profile["unsheared_mm"]) <= lines_mm


def test_the_paper_at_a_quarter_of_the_pixels(command, tmp_path):
    assert command("+experiment=paper") == 0
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    _check(summary, sheet_px=1.0, numbers_rel=0.003, lines_mm=0.03, product_mm=0.05)
    by_iteration = summary["still"]["two_step"]["rmse_by_iteration_mm"]
    assert by_iteration[0] == pytest.approx(2.5006, abs=1e-4)
    assert by_iteration[5] <= 0.020
    assert (tmp_path / "run" / "report.html").stat().st_size > 100_000
    assert not list(tmp_path.rglob("*.partial"))


def test_the_paper_at_a_tenth_of_the_pixels(command, tmp_path):
    assert command("+experiment=paper", "scale=10", "vibrating.seed=100") == 0
    # Windows of 9 mm around a corner level a part of the shortest wave, of 61 mm, out.
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    _check(summary, sheet_px=1.0, numbers_rel=0.08, lines_mm=0.1, product_mm=0.05)
