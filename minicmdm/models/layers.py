"""The bricks: causal convolution for the VAE; rotary attention, RMSNorm and modulation for the DiT.

Both halves also work in pieces, for endless streams. A convolution keeps the last inputs that its next output needs
(`States`), attention keeps the keys and values of what will not change any more (`KeyValueCache`).
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

States = dict[nn.Module, Tensor]  # per convolution the end of its input so far; a stream begins with an empty one


class CausalConv1d(nn.Module):
    """A convolution over time that pads only on the left, so output i never sees input after its own group.

    With stride s the left padding is (k-1)*dilation + 1-s: the output has T/s frames, and output i sees
    inputs up to s*i + s-1, the last frame of its group. `causal=False` splits the same padding over both
    sides, which is the ordinary convolution of the ablation. (B,C_in,T) -> (B,C_out,T/s).
    """

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        kernel_size: int,
        stride: int = 1,
        dilation: int = 1,
        causal: bool = True,
    ):
        super().__init__()
        self.conv = nn.Conv1d(in_channels, out_channels, kernel_size, stride=stride, dilation=dilation)
        total = (kernel_size - 1) * dilation + 1 - stride
        right = 0 if causal else total // 2
        self.padding = (total - right, right)

    def forward(self, x: Tensor, states: States | None = None) -> Tensor:
        """With `states`, x continues the x of the call before: its end stands where zeros would be padded."""
        if states is None:
            return self.conv(F.pad(x, self.padding))
        left, right = self.padding
        if right:
            raise ValueError("only a causal convolution can work in pieces, and this one looks ahead")
        x = torch.cat([states[self], x], dim=-1) if self in states else F.pad(x, self.padding)
        states[self] = x[..., x.shape[-1] - left :]  # (B,C_in,left)
        return self.conv(x)


class ResidualBlock(nn.Module):
    """ReLU, dilated k3 convolution, ReLU, k1 convolution, plus the input. (B,C,T) -> (B,C,T)."""

    def __init__(self, channels: int, dilation: int, causal: bool = True):
        super().__init__()
        self.dilated = CausalConv1d(channels, channels, 3, dilation=dilation, causal=causal)
        self.mix = CausalConv1d(channels, channels, 1, causal=causal)

    def forward(self, x: Tensor, states: States | None = None) -> Tensor:
        return x + self.mix(F.relu(self.dilated(F.relu(x), states)))  # the k1 convolution has no past to keep


class RMSNorm(nn.Module):
    """Divide by the root mean square of the last axis, then scale. Any shape (..., dim)."""

    def __init__(self, dim: int, eps: float = 1e-6):
        super().__init__()
        self.weight = nn.Parameter(torch.ones(dim))
        self.eps = eps

    def forward(self, x: Tensor) -> Tensor:
        # Under autocast x is bfloat16: too coarse to add up squares, good enough for the squares themselves.
        wide = torch.promote_types(x.dtype, torch.float32)
        scale = torch.rsqrt((x * x).mean(-1, keepdim=True, dtype=wide) + self.eps)
        return x * scale.to(x.dtype) * self.weight.to(x.dtype)


def modulate(x: Tensor, shift: Tensor, scale: Tensor) -> Tensor:
    """AdaLN: x (1 + scale) + shift, each latent with its own shift and scale. All (B,N,dim)."""
    return torch.addcmul(x + shift, x, scale)  # one pass over memory less than it reads


def sinusoid(t: Tensor, dim: int) -> Tensor:
    """Cosines and sines of t at dim/2 frequencies from 1 to 1/10000. (B,N) -> (B,N,dim)."""
    half = dim // 2
    exponent = torch.arange(half, device=t.device, dtype=t.dtype) / half
    angle = t.unsqueeze(-1) * 10_000.0**-exponent  # (B,N,dim/2)
    return torch.cat([angle.cos(), angle.sin()], dim=-1)


Turns = tuple[Tensor, Tensor]  # what `turns` makes of positions: (N,1,d) each


def turns(positions: Tensor, width: int, dtype: torch.dtype) -> Turns:
    """Cosines and signed sines of the angles by which `rotate` turns the pairs of vectors of an even width d.

    The same for every layer, so a model may compute them once. Nothing is tabled: there is no longest sequence.
    """
    wide = torch.promote_types(dtype, torch.float32)  # an angle in bfloat16 would be off by whole latents
    exponent = torch.arange(width // 2, device=positions.device, dtype=wide) / (width // 2)
    angle = positions.to(wide)[:, None, None] * 10_000.0**-exponent  # (N,1,d/2)
    cos, sin = angle.cos().to(dtype), angle.sin().to(dtype)
    return torch.cat([cos, cos], dim=-1), torch.cat([-sin, sin], dim=-1)


def rotate(x: Tensor, positions: Tensor | Turns) -> Tensor:
    """Rotary position embedding (RoPE): turn each channel pair by an angle proportional to the position.

    Channel i of the first half (a) and channel i of the second (b) are the two coordinates of a pair, which becomes
    (a cos - b sin, b cos + a sin). A dot product of two rotated vectors then depends on the difference of their
    positions only. x (B,N,H,d) with d even; positions (N,), or their `turns`.
    """
    cos, sin = turns(positions, x.shape[-1], x.dtype) if isinstance(positions, Tensor) else positions
    # Real numbers: the complex product that says the same in one line is thirty times slower on a CPU.
    return torch.addcmul(x * cos, x.roll(x.shape[-1] // 2, dims=-1), sin)


class Attention(nn.Module):
    """Multi-head attention of x over a context, under an explicit mask: True where a query may look.

    Self-attention passes x as its own context and gives positions, which rotate queries and keys;
    cross-attention gives none. Queries and keys are RMS-normalised over the full width. Keys and values
    come from one method, so that a stream can compute them once and keep them.
    """

    def __init__(self, dim: int, heads: int):
        super().__init__()
        if dim % (2 * heads):
            raise ValueError(f"dim must be a multiple of 2 * heads (RoPE turns pairs), got {dim} and {heads}")
        self.heads = heads
        self.query, self.key, self.value, self.out = (nn.Linear(dim, dim) for _ in range(4))
        self.query_norm, self.key_norm = RMSNorm(dim), RMSNorm(dim)

    def split(self, x: Tensor, positions: Tensor | Turns | None) -> Tensor:
        x = x.unflatten(-1, (self.heads, -1))  # (B,N,dim) -> (B,N,H,d)
        return (x if positions is None else rotate(x, positions)).transpose(1, 2)  # (B,H,N,d)

    def keys_values(self, context: Tensor, positions: Tensor | Turns | None = None) -> tuple[Tensor, Tensor]:
        """Keys and values (B,H,S,d) of a context (B,S,dim) whose entries stand at `positions` (S,)."""
        return self.split(self.key_norm(self.key(context)), positions), self.split(self.value(context), None)

    def attend(self, x: Tensor, keys: Tensor, values: Tensor, mask: Tensor | None, positions=None) -> Tensor:
        """x (B,N,dim) looks at keys and values (B,H,S,d) where mask (N,S) or (B,N,S) is True -> (B,N,dim).

        No mask shows everything. A mask of numbers is added to the scores, and must leave something to every query.
        """
        queries = self.split(self.query_norm(self.query(x)), positions)
        queries = queries * queries.shape[-1] ** -0.5  # here rather than on the scores, which are more numbers
        if mask is not None and mask.ndim == 3:
            mask = mask.unsqueeze(1)  # (B,N,S) -> (B,1,N,S): the same for all heads
        # Autocast is off because it would widen every score to float32; a softmax sums in float32 by itself.
        with torch.autocast(x.device.type, enabled=False):
            keys, values = keys.to(queries.dtype), values.to(queries.dtype)
            if not torch.is_grad_enabled():
                out = F.scaled_dot_product_attention(queries, keys, values, mask, scale=1.0)  # (B,H,N,d)
            else:  # written out: on a CPU in bfloat16 the fused backward pass is ten times slower than this
                scores = queries @ keys.transpose(-1, -2)  # (B,H,N,S)
                if mask is not None:
                    hidden = torch.finfo(scores.dtype).min
                    scores = scores + mask if mask.is_floating_point() else scores.masked_fill(~mask, hidden)
                out = scores.softmax(-1) @ values  # (B,H,N,d)
        # A query that may look at nothing has a softmax over equal scores; its answer is zero, not their mean.
        if mask is not None and mask.dtype == torch.bool:
            nothing = ~mask.any(-1, keepdim=True)
            # To look first saves a pass when sampling; in training it would cut the compiled block in two.
            if torch.is_grad_enabled() or nothing.any():
                out = out.masked_fill(nothing, 0.0)
        return self.out(out.transpose(1, 2).flatten(2))  # (B,N,dim)

    def forward(self, x: Tensor, context: Tensor, mask: Tensor, positions=None) -> Tensor:
        return self.attend(x, *self.keys_values(context, positions), mask, positions)


class KeyValueCache:
    """Keys and values, for every layer, of latents that will not change any more, and room for those that still do.

    They lie in numbered slots: [first, end) are kept, and what is written comes after, again and again until `keep`
    moves the end. A latent's slot is also its rotary position. When the slots run out, what is still in the window
    moves to slot 0 and its keys are turned back by as much: attention hears distances only, so nothing changes, the
    memory never grows, and no position is ever so large that its angle loses digits.
    """

    def __init__(self, layers: int, batch: int, heads: int, width: int, window: int, like: Tensor):
        self.window = window  # the most latents that one call sees
        self.first = self.end = 0
        # Twice the window, so that moving to the front, once in `window` latents, costs next to nothing.
        self.keys = like.new_zeros(layers, batch, heads, 2 * window, width)
        self.values = torch.zeros_like(self.keys)

    def make_room(self, count: int) -> None:
        """Before a call that writes `count` latents: forget what leaves the window."""
        self.first = max(self.first, self.end + count - self.window)
        if self.end + count > self.keys.shape[3]:
            kept = slice(self.first, self.end)
            back = torch.tensor([-self.first], device=self.keys.device)
            # rotate() wants (..., slots, heads, d) and one position for all of them
            keys = rotate(self.keys[..., kept, :].transpose(2, 3), back).transpose(2, 3)
            values = self.values[..., kept, :].clone()
            self.first, self.end = 0, self.end - self.first
            self.keys[..., : self.end, :], self.values[..., : self.end, :] = keys, values

    def write(self, layer: int, keys: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
        """Put one layer's (B,H,n,d) after the kept ones; return all that its queries may look at, (B,H,kept+n,d)."""
        stop = self.end + keys.shape[2]
        self.keys[layer, :, :, self.end : stop] = keys
        self.values[layer, :, :, self.end : stop] = values
        return self.keys[layer, :, :, self.first : stop], self.values[layer, :, :, self.first : stop]

    def keep(self, count: int) -> None:
        """The first `count` of the latents just written are final."""
        self.end += count

    def __len__(self) -> int:
        return self.end - self.first
