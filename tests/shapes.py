"""What annotations state about types and shapes is checked once for every function and combination of shapes.

A check takes longer than most of the functions that are checked, and a filter calls them thousands of times with the
same shapes: checking every call would more than double the time of the tests.
"""

import functools
import inspect
from collections.abc import Callable
from dataclasses import is_dataclass
from typing import Any

import jaxtyping
import torch

_check_every_call = jaxtyping.jaxtyped
# What each function was called with; a function within another is defined again and again, and checked once.
_KNOWN: dict[tuple[str, str, int], set] = {}


def install_checks(modules: list[str]) -> None:
    """Check the functions and dataclasses of some modules, which must not have been imported yet."""
    jaxtyping.jaxtyped = _check_every_shape  # what the hook decorates them with
    jaxtyping.install_import_hook(modules, "beartype.beartype")


def _check_every_shape(*, typechecker: Callable) -> Callable:
    def decorate(plain: Any) -> Any:
        if not inspect.isclass(plain):
            return _once_for_every_shape(plain, typechecker)
        if is_dataclass(plain) and "__init__" in vars(plain):
            plain.__init__ = _once_for_every_shape(plain.__init__, typechecker)
        return plain

    return decorate


def _once_for_every_shape(plain: Callable, typechecker: Callable) -> Callable:
    """A function that is checked where its arguments have types and shapes that it was not called with before."""
    known = _KNOWN.setdefault((plain.__module__, plain.__qualname__, plain.__code__.co_firstlineno), set())

    @functools.cache
    def checked() -> Callable:
        return _check_every_call(plain, typechecker=typechecker)  # when it is called first: most never are

    @functools.wraps(plain)
    def call(*args: Any, **kwargs: Any) -> Any:
        __tracebackhide__ = True
        shapes = (*map(_shape, args), *kwargs, *map(_shape, kwargs.values()))
        if shapes in known:
            return plain(*args, **kwargs)
        result = checked()(*args, **kwargs)
        known.add(shapes)
        return result

    return call


def _shape(value: Any) -> Any:
    """What of a value its annotation may speak of."""
    if isinstance(value, torch.Tensor):
        return value.dtype, value.shape
    if isinstance(value, tuple):
        return type(value), *map(_shape, value)
    return value if isinstance(value, str) else type(value)
