"""Part-TMR by frames: a teacher that puts every frame of a motion where its sentence is (CMDM 3.1, A.1).

Each part of the body has a transformer of its own over time; the parts' frames are averaged and projected. The mean
over time is the motion's vector, the mean over words the sentence's, and contrastive training brings the two together:

    x (B,T,263) -> part p's columns -> linear -> transformer p -> mean over parts -> head -> frames (B,T,embed_dim)

The original Part-TMR reads a class token at the end; here there is none, since every frame must mean something: those
frames are what CMDM's alignment losses ask of the latents. `parts="one"` is plain TMR, the body in one piece.

Two honest choices. A bidirectional teacher (`causal=False`, the paper's) knows how a motion goes on, and so a causal
latent is asked for what it cannot know yet; `causal=True` asks only for what has been seen. And the release's time mean
counts the zeros that pad a batch (`mean="padded"`), so that a short clip's vector is mostly padding's and changes with
the batch; "valid" does not.
"""

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from minicmdm.config import TMRConfig
from minicmdm.data.features import NUM_FEATURES
from minicmdm.data.skeleton import SMPL22, Skeleton, skeleton_of
from minicmdm.models.layers import sinusoid
from minicmdm.models.text import TextEncoder

MAX_SCALE = 100.0  # of the cosines: sharper would learn from the hardest pair of a batch only


def parts_of(body: Skeleton) -> dict[str, tuple[int, ...]]:
    """The six parts' columns of a body's features.

    The joint that carries both arms (9, spine3) is in three parts; every other column is in exactly one.
    """
    positions, rotations, velocities, contacts = (block.start for block in body.blocks)

    def columns(joints: tuple[int, ...], *planted: int) -> tuple[int, ...]:
        found = [contacts + place for place in planted]
        for joint in joints:  # positions and rotations begin at joint 1, velocities at joint 0
            found += range(positions + 3 * (joint - 1), positions + 3 * joint)
            found += range(rotations + 6 * (joint - 1), rotations + 6 * joint)
            found += range(velocities + 3 * joint, velocities + 3 * (joint + 1))
        return tuple(sorted(found))

    right_leg, left_leg, trunk, right_arm, left_arm = body.chains
    return {
        "root": (0, 1, 2, 3, *range(velocities, velocities + 3)),
        "right_leg": columns(right_leg[1:], 2, 3),
        "left_leg": columns(left_leg[1:], 0, 1),
        "backbone": columns(trunk[1:]),
        "right_arm": columns(right_arm),
        "left_arm": columns(left_arm),
    }


PARTS = parts_of(SMPL22)


class PartLinear(nn.Module):
    """One linear map a part, all in one call. (P,M,in) -> (P,M,out)."""

    def __init__(self, parts: int, in_dim: int, out_dim: int):
        super().__init__()
        bound = in_dim**-0.5  # as nn.Linear
        self.weight = nn.Parameter(torch.empty(parts, in_dim, out_dim).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.empty(parts, 1, out_dim).uniform_(-bound, bound))

    def forward(self, x: Tensor) -> Tensor:
        return torch.baddbmm(self.bias, x, self.weight)


class PartBlock(nn.Module):
    """A transformer block a part: x += Attention(LN(x)), x += FeedForward(LN(x)). (P,M,dim) with M = B*T.

    No part sees another. The norms have no weights of their own, since a linear map follows each of them.
    """

    def __init__(self, parts: int, dim: int, heads: int, dropout: float):
        super().__init__()
        self.dim, self.heads = dim, heads
        self.qkv, self.out = PartLinear(parts, dim, 3 * dim), PartLinear(parts, dim, dim)
        self.up, self.down = PartLinear(parts, dim, 2 * dim), PartLinear(parts, 2 * dim, dim)
        self.dropout = nn.Dropout(dropout)

    def forward(self, x: Tensor, bias: Tensor) -> Tensor:
        """bias (1 or B,T,T) is added to the scores: 0 where a frame (row) may look, hugely negative elsewhere."""
        x = x + self.dropout(self.out(self.attend(self.qkv(F.layer_norm(x, (self.dim,))), bias)))
        return x + self.dropout(self.down(F.gelu(self.up(F.layer_norm(x, (self.dim,))))))

    def attend(self, qkv: Tensor, bias: Tensor) -> Tensor:
        frames = bias.shape[-1]
        qkv = qkv.view(len(qkv), -1, frames, 3, self.heads, self.dim // self.heads)  # (P,M,3*dim) -> (P,B,T,3,H,d)
        queries, keys, values = qkv.permute(3, 0, 1, 4, 2, 5)  # 3 x (P,B,H,T,d)
        # Written out and without autocast: models/layers.py says why. The scores are most of the work here, and a sum
        # in place costs less than `masked_fill`, whose backward pass fills again.
        with torch.autocast(qkv.device.type, enabled=False):
            scores = (queries * queries.shape[-1] ** -0.5) @ keys.transpose(-1, -2)  # (P,B,H,T,T)
            out = scores.add_(bias.unsqueeze(1)).softmax(-1) @ values  # (P,B,H,T,d)
        return out.transpose(2, 3).flatten(3).flatten(1, 2)  # (P,B,H,T,d) -> (P,M,dim)


class MotionTeacher(nn.Module):
    """Motion and sentences in one space: Part-TMR or TMR by frames, and the text encoder that it teaches.

    `width` is that of the features: 263, or KIT-ML's 251.
    (Or the words of one that learns no more, read beforehand: a `WordCache`, no module and no part of its weights.)

    ValueError: an unknown `parts` or `mean`, or a dim that does not split into heads.
    """

    def __init__(self, cfg: TMRConfig, text: TextEncoder, width: int = NUM_FEATURES):
        super().__init__()
        if cfg.parts not in ("six", "one") or cfg.mean not in ("valid", "padded"):
            raise ValueError(
                f"parts must be 'six' or 'one' and mean 'valid' or 'padded', got {cfg.parts!r} and {cfg.mean!r}"
            )
        if cfg.dim % cfg.heads or cfg.dim % 2:
            raise ValueError(f"dim must be even and a multiple of heads, got {cfg.dim} and {cfg.heads}")
        self.cfg, self.text, self.width = cfg, text, width
        parts = parts_of(skeleton_of(width)).values() if cfg.parts == "six" else [range(width)]
        self.columns = [list(columns) for columns in parts]
        self.embed = nn.ModuleList(nn.Linear(len(columns), cfg.dim) for columns in self.columns)
        self.blocks = nn.ModuleList(PartBlock(len(parts), cfg.dim, cfg.heads, cfg.dropout) for _ in range(cfg.layers))
        self.narrow, self.refine = nn.Linear(cfg.dim, cfg.embed_dim), nn.Linear(cfg.embed_dim, cfg.embed_dim)
        self.dropout, self.norm = nn.Dropout(cfg.dropout), nn.LayerNorm(cfg.embed_dim)
        self.embed_words = nn.Linear(text.cfg.dim, cfg.embed_dim)
        self.log_scale = nn.Parameter(torch.tensor(math.log(1 / 0.07)))

    def frames(self, x: Tensor, valid: Tensor | None = None) -> Tensor:
        """Normalised features (B,T,D), valid (B,T) False on padding -> frame features (B,T,embed_dim).

        No valid frame sees padding, whatever stands there. Padded frames get features too: those of zeros.
        ValueError: shapes that do not fit.
        """
        _check(x, valid, self.width)
        batch, frames = x.shape[:2]
        hidden = torch.full((1, frames, frames), self.cfg.causal, device=x.device).triu(1)
        if valid is not None:
            x = x.masked_fill(~valid.unsqueeze(-1), 0.0)
            hidden = hidden | ~valid.unsqueeze(1)  # (B,T,T)
        h = torch.stack([embed(x[..., columns]) for embed, columns in zip(self.embed, self.columns)])  # (P,B,T,dim)
        positions = sinusoid(torch.arange(frames, device=x.device, dtype=torch.float32), self.cfg.dim)  # (T,dim)
        h = (h + positions.to(h.dtype)).flatten(1, 2)  # (P,B,T,dim) -> (P,M,dim)
        # Finite, so that a padded frame that may look at nothing sees everything equally, which is not NaN.
        bias = hidden.to(h.dtype) * torch.finfo(h.dtype).min
        for block in self.blocks:
            h = block(h, bias)
        h = self.narrow(h.mean(0)).unflatten(0, (batch, frames))  # (P,M,dim) -> (B,T,embed_dim)
        return self.norm(h + self.dropout(self.refine(F.gelu(h))))

    def motion(self, x: Tensor, valid: Tensor | None = None) -> Tensor:
        """The mean over time of `frames`: valid ones, or all as in the release (`cfg.mean`). -> (B,embed_dim)."""
        return masked_mean(self.frames(x, valid), None if self.cfg.mean == "padded" else valid)

    def sentences(self, sentences: list[str]) -> Tensor:
        """The mean over a sentence's words of a linear map of their vectors. -> (B,embed_dim).

        The release reads [CLS] alone, so nothing asks the other words' vectors to mean anything; but the denoiser
        attends to all of them. The mean asks all of them, [CLS] and [SEP] included, which are all that "" has.
        """
        words, mask = (part.to(self.log_scale.device) for part in self.text.encode(sentences))  # (B,S,E), (B,S)
        return masked_mean(self.embed_words(words), mask)

    def similarity(self, motion: Tensor, text: Tensor) -> Tensor:
        """Cosines of motions (A,E) and sentences (B,E) times a learnt scale of at most 100. -> (A,B)."""
        with torch.no_grad():  # the weight itself: behind a clamp of its value no gradient would bring it back
            self.log_scale.clamp_(max=math.log(MAX_SCALE))
        with torch.autocast(motion.device.type, enabled=False):  # bfloat16 would round a logit of 50 to a quarter
            return self.log_scale.exp() * F.normalize(motion, dim=-1) @ F.normalize(text, dim=-1).T


def contrastive_loss(similarity: Tensor, same: Tensor | None = None) -> Tensor:
    """Symmetric InfoNCE: each motion finds its sentence in the batch, each sentence its motion. (B,B) -> scalar.

    `same` (B,B) bool marks pairs that say the same thing: to push those apart would be to learn noise, so they do not
    count as wrong answers. The pairs on the diagonal always count. ValueError: shapes that do not fit.
    """
    if similarity.ndim != 2 or similarity.shape[0] != similarity.shape[1]:
        raise ValueError(f"similarity must be square, each motion with its own sentence, got {tuple(similarity.shape)}")
    right = torch.arange(len(similarity), device=similarity.device)
    if same is not None:
        if same.shape != similarity.shape:
            raise ValueError(f"same must be of shape {tuple(similarity.shape)}, got {tuple(same.shape)}")
        ignored = same & (right[:, None] != right)
        similarity = similarity.masked_fill(ignored, -torch.inf)
    return (F.cross_entropy(similarity, right) + F.cross_entropy(similarity.T, right)) / 2


def masked_mean(x: Tensor, mask: Tensor | None) -> Tensor:
    """The mean over axis 1 of x (B,T,E) where mask (B,T) is True, everywhere without one. -> (B,E).

    Summed in float32 at least; a row without any True gives zeros.
    """
    wide = torch.promote_types(x.dtype, torch.float32)
    if mask is None:
        return x.mean(1, dtype=wide)
    weights = mask.to(wide) / mask.sum(1, keepdim=True).clamp(min=1)  # (B,T)
    return (weights.unsqueeze(-1) * x).sum(1)


def _check(x: Tensor, valid: Tensor | None, width: int) -> None:
    if x.ndim != 3 or x.shape[-1] != width or x.shape[1] == 0:
        raise ValueError(f"the teacher reads (batch, frames >= 1, {width}), got {tuple(x.shape)}")
    if valid is not None and valid.shape != x.shape[:2]:
        raise ValueError(f"valid: expected shape {tuple(x.shape[:2])}, got {tuple(valid.shape)}")
