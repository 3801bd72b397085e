"""``+experiment=view``: it says where the page is, and ends with Ctrl-C; faults are one line."""

import socket

import pytest

from lsvision.viewer.server import ViewServer
from tests.viewer.products import write_rail


def test_it_says_where_the_page_is_and_ends_with_ctrl_c(command, tmp_path, capsys, monkeypatch):
    def interrupted(server):
        raise KeyboardInterrupt

    monkeypatch.setattr(ViewServer, "serve_forever", interrupted)
    assert command("+experiment=view", f"product={write_rail(tmp_path / 'rail.zarr', inspected=False)}") == 0
    assert "open http://127.0.0.1:" in capsys.readouterr().out


@pytest.mark.parametrize(("given", "said"), [(("product=nowhere",), "nowhere"), (("port=70000",), "port")])
def test_faults_are_one_line(given, said, command, tmp_path, capsys):
    product = f"product={write_rail(tmp_path / 'rail.zarr', inspected=False)}"
    assert command("+experiment=view", *(given if "product" in given[0] else (product, *given))) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line


def test_a_port_that_is_taken_is_one_line(command, tmp_path, capsys):
    product = write_rail(tmp_path / "rail.zarr", inspected=False)
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert command("+experiment=view", f"product={product}", f"port={port}") == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert f"port: {port} cannot be used" in line
