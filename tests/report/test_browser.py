"""Reports in a real browser: no message on its console, no request to the network, readable at every width."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from lsvision.report import Headline, Page, ReportFigure, Table, calibration_report, write_report
from lsvision.report.product_figures import product_images
from lsvision.report.space_figures import surface_in_space

pytestmark = pytest.mark.slow

FLAGS = (
    "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--hide-scrollbars",
    "--disable-background-networking", "--disable-component-update", "--disable-sync", "--disable-dev-shm-usage",
    "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",
)  # fmt: skip

# A script that the page under test runs after it has loaded: it lists what the page shows, turns and zooms a figure.
PROBE = """
<script>
addEventListener("load", () => {
  const views = () => [...document.querySelectorAll("figure.solid img")].map((view) => view.hidden);
  const before = views(), slider = document.querySelector("figure.solid input");
  if (slider) { slider.value = 3; slider.dispatchEvent(new Event("input")); }
  const image = document.querySelector("figure:not(.solid) img");
  image.click();
  const zoomed = image.parentElement.classList.contains("zoomed");
  document.dispatchEvent(new KeyboardEvent("keydown", { key: "Escape" }));
  const broken = [...document.images].filter((img) => !img.complete || img.naturalWidth === 0).length;
  const found = {
    images: document.images.length, broken, zoomed, closed: !image.parentElement.classList.contains("zoomed"),
    turned: views().indexOf(false) - before.indexOf(false), width: document.documentElement.scrollWidth,
    inner: innerWidth, background: getComputedStyle(document.body).backgroundColor,
    resources: performance.getEntriesByType("resource").map((entry) => entry.name.slice(0, 40)),
  };
  document.title = "FOUND" + JSON.stringify(found) + "END";
});
</script>
"""


@pytest.fixture(scope="module")
def chromium() -> str:
    for name in ("chromium", "chromium-browser", "google-chrome"):
        if path := shutil.which(name):
            return path
    pytest.skip("no chromium here: the reports were not opened in a browser (apt-get install chromium)")


@pytest.fixture
def folder(tmp_path, determined, corners):
    """A calibration's report, with a surface and an image beside it."""
    calibration_report(determined, [corners, corners], {"method": "joint"}, tmp_path / "calibration")
    y, x = torch.meshgrid(torch.arange(90.0), torch.arange(120.0), indexing="ij")
    height = 4 * torch.exp(-((x - 60) ** 2) / 900) + 0.002 * y
    color = (40 * height[..., None]).clamp(0, 255).to(torch.uint8).expand(-1, -1, 3)
    figures: list[ReportFigure] = [
        product_images("product", "Colour and height", color, height, 0.5, (0.0, 0.0)),
        surface_in_space("surface", height, 0.5, (0.0, 0.0)),
    ]
    page = Page(
        title="A product with a very long name that has to break somewhere_" + "x" * 60,
        lead="A lead paragraph.",
        headlines=[Headline("Size", "90 x 120 cells", "of 0.5 mm")],
        tables=[Table("Wide", [f"column {i}" for i in range(12)], [["0.123456"] * 12] * 3)],
        figures=figures,
        settings={"a": 1},
        provenance={"scans/a": "sha256 " + "f" * 64},
    )
    write_report(page, tmp_path / "product")
    return tmp_path


@pytest.fixture(scope="module")
def swept(tmp_path_factory) -> Path:
    """A sweep of two small studies: its own report and one of each job."""
    folder = tmp_path_factory.mktemp("swept")
    command = [sys.executable, "-m", "lsvision.run", "--multirun", "+experiment=study_tilts", "runs=4,5", "map_steps=3"]
    subprocess.run([*command, f"hydra.sweep.dir={folder}"], capture_output=True, timeout=300, check=True)
    return folder


def open_page(chromium: str, page: Path, width: int, *flags: str) -> tuple[dict, str, dict]:
    """Results of the probe, the browser's log and its record of network traffic."""
    probed = page.with_name("probed.html")
    probed.write_text(page.read_text(encoding="utf-8").replace("</body>", PROBE + "</body>"), encoding="utf-8")
    home = page.parent / f"home_{width}{''.join(flags).count('dark')}"
    options = [
        f"--user-data-dir={home}", f"--log-net-log={home}.json", "--enable-logging=stderr", "--v=0",
        f"--window-size={width},2400", "--virtual-time-budget=4000", "--dump-dom", *FLAGS, *flags,
    ]  # fmt: skip
    done = subprocess.run(
        [chromium, *options, probed.as_uri()], capture_output=True, text=True, timeout=120, check=True
    )
    found = json.loads(done.stdout.split("FOUND", 1)[1].split("END", 1)[0])
    return found, done.stderr, json.loads(Path(f"{home}.json").read_text(encoding="utf-8"))


def requested_addresses(record: dict) -> list[str]:
    """Addresses that the page requested, without files and data; the browser's own requests have no origin."""
    names = {value: name for name, value in record["constants"]["logEventTypes"].items()}
    requests = [
        event["params"]
        for event in record["events"]
        if names[event["type"]] == "URL_REQUEST_START_JOB" and "url" in event.get("params", {})
    ]
    urls = [request["url"] for request in requests if request["initiator"] != "not an origin"]
    return [url for url in urls if not url.startswith(("file:", "data:", "chrome:", "devtools:", "blob:"))]


@pytest.mark.parametrize("name", ["calibration", "product"])
@pytest.mark.parametrize(
    ("width", "flags"), [(1280, ()), (1280, ("--blink-settings=preferredColorScheme=0",)), (500, ())]
)
def test_a_page_opens_from_disk(name, width, flags, folder, chromium):
    found = check_page(chromium, folder / name / "report.html", width, *flags)
    assert found["images"] > 10
    assert found["turned"] == 3
    light = "rgb(246, 247, 248)"
    assert (found["background"] == light) == (not flags)


@pytest.mark.parametrize("name", [".", "1"])
@pytest.mark.parametrize("width", [1280, 500])
def test_a_study_and_a_sweep_open_from_disk(name, width, swept, chromium):
    assert check_page(chromium, swept / name / "report.html", width)["images"] > 0


def check_page(chromium: str, page: Path, width: int, *flags: str) -> dict:
    """Open a page, check what every report must satisfy, and return the results of the probe."""
    found, log, record = open_page(chromium, page, width, *flags)
    assert "CONSOLE" not in log
    assert requested_addresses(record) == []
    assert [name for name in found["resources"] if not name.startswith("data:")] == []
    assert found["broken"] == 0
    assert found["zoomed"]
    assert found["closed"]
    assert found["width"] <= found["inner"]
    return found


def test_the_checks_see_a_request_and_an_error(tmp_path, chromium):
    page = tmp_path / "report.html"
    body = '<body><figure><img src="http://127.0.0.1:9/a.png"></figure><script>console.error("spam")</script></body>'
    page.write_text(f"<!doctype html><html>{body}</html>", encoding="utf-8")
    found, log, record = open_page(chromium, page, 800)
    assert requested_addresses(record) == ["http://127.0.0.1:9/a.png"]
    assert found["resources"] == ["http://127.0.0.1:9/a.png"]
    assert found["broken"] == 1
    assert "CONSOLE" in log
    assert "spam" in log
