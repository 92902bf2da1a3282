"""The judges: small frozen networks that put motions and sentences in one space, where metrics measure distances.

    "t2m"   two strided convolutions -> BiGRU | word vectors -> BiGRU                  close: by Euclidean distance
    "clip"  groups of four frames -> transformer | word vectors -> transformer         close: by cosine

Both are the field's kinds (T2M's, and MARDM's after MotionCLIP), made small. No model is graded by its own tutor: they
share neither weights nor words nor architecture nor order of data with the teacher that aligns the VAE.
"""

from __future__ import annotations

import json
import re
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.nn.utils.rnn import pack_padded_sequence, pad_sequence

from minicmdm.config import Preset
from minicmdm.data.dataset import Clip, MotionDataset
from minicmdm.data.features import NUM_FEATURES
from minicmdm.data.skeleton import SKELETONS, skeleton_of
from minicmdm.evaluation.metrics import r_precision
from minicmdm.evaluation.pairs import draw_pairs
from minicmdm.files import write_text
from minicmdm.models.layers import sinusoid
from minicmdm.models.tmr import MAX_SCALE, contrastive_loss
from minicmdm.training.checkpoints import checksum, load_tensors, load_weights, save_tensors
from minicmdm.training.distributed import ALONE, Team
from minicmdm.training.loop import LoopConfig, LoopResult, fit, step_key

FORMAT = "minicmdm-bench-1"
ESSENTIAL = 67  # root and joint positions, the first of the 263: all that a skeleton is drawn from (MARDM)
GROUP, SLOPE = 4, 0.2  # frames a token; LeakyReLU's, as in T2M
PADDING, UNKNOWN, FIRST = 0, 1, 2  # places in the vocabulary
LAYERS, HEADS = 2, 4  # of the transformers
DROPOUT = 0.1  # of what enters a reader; inside the transformer it drowns the order of the words
WORD = re.compile(r"\w+")  # what stands between spaces and punctuation
FORGET = 0.05  # how often a word is hidden in training, so that the unknown one means "some word"


@dataclass(frozen=True)
class EvaluatorConfig:
    """One judge's shape."""

    kind: str = "t2m"  # "t2m" or "clip"
    dims: int = NUM_FEATURES  # how many features it reads, from the first: 263 or 67, of KIT-ML 251 or 64
    width: int = 112
    embed_dim: int = 64  # few, since FID between two draws of the same motions grows with them


BENCH = {  # the three judges of toy-bench-1
    "t2m": EvaluatorConfig("t2m"),
    "t2m_essential": EvaluatorConfig("t2m", ESSENTIAL),
    "clip_essential": EvaluatorConfig("clip", ESSENTIAL, width=96),
}


class GRUReader(nn.Module):
    """A BiGRU with learnt first states reads x (B,N,width) up to `lengths` (B,); its last states -> (B,embed_dim)."""

    def __init__(self, cfg: EvaluatorConfig):
        super().__init__()
        self.start = nn.Parameter(0.1 * torch.randn(2, 1, cfg.width // 2))
        self.gru = nn.GRU(cfg.width, cfg.width // 2, batch_first=True, bidirectional=True)
        inner = nn.Linear(cfg.width, cfg.width), nn.LayerNorm(cfg.width), nn.LeakyReLU(SLOPE)
        self.head = nn.Sequential(*inner, nn.Linear(cfg.width, cfg.embed_dim))

    def forward(self, x: Tensor, lengths: Tensor) -> Tensor:
        packed = pack_padded_sequence(x, lengths.cpu(), batch_first=True, enforce_sorted=False)
        _, last = self.gru(packed, self.start.expand(-1, len(x), -1).contiguous())  # (2,B,width/2)
        return self.head(torch.cat([last[0], last[1]], dim=-1))


class TransformerReader(nn.Module):
    """A class token reads x (B,N,width) up to `lengths` (B,) through a transformer -> (B,embed_dim) of length 1."""

    def __init__(self, cfg: EvaluatorConfig):
        super().__init__()
        sizes = cfg.width, HEADS, 2 * cfg.width
        layer = nn.TransformerEncoderLayer(*sizes, 0.0, F.gelu, batch_first=True, norm_first=True)
        self.token = nn.Parameter(0.1 * torch.randn(1, 1, cfg.width))
        self.layers = nn.TransformerEncoder(layer, LAYERS, nn.LayerNorm(cfg.width), enable_nested_tensor=False)
        self.head = nn.Linear(cfg.width, cfg.embed_dim)

    def forward(self, x: Tensor, lengths: Tensor) -> Tensor:
        x = torch.cat([self.token.expand(len(x), -1, -1), x], dim=1)  # (B,N,width) -> (B,1+N,width)
        waves = sinusoid(torch.arange(x.shape[1], device=x.device, dtype=x.dtype), 3 * x.shape[2]).chunk(2, dim=-1)
        # The quicker third of the waves: the others hardly move over fifty tokens, and order is learnt too late.
        x = x + torch.cat([wave[:, : x.shape[2] // 2] for wave in waves], dim=-1)  # (1+N,width)
        x = self.layers(x, src_key_padding_mask=_after(1 + lengths, x.shape[1]))
        return F.normalize(self.head(x[:, 0]), dim=-1)


class Evaluator(nn.Module):
    """One judge, with its vocabulary `words` and its own `mean` and `std` (dims,). ValueError: a config of no kind."""

    def __init__(self, cfg: EvaluatorConfig, words: list[str]):
        super().__init__()
        dims = [size for body in SKELETONS for size in (body.num_features, body.num_essential)]
        if cfg.kind not in ("t2m", "clip") or cfg.dims not in dims or cfg.width % (2 * HEADS):
            raise ValueError(f"expected 't2m' or 'clip', 263 or 67 dims, a width that {2 * HEADS} divides, got {cfg}")
        self.cfg, self.words = cfg, list(words)
        self.places = {word: place for place, word in enumerate(self.words, start=FIRST)}
        self.register_buffer("mean", torch.zeros(cfg.dims))
        self.register_buffer("std", torch.ones(cfg.dims))
        self.embed_words = nn.Embedding(FIRST + len(self.words), cfg.width, PADDING)
        if cfg.kind == "t2m":
            down = [nn.Conv1d(cfg.dims, cfg.width, 4, 2, 1), nn.Conv1d(cfg.width, cfg.width, 4, 2, 1)]
        else:
            down = [nn.Conv1d(cfg.dims, cfg.width, GROUP, GROUP)]  # a linear map of four frames side by side
            self.log_scale = nn.Parameter(torch.tensor(1 / 0.07).log())
        self.down = nn.ModuleList(down)
        reader = GRUReader if cfg.kind == "t2m" else TransformerReader
        self.read_motion, self.read_words, self.dropout = reader(cfg), reader(cfg), nn.Dropout(DROPOUT)

    def motion(self, x: Tensor, lengths: Tensor) -> Tensor:
        """Raw features x (B,T,263), or their first `dims`, of `lengths` (B,) frames, 4 to T -> (B,embed_dim).

        Neither what follows a motion's end is read nor a last group of less than four frames. ValueError: shapes.
        """
        whole = skeleton_of(self.cfg.dims).num_features
        fits = x.ndim == 3 and x.shape[2] in (whole, self.cfg.dims) and lengths.shape == x.shape[:1] != (0,)
        if not fits or lengths.min() < GROUP or lengths.max() > x.shape[1]:
            raise ValueError(f"expected x (B,T,{whole}), B lengths in 4..T; got {tuple(x.shape)}, {lengths.tolist()}")
        ends = lengths.to(x.device) // GROUP * GROUP  # (B,)
        x = x[..., : self.cfg.dims].sub(self.mean).div_(self.std).transpose(1, 2)  # (B,T,263) -> (B,dims,T)
        for conv in self.down:  # each meets zeros past the end, as if nothing followed
            x = F.leaky_relu(conv(x.masked_fill(_after(ends, x.shape[2]).unsqueeze(1), 0.0)), SLOPE)
            ends = ends // conv.stride[0]  # in the end x is (B,width,T/4)
        return self.read_motion(self.dropout(x.transpose(1, 2)), ends)

    def sentences(self, sentences: list[str]) -> Tensor:
        """Sentences -> (B,embed_dim). Only words count; a sentence that has none is one unknown word."""
        ids = [[self.places.get(w, UNKNOWN) for w in WORD.findall(s.lower())] or [UNKNOWN] for s in sentences]
        table = pad_sequence([torch.tensor(row) for row in ids], batch_first=True).to(self.mean.device)  # (B,S)
        if self.training:  # as dropout does, from the global generator, which the loop keys by step
            table = table.masked_fill(torch.rand(table.shape, device=table.device) < FORGET, UNKNOWN)
        lengths = torch.tensor([len(row) for row in ids], device=table.device)
        return self.read_words(self.dropout(self.embed_words(table)), lengths)

    def similarity(self, motion: Tensor, text: Tensor) -> Tensor:
        """Logits, (A,E) and (B,E) -> (A,B): minus squared distances, or cosines times a learnt scale of at most 100."""
        if self.cfg.kind == "t2m":
            return -(motion[:, None] - text).square().sum(-1)
        return self.log_scale.exp().clamp(max=MAX_SCALE) * motion @ text.T


def _after(lengths: Tensor, size: int) -> Tensor:
    return torch.arange(size, device=lengths.device) >= lengths[:, None]  # (B,size): True past the end


def train_evaluator(
    cfg: EvaluatorConfig,
    train_set: MotionDataset,
    val_set: MotionDataset,
    out: Path,
    *,
    steps: int,
    batch: int,
    lr: float,
    seed: int,
    accumulate: int = 1,
    resume: bool = False,
    progress: bool = True,
    team: Team = ALONE,
) -> LoopResult:
    """Learn which sentence belongs to which motion; `ema["evaluator"]` of the result is the judge.

    T2M pushes each motion from one wrong sentence, that of a neighbour in the batch; here from all at once (InfoNCE),
    and from a near miss, without which counts and order hardly ever decide and the judge is deaf to them.
    """
    own = step_key(seed, -4)  # not the teacher's seed, hence another order of the data
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(own)
        said = " ".join(text for clip in train_set.clips for text in clip.captions).lower()
        judge = Evaluator(cfg, sorted(set(WORD.findall(said))))
    judge.mean.copy_(torch.from_numpy(train_set.mean[: cfg.dims]))
    judge.std.copy_(torch.from_numpy(train_set.std[: cfg.dims]))

    def draw(generator: torch.Generator) -> tuple[list[Clip], list[str], list[str], list[int]]:
        return draw_pairs(train_set, batch, generator)

    def loss(models: nn.ModuleDict, drawn: tuple, generator: torch.Generator) -> tuple[Tensor, dict[str, float]]:
        clips, texts, misses, whose = drawn
        said = [clip.program or text for clip, text in zip(clips, texts)]
        # Not wrong answers, if not right ones.
        same = torch.tensor([[a == b for b in said] for a in said], device=team.device)
        motion = judge.motion(*_stack([clip.features for clip in clips], team.device))
        text = judge.sentences(texts + misses)
        closeness = judge.similarity(motion, text)  # (B,B+M)
        right, wrong = closeness.diagonal()[whose], closeness[whose, len(clips) + torch.arange(len(whose))]  # (M,) each
        value = contrastive_loss(closeness[:, : len(clips)], same) + F.softplus(wrong - right).sum() / len(clips)
        return value, {"near_misses": float((wrong < right).sum()) / max(1, len(whose))}  # the share refused

    def validate(ema: nn.ModuleDict) -> dict[str, float]:
        pairs = embed(ema["evaluator"], [c.captions[0] for c in val_set.clips], [c.features for c in val_set.clips])
        found = r_precision(*pairs, pool=min(32, len(val_set)))
        return dict(zip(("val_r_at_1", "val_r_at_2", "val_r_at_3"), found.tolist()))

    loop = LoopConfig(steps, lr, warmup=steps // 15, weight_decay=0.01, ema=0.99, accumulate=accumulate, seed=own)
    identity = asdict(cfg) | {"steps": steps, "batch": batch, "lr": lr, "seed": seed, "data": train_set.fingerprint}
    name, models = f"evaluator_{cfg.kind}_{cfg.dims}", nn.ModuleDict({"evaluator": judge})
    how = {"identity": identity, "resume": resume, "progress": progress, "team": team, "draw": draw}
    return fit(name, models, loss, validate, loop, Path(out), **how)


def train_bench(
    plan: Preset,
    train_set: MotionDataset,
    val_set: MotionDataset,
    out: Path,
    *,
    resume: bool,
    progress: bool,
    team: Team = ALONE,
) -> LoopResult:
    """Train the three judges of a preset one after the other and write them into `out`/evaluator."""
    cfg, judges, metrics, seconds = plan.train, nn.ModuleDict(), {}, 0.0
    sizes = {"steps": cfg.evaluator_steps, "batch": cfg.evaluator_batch, "lr": cfg.evaluator_lr, "seed": cfg.seed}
    how = {"accumulate": cfg.accumulate, "resume": resume, "progress": progress, "team": team}
    body = skeleton_of(len(train_set.mean))
    for name, shape in BENCH.items():
        shape = replace(shape, dims=body.num_features if shape.dims == NUM_FEATURES else body.num_essential)
        result = train_evaluator(shape, train_set, val_set, out, **sizes, **how)
        judges[name], seconds = result.ema["evaluator"], seconds + result.seconds
        metrics |= {f"{name}_{key}": value for key, value in result.metrics.items()}
    facts = {**sizes, "data": train_set.fingerprint, "metrics": metrics, "seconds": round(seconds, 1)}
    if team.first:
        save_bench(out / "evaluator", dict(judges.items()), facts)
    return LoopResult(nn.ModuleDict({"evaluator": judges}), metrics, seconds)


def _stack(motions: list[np.ndarray], device: torch.device | None = None) -> tuple[Tensor, Tensor]:
    x = [torch.as_tensor(motion, dtype=torch.float32, device=device) for motion in motions]
    return pad_sequence(x, batch_first=True), torch.tensor([len(motion) for motion in motions])  # (B,T,263), (B,)


@torch.no_grad()
def embed(judge: Evaluator, sentences: list[str], motions: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Text (N,E) and motion (M,E) embeddings, float64, of sentences and of raw features, one (T,263) a motion."""
    order = np.argsort([len(x) for x in motions], kind="stable")
    out = np.zeros((len(order), judge.cfg.embed_dim))
    for chosen in np.array_split(order, -(-len(order) // 64)):  # motions of like length together
        out[chosen] = judge.motion(*_stack([motions[i] for i in chosen], judge.mean.device)).cpu()
    return judge.sentences(sentences).cpu().double().numpy(), out


def save_bench(folder: str | Path, evaluators: dict[str, Evaluator], facts: dict[str, object]) -> None:
    """Write judges, one file each, and last the card with their checksums and what else is known of them (`facts`)."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    for name, judge in evaluators.items():
        note = {"config": asdict(judge.cfg), "words": judge.words}
        save_tensors(folder / f"{name}.safetensors", judge.state_dict(), note)
    files = {name: checksum(folder / f"{name}.safetensors") for name in evaluators}
    write_text(folder / "card.json", json.dumps({"format": FORMAT, **facts, "files": files}, indent=2) + "\n")


def load_bench(folder: str | Path = "toy-bench-1") -> dict[str, Evaluator]:
    """The judges of a folder, or the shipped ones, frozen, in eval mode. Raises FileNotFoundError or ValueError."""
    folder = Path(__file__).parents[1] / "assets" / folder if str(folder) == "toy-bench-1" else Path(folder)
    if not (folder / "card.json").is_file():
        raise FileNotFoundError(f"no card.json in {folder}: `minicmdm train --stage evaluator` makes evaluators")
    bench = {}
    try:
        card = json.loads((folder / "card.json").read_text(encoding="utf-8"))
        if card.get("format") != FORMAT:
            raise ValueError(f"format {FORMAT!r} expected in card.json, {card.get('format')!r} found")
        for name, expected in card["files"].items():
            path = folder / f"{name}.safetensors"
            note = load_tensors(path)[1]  # says itself what is missing or cut short
            if checksum(path) != expected:
                raise ValueError(f"{path.name} is not the file of card.json: it was changed or mixed in")
            bench[name] = Evaluator(EvaluatorConfig(**note["config"]), note["words"]).eval().requires_grad_(False)
            load_weights(bench[name], path)
    except (ValueError, KeyError, TypeError, AttributeError, ArithmeticError, RuntimeError, MemoryError) as error:
        raise ValueError(f"{folder} holds no evaluators that this version can read: {error}") from error
    return bench
