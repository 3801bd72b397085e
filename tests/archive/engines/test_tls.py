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
