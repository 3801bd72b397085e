"""Scans found below folders, in lists and by patterns."""

from pathlib import Path

import pytest

from lsvision.archive import find_scans
from lsvision.errors import ConfigError


def touch(root: Path, *names: str) -> None:
    for name in names:
        (root / name).mkdir(parents=True)
        (root / name / "scan.yaml").write_text("")


def keys(archive: object) -> list[str]:
    return [found.key for found in find_scans(str(archive))]


def test_scans_below_a_folder_whatever_their_names(tmp_path):
    touch(tmp_path, "b", "2024/a", "Schiene Ä 7/läuft", ".hidden/x", "made.zarr/y", "b/within a scan")
    assert keys(tmp_path) == ["2024/a", "Schiene Ä 7/läuft", "b"]


def test_the_output_is_not_looked_into(tmp_path):
    touch(tmp_path, "a", "out/b")
    assert [found.key for found in find_scans(str(tmp_path), tmp_path / "out")] == ["a"]


def test_a_scan_alone_is_named_by_its_folder(tmp_path):
    touch(tmp_path, "a")
    assert keys(tmp_path / "a") == ["a"]


def test_a_list_and_a_pattern(tmp_path):
    touch(tmp_path, "2023/a", "2024/b", "2024/c", "d")
    (tmp_path / "list.txt").write_text("2024/c\n\n2023/a\n2024/c\n")
    assert keys(tmp_path / "list.txt") == ["2023/a", "2024/c"]
    assert keys(tmp_path / "2024" / "*") == ["b", "c"]
    assert keys(tmp_path / "**" / "[ab]") == ["2023/a", "2024/b"]


def test_a_scan_reached_twice_counts_once(tmp_path):
    touch(tmp_path, "a")
    (tmp_path / "b").symlink_to(tmp_path / "a")
    assert keys(tmp_path) == ["a"]


def test_links_in_circles_are_told_and_not_followed(tmp_path):
    touch(tmp_path, "x/a")
    (tmp_path / "x" / "up").symlink_to(tmp_path)
    (tmp_path / "self").symlink_to(tmp_path / "self")
    problems = {found.key: found.problem for found in find_scans(str(tmp_path))}
    assert list(problems) == ["self", "x/a", "x/up"]
    assert problems["x/a"] is None
    assert "loops back to itself" in problems["self"]
    assert f"loops back to {tmp_path}" in problems["x/up"]


def test_what_is_not_there(tmp_path):
    with pytest.raises(ConfigError, match="archive: no such folder"):
        find_scans(str(tmp_path / "nowhere"))
