"""Lists of different lengths, one after the other in one tensor."""

import torch
from jaxtyping import Int
from torch import Tensor


def ragged_range(counts: Int[Tensor, " lists"]) -> tuple[Int[Tensor, " entries"], Int[Tensor, " entries"]]:
    """For each entry of lists of some lengths the number of its list and its place in it, both from 0 on."""
    which = torch.arange(len(counts), device=counts.device).repeat_interleave(counts)
    return which, torch.arange(len(which), device=counts.device) - (counts.cumsum(0) - counts)[which]
