"""The local server of the page: on 127.0.0.1 alone, for reading alone, without anything from elsewhere."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from typing import Any
from urllib.parse import parse_qs, urlsplit

from lsvision.errors import LsvisionError
from lsvision.io.json_file import json_text
from lsvision.viewer.product_view import ProductView

ADDRESS = "127.0.0.1"
_PAGE = {
    "/": ("index.html", "text/html; charset=utf-8"),
    "/viewer.js": ("viewer.js", "text/javascript; charset=utf-8"),
    "/viewer.css": ("viewer.css", "text/css; charset=utf-8"),
    "/openseadragon.min.js": ("openseadragon.min.js", "text/javascript; charset=utf-8"),
}
_TILE = re.compile(r"/tile/(\w{1,32})/(\d{1,3})/(\d{1,9})_(\d{1,9})\.png")
_SECTION = re.compile(r"/section/(\w{1,32})/(\d{1,9})_(\d{1,9})\.json")


@dataclass(frozen=True)
class _Answer:
    """What a request is answered with."""

    body: bytes
    kind: str


class ViewServer(ThreadingHTTPServer):
    """Serves a product on a port; 0 takes a free one.

    Raises:
        OSError: the port is taken.
    """

    daemon_threads = True

    def __init__(self, view: ProductView, port: int) -> None:
        super().__init__((ADDRESS, port), _Handler)
        self.view = view

    @property
    def url(self) -> str:
        """Where the page is."""
        return f"http://{ADDRESS}:{self.server_port}/"


class _Handler(BaseHTTPRequestHandler):
    server: ViewServer

    def do_GET(self) -> None:
        """Answer a request; whatever it asks for, nothing but the product and the page is read."""
        if self.headers.get("Host", "").rsplit(":", 1)[0] not in (ADDRESS, "localhost"):
            self.send_error(HTTPStatus.FORBIDDEN, "expected a request to this machine")  # as other sites' pages send
            return
        parts = urlsplit(self.path)
        try:
            answer = self._answer(parts.path, parse_qs(parts.query))
        except LsvisionError as error:
            self.send_error(HTTPStatus.NOT_FOUND, str(error)[:200])
            return
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", answer.kind)
        self.send_header("Content-Length", str(len(answer.body)))
        self.send_header("Cache-Control", "no-store" if answer.kind == "application/json" else "max-age=600")
        self.end_headers()
        self.wfile.write(answer.body)

    def _answer(self, path: str, query: dict[str, list[str]]) -> _Answer:
        view = self.server.view
        if path in _PAGE:
            name, kind = _PAGE[path]
            return _Answer((files("lsvision.viewer") / "page" / name).read_bytes(), kind)
        if path == "/info.json":
            return _json(view.info)
        if (tile := _TILE.fullmatch(path)) is not None:
            name, (level, column, row) = tile[1], map(int, tile.groups()[1:])
            if name not in view.layers:
                raise LsvisionError(f"layer: none is called {name}")
            return _Answer(view.layers[name].tile(level, column, row, _span_of(query)), "image/png")
        if (section := _SECTION.fullmatch(path)) is not None:
            return _json(view.section(section[1], int(section[2]), int(section[3])))
        raise LsvisionError("nothing is here")

    def log_message(self, format: str, *arguments: Any) -> None:
        """Say nothing: a page asks for hundreds of tiles."""


def _span_of(query: dict[str, list[str]]) -> tuple[float, float] | None:
    """The range of values that a request asks for."""
    try:
        low, high = float(query["low"][0]), float(query["high"][0])
    except (KeyError, ValueError):
        return None
    return (low, high) if high > low else None


def _json(data: dict[str, Any]) -> _Answer:
    return _Answer(json_text(data).encode(), "application/json")


def serve(view: ProductView, port: int, started: Callable[[str], None]) -> None:
    """Serve until the process is interrupted.

    Args:
        started: takes the address of the page.

    Raises:
        OSError: the port is taken.
    """
    with ViewServer(view, port) as server:
        started(server.url)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            return
