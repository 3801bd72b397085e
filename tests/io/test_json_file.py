import json
import math
import re
from pathlib import Path

import pytest

import lsvision
from lsvision.io import write_json

# Hashes of plain data, which no one reads back.
HASHES = {"experiments/settings.py", "archive/identity.py"}


def test_numbers_that_are_not_finite_become_null(tmp_path: Path) -> None:
    data = {"a": math.nan, "b": [1.5, -math.inf, {"c": (math.inf, 2, "text", None, True)}]}
    write_json(tmp_path / "summary.json", data)
    assert json.loads((tmp_path / "summary.json").read_text()) == {
        "a": None,
        "b": [1.5, None, {"c": [None, 2, "text", None, True]}],
    }


def test_they_are_an_error_where_they_must_not_be(tmp_path: Path) -> None:
    with pytest.raises(ValueError):
        write_json(tmp_path / "truth.json", {"a": math.nan}, strict=True)
    assert not any(tmp_path.iterdir())


def test_no_other_code_writes_json() -> None:
    root = Path(lsvision.__file__).parent
    writers = {
        path.relative_to(root).as_posix()
        for path in root.rglob("*.py")
        if re.search(r"json\.dumps?\(", path.read_text())
    }
    assert writers - HASHES == {"io/json_file.py"}
