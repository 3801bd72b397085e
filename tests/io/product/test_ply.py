from pathlib import Path

import numpy as np
import pytest
import torch

from lsvision.io import write_ply


def read_ply(path: Path) -> tuple[list[str], np.ndarray]:
    header, body = path.read_bytes().split(b"end_header\n", 1)
    vertex = np.dtype([("xyz", "<f8", 3), ("rgb", "u1", 3)])
    return header.decode("ascii").splitlines(), np.frombuffer(body, vertex)


@pytest.mark.parametrize("sizes", [[], [1], [5, 0, 7], [100]])
def test_blocks_come_back(tmp_path: Path, sizes: list[int]) -> None:
    points = torch.randn(sum(sizes), 3, dtype=torch.float64) * 1e5
    colors = torch.randint(0, 256, (sum(sizes), 3), dtype=torch.uint8)
    blocks = zip(points.split(sizes), colors.split(sizes), strict=True) if sizes else []
    assert write_ply(tmp_path / "a.ply", blocks) == sum(sizes)
    header, vertices = read_ply(tmp_path / "a.ply")
    assert [line.rstrip() for line in header] == [
        "ply",
        "format binary_little_endian 1.0",
        "comment millimetres",
        f"element vertex {sum(sizes)}",
        *("property double x", "property double y", "property double z"),
        *("property uchar red", "property uchar green", "property uchar blue"),
    ]
    np.testing.assert_array_equal(vertices["xyz"], points.numpy())
    np.testing.assert_array_equal(vertices["rgb"], colors.numpy())


def test_blocks_that_do_not_match_leave_nothing(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="blocks: expected"):
        write_ply(tmp_path / "a.ply", [(torch.zeros(4, 3), torch.zeros(5, 3, dtype=torch.uint8))])
    assert not any(tmp_path.iterdir())
