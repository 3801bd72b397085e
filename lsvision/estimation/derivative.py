"""Derivatives by forward differentiation."""

import warnings
from collections.abc import Callable

from torch import Tensor
from torch.func import jacfwd


def jacobian(function: Callable[[Tensor], Tensor], at: Tensor) -> Tensor:
    """Derivative of a function at a point, ``(*values, *arguments)``.

    torch loads its forward formulas at the first call and then warns of torch.jit, which it uses itself; the caller
    cannot act on that.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="`torch.jit.script", category=DeprecationWarning)
        return jacfwd(function)(at)
