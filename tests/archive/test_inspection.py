"""``reprocess inspect=true``: surfaces of all products, the same wherever they are made, gathered in one table."""

from dataclasses import replace

import polars
import pytest
import torch

from lsvision.archive import gather_surfaces
from lsvision.geometry import zero_disparity_mm
from lsvision.io import NewScan, surface_metadata, write_scan
from lsvision.stages.surface.config import SurfaceConfig
from lsvision.types import Travel
from tests.archive.archives import PROCESSING, RIG, WIDTH, local, make_calibration, process

SURFACE = SurfaceConfig(smoothing_mm=2.0, least_area_mm2=20.0, margin_mm=3.0, local_mm=400.0, matching_blur=0.0)
INSPECTING = replace(PROCESSING, surface=SURFACE)
PITCH_MM, LINES = 1.12, 256


def make_rail(folder, dent_mm=1.0, gaps=False):
    """A scan whose depth is that of an arc, with a dent in its middle; seen in stripes alone with ``gaps``."""
    column = torch.arange(WIDTH) - WIDTH / 2
    line = torch.arange(LINES)[:, None]
    dent = dent_mm * (1 - ((line - 120) ** 2 + column**2) / 8**2).clamp(min=0) ** 2
    noise = 0.01 * torch.randn(LINES, WIDTH, generator=torch.Generator().manual_seed(0))
    z = zero_disparity_mm(RIG) - 4.0 + column**2 / 120 + dent + noise
    if gaps:
        z[:, torch.arange(WIDTH) % 9 < 6] = torch.nan
    left = torch.full((LINES, WIDTH, 3), 100, dtype=torch.uint8)
    write_scan(folder, NewScan(RIG, Travel(PITCH_MM), [left], None, LINES, depth=[z[..., None].float()]))
    return folder


@pytest.fixture
def archive(tmp_path):
    """Two rails and a scan without any profile."""
    for name in ("a", "b"):
        make_rail(tmp_path / "scans" / name, 1.0 if name == "a" else 0.6)
    make_rail(tmp_path / "scans" / "noise", gaps=True)
    return tmp_path


def surface_bytes(product):
    """Every chunk and table of a surface, but what it was made from."""
    files = sorted(path for path in (product / "surface").rglob("*") if path.is_file())
    assert len(files) > 10
    return {path.name if path.parent.name == "surface" else str(path.relative_to(product)): path.read_bytes()
            for path in files if path != product / "surface" / "zarr.json"}  # fmt: skip


def test_candidates_of_all_products_are_one_table_and_a_scan_without_a_profile_says_so(archive):
    straight = make_calibration(archive / "n.json", (0.0, 1.02, 0.0))
    rows, _ = process(archive / "scans", straight, archive / "out", processing=INSPECTING)
    assert [row.status for row in rows] == ["done"] * 3
    found = {surface.scan: surface for surface in gather_surfaces(archive / "out", sorted(row.scan for row in rows))}
    assert "no profile" in found["noise"].problem
    assert (found["a"].dents, found["b"].dents) == (1, 1)
    assert found["a"].per_metre == pytest.approx(1e3 / found["a"].length_mm)
    table = polars.read_parquet(archive / "out" / "defects.parquet")
    assert table["scan"].to_list() == ["a", "b"]  # the deeper first
    assert table["depth_mm"].to_list() == pytest.approx([-1.0, -0.6], abs=0.1)
    assert table["along_mm"].to_list() == pytest.approx([120 * PITCH_MM * 1.02] * 2, abs=0.5)


def test_only_what_is_missing_is_inspected_again(archive):
    calibration, out = make_calibration(archive / "n.json"), archive / "out"
    process(archive / "scans", calibration, out)
    assert not (out / "a.zarr" / "surface").exists()
    _, engine = process(archive / "scans", calibration, out, processing=INSPECTING)
    assert {type(task.work).__name__ for task in engine.tasks} == {"InspectProduct"}
    _, engine = process(archive / "scans", calibration, out, processing=INSPECTING)
    assert engine.tasks == []
    other = replace(INSPECTING, surface=replace(SURFACE, high_sigma=9.0))
    _, engine = process(archive / "scans", calibration, out, processing=other)
    assert len(engine.tasks) == 3
    assert surface_metadata(out / "a.zarr")["options"]["high_sigma"] == 9.0


@pytest.mark.slow
def test_no_bit_depends_on_strips_or_workers(archive):
    calibration = make_calibration(archive / "n.json")
    lower = replace(INSPECTING, correction=replace(PROCESSING.correction, strip_rows=32))
    process(archive / "scans", calibration, archive / "one", processing=INSPECTING)
    process(archive / "scans", calibration, archive / "two", local(2), lower)
    for name in ("a.zarr", "b.zarr"):
        assert surface_bytes(archive / "one" / name) == surface_bytes(archive / "two" / name)


def test_reprocess_reports_the_surfaces(archive, command, tmp_path, capsys):
    options = [f"surface.{name}={getattr(SURFACE, name)}" for name in ("smoothing_mm", "least_area_mm2", "local_mm")]
    given = (f"archive={archive / 'scans'}", f"calibration={make_calibration(archive / 'n.json')}")
    run = ("+experiment=reprocess", *given, f"output={archive / 'out'}", "inspect=true", "engine.workers=1", *options)
    assert command(*run, "surface.margin_mm=3", "surface.matching_blur=0") == 0
    assert "surfaces of 2 scans" in (said := capsys.readouterr().out)
    assert "1 show no profile" in said
    page = (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    assert "Worst candidates" in page
    assert (archive / "out" / "defects.parquet").is_file()
