"""Scans found below folders, in lists and by patterns."""

import fsspec
import pytest
import torch

from lsvision.archive import find_scans, local_archive
from lsvision.errors import ConfigError
from lsvision.io import read_scan, write_response
from lsvision.types import CameraResponse
from tests.archive.archives import WIDTH, touch


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


@pytest.fixture
def remote(archive):
    """The archive in a file system that is not this machine's, its scans sharing one rig."""
    files = fsspec.filesystem("memory")
    files.put(str(archive), "/bucket", recursive=True)
    for name in ("a", "b"):
        scan = f"/bucket/{name}/scan.yaml"
        files.pipe_file(scan, files.cat_file(scan).replace(b"rig: rig.yaml", b"rig: ../rig.yaml"))
    files.mv("/bucket/a/rig.yaml", "/bucket/rig.yaml")
    files.rm("/bucket/b/rig.yaml")
    yield files
    files.rm("/bucket", recursive=True)


@pytest.mark.parametrize(
    ("url", "keys"),
    [
        ("memory://bucket", ["2024/c", "2024/d", "a", "b"]),
        ("memory://bucket/?", ["a", "b"]),
        ("memory://bucket/2024/*", ["c", "d"]),
    ],
)
def test_scans_behind_a_url_are_copied_with_their_rigs(remote, tmp_path, url, keys):
    found = find_scans(local_archive(url, tmp_path))
    assert [item.key for item in found] == keys
    for item in found:
        assert read_scan(item.path).lines > 0


def test_responses_that_a_shared_rig_names_are_copied_too(remote, tmp_path):
    values = torch.ones(WIDTH, 3)
    write_response(CameraResponse(0 * values, values), tmp_path / "r.tif")
    remote.put(str(tmp_path / "r.tif"), "/bucket/r.tif")
    rig = remote.cat_file("/bucket/rig.yaml")
    remote.pipe_file("/bucket/rig.yaml", rig + b"response: {left: r.tif}\n")
    found = find_scans(local_archive("memory://bucket/?", tmp_path / "copies"))
    assert [item.problem for item in found] == [None, None]
    assert read_scan(found[0].path).lines > 0
    remote.pipe_file("/bucket/rig.yaml", rig + b"response: {left: ../../r.tif}\n")
    found = find_scans(local_archive("memory://bucket/?", tmp_path / "copies"))
    assert {item.problem for item in found} == {"rig.yaml: response: leads outside the archive"}


def test_unchanged_files_of_a_url_are_not_copied_again(remote, tmp_path):
    local_archive("memory://bucket", tmp_path)
    times = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*") if path.is_file()}
    local_archive("memory://bucket", tmp_path)
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*") if path.is_file()} == times
    remote.pipe_file("/bucket/a/left.tif", b"other")
    remote.rm("/bucket/b", recursive=True)
    local_archive("memory://bucket", tmp_path)
    assert (tmp_path / "a" / "left.tif").read_bytes() == b"other"
    assert [item.key for item in find_scans(str(tmp_path))] == ["2024/c", "2024/d", "a"]


def test_urls_of_this_machine_and_of_nowhere(archive, tmp_path):
    assert [item.key for item in find_scans(local_archive(f"file://{archive}/?", tmp_path))] == ["a", "b"]
    assert not list(tmp_path.iterdir())
    with pytest.raises(ConfigError, match="archive: nothing://here cannot be read"):
        local_archive("nothing://here", tmp_path)
    with pytest.raises(ConfigError, match="archive: no scans at /empty"):
        local_archive("memory://empty/*", tmp_path)
