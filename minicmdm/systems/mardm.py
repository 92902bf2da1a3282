"""MARDM: latents are masked, a transformer says what it knows about each, and a small diffusion head draws it.

    autoencoder     67 essential features -> latents without noise: `MACVAE` with deterministic=True, causal=False
    transformer     latents, some replaced by a mask vector -> a condition (B,N,dim) for each; all see each other
    head            noise, its time and a condition -> the velocity of one latent (B,N,C), no latent sees another

Training masks a share cos(pi u / 2) of a motion, u uniform, and asks the head for the masked latents. Sampling begins
with nothing but masks and runs the transformer a few times; each time the head draws all that is still masked, and
those whose turn has come keep what was drawn. To edit is the same with a part given.

What differs from the release, on purpose: the transformer is this library's (its blocks, its words, its clock) where
MARDM has one wide block and a pooled sentence; the autoencoder has the sigma-VAE's loss where MARDM has SmoothL1 (its
Eq. 8 says L1); latents are normalised; masks count real latents, not padding; Euler's fixed steps replace dopri5, whose
answer depends on the batch. The kept parts of an edited motion are encoded on their own: the released way encodes the
whole clip, and its 176 frames of receptive field tell the answer (editing.py, notebook 13).
"""

import math
from collections.abc import Callable, Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from minicmdm.asking import MAX_FRAMES
from minicmdm.config import Preset
from minicmdm.diffusion.forcing import diffusion_forcing_loss
from minicmdm.diffusion.sampling import from_noise_prediction, sample
from minicmdm.diffusion.schedules import schedule_matrix
from minicmdm.models.dit import CausalDiT, clock_features
from minicmdm.models.layers import modulate, sinusoid
from minicmdm.models.text import Words

NOISE, MASK = 0.1, 0.9 * 0.88  # of the masked latents become noise, and the mask vector; the rest stay as they are
LONGEST = MAX_FRAMES // 4  # latents. Luck is drawn for so many, then cut: no sample depends on its company


class HeadBlock(nn.Module):
    """x + gate MLP(modulate(LN(x))), modulated by time and condition y. (M,width) -> (M,width)."""

    def __init__(self, width: int):
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.mlp = nn.Sequential(nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width))
        self.modulation = nn.Linear(width, 3 * width)
        nn.init.zeros_(self.modulation.weight)
        nn.init.zeros_(self.modulation.bias)

    def forward(self, x: Tensor, y: Tensor) -> Tensor:
        shift, scale, gate = self.modulation(y).chunk(3, dim=-1)
        return x + gate * self.mlp(modulate(self.norm(x), shift, scale))


class DiffusionHead(nn.Module):
    """A small denoiser of single latents: noisy x (...,C) at times t (...), given conditions (...,D) -> (...,C)."""

    def __init__(self, channels: int, dim: int, width: int, layers: int):
        super().__init__()
        self.width = width
        self.embed, self.condition = nn.Linear(channels, width), nn.Linear(dim, width)
        self.time = nn.Sequential(nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width))
        self.blocks = nn.ModuleList(HeadBlock(width) for _ in range(layers))
        self.norm, self.modulation = nn.LayerNorm(width, elementwise_affine=False), nn.Linear(width, 2 * width)
        self.out = nn.Linear(width, channels)
        for layer in (self.modulation, self.out):
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)

    def forward(self, x: Tensor, t: Tensor, conditions: Tensor) -> Tensor:
        waves = sinusoid(1000 * t, self.width).to(self.out.weight.dtype)  # as in models/dit.py
        y = F.silu(self.time(waves) + self.condition(conditions))
        h = self.embed(x)
        for block in self.blocks:
            h = block(h, y)
        return self.out(modulate(self.norm(h), *self.modulation(y).chunk(2, dim=-1)))


class MaskedTransformer(nn.Module):
    """The transformer and its head. `conditions` is one look at the motion; `head` draws from what was seen."""

    def __init__(self, plan: Preset):
        super().__init__()
        self.cfg, self.masked = plan.dit, plan.masked
        self.body = CausalDiT(plan.dit)
        self.body.out = nn.Linear(plan.dit.dim, plan.dit.dim)  # conditions, not velocities
        self.mask_vector = nn.Parameter(torch.zeros(plan.dit.latent_dim))
        self.head = DiffusionHead(plan.dit.latent_dim, plan.dit.dim, plan.masked.head_dim, plan.masked.head_layers)

    def read(self, words: Words) -> Words:
        """Sentences as `CausalDiT.read` reads them."""
        return self.body.read(words)

    def sees(self, known: Tensor, valid: Tensor) -> Tensor:
        """Which latent looks at which, (B,N,N): here all at all; known (B,N) tells those that are not masked."""
        return valid[:, None, :].expand(-1, valid.shape[1], -1)

    def conditions(
        self,
        shown: Tensor,
        known: Tensor,
        words: Tensor,
        word_mask: Tensor,
        valid: Tensor,
        clock: Tensor | None,
        heard: tuple[Tensor, Tensor] | None = None,
    ) -> Tensor:
        """What the head is told about every latent (B,N,dim), of latents as `shown` (B,N,C), masked ones masked.

        words (B,S,dim) from `read`, word_mask (B,N,S), valid (B,N), clock (B,N,2) as in `CausalDiT.forward`. `heard`
        adds tokens (B,H,dim) and who sees them (B,N,H) to the words.
        """
        if heard is not None:
            words, word_mask = torch.cat([words, heard[0]], 1), torch.cat([word_mask, heard[1]], 2)
        body, now = self.body, shown.new_ones(shown.shape[:2])  # (B,N): there is no noise level here
        told = clock_features(now, clock) if self.cfg.clock else None
        return body.evaluate(
            shown,
            now.long() - 1,  # the one row of modulations
            body.modulations(now[:1, :1].flatten()),
            body.keys_values(words),
            word_mask,
            self.sees(known, valid),
            torch.arange(shown.shape[1], device=shown.device),
            told,
        )

    def heard(self, z: Tensor, known: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor] | None:
        """What else training lets latents hear, see `conditions`; nothing here."""
        return None


def draw_mask(valid: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """Mask a share cos(pi u / 2) of each sample's latents, at least one: valid (B,N) -> masked (B,N) bool.

    On average 2 / pi of them. The release counts the padded length and then drops what is padding, so that short
    motions are sometimes left without any mask.
    """
    device = generator.device if generator is not None else valid.device
    luck = torch.rand(len(valid), generator=generator, device=device).to(valid.device)
    count = (torch.cos(math.pi / 2 * luck) * valid.sum(1)).round().clamp_min(1)  # (B,)
    order = torch.rand(valid.shape, generator=generator, device=device).to(valid.device).masked_fill(~valid, 2.0)
    return (order.argsort(1).argsort(1) < count[:, None]) & valid


def corrupt(z: Tensor, masked: Tensor, mask_vector: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """What the transformer is shown (B,N,C): of masked latents 10 % are noise, 79.2 % the mask vector, 10.8 % as is.

    The papers say "10 % and 88 %", but the second draw is made among those that the first has left.
    """
    device = generator.device if generator is not None else z.device
    luck = torch.rand(masked.shape, generator=generator, device=device).to(z.device).unsqueeze(-1)  # (B,N,1)
    noise = torch.randn(z.shape, generator=generator, device=device).to(z)
    changed = torch.where(luck < NOISE, noise, torch.where(luck < NOISE + MASK, mask_vector.to(z), z))
    return torch.where(masked.unsqueeze(-1), changed, z)


def masked_loss(
    model: MaskedTransformer,
    z: Tensor,
    words: Tensor,
    word_mask: Tensor,
    valid: Tensor,
    clock: Tensor | None,
    generator: torch.Generator,
) -> Tensor:
    """The head's error on masked latents (MARDM Eqs 6-10), each with several noises. Scalar.

    Arguments as in `diffusion_forcing_loss`, which also computes it: to the head latents are samples of their own.
    """
    masked = draw_mask(valid, generator)
    heard = model.heard(z, ~masked & valid, generator)
    shown = corrupt(z, masked, model.mask_vector, generator)
    conditions = model.conditions(shown, ~masked & valid, words, word_mask, valid, clock, heard)  # (B,N,dim)
    tokens, seen = (x[masked].repeat(model.masked.repeats, 1)[None] for x in (z, conditions))  # (1,M,C), (1,M,dim)

    def head(x: Tensor, t: Tensor, conditions: Tensor, *_) -> Tensor:
        return model.head(x, t, conditions)

    return diffusion_forcing_loss(head, tokens, seen, None, generator=generator, path=model.cfg.path)


def unmask_counts(length: Tensor, iterations: int) -> Tensor:
    """How many latents are still masked in each iteration: cos(pi k / 2) of them for k from 0 to 1, at least one.

    length (B,) -> (iterations,B). The last iteration draws the last one.
    """
    share = torch.cos(math.pi / 2 * torch.linspace(0, 1, iterations, dtype=torch.float64))
    return (share[:, None] * length).round().clamp_min(1).long()


@torch.no_grad()
def unmask(
    look: Callable[[Tensor, Tensor], list[Tensor]],
    model: MaskedTransformer,
    wanted: Tensor,
    generators: Sequence[torch.Generator],
    given: Tensor | None = None,
    *,
    num_steps: int = 20,
    guidance_scale: float = 3.0,
    solver: str = "euler",
) -> Tensor:
    """Draw the wanted latents (B,N) bool, in a random order -> (B,N,C); those that are not wanted stay as `given`.

    look(shown, known) -> conditions (B,N,dim), one for each branch of guidance. Guidance is the head's: at every step
    both branches see the same noise, v = v_null + s (v_text - v_null). A sample's luck is its own generator's.
    """
    channels = model.cfg.latent_dim
    z = wanted.new_zeros((*wanted.shape, channels), dtype=torch.float32) if given is None else given
    num_latents = wanted.shape[1]
    longest = max(num_latents, LONGEST)
    order = torch.stack([torch.rand(longest, generator=g)[:num_latents] for g in generators]).masked_fill(~wanted, 2.0)
    turn = order.argsort(1).argsort(1)  # (B,N): who is revealed last has turn 0
    if not wanted.any():
        return z
    for count in unmask_counts(wanted.sum(1), model.masked.iterations):
        masked = wanted & (turn < count[:, None])
        shown = torch.where(masked.unsqueeze(-1), model.mask_vector, z)
        branches = [seen[masked] for seen in look(shown, ~masked)]  # each (M,dim)
        noise = torch.stack([torch.randn(longest, channels, generator=g)[:num_latents] for g in generators])[masked]

        def predict(x: Tensor, t: Tensor, branches=branches) -> Tensor:  # (1,M,C), (1,M)
            first, *rest = (model.head(x[0], t[0], seen)[None] for seen in branches)
            return first if not rest else rest[0] + guidance_scale * (first - rest[0])

        denoise = from_noise_prediction(predict) if model.cfg.path == "ddpm" else predict
        matrix = schedule_matrix(len(noise), num_steps, kind="full")
        drawn = sample(denoise, matrix, noise[None], solver=solver, path=model.cfg.path, generator=generators[0])[0]
        z = z.masked_scatter(masked.unsqueeze(-1), drawn)
    return z
