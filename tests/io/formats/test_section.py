"""The nominal section by name and from a CSV; what is no outline is one line that names file and row."""

from pathlib import Path

import pytest

from lsvision.errors import FileFormatError
from lsvision.io import read_section

POINTS = [(-4.0 + i, -0.1 * (i - 4) ** 2) for i in range(9)]


def csv(rows: list[str], header: str = "across_mm,height_mm") -> str:
    return "\n".join(["# drawn by hand", header, *rows]) + "\n"


ROWS = [f"{across},{height}" for across, height in POINTS]


def test_a_file_and_a_name(tmp_path: Path) -> None:
    file = tmp_path / "mine.csv"
    file.write_text(csv([*ROWS[:4], "", ROWS[4] + "  # the crown", *ROWS[5:]]))
    section = read_section(file)
    assert (section.name, list(zip(section.across_mm, section.height_mm, strict=True))) == ("mine", POINTS)
    rail = read_section("EN60E1")
    assert rail.name == "EN60E1"
    assert max(rail.across_mm) - min(rail.across_mm) == pytest.approx(74.1, abs=0.1)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (csv([row.split(",")[0] for row in ROWS]), r"row 3: expected two columns, got 1"),
        (csv([*ROWS[:4], "0.0,nan", *ROWS[5:]]), r"row 7: expected two finite numbers"),
        (csv([*ROWS[:4], "0.0,1e9", *ROWS[5:]]), r"row 7: expected two finite numbers"),
        (csv([*ROWS[:4], "zero,0.0", *ROWS[5:]]), r"expected numbers in two columns"),
        (csv(ROWS[::-1]), r"row 4: across_mm: expected more than in the row before"),
        (csv([*ROWS[:4], ROWS[3], *ROWS[4:]]), r"row 7: across_mm: expected more than in the row before"),
        (csv(ROWS[:3]), r"expected at least 8 points, got 3"),
        (csv(ROWS, "x,y"), r"expected the header across_mm,height_mm"),
        ("", r"expected the header across_mm,height_mm"),
    ],
)
def test_what_is_no_outline(text: str, problem: str, tmp_path: Path) -> None:
    file = tmp_path / "bad.csv"
    file.write_text(text)
    with pytest.raises(FileFormatError, match=rf"bad\.csv: {problem}") as error:
        read_section(file)
    assert "\n" not in str(error.value)


def test_no_such_file(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=r"EN54E1: no such file"):
        read_section(tmp_path / "EN54E1")
