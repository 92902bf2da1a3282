"""Causal-DiT: a transformer that reads noisy latents, each at its own noise level, and predicts velocity.

Every block does three things (CMDM Sec. 4.2, A.2; where the paper is silent, the released code):

    x += gate1 * SelfAttention(modulate(LN(x), shift1, scale1))     latents look back, rotary positions
    x +=         CrossAttention(LN(x), words)                       each latent looks at the words it may see
    x += gate2 * FeedForward(modulate(LN(x), shift2, scale2))

The six modulation vectors come from the latent's own time t, per block and per latent (AdaLN): diffusion
forcing needs that, as neighbours stand at different levels. They start at zero, and so does the output
layer, so a new model predicts zero and each block starts as its cross-attention alone.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from minicmdm.config import DiTConfig
from minicmdm.models.layers import Attention, modulate, sinusoid

ATTENTION = ("causal", "bidirectional")
CLOCK_DIM = 64  # waves for each of the clock's two numbers


def self_attention_mask(
    num_latents: int,
    block_size: int,
    attention: str,
    valid: Tensor | None = None,
    device: torch.device | str | None = None,
) -> Tensor:
    """Which latent (row) may look at which (column): (N,N) bool, or (B,N,N) when valid (B,N) hides padding.

    "causal": block i looks at blocks up to i, so the latents of one block see each other. block_size 1 is
    the paper's lower triangle, 3 is the release. "bidirectional": everything.
    """
    if attention == "bidirectional":
        mask = torch.ones(num_latents, num_latents, dtype=torch.bool, device=device)
    else:
        block = torch.arange(num_latents, device=device) // block_size
        mask = block[:, None] >= block[None, :]  # (N,N)
    if valid is not None:
        mask = mask & valid.unsqueeze(1)  # (B,1,N): padding is never looked at
    return mask


def clock_features(t: Tensor, clock: Tensor | None) -> Tensor:
    """How many latents ago this latent's sentence began, and how many are left of it: (B,N,2) -> (B,N,2*CLOCK_DIM+1).

    A number left below 0 says that nobody knows, as in an endless stream; without a clock, sentences began at latent
    0. The paper's model has to count for itself, and cannot tell where it stands: rotary positions know distances only
    and a causal mask has no first word to count from. t (B,N) gives shape and dtype.
    """
    if clock is None:
        begun = torch.arange(t.shape[1], device=t.device, dtype=t.dtype).expand_as(t)
        clock = torch.stack([begun, torch.full_like(t, -1.0)], dim=-1)  # (B,N,2)
    known = (clock[..., 1:] >= 0).to(t.dtype)  # (B,N,1)
    begun, left = (sinusoid(part.to(t.dtype), CLOCK_DIM) for part in clock.unbind(-1))  # 2 x (B,N,CLOCK_DIM)
    return torch.cat([begun, left * known, known], dim=-1)


class Block(nn.Module):
    """One transformer block; see the top of the file."""

    def __init__(self, dim: int, heads: int, feedforward_dim: int):
        super().__init__()
        self.modulation = nn.Linear(dim, 6 * dim)
        self.norm1 = nn.LayerNorm(dim, elementwise_affine=False)
        self.self_attention = Attention(dim, heads)
        self.norm2 = nn.LayerNorm(dim)
        self.cross_attention = Attention(dim, heads)
        self.norm3 = nn.LayerNorm(dim, elementwise_affine=False)
        self.feedforward = nn.Sequential(
            nn.Linear(dim, feedforward_dim), nn.GELU(approximate="tanh"), nn.Linear(feedforward_dim, dim)
        )
        nn.init.zeros_(self.modulation.weight)
        nn.init.zeros_(self.modulation.bias)

    def forward(
        self,
        x: Tensor,
        time: Tensor,
        which: Tensor,
        mask: Tensor,
        positions: Tensor,
        words: Tensor,
        word_mask: Tensor,
    ) -> Tensor:
        modulation = F.embedding(which, self.modulation(time))  # (U,dim) -> (U,6*dim) -> (B,N,6*dim)
        shift1, scale1, gate1, shift2, scale2, gate2 = modulation.chunk(6, dim=-1)  # 6 x (B,N,dim)
        h = modulate(self.norm1(x), shift1, scale1)
        x = x + gate1 * self.self_attention(h, h, mask, positions)
        x = x + self.cross_attention(self.norm2(x), words, word_mask)
        return x + gate2 * self.feedforward(modulate(self.norm3(x), shift2, scale2))


class CausalDiT(nn.Module):
    """Noisy latents, their times and the words they may see -> velocity (CMDM Eq. 7, as a flow)."""

    def __init__(self, cfg: DiTConfig):
        super().__init__()
        if cfg.attention not in ATTENTION:
            raise ValueError(f"unknown attention {cfg.attention!r}: expected one of {', '.join(ATTENTION)}")
        if cfg.block_size < 1:
            raise ValueError(f"block_size counts the latents of a block, at least 1, got {cfg.block_size}")
        self.cfg = cfg
        self.embed_latent = nn.Linear(cfg.latent_dim, cfg.dim)
        self.embed_words = nn.Linear(cfg.text_dim, cfg.dim)
        if cfg.clock:
            self.embed_clock = nn.Linear(2 * CLOCK_DIM + 1, cfg.dim)
        # AdaLN is SiLU and linear in every block; the SiLU is the same for all of them, so it is done here, once.
        self.embed_time = nn.Sequential(
            nn.Linear(cfg.time_dim, cfg.dim), nn.SiLU(), nn.Linear(cfg.dim, cfg.dim), nn.SiLU()
        )
        self.blocks = nn.ModuleList(Block(cfg.dim, cfg.heads, cfg.feedforward_dim) for _ in range(cfg.layers))
        self.out = nn.Linear(cfg.dim, cfg.latent_dim)  # plain, as released: no last norm, no last AdaLN
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def forward(
        self,
        z_t: Tensor,
        t: Tensor,
        words: Tensor,
        word_mask: Tensor,
        valid: Tensor | None = None,
        clock: Tensor | None = None,
    ) -> Tensor:
        """Predict the velocity of every latent.

        z_t (B,N,C) at times t (B,N) in [0,1]; words (B,S,E) with word_mask (B,N,S), True where latent n
        may see word s (a row without any True sees no words at all); valid (B,N), False on padding; clock
        (B,N,2), see `clock_features`, read only by a model that has one. -> (B,N,C).
        """
        self._check(z_t, t, words, word_mask, valid, clock)
        num_latents = z_t.shape[1]
        positions = torch.arange(num_latents, device=z_t.device)
        # The one place that decides who sees whom.
        mask = self_attention_mask(num_latents, self.cfg.block_size, self.cfg.attention, valid, z_t.device)
        # The release feeds t in [0,1] as it is, but the fastest of these waves turns one radian per unit:
        # over [0,1] most of them hardly move. Times 1000, the scale they were made for, neighbouring
        # levels look different.
        # A batch has far more latents than levels, and modulation is a third of the work: do it once a level.
        levels, which = t.unique(return_inverse=True)  # (U,), and for every latent its place there (B,N)
        time = self.embed_time(sinusoid(1000 * levels, self.cfg.time_dim))  # (U,) -> (U,dim)
        words = self.embed_words(words)  # (B,S,E) -> (B,S,dim)
        x = self.embed_latent(z_t)  # (B,N,C) -> (B,N,dim)
        if self.cfg.clock:
            x = x + self.embed_clock(clock_features(t, clock))
        for block in self.blocks:
            x = block(x, time, which, mask, positions, words, word_mask)
        return self.out(x)  # (B,N,dim) -> (B,N,C)

    def _check(self, z_t, t, words, word_mask, valid, clock):
        batch, num_latents = z_t.shape[:2]
        expected = {
            "z_t": (z_t, (batch, num_latents, self.cfg.latent_dim)),
            "t": (t, (batch, num_latents)),
            "words": (words, (batch, words.shape[1], self.cfg.text_dim)),
            "word_mask": (word_mask, (batch, num_latents, words.shape[1])),
            "valid": (valid, (batch, num_latents)),
            "clock": (clock, (batch, num_latents, 2)),
        }
        for name, (tensor, shape) in expected.items():
            if tensor is not None and tuple(tensor.shape) != shape:
                raise ValueError(f"{name}: expected shape {shape}, got {tuple(tensor.shape)}")
