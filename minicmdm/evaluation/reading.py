"""A study of the words: is what a sentence asks for still in the vectors that the denoiser sees?

The text encoder is frozen before the denoiser is trained. When a model fails to do what new phrases say, either the
vectors do not tell it or it cannot read them. A probe decides: a small transformer layer learns from the training
segments' sentences to name each field of the program, and is asked about test segments whose sentence, word for word,
no training segment has. A field counts where the program states it; "all" are the segments with every field named.

`python -m minicmdm.evaluation.studies reading` runs it, in a minute a seed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from minicmdm.data.dataset import Clip, toy_dataset
from minicmdm.data.programs import FIELDS, Segment
from minicmdm.models.text import Words
from minicmdm.models.wordcache import WordCache
from minicmdm.pipeline import MotionPipeline

KINDS = ("ordinary", "paraphrase", "pairs")
STEPS, BATCH, RATE, WIDTH = 600, 64, 2e-3, 64


class Probe(nn.Module):
    """Words (B,S,E) -> for each field the scores of its values, (B,V) each."""

    def __init__(self, text_dim: int, values: list[list[str]]):
        super().__init__()
        self.embed = nn.Linear(text_dim, WIDTH)
        self.layer = nn.TransformerEncoderLayer(WIDTH, 4, 2 * WIDTH, 0.0, batch_first=True)
        self.weigh = nn.Linear(WIDTH, 1)
        self.heads = nn.ModuleList(nn.Linear(WIDTH, len(options)) for options in values)

    def forward(self, words: Words) -> list[Tensor]:
        x = self.layer(self.embed(words.embeddings), src_key_padding_mask=~words.mask)  # (B,S,W)
        weights = self.weigh(x).squeeze(-1).masked_fill(~words.mask, -torch.inf).softmax(-1)  # (B,S)
        sentence = (weights.unsqueeze(-1) * x).sum(1)  # (B,W)
        return [head(sentence) for head in self.heads]


def sentences(clips: list[Clip]) -> list[tuple[str, Segment]]:
    """Every labelled segment's sentence with what it asks for."""
    return [(said, segment) for clip in clips for segment, (_, _, said) in zip(clip.program, clip.labels)]


@cache
def read(seed: int, steps: int = STEPS, limit: int | None = None) -> dict[str, dict[str, float]]:
    """Train a probe; for each kind of test clip the share of fields that it names, where stated, and "all" of them.

    `limit` takes only the first clips of each split.
    """
    train = sentences(toy_dataset("train", limit, progress=False).clips)
    test = toy_dataset("test", limit, progress=False).clips
    values = [sorted({str(getattr(segment, field)) for _, segment in train}) for field in FIELDS]
    words = WordCache(MotionPipeline.from_pretrained("toy").text, [said for said, _ in train])
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        probe, generator = Probe(words.cfg.dim, values), torch.Generator().manual_seed(seed)
    optimizer = torch.optim.AdamW(probe.parameters(), RATE)
    decay = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.0, steps)

    def answers(some: list[tuple[str, Segment]]) -> Tensor:
        right = [[options.index(str(getattr(s, f))) for f, options in zip(FIELDS, values)] for _, s in some]
        return torch.tensor(right)  # (B,fields)

    for _ in range(steps):
        batch = [train[i] for i in torch.randint(len(train), (BATCH,), generator=generator).tolist()]
        scores, right = probe(words.encode([said for said, _ in batch])), answers(batch)
        loss = sum(F.cross_entropy(score, right[:, k]) for k, score in enumerate(scores))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        decay.step()

    found, known = {}, {said for said, _ in train}
    for kind in KINDS:
        new = [clip for clip in test if clip.kind == kind]
        asked = [(said, segment) for said, segment in sentences(new) if said not in known]
        with torch.no_grad():
            scores = probe(words.encode([said for said, _ in asked]))
        same = torch.stack([score.argmax(-1) for score in scores], dim=1) == answers(asked)  # (B,fields)
        stated = torch.tensor([[getattr(s, field) is not None for field in FIELDS] for _, s in asked])
        found[kind] = {field: same[stated[:, k], k].float().mean().item() for k, field in enumerate(FIELDS)}
        found[kind]["all"] = (same | ~stated).all(1).float().mean().item()
    return found


def reading_rows(scratch: Path) -> Iterator[tuple[dict, Callable[[], dict]]]:
    """One row for each kind of test clip and each seed of the probe."""
    for seed in range(3):
        for kind in KINDS:
            yield {"kind": kind, "seed": seed}, partial(_row, seed, kind)


def _row(seed: int, kind: str) -> dict[str, float]:
    return read(seed)[kind]
