"""Posteriors of some problems of a batch put among those of all."""

import torch
from jaxtyping import Bool, Shaped
from torch import Tensor

from lsvision.estimation import Posterior


def merged(chosen: Bool[Tensor, "*batch"], part: Posterior, whole: Posterior) -> Posterior:
    """``whole`` with the posteriors of the chosen problems replaced by those of ``part``, which has them in a row."""
    length = max(len(part.path), len(whole.path))
    paths = (torch.cat([p.path, p.path[-1:].expand(length - len(p.path), *p.path.shape[1:])]) for p in (part, whole))
    path = [scattered(chosen, *steps) for steps in zip(*paths, strict=True)]
    names = ("mean", "factor", "iterations", "converged", "info")
    replaced = {name: scattered(chosen, getattr(part, name), getattr(whole, name)) for name in names}
    return Posterior(path=torch.stack(path), **replaced)


def scattered(
    chosen: Bool[Tensor, "*batch"], part: Shaped[Tensor, "*_"], whole: Shaped[Tensor, "*_"]
) -> Shaped[Tensor, "*_"]:
    """A copy of ``whole`` with the entries of a mask replaced by those of ``part``, in order."""
    copy = whole.clone()
    copy[chosen] = part
    return copy
