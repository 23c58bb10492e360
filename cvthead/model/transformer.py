"""Transformer encoder over vertex and image tokens (paper section 3.3)."""

from __future__ import annotations

from einops import rearrange
from torch import Tensor, nn
from torch.nn import functional as F


class Attention(nn.Module):
    """Multi-headed self-attention on normalised tokens."""

    def __init__(self, size: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm = nn.LayerNorm(size)
        self.to_qkv = nn.Linear(size, 3 * size, bias=False)
        self.to_out = nn.Linear(size, size)

    def forward(self, x: Tensor) -> Tensor:
        qkv = self.to_qkv(self.norm(x))  # b t 3d
        q, k, v = rearrange(qkv, "b t (n h d) -> n b h t d", n=3, h=self.heads)
        # Half-precision attention is several times slower than float32 on a CPU.
        out = F.scaled_dot_product_attention(q.float(), k.float(), v.float())  # b h t d
        projected: Tensor = self.to_out(rearrange(out, "b h t d -> b t (h d)"))
        return projected


class FeedForward(nn.Module):
    def __init__(self, size: int, hidden: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(size)
        self.inner = nn.Linear(size, hidden)
        self.outer = nn.Linear(hidden, size)

    def forward(self, x: Tensor) -> Tensor:
        out: Tensor = self.outer(F.gelu(self.inner(self.norm(x))))
        return out


class Transformer(nn.Module):
    """Pre-norm encoder layers without a final norm."""

    def __init__(self, size: int, depth: int, heads: int, mlp_size: int) -> None:
        super().__init__()
        self.layers = nn.ModuleList(
            nn.ModuleList([Attention(size, heads), FeedForward(size, mlp_size)])
            for _ in range(depth)
        )

    def forward(self, x: Tensor) -> Tensor:
        for layer in self.layers:
            attention, feed_forward = layer.children()
            x = x + attention(x)
            x = x + feed_forward(x)
        return x
