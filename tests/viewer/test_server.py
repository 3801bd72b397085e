"""The page's server: what it answers, and what it does not."""

import http.client
import json
import shutil
import subprocess
import threading

import pytest

from lsvision.viewer.product_view import ProductView
from lsvision.viewer.server import ADDRESS, ViewServer
from tests.viewer.products import write_rail


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    view = ProductView.of(write_rail(tmp_path_factory.mktemp("server") / "rail.zarr"))
    with ViewServer(view, 0) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield server
        server.shutdown()
        thread.join()


def get(server, path, host=None):
    connection = http.client.HTTPConnection(ADDRESS, server.server_port, timeout=30)
    connection.request("GET", path, headers={} if host is None else {"Host": host})
    answer = connection.getresponse()
    body = answer.read()
    connection.close()
    return answer.status, answer.getheader("Content-Type"), body


def test_what_the_page_needs(server):
    for path, kind in (
        ("/", "text/html; charset=utf-8"), ("/viewer.js", "text/javascript; charset=utf-8"),
        ("/viewer.css", "text/css; charset=utf-8"), ("/openseadragon.min.js", "text/javascript; charset=utf-8"),
        ("/info.json", "application/json"), ("/tile/color/11/0_0.png", "image/png"),
        ("/tile/height/9/0_0.png?low=0&high=2.5", "image/png"), ("/section/deviation/10_20.json", "application/json"),
    ):  # fmt: skip
        status, found, body = get(server, path)
        assert (status, found) == (200, kind), path
        assert body
    assert json.loads(get(server, "/info.json")[2])["name"] == "rail"
    assert b"http" not in get(server, "/")[2]  # nothing from elsewhere


@pytest.mark.parametrize(
    "path",
    ["/../../etc/passwd", "/page/index.html", "/tile/color/99/0_0.png", "/tile/x/1/0_0.png", "/section/color/0_0.json",
     "/section/height/99999_0.json", "/tile/color/11/0_0.png/..", "/info.json/", "/tile/color/-1/0_0.png"],
)  # fmt: skip
def test_nothing_else_is_answered(server, path):
    assert get(server, path)[0] == 404


def test_pages_of_other_sites_get_nothing(server):
    assert get(server, "/info.json", host="example.org")[0] == 403
    assert get(server, "/info.json", host=f"localhost:{server.server_port}")[0] == 200
    assert server.server_address[0] == "127.0.0.1"


@pytest.mark.drawn
def test_the_page_opens_in_a_browser(server, tmp_path):
    chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if chromium is None:
        pytest.skip("no chromium here: the page was not opened in a browser (apt-get install chromium)")
    options = (
        "--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--window-size=1300,800",
        f"--user-data-dir={tmp_path}", "--virtual-time-budget=8000", "--dump-dom",
    )  # fmt: skip
    for link, expected in (
        ("", ('data-ready="color"', 'id="layer-height"', "1 in all")),
        (
            "#layer=deviation&candidate=1",
            ('data-ready="deviation"', 'class="mark dent chosen"', "1 of 1", "deviation -0."),
        ),
    ):
        page = subprocess.run(
            [chromium, *options, server.url + link], capture_output=True, text=True, timeout=120, check=True
        ).stdout
        for text in expected:
            assert text in page, (link, text)
