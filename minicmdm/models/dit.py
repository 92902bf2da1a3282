"""Causal-DiT: a transformer that reads noisy latents, each at its own noise level, and predicts velocity.

Every block does three things (CMDM Sec. 4.2, A.2; where the paper is silent, the released code):

    x += gate1 * SelfAttention(modulate(LN(x), shift1, scale1))     latents look back, rotary positions
    x +=         CrossAttention(LN(x), words)                       each latent looks at the words it may see
    x += gate2 * FeedForward(modulate(LN(x), shift2, scale2))

The six modulation vectors come from the latent's own time t, per block and per latent (AdaLN): diffusion
forcing needs that, as neighbours stand at different levels. They start at zero, and so does the output
layer, so a new model predicts zero and each block starts as its cross-attention alone.

`forward` is for training and for samplers that know the whole motion. A stream (diffusion/streaming.py) calls
its parts: what depends on the noise level alone (`modulations`), on the words alone (`read`, `keys_values`), and the
rest (`evaluate`), which can leave the keys and values of finished latents in a cache.
"""

from functools import partial

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from minicmdm.config import DiTConfig
from minicmdm.models.layers import Attention, KeyValueCache, Turns, modulate, sinusoid, turns
from minicmdm.models.text import Words

ATTENTION = ("causal", "bidirectional", "window")
TARGETS = ("v", "x0", "eps")
CLOCK_DIM = 64  # waves for each of the clock's two numbers


def self_attention_mask(
    num_latents: int,
    block_size: int,
    attention: str,
    valid: Tensor | None = None,
    device: torch.device | str | None = None,
    committed: Tensor | None = None,
) -> Tensor:
    """Which latent (row) may look at which (column): (N,N) bool, or (B,N,N) with valid or committed (B,N).

    "causal": block i looks at blocks up to i, so the latents of one block see each other. block_size 1 is
    the paper's lower triangle, 3 is the release. "bidirectional": everything. "window" (ours): committed latents are
    clean and never look ahead, so their keys and values are final; those in flight look at everything. There the
    blocks play no part. `valid` hides padding.
    """
    place = torch.arange(num_latents, device=device)
    if attention == "bidirectional":
        mask = torch.ones(num_latents, num_latents, dtype=torch.bool, device=device)
    elif attention == "window":
        if committed is None:
            raise ValueError('attention "window" must be told which latents are committed')
        back = (place[:, None] >= place) & committed.unsqueeze(1)  # (B,N,N): committed ones, and never ahead
        mask = back | ~committed.unsqueeze(2)
    else:
        block = place // block_size
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
        modulation: Tensor,
        words: tuple[Tensor, Tensor],
        word_mask: Tensor | None,
        mask: Tensor | None,
        positions: Turns,
        write=None,
    ) -> Tensor:
        """x (B,N,dim), modulation (B,N,6*dim), words as keys and values; `write` adds what a cache has kept."""
        shift1, scale1, gate1, shift2, scale2, gate2 = modulation.chunk(6, dim=-1)  # 6 x (B,N,dim)
        h = modulate(self.norm1(x), shift1, scale1)
        keys, values = self.self_attention.keys_values(h, positions)
        if write is not None:
            keys, values = write(keys, values)  # (B,H,N,d) -> (B,H,kept+N,d)
        x = x + gate1 * self.self_attention.attend(h, keys, values, mask, positions)
        x = x + self.cross_attention.attend(self.norm2(x), *words, word_mask)
        return x + gate2 * self.feedforward(modulate(self.norm3(x), shift2, scale2))


class WordBlock(nn.Module):
    """Words look at the words of their own sentence: who turns, to which side, how often. (U,S,dim) -> (U,S,dim).

    A text encoder learnt by contrast and then frozen need only say which sentence is whose, and hardly tells which word
    goes with which; the denoiser has to know. The paper reads a frozen DistilBERT's words as they are.
    """

    def __init__(self, dim: int, heads: int):
        super().__init__()
        self.norm1, self.attention = nn.LayerNorm(dim), Attention(dim, heads)
        self.norm2 = nn.LayerNorm(dim)
        self.feedforward = nn.Sequential(nn.Linear(dim, 2 * dim), nn.GELU(), nn.Linear(2 * dim, dim))

    def forward(self, x: Tensor, mask: Tensor | None, positions: Tensor) -> Tensor:
        h = self.norm1(x)
        x = x + self.attention(h, h, mask, positions)
        return x + self.feedforward(self.norm2(x))


class CausalDiT(nn.Module):
    """Noisy latents, their times and the words they may see -> velocity (CMDM Eq. 7, as a flow)."""

    def __init__(self, cfg: DiTConfig):
        super().__init__()
        if cfg.attention not in ATTENTION:
            raise ValueError(f"unknown attention {cfg.attention!r}: expected one of {', '.join(ATTENTION)}")
        if cfg.target not in TARGETS:
            raise ValueError(f"unknown target {cfg.target!r}: expected one of {', '.join(TARGETS)}")
        if cfg.block_size < 1:
            raise ValueError(f"block_size counts the latents of a block, at least 1, got {cfg.block_size}")
        self.cfg = cfg
        self.embed_latent = nn.Linear(cfg.latent_dim, cfg.dim)
        self.embed_words = nn.Linear(cfg.text_dim, cfg.dim)
        self.word_blocks = nn.ModuleList(WordBlock(cfg.dim, cfg.heads) for _ in range(cfg.text_layers))
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
        committed: Tensor | None = None,
    ) -> Tensor:
        """Predict the velocity of every latent.

        z_t (B,N,C) at times t (B,N) in [0,1]; words (B,S,dim) from `read`, with word_mask (B,N,S), True where
        latent n may see word s (a row without any True sees no words at all); valid (B,N), False on padding; clock
        (B,N,2), see `clock_features`, read only by a model that has one; committed (B,N), the finished past under the
        "window" mask, by default those at t = 1. -> (B,N,C).
        """
        self._check(z_t, t, words, word_mask, valid, clock, committed)
        num_latents = z_t.shape[1]
        positions = torch.arange(num_latents, device=z_t.device)
        # The one place that decides who sees whom.
        committed = t >= 1 if committed is None else committed
        mask = self_attention_mask(num_latents, self.cfg.block_size, self.cfg.attention, valid, z_t.device, committed)
        # A batch has far more latents than levels, and modulation is a third of the work: do it once a level.
        levels, which = t.unique(return_inverse=True)  # (U,), and for every latent its place there (B,N)
        told = clock_features(t, clock) if self.cfg.clock else None
        modulations = self.modulations(levels)
        return self.evaluate(z_t, which, modulations, self.keys_values(words), word_mask, mask, positions, told)

    def modulations(self, levels: Tensor) -> list[Tensor]:
        """What every block makes of the times (U,): its six modulation vectors, (U,6*dim) each."""
        # The release feeds t in [0,1] as it is, but the fastest of these waves turns one radian per unit:
        # over [0,1] most of them hardly move. Times 1000, the scale they were made for, neighbouring
        # levels look different.
        waves = sinusoid(1000 * levels, self.cfg.time_dim).to(self.out.weight.dtype)
        time = self.embed_time(waves)  # (U,time_dim) -> (U,dim)
        return [block.modulation(time) for block in self.blocks]

    def read(self, words: Words) -> Words:
        """Sentences (U,S,E) as a text encoder leaves them -> (U,S,dim) as `forward` wants them, each read by itself.

        It depends on the sentence alone, so it is done once for each, before sentences are laid side by side.
        """
        x = self.embed_words(words.embeddings)  # (U,S,E) -> (U,S,dim)
        for block in self.word_blocks:
            x = block(x, words.mask[:, None, :], torch.arange(x.shape[1], device=x.device))
        return Words(x, words.mask)

    def keys_values(self, words: Tensor) -> list[tuple[Tensor, Tensor]]:
        """The keys and values that every block's cross-attention makes of read words (B,S,dim): (B,H,S,d) each."""
        return [block.cross_attention.keys_values(words) for block in self.blocks]

    def evaluate(
        self,
        z_t: Tensor,
        which: Tensor,
        modulations: list[Tensor],
        words: list[tuple[Tensor, Tensor]],
        word_mask: Tensor | None,
        mask: Tensor | None,
        positions: Tensor,
        told: Tensor | None,
        cache: KeyValueCache | None = None,
    ) -> Tensor:
        """The velocity (B,N,C) of latents z_t (B,N,C) at positions (N,), the rest of the work being done.

        which (B,N) numbers the rows of `modulations`; `words` comes from `keys_values`, with word_mask (B,N,S); mask
        (N,N') or (B,N,N') covers the N' - N latents of the cache first; told (B,N,.) are `clock_features`. Masks as in
        `Attention.attend`.
        """
        x = self.embed_latent(z_t)  # (B,N,C) -> (B,N,dim)
        if told is not None:
            x = x + self.embed_clock(told)
        positions = turns(positions, self.cfg.dim // self.cfg.heads, x.dtype)
        for layer, (block, table, keys_values) in enumerate(zip(self.blocks, modulations, words)):
            modulation = F.embedding(which, table)  # (U,6*dim) -> (B,N,6*dim)
            write = None if cache is None else partial(cache.write, layer)
            x = block(x, modulation, keys_values, word_mask, mask, positions, write)
        return self.out(x)  # (B,N,dim) -> (B,N,C)

    def _check(self, z_t, t, words, word_mask, valid, clock, committed):
        batch, num_latents = z_t.shape[:2]
        expected = {
            "z_t": (z_t, (batch, num_latents, self.cfg.latent_dim)),
            "t": (t, (batch, num_latents)),
            "words": (words, (batch, words.shape[1], self.cfg.dim)),
            "word_mask": (word_mask, (batch, num_latents, words.shape[1])),
            "valid": (valid, (batch, num_latents)),
            "clock": (clock, (batch, num_latents, 2)),
            "committed": (committed, (batch, num_latents)),
        }
        for name, (tensor, shape) in expected.items():
            if tensor is not None and tuple(tensor.shape) != shape:
                raise ValueError(f"{name}: expected shape {shape}, got {tuple(tensor.shape)}")
