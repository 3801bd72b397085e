"""Files with random damage: they read, or one error of ours names the file; nothing else is raised."""

import random
import warnings
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from lsvision.errors import ConfigError, FileFormatError
from lsvision.io import (
    ProductLayout,
    check_product,
    product_writer,
    read_calibration,
    read_product,
    read_rig,
    read_scan,
    write_rig,
)
from lsvision.io.formats.encoder import read_encoder, write_encoder
from lsvision.types import ProductGrid, ProductStrip, Travel
from tests.archive.archives import RIG, make_calibration

FAST, MANY = 100, 3000
# What texts are changed to: numbers beyond every range, other types, and signs with a meaning in YAML or JSON.
PIECES = [
    "0", "-1", "1e999", "-1e308", "NaN", ".nan", "Infinity", "9" * 5000, "1e-320", "null", "true", "[]", "{}", '""',
    "\0",
    "[" * 3000, "{a: " * 300, "&a [*a]", "*a", "!!python/object:os.system {}", "<<: {}", "? ", ": ", "- ", "\n", "\t",
    "\ufeff", "\ud7ff", "\u2028", "../../x", "/dev/zero", "x" * 300, "%", "'", '"', ",", "0x1p3", "2024-13-45", "1:2:3",
]  # fmt: skip


def mutated(content: bytes, chance: random.Random) -> bytes:
    """A content with one to four changes: bytes, pieces of text in place of tokens, parts lost or doubled."""
    for _ in range(chance.randint(1, 4)):
        begin = chance.randrange(len(content) + 1)
        end = min(len(content), begin + chance.choice([0, 1, 3, 8, 40]))
        kind = chance.randrange(5)
        if kind == 0:
            new = bytes(chance.randrange(256) for _ in range(chance.randint(1, 4)))
        elif kind == 1:
            new = chance.choice(PIECES).encode("utf-8", "surrogatepass")
        elif kind == 2:
            new = content[begin:end] * 2
        elif kind == 3:  # a whole value
            tokens = [i for i, sign in enumerate(content) if sign in b" ,:\n["]
            begin = chance.choice(tokens) + 1 if tokens else begin
            end = next((i for i in range(begin, len(content)) if content[i] in b",\n]}"), len(content))
            new = chance.choice(PIECES).encode("utf-8", "surrogatepass")
        else:
            new = b""
        content = content[:begin] + new + content[end:]
    return content


@pytest.fixture
def files(tmp_path: Path, make_scan: Callable[..., Path]) -> dict[str, tuple[Path, Callable[[], object]]]:
    """A file of each kind, and what reads it."""
    scan = make_scan(
        travel=Travel(0.56, torch.arange(300.0).double()), attributes={"date": "2024-05-31", "heat": "0123"}
    )
    write_rig(RIG, tmp_path / "own.yaml")
    write_encoder(torch.arange(20.0).double(), tmp_path / "encoder.csv")
    calibration = make_calibration(tmp_path / "calibration.json")
    product = tmp_path / "p.zarr"
    layout = ProductLayout(ProductGrid(8, 6, 0.5, 0.0, 0.0), 3, torch.uint8, 4, {"n": [0.0, 1.0, 0.0]})
    with product_writer(product, layout) as writer:
        for row in (0, 4):
            cells, colors = torch.zeros(4, 6), torch.zeros(4, 6, 3, dtype=torch.uint8)
            writer.write(ProductStrip(row, colors, cells, torch.isfinite(cells), torch.zeros(4, 6, 2)))

    def validate() -> None:
        check_product(product)
        read_product(product).read(0, 1)

    return {
        "rig": (tmp_path / "own.yaml", lambda: read_rig(tmp_path / "own.yaml")),
        "scan": (scan / "scan.yaml", lambda: read_scan(scan)),
        "encoder": (tmp_path / "encoder.csv", lambda: read_encoder(tmp_path / "encoder.csv", 20)),
        "repaired": (tmp_path / "encoder.csv", lambda: read_encoder(tmp_path / "encoder.csv", 20, repair=True)),
        "calibration": (calibration, lambda: read_calibration(calibration)),
        "product": (product / "zarr.json", validate),
        "image": (product / "height" / "zarr.json", validate),
        "array": (product / "color" / "0" / "zarr.json", validate),
    }


@pytest.mark.parametrize("number", [FAST, pytest.param(MANY, marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", ["rig", "scan", "encoder", "repaired", "calibration", "product", "image", "array"])
def test_damage_is_one_error_of_ours(files, kind, number):
    path, read = files[kind]
    whole = path.read_bytes()
    read()
    chance = random.Random(f"{kind} {number}")
    problems = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # zarr's, about metadata that it does not know
        for _ in range(number):
            path.write_bytes(mutated(whole, chance))
            try:
                read()
            except (FileFormatError, ConfigError) as error:
                problems.append(str(error))
    assert len(problems) > number / 5
    assert not [problem for problem in problems if len(problem.splitlines()) != 1]
