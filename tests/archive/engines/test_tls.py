"""Certificates for a Dask cluster: encrypted, and closed to whoever has none."""

import importlib.util
import shutil
import subprocess
from pathlib import Path

import pytest

from lsvision.archive.engines.protocol import EngineConfig, TlsFiles
from lsvision.archive.tasks import Task
from lsvision.errors import ConfigError
from lsvision.schema import build, option_fault
from tests.archive.engines.test_engine import Number, collected

pytestmark = pytest.mark.skipif(importlib.util.find_spec("distributed") is None, reason="distributed is not here")


@pytest.fixture
def tls(tmp_path: Path) -> TlsFiles:
    """An authority, and a certificate that it signed."""
    if shutil.which("openssl") is None:
        pytest.skip("no openssl to make certificates with")
    ca, key, csr, cert = (str(tmp_path / name) for name in ("ca.pem", "key.pem", "cert.csr", "cert.pem"))
    new = ["openssl", "req", "-newkey", "rsa:2048", "-nodes"]
    for command in (
        [*new, "-x509", "-keyout", f"{ca}.key", "-out", ca, "-days", "2", "-subj", "/CN=authority"],
        [*new, "-keyout", key, "-out", csr, "-subj", "/CN=lsvision"],
        ["openssl", "x509", "-req", "-in", csr, "-CA", ca, "-CAkey", f"{ca}.key", "-CAcreateserial", "-out", cert],
    ):
        subprocess.run(command, check=True, capture_output=True)
    return TlsFiles(ca, cert, key)


def test_certificates_are_three_files():
    given = {"tls_authority": "a", "tls_certificate": "c", "tls_key": "k"}
    assert build(EngineConfig, given, option_fault, "engine").tls == TlsFiles("a", "c", "k")
    assert EngineConfig().tls is None
    with pytest.raises(ConfigError, match=r"engine.tls_key: missing; certificates are three files"):
        build(EngineConfig, {**given, "tls_key": None}, option_fault, "engine")


@pytest.mark.parametrize("address", ["garbage", "http://a:1", "ucx://a:1", "tcp://a", "tcp://a b:1", "tcp://a:123456"])
def test_what_is_no_address_of_a_scheduler(address):
    with pytest.raises(ConfigError, match=r"engine.scheduler: expected an address as tcp://host:8786, got"):
        build(EngineConfig, {"scheduler": address}, option_fault, "engine")


@pytest.mark.parametrize("address", ["tcp://a.b-c:8786", "127.0.0.1:1", "tcp://[::1]:8786"])
def test_addresses_of_schedulers(address):
    assert build(EngineConfig, {"scheduler": address}, option_fault, "engine").scheduler == address


def test_certificates_and_tls_belong_together():
    files = {"tls_authority": "a", "tls_certificate": "c", "tls_key": "k"}
    assert build(EngineConfig, {**files, "scheduler": "tls://a:1"}, option_fault, "engine").tls is not None
    for given in ({"scheduler": "tls://a:1"}, {**files, "scheduler": "tcp://a:1"}):
        with pytest.raises(ConfigError, match=r"engine.scheduler: a scheduler at tls:// asks for certificates"):
            build(EngineConfig, given, option_fault, "engine")


def test_a_certificate_that_is_not_there_is_one_line(tmp_path):
    from lsvision.archive.engines.dask import DaskEngine

    with pytest.raises(ConfigError, match=r"engine.tls_authority: .*no.pem: No such file"):
        DaskEngine(None, 1, 3072, TlsFiles(str(tmp_path / "no.pem"), "c", "k"))


@pytest.mark.slow
def test_nobody_joins_without_a_certificate(tls):
    from distributed import Client

    from lsvision.archive.engines.dask import DaskEngine

    task = Task("a", Number(5))
    with DaskEngine(None, 1, 3072, tls) as engine:
        address = engine._client.scheduler.address
        assert address.startswith("tls://127.0.0.1:")
        assert collected(engine, [task])[task].result == 5
        with pytest.raises((OSError, TypeError, RuntimeError)):
            Client(address, timeout="2s", set_as_default=False)
