import errno
from pathlib import Path

import pytest

from lsvision.errors import FileFormatError, WriteError
from lsvision.io.atomic import partial_file, partial_folder, replace_folder, write_text


def test_file_appears_when_complete(tmp_path: Path) -> None:
    target = tmp_path / "new" / "a.txt"
    with partial_file(target) as partial:
        partial.write_text("whole")
        assert not target.exists()
        assert partial.name.startswith(".")
    assert target.read_text() == "whole"
    assert [path.name for path in target.parent.iterdir()] == ["a.txt"]


def break_off(partial: Path, error: type[BaseException]) -> None:
    partial.write_text("half")
    raise error


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_failed_file_leaves_the_earlier_one(tmp_path: Path, error: type[BaseException]) -> None:
    target = tmp_path / "a.txt"
    write_text(target, "earlier")
    with pytest.raises(error), partial_file(target) as partial:
        break_off(partial, error)
    assert target.read_text() == "earlier"
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]


def test_folder_appears_when_complete_with_the_usual_permissions(tmp_path: Path) -> None:
    (tmp_path / "usual").mkdir()
    with partial_folder(tmp_path / "a", marker="mark") as partial:
        (partial / "mark").touch()
        assert not (tmp_path / "a").exists()
    assert (tmp_path / "a").stat().st_mode == (tmp_path / "usual").stat().st_mode
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "usual"]


def test_folder_with_the_marker_is_replaced_whole(tmp_path: Path) -> None:
    for content in ("first", "second"):
        with partial_folder(tmp_path / "a", marker="mark") as partial:
            (partial / "mark").touch()
            (partial / content).touch()
    assert sorted(path.name for path in (tmp_path / "a").iterdir()) == ["mark", "second"]
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


def test_empty_folder_is_replaced(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    with partial_folder(tmp_path / "a", marker="mark") as partial:
        (partial / "mark").touch()
    assert (tmp_path / "a" / "mark").exists()


def test_other_folders_and_files_are_refused(tmp_path: Path) -> None:
    write_text(tmp_path / "a" / "thesis.txt", "years of work")
    for target in (tmp_path / "a", tmp_path / "a" / "thesis.txt"):
        with pytest.raises(FileFormatError, match="mark to replace"), partial_folder(target, marker="mark"):
            pass
    assert (tmp_path / "a" / "thesis.txt").read_text() == "years of work"


def test_failed_folder_leaves_the_earlier_one(tmp_path: Path) -> None:
    with partial_folder(tmp_path / "a", marker="mark") as partial:
        (partial / "mark").touch()
    with pytest.raises(ZeroDivisionError), partial_folder(tmp_path / "a", marker="mark") as partial:
        break_off(partial / "half", ZeroDivisionError)
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["mark"]
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


def test_replacing_puts_the_earlier_folder_back_where_the_new_one_cannot_be_moved(tmp_path: Path) -> None:
    write_text(tmp_path / "a" / "mark", "earlier")
    with pytest.raises(FileNotFoundError):
        replace_folder(tmp_path / "missing", tmp_path / "a", marker="mark")
    assert (tmp_path / "a" / "mark").read_text() == "earlier"
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


@pytest.mark.parametrize("partial", [partial_file, lambda target: partial_folder(target, marker="mark")])
def test_a_full_disk_names_the_target(tmp_path: Path, partial) -> None:
    with pytest.raises(WriteError, match="a: cannot be written: No space left"), partial(tmp_path / "a"):
        raise OSError(errno.ENOSPC, "full")
    with pytest.raises(PermissionError), partial(tmp_path / "a"):
        raise PermissionError(errno.EACCES, "not allowed")
    assert not any(tmp_path.iterdir())


def test_a_link_is_replaced_and_what_it_leads_to_is_kept(tmp_path):
    (tmp_path / "kept.json").write_text("kept")
    (tmp_path / "o").mkdir()
    (tmp_path / "o" / "a.json").symlink_to(tmp_path / "kept.json")
    write_text(tmp_path / "o" / "a.json", "new")
    assert (tmp_path / "kept.json").read_text() == "kept"
    assert (tmp_path / "o" / "a.json").read_text() == "new"
    assert not (tmp_path / "o" / "a.json").is_symlink()
