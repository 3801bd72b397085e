"""YAML files of any content: plain data or one line, soon and in little memory."""

import os
import tracemalloc
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lsvision.errors import FileFormatError
from lsvision.io import read_rig, read_scan
from lsvision.io.formats.plain_yaml import load_plain_yaml
from lsvision.io.formats.validation import read_json, read_yaml


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("a: 1", 1), ("a: -0", 0), ("a: 1.10", 1.1), ("a: 7e-2", 0.07), ("a: +.5", 0.5), ("a: .inf", float("inf")),
        ("a: true", True), ("a: no", False), ("a: ~", None), ("a:", None), ("a: [1, b]", [1, "b"]),
        ("a: 2024-05-31", "2024-05-31"), ("a: 2024-13-45", "2024-13-45"), ("a: 12:30:45", "12:30:45"),
        ("a: 0123", "0123"), ("a: 1_000", "1_000"), ("a: 0x1f", "0x1f"), ("a: '5'", "5"), ("a: !!str 5", "5"),
    ],
)  # fmt: skip
def test_values(text, value):
    assert load_plain_yaml(text) == {"a": value}


def test_attributes_stay_as_they_are_written():
    text = (
        "attributes: {time: 12:30:45, heat: 0123, version: 1.10, share: 7e-2, date: 2024-02-31, 7: x, big: "
        + "9" * 5000
    )
    written = load_plain_yaml(text + "}")["attributes"]
    assert written.pop("big") == "9" * 5000
    assert written == {
        "time": "12:30:45", "heat": "0123", "version": "1.10", "share": "7e-2", "date": "2024-02-31", "7": "x",
    }  # fmt: skip


LAUGHS = "a: &a [lol, lol]\n" + "".join(
    f"{c}: &{c} [{', '.join(f'*{b}' for _ in range(9))}]\n" for b, c in zip("abcdefgh", "bcdefghi", strict=True)
)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (LAUGHS, "line 2: found an alias"),
        ("[" * 5000, "line 1: found more than 20 levels"),
        ("- " * 5000, "line 1: found more than 20 levels"),
        ("{a: " * 5000, "line 1: found more than 20 levels"),
        ("a: " + "9" * 5000, "line 1: found a number of 5000 digits"),
        ("a: 1\nb: 2\na: 3", "line 3: found the key 'a' a second time"),
        ("a: {b: 1, b: 2}", "found the key 'b' a second time"),
        ("? [a]\n: b", "a key that is no text"),
        ("a: !!timestamp 2024-13-45", "found a tag"),
        ("a: !!python/object/apply:os.getcwd []", "found a tag"),
        ("a: !!binary 0", "found a tag"),
        ("a: *secret", "found an alias"),
        ("a: 1\n---\nb: 2", "found another document"),
        ("a: \0", "a character that is no text at position 3"),
        ("a: [", "line 1: "),
        ("a: 'x", "line 1: "),
    ],
)  # fmt: skip
def test_what_is_refused(tmp_path, text, problem):
    (tmp_path / "x.yaml").write_text(text)
    tracemalloc.start()
    with pytest.raises(FileFormatError) as raised:
        read_yaml(tmp_path / "x.yaml")
    assert tracemalloc.get_traced_memory()[1] < 20e6
    tracemalloc.stop()
    assert str(raised.value).startswith(f"{tmp_path / 'x.yaml'}: expected plain YAML: ")
    assert problem in str(raised.value)
    assert len(str(raised.value).splitlines()) == 1


@given(st.text(max_size=60) | st.text(alphabet="ab:-[]{},&*!?#|>'\"%@ \n\t0.e~", max_size=60))
def test_any_text_is_data_or_one_error(text):
    problem = ""
    try:
        load_plain_yaml(text)
    except ValueError as error:
        problem = str(error)
    assert len(problem.splitlines()) <= 1


def test_what_is_no_small_file_is_not_read(tmp_path):
    (tmp_path / "large.yaml").write_text("#" * (1 << 20) + "\n")
    os.mkfifo(tmp_path / "pipe")
    for name, problem in (
        ("large.yaml", "expected at most 1048576 bytes, got 1048577"),
        ("pipe", "expected a file, got a folder, device or pipe"),
        ("/dev/zero", "expected a file, got a folder, device or pipe"),
        (".", "expected a file, got a folder, device or pipe"),
        ("a\0b", "cannot be read: "),
        ("x" * 5000, "cannot be read: File name too long"),
    ):
        with pytest.raises(FileFormatError, match=problem):
            read_yaml(tmp_path / name)


def test_nothing_of_a_file_that_is_not_ours_is_shown(tmp_path):
    secret = tmp_path / "secret"
    for text in ("root:$6$geheim:19000:0\n", "geheim", "geheim: [geheim", "- geheim\n", "a: *geheim", "'geheim"):
        secret.write_text(text)
        with pytest.raises(FileFormatError) as raised:
            read_rig(secret)
        assert "geheim" not in str(raised.value)
        with pytest.raises(FileFormatError) as raised:
            read_json(secret)
        assert "geheim" not in str(raised.value)


@pytest.mark.parametrize("text", ['{"a": 1, "a": 2}', '{"a": ' + "9" * 5000 + "}", "[" * 100000, "\ufeff{}", "{"])
def test_json_that_is_refused(tmp_path, text):
    (tmp_path / "x.json").write_text(text, encoding="utf-8")
    with pytest.raises(FileFormatError, match=r"x\.json: expected JSON: "):
        read_json(tmp_path / "x.json")


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("/dev/zero", "expected a file or folder, got a device or pipe: /dev/zero"),
        ('"a\\0b"', "no such file or folder"),
        ('"a\\nb"', "no such file or folder"),
        ("x" * 5000, "no such file or folder"),
    ],
)
@pytest.mark.parametrize("key", ["rig", "left", "encoder"])
def test_entries_that_name_no_file(make_scan, key, name, problem):
    scan: Path = make_scan()
    lines = [line for line in (scan / "scan.yaml").read_text().splitlines() if not line.startswith(f"{key}:")]
    (scan / "scan.yaml").write_text("\n".join([*lines, f"{key}: {name}"]))
    with pytest.raises(FileFormatError, match=problem) as raised:
        read_scan(scan)
    assert len(str(raised.value).splitlines()) == 1
    assert len(str(raised.value)) < 500
