"""The house rules that a reader relies on, counted over the package: where formulas live, how large pieces are."""

import ast
import functools
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "lsvision"
# What arithmetic with the cameras or the product's axes is made of.
CAMERA_FIELDS = {"focal_length_mm", "pixel_pitch_um", "baseline_mm", "principal_left_px", "principal_right_px"}
GEOMETRY_ONLY = {"product_axes", "focal_length_px"}
# They define the fields, and write and read them.
NAMES_FIELDS = {"types/raw_rig.py", "types/scan.py", "io/formats/raw_rig.py", "io/formats/rig.py"}

Function = ast.FunctionDef | ast.AsyncFunctionDef


@functools.cache
def modules() -> dict[str, ast.Module]:
    return {
        path.relative_to(PACKAGE).as_posix(): ast.parse(path.read_text(encoding="utf-8"))
        for path in sorted(PACKAGE.rglob("*.py"))
    }


def functions() -> Iterator[tuple[str, Function]]:
    for name, module in modules().items():
        for node in ast.walk(module):
            if isinstance(node, Function):
                yield f"{name}:{node.lineno} {node.name}", node


def names_in(module: ast.Module) -> Iterator[tuple[int, str]]:
    for node in ast.walk(module):
        if isinstance(node, ast.Attribute):
            yield node.lineno, node.attr
        elif isinstance(node, ast.Name):
            yield node.lineno, node.id
        elif isinstance(node, ast.alias):
            yield node.lineno, node.name


def test_only_geometry_does_arithmetic_with_cameras_and_product_axes() -> None:
    found = [
        f"{name}:{line} {used}"
        for name, module in modules().items()
        if not name.startswith("geometry/")
        for line, used in names_in(module)
        if used in GEOMETRY_ONLY or (used in CAMERA_FIELDS and name not in NAMES_FIELDS)
    ]
    assert not found, found


def returns_three_or_more(function: Function) -> bool:
    """Whether a function is annotated to return a tuple of three or more; ``tuple[X, ...]`` is one of any length."""
    match function.returns:
        case ast.Subscript(value=ast.Name(id="tuple"), slice=ast.Tuple(elts=parts)):
            return len(parts) >= 3
    return False


def parameters(function: Function) -> int:
    arguments = [*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs]
    return sum(argument.arg not in ("self", "cls") for argument in arguments)


@pytest.mark.parametrize(
    ("what", "share"),
    [("returns_three_or_more", 0.03), ("more_than_six_parameters", 0.02), ("private", 0.40)],
)
def test_pieces_have_a_size_that_reads(what: str, share: float) -> None:
    counted = {
        "returns_three_or_more": returns_three_or_more,
        "more_than_six_parameters": lambda function: parameters(function) > 6,
        "private": lambda function: function.name.startswith("_") and not function.name.startswith("__"),
    }[what]
    every = list(functions())
    found = [where for where, function in every if counted(function)]
    assert len(found) <= share * len(every), (len(found), len(every), found)


def test_a_long_file_says_why() -> None:
    for name, module in modules().items():
        lines = (PACKAGE / name).read_text(encoding="utf-8").count("\n")
        docstring = ast.get_docstring(module) or ""
        assert lines <= 250 or "One file, long as it is" in docstring, (name, lines)
