"""CDAMD: MARDM in absolute coordinates, with a causal look at what is made and a memory of motion tokens.

    autoencoder     66 coordinates, metres in the clip's own frame -> latents without noise
    quantiser       latents -> residual codes; those of level 0 are the motion tokens H
    transformer     MARDM's, under the dual-constrained mask; latents hear words and, in 30 % of training, H
    head            MARDM's

What the paper calls a dual-constrained causal mask exists in three readings (`dual_mask`), each of which was somebody's
intention: the released code trains with one, samples with another, and the paper's text describes a third. Its Eq. 11,
the intersection of "causal" with something wider, is plainly causal.

What differs from the release, on purpose: the quantiser reads the autoencoder's latents and is fitted to them before
training, where the release trains a second encoder; one straight-through gradient on the sum of the levels, where the
release adds one up for every level, which multiplies the encoder's gradient by their number; dead codes are replaced
by random vectors of the batch, not its first ones. At sampling there are no motion tokens, in the release as here.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from minicmdm.config import Preset
from minicmdm.models.layers import sinusoid
from minicmdm.systems.mardm import MaskedTransformer

READINGS = ("trained", "run", "meant")
DECAY, DEAD = 0.99, 1.0  # of the codebook's running sums; a code that fewer vectors chose than this is replaced
LEVEL_DROP = 0.2  # how often training uses the first levels only


def dual_mask(known: Tensor, reading: str) -> Tensor:
    """Which latent (row) may look at which (column), known (B,N) bool -> (B,N,N) bool (CDAMD Eqs 11-13).

    "trained"   the release in training: known latents see the known; those to be made look back, at anything. With two
                layers the known future reaches them all the same, through known latents before them
    "run"       the release when it samples, edits and validates, and Eq. 11 to the letter: plainly causal. A known
                future is not seen
    "meant"     the text, and a switch that is off: known latents see the known; those to be made look back, and at all
                that is known
    """
    place = torch.arange(known.shape[1], device=known.device)
    back = (place[:, None] >= place).expand(len(known), -1, -1)  # (B,N,N)
    if reading == "run":
        return back
    row, column = known.unsqueeze(2), known.unsqueeze(1)
    if reading == "trained":
        return (row & column) | (~row & back)
    if reading == "meant":
        return (row & column) | (~row & (back | column))
    raise ValueError(f"unknown reading {reading!r} of the dual-constrained mask: expected {', '.join(READINGS)}")


class ResidualQuantizer(nn.Module):
    """Each level names the nearest code of what the levels before it have left: z (...,C) -> sum of codes (...,C).

    Codebooks are running means of the vectors that chose them (EMA): they have no gradient and need no codebook loss,
    whatever CDAMD Eq. 10 prints.
    """

    def __init__(self, levels: int, codes: int, dim: int):
        super().__init__()
        self.register_buffer("codebook", torch.zeros(levels, codes, dim))
        self.register_buffer("counts", torch.zeros(levels, codes))
        self.register_buffer("sums", torch.zeros(levels, codes, dim))

    def codes(self, z: Tensor, levels: int | None = None) -> Tensor:
        """The code of each level, (...,Q)."""
        left, found = z, []
        for book in self.codebook[:levels]:
            index = _nearest(left, book)  # (...,)
            left = left - book[index]
            found.append(index)
        return torch.stack(found, dim=-1)

    def decode(self, codes: Tensor) -> Tensor:
        """The sum (...,C) of the codes (...,Q) of the first Q levels."""
        return sum(book[index] for book, index in zip(self.codebook, codes.unbind(-1)))

    def forward(self, z: Tensor, levels: int | None = None) -> tuple[Tensor, Tensor]:
        """Quantised z, whose gradient goes straight through to z, and the commitment loss, that z stays near."""
        found = self.decode(self.codes(z.detach(), levels))
        return z + (found - z).detach(), (z - found.detach()).square().mean()

    @torch.no_grad()
    def learn(self, z: Tensor, generator: torch.Generator) -> None:
        """Move the codebooks towards the vectors z (M,C) that choose their codes, and replace dead codes.

        In a share of the calls only the first levels, a random number of them, are used and learn.
        """
        levels = len(self.codebook)
        if torch.rand((), generator=generator) < LEVEL_DROP:
            levels = int(torch.randint(1, levels + 1, (), generator=generator))
        left = z
        for book, counts, sums in list(zip(self.codebook, self.counts, self.sums))[:levels]:
            if not counts.any():
                book.copy_(_some(left, len(book), generator))  # the first batch
            chosen = F.one_hot(_nearest(left, book), len(book)).to(left)  # (M,V)
            counts.lerp_(chosen.sum(0), 1 - DECAY) if counts.any() else counts.copy_(chosen.sum(0))
            sums.lerp_(chosen.T @ left, 1 - DECAY) if sums.any() else sums.copy_(chosen.T @ left)
            dead = counts < DEAD
            means = sums / counts.clamp_min(DEAD)[:, None]
            book.copy_(torch.where(dead[:, None], _some(left, len(book), generator), means))
            sums.copy_(torch.where(dead[:, None], book, sums))
            counts.masked_fill_(dead, DEAD)
            left = left - book[_nearest(left, book)]

    def fit(self, z: Tensor, generator: torch.Generator, steps: int = 300, batch: int = 4096) -> None:
        """Learn from random batches of the vectors z (M,C)."""
        for _ in range(steps):
            self.learn(z[torch.randint(len(z), (batch,), generator=generator)], generator)


def _nearest(z: Tensor, book: Tensor) -> Tensor:
    return torch.cdist(z.reshape(1, -1, z.shape[-1]), book[None])[0].argmin(-1).reshape(z.shape[:-1])


def _some(z: Tensor, count: int, generator: torch.Generator) -> Tensor:
    return z[torch.randint(len(z), (count,), generator=generator)]


class DualTransformer(MaskedTransformer):
    """MARDM's transformer under the dual-constrained mask, which hears motion tokens in a part of its training.

    `reading` may be changed between training and sampling, as the release does.
    """

    def __init__(self, plan: Preset):
        super().__init__(plan)
        self.reading = plan.masked.mask
        self.quantizer = ResidualQuantizer(plan.masked.code_levels, plan.masked.codes, plan.dit.latent_dim)
        self.embed_code = nn.Embedding(plan.masked.codes, plan.dit.dim)

    def sees(self, known: Tensor, valid: Tensor) -> Tensor:
        """The dual-constrained mask, (B,N,N)."""
        return dual_mask(known, self.reading) & valid[:, None, :]

    def heard(self, z: Tensor, known: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor] | None:
        """Motion tokens (B,N,dim), and who sees them, (B,N,N): H_j where latent j is seen. For 30 % of batches.

        So a latent to be made sees its own token, the answer, in the readings of the release; where the mask is as
        "meant" it does not.
        """
        if torch.rand((), generator=generator) < self.masked.prior_drop:
            return None
        tokens = self.embed_code(self.quantizer.codes(z, 1)[..., 0])  # (B,N,dim)
        waves = sinusoid(torch.arange(z.shape[1], device=z.device, dtype=tokens.dtype), tokens.shape[-1])  # (N,dim)
        sees = dual_mask(known, self.reading)
        if self.reading == "meant":
            own = torch.eye(z.shape[1], dtype=torch.bool, device=z.device)
            sees = sees & (known.unsqueeze(2) | ~own)
        return tokens + waves, sees
