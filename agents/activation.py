"""A quicker tanh for training on the CPU: PyTorch's costs as much as the matrix product before it, NumPy's a tenth."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import nn


class _NumpyTanh(torch.autograd.Function):
    """tanh by NumPy, its gradient g (1 − y²) by PyTorch."""

    @staticmethod
    def forward(ctx: Any, x: torch.Tensor) -> torch.Tensor:
        y = torch.from_numpy(np.tanh(x.detach().numpy()))
        ctx.save_for_backward(y)
        return y

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> torch.Tensor:
        (y,) = ctx.saved_tensors
        return torch.ops.aten.tanh_backward(gradients[0], y)


class QuickTanh(nn.Tanh):
    """`nn.Tanh`, equal to rounding; on other devices than the CPU the original."""

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Tanh of every element."""
        return _NumpyTanh.apply(x) if x.device.type == "cpu" else super().forward(x)  # type: ignore[return-value]


def quicken(network: nn.Module) -> None:
    """Put a `QuickTanh` in the place of every `nn.Tanh` of a network; parameters and saved files stay as they are."""
    for module in network.modules():
        for name, child in module.named_children():
            if type(child) is nn.Tanh:
                setattr(module, name, QuickTanh())
