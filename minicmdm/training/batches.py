"""What a batch is made of: crops of features for the VAE; latents and the words that each of them sees for the DiT.

A motion of several segments can be described in two ways. The whole-clip caption ("a person walks, then waves") is seen
by every latent. Or each latent sees only the sentence of its own segment ("a person walks" | "a person waves"): this is
how a prompt that changes over time will arrive later (CMDM B.1). Crops that start in the middle of a motion teach the
model that a motion need not begin at rest with its first sentence.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from minicmdm.data.dataset import Clip, MotionDataset
from minicmdm.models.text import Words
from minicmdm.models.vae import MACVAE

WHOLE, SEGMENTS, CROPPED = 0, 1, 2  # the three ways to show a clip
SHARES = (0.6, 0.2, 0.2)  # how often each is drawn
SHORTEST_CROP = 4  # latents
SEGMENT_SHARE = 0.3  # how often contrast is learnt from one segment rather than a whole clip
LENGTH_DROP = 0.3  # how often a sample does not say how long its sentences last
POOL = 8  # batches are cut from a pool of this many batches, sorted by length, so that little is padding


def crop_features(
    data: MotionDataset,
    count: int,
    frames: int,
    generator: torch.Generator,
    guides: list[Tensor] | None = None,
) -> tuple[Tensor, Tensor | None]:
    """Draw `count` normalised crops of one length (B,T,D): `frames` long or, for a share of the batches, as long as
    the shortest clips, so that clips shorter than a crop are learnt too. `guides` holds something else for every frame
    of every clip, (T,E) each; its crops (B,T,E) come second."""
    lengths = np.array([len(clip.features) for clip in data.clips])
    group = lengths >= frames
    if torch.rand((), generator=generator).item() >= group.mean():  # a batch of the short ones
        group = ~group
        frames = int(lengths[group].min()) // 4 * 4
    members = np.flatnonzero(group)
    chosen = members[torch.randint(len(members), (count,), generator=generator).numpy()]
    starts = (torch.rand(count, generator=generator).numpy() * (lengths[chosen] - frames + 1)).astype(int)
    crops = np.stack([data.clips[i].features[s : s + frames] for i, s in zip(chosen, starts)])
    x = torch.from_numpy((crops - data.mean) / data.std).float()
    return x, None if guides is None else torch.stack([guides[i][s : s + frames] for i, s in zip(chosen, starts)])


def draw_captioned(
    data: MotionDataset, count: int, generator: torch.Generator
) -> tuple[Tensor, Tensor, list[str], Tensor]:
    """Draw `count` motions with a sentence each: x (B,T,D) normalised, valid (B,T), sentences, same (B,B).

    Mostly whole clips with one of their captions; in a share of the draws one labelled segment with its own sentence,
    since the denoiser will be told segments too. `same` is True where two draws ask for the same.
    """
    pool = torch.randint(len(data.clips), (POOL * count,), generator=generator).tolist()
    luck = torch.rand(POOL * count, 3, generator=generator).tolist()
    draws = []  # (clip, first frame, end, sentence, what it asks for)
    for i, (way, which, where) in zip(pool, luck):
        clip = data.clips[i]
        k = int(where * len(clip.labels))
        start, end, sentence = clip.labels[k] if clip.labels else (0, len(clip.features), "")
        if way < SEGMENT_SHARE and end - start >= 4 * SHORTEST_CROP:
            asks = clip.program[k : k + 1] if clip.program else sentence
        else:
            start, end, sentence = 0, len(clip.features), clip.captions[int(which * len(clip.captions))]
            asks = clip.program or sentence
        draws.append((i, start, end, sentence, asks))
    draws.sort(key=lambda draw: draw[2] - draw[1])
    slot = int(torch.randint(POOL, (), generator=generator))
    draws = draws[slot * count : (slot + 1) * count]
    longest = max(end - start for _, start, end, _, _ in draws)
    x, valid = np.zeros((count, longest, data.mean.shape[0]), np.float32), torch.zeros(count, longest, dtype=torch.bool)
    for row, (i, start, end, _, _) in enumerate(draws):
        x[row, : end - start] = (data.clips[i].features[start:end] - data.mean) / data.std
        valid[row, : end - start] = True
    same = torch.tensor([[a[4] == b[4] for b in draws] for a in draws])
    return torch.from_numpy(x), valid, [draw[3] for draw in draws], same


def said(data: MotionDataset) -> set[str]:
    """Every sentence of a data set: captions of clips and of their segments."""
    captions = {caption for clip in data.clips for caption in clip.captions}
    return captions | {sentence for clip in data.clips for _, _, sentence in clip.labels}


def latent_owners(clip: Clip, num_latents: int) -> np.ndarray:
    """Which of the clip's labels each latent (four frames) belongs to: the last one begun by its middle frame. (N,)"""
    begins = np.array([start for start, _, _ in clip.labels])
    middle = 4 * np.arange(num_latents) + 2
    return np.clip(np.searchsorted(begins, middle, side="right") - 1, 0, None)


@dataclass
class LatentSet:
    """Every clip of a dataset as a Gaussian per latent, normalised to mean 0 and std 1 per channel."""

    means: list[Tensor]  # one (N,C) per clip
    stds: list[Tensor]  # one (N,C) per clip
    captions: list[list[str]]
    sentences: list[list[str]]  # per clip, one sentence per label; empty if it has no labels
    owners: list[Tensor]  # one (N,) per clip: the label of each latent
    shift: Tensor  # (C,) the measured mean and std of raw latents
    scale: Tensor

    def __len__(self) -> int:
        return len(self.means)


@torch.no_grad()
def encode_dataset(vae: MACVAE, data: MotionDataset, stats: tuple[Tensor, Tensor] | None = None) -> LatentSet:
    """Encode every clip once (the last one to three frames of an odd length are dropped).

    `stats` (shift, scale) are those of the training set; without them they are measured here, on sampled latents:
    the variance of a sample is the variance of the means plus the mean of the posterior variances.
    """
    device = next(vae.parameters()).device
    means: list = [None] * len(data.clips)
    stds: list = [None] * len(data.clips)
    counts = np.array([len(clip.features) // 4 for clip in data.clips])
    for n in np.unique(counts):  # clips of one length together: an encoder that looks ahead must not see padding
        same = np.flatnonzero(counts == n)
        for chosen in np.split(same, range(64, len(same), 64)):
            batch = np.stack([(data.clips[i].features[: 4 * n] - data.mean) / data.std for i in chosen])
            mean, logvar = vae.encode(torch.from_numpy(batch.astype(np.float32)).to(device))  # (B,N,C) each
            for i, m, s in zip(chosen, mean.cpu(), (0.5 * logvar).exp().cpu()):
                means[i], stds[i] = m.clone(), s.clone()
    if stats is None:
        every_mean, every_std = torch.cat(means), torch.cat(stds)  # (all latents, C)
        variance = every_mean.var(0) + every_std.square().mean(0)
        stats = every_mean.mean(0), variance.sqrt().clamp_min(1e-3)
    shift, scale = stats
    return LatentSet(
        means=[(m - shift) / scale for m in means],
        stds=[s / scale for s in stds],
        captions=[clip.captions for clip in data.clips],
        sentences=[[sentence for _, _, sentence in clip.labels] for clip in data.clips],
        owners=[
            torch.from_numpy(latent_owners(clip, len(m))) if clip.labels else torch.zeros(len(m), dtype=torch.long)
            for clip, m in zip(data.clips, means)
        ],
        shift=shift,
        scale=scale,
    )


@dataclass
class DenoiserBatch:
    """Latents, and which sentence each of them sees. R is the most sentences of any sample in the batch."""

    z: Tensor  # (B,N,C) normalised, zero where not valid
    valid: Tensor  # (B,N) bool
    sentences: list[str]  # every different sentence of the batch, once
    choice: Tensor  # (B,R) index into `sentences`; -1 where a sample has fewer than R
    owner: Tensor  # (B,N) which of its sample's R sentences a latent sees
    clock: Tensor  # (B,N,2) latents since its sentence began, and left of it (-1: hidden)

    def to(self, device: torch.device) -> DenoiserBatch:
        """The same batch on a device."""
        tensors = {name: value.to(device) for name, value in vars(self).items() if isinstance(value, Tensor)}
        return replace(self, **tensors)


def draw_batch(
    latents: LatentSet, count: int, text_drop: float, generator: torch.Generator, shares=SHARES
) -> DenoiserBatch:
    """Draw a batch: clips of like length, sampled latents, sentences by one of the three ways, some text dropped."""
    pool = torch.randint(len(latents), (POOL * count,), generator=generator).tolist()
    ways = torch.multinomial(torch.tensor(shares), POOL * count, replacement=True, generator=generator).tolist()
    luck = torch.rand(POOL * count, 4, generator=generator).tolist()
    begins = [
        1 + int(where * (len(latents.means[i]) - SHORTEST_CROP))  # 1 .. total - SHORTEST_CROP
        if way == CROPPED and latents.sentences[i] and len(latents.means[i]) > SHORTEST_CROP
        else 0
        for i, way, (where, _, _, _) in zip(pool, ways, luck)
    ]
    by_length = sorted(range(len(pool)), key=lambda k: len(latents.means[pool[k]]) - begins[k])
    slot = int(torch.randint(POOL, (), generator=generator))
    table: dict[str, int] = {}  # sentence -> its place in the batch's list
    samples = []
    for k in by_length[slot * count : (slot + 1) * count]:  # every clip of the pool is as likely as any other
        i, begin, (_, which, dropped, hidden) = pool[k], begins[k], luck[k]
        owner, sentences = latents.owners[i], latents.sentences[i]
        if not sentences or ways[k] == WHOLE:  # a clip without labels has its caption only
            captions = latents.captions[i]
            sentences, owner = [captions[int(which * len(captions))]], torch.zeros_like(owner)
        if dropped < text_drop:
            sentences, owner = [""], torch.zeros_like(owner)
        places = [table.setdefault(sentence, len(table)) for sentence in sentences]
        samples.append((i, begin, places, owner[begin:], sentence_clock(owner, hidden < LENGTH_DROP)[begin:]))

    longest = max(len(owner) for _, _, _, owner, _ in samples)
    most = max(len(places) for _, _, places, _, _ in samples)
    channels = latents.shift.shape[0]
    mean, std = torch.zeros(count, longest, channels), torch.zeros(count, longest, channels)
    valid = torch.zeros(count, longest, dtype=torch.bool)
    choice = torch.full((count, most), -1)
    owners = torch.zeros(count, longest, dtype=torch.long)
    clocks = torch.zeros(count, longest, 2)
    for row, (i, begin, places, owner, clock) in enumerate(samples):
        n = len(owner)
        mean[row, :n], std[row, :n] = latents.means[i][begin:], latents.stds[i][begin:]
        valid[row, :n] = True
        choice[row, : len(places)] = torch.tensor(places)
        owners[row, :n], clocks[row, :n] = owner, clock
    z = mean + std * torch.randn(mean.shape, generator=generator)  # a posterior sample; std is 0 in the padding
    return DenoiserBatch(z, valid, list(table), choice, owners, clocks)


def sentence_clock(owner: Tensor, hide_length: bool = False) -> Tensor:
    """For every latent, how many latents ago its sentence began and how many are left of it. owner (N,) -> (N,2)

    `owner` numbers the sentences in the order in which they begin. What is left is -1 (unknown) with `hide_length`: in
    an endless stream nobody can say how long a sentence will last.
    """
    begins, ends = torch.searchsorted(owner, owner), torch.searchsorted(owner, owner, right=True)  # (N,) each
    place = torch.arange(len(owner))
    left = torch.full_like(place, -1) if hide_length else ends - 1 - place
    return torch.stack([place - begins, left], dim=-1).float()


def words_per_latent(words: Words, choice: Tensor, owner: Tensor) -> tuple[Tensor, Tensor]:
    """Lay each sample's sentences side by side and let each latent see the words of its own sentence.

    `words` are the batch's different sentences, encoded one by one: embeddings (U,S1,E), mask (U,S1). Returns words
    (B,S,E) and mask (B,N,S), where S counts the real words of the sample that has most.
    """
    length = words.mask.shape[1]
    rows = choice.clamp(min=0)  # (B,R)
    real = (words.mask[rows] & (choice >= 0)[..., None]).flatten(1)  # (B,R,S1) -> (B,R*S1)
    most = int(real.sum(1).max())
    order = real.int().argsort(dim=1, descending=True, stable=True)[:, :most]  # (B,S): real words first, in order
    sentence = order // length  # (B,S): which of its sample's sentences a word belongs to
    place = rows.gather(1, sentence) * length + order % length  # (B,S): where it stands among all words of the batch
    side_by_side = F.embedding(place, words.embeddings.flatten(0, 1))  # (U*S1,E) -> (B,S,E)
    mask = real.gather(1, order)[:, None, :] & (sentence[:, None, :] == owner[:, :, None])  # (B,N,S)
    return side_by_side, mask
