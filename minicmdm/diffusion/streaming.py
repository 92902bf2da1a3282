"""The sampler without an end: latents are finished from left to right, prompts change at any time (CMDM Alg. 2).

It gives what `sampling.sample` gives, and does less for it:

* A latent that waits is not evaluated: every mask hides it.
* A finished latent is evaluated once more, at t = 1, in the call after its last step. Keys and values depend on the
  noise level, so those of its last step are no use; these are final and go to a cache. Under "causal" attention with
  blocks, a block is final when all of it is finished. Under "bidirectional" attention nothing ever is, because finished
  latents look at those in flight: there the whole window is evaluated in every call.
* Modulation depends on the level alone and is computed for the K+1 levels once; the keys and values of words once a
  prompt. Weights are laid out once for products of few rows (models/packed.py).

All this is exact. What slides is the past: a call sees `window` latents at most, finished ones and those in flight, and
the oldest finished one leaves when a new one starts. Up to there the stream is the dense sampler; beyond, memory and
time per latent stay what they are. (What a latent once heard from those that left stays in its keys and values.)

The release has no stream: it generates segments, each from scratch on the last four frames of the one before.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from minicmdm.diffusion.path import euler_step, level_to_time
from minicmdm.diffusion.schedules import schedule_matrix
from minicmdm.models.dit import CausalDiT, clock_features, self_attention_mask
from minicmdm.models.layers import KeyValueCache
from minicmdm.models.packed import packed
from minicmdm.models.text import Words

LONGEST = 49  # latents: the longest motion in training, hence the usual window, and a page of noise
REACH = ("new", "active")


def pace(schedule: str, num_steps: int, uncertainty: int) -> tuple[int, int]:
    """How a schedule goes on for ever: (calls, blocks), so that block j starts after calls * j // blocks calls.

    (0, 1) moves all together. ValueError: a bad schedule, or the trapezoid, whose last latents come before the middle.
    """
    schedule_matrix(1, num_steps, uncertainty, kind=schedule)  # knows what is bad
    if schedule == "trapezoid":
        raise ValueError("the schedule 'trapezoid' finishes both ends first: it cannot stream from left to right")
    if schedule == "triangular" and uncertainty:
        return num_steps, -(-num_steps // uncertainty)
    return {"full": 0, "autoregressive": num_steps}.get(schedule, uncertainty), 1


@dataclass(eq=False)
class Said:
    """What the streams of a batch are told at one time. Times are counted in latents since the stream began."""

    start: int  # the first latent that hears it
    sentences: list[str]
    begin: Tensor  # (B,) where each stream's sentence began
    lasts: Tensor  # (B,) how long it lasts, and then again and again; 0 if nobody knows
    words: list[tuple[Tensor, Tensor]]  # every block's keys and values (R,H,S,d); R counts both branches of guidance
    real: Tensor  # (R,S) bool, False on padding


class LatentStream:
    """B streams of latents in step, each with its own noise and its own sentences; `step` is one call of the denoiser.

    read: B sentences -> Words, as `dit.read` returns them; null: those of "". `num_latents` gives it an end ("full"
    needs one). `window` is LONGEST unless given, or what is in flight if that is more. ValueError: a schedule that
    cannot stream, a window that is smaller than what is in flight, an unknown `new_prompt`.
    """

    def __init__(
        self,
        dit: CausalDiT,
        read: Callable[[list[str]], Words],
        null: Words,
        sentences: list[str],
        generators: list[torch.Generator],
        *,
        schedule: str = "fss",
        num_steps: int = 20,
        uncertainty: int = 2,
        block_size: int = 1,
        guidance_scale: float = 3.0,
        window: int | None = None,
        new_prompt: str = "new",
        num_latents: int | None = None,
        lasts: int | Sequence[int] = 0,
    ):
        self.pace = calls, blocks = pace(schedule, num_steps, uncertainty)
        if calls == 0 and num_latents is None:
            raise ValueError("full-sequence sampling moves all latents together, so it needs an end: say how many")
        if new_prompt not in REACH:
            raise ValueError(f"new_prompt must be one of {', '.join(REACH)}, and {new_prompt!r} came")
        self.num_steps, self.block_size, self.num_latents = num_steps, block_size, num_latents
        self.dit, self.cfg, self.read, self.null = dit, dit.cfg, read, null
        self.guidance_scale, self.new_prompt = guidance_scale, new_prompt
        self.branches = {0: ("null",), 1: ("text",)}.get(guidance_scale, ("text", "null"))

        end = float("inf") if num_latents is None else num_latents
        # Latents that have started before a block is finished; in the call after, that block is there once more.
        self.ahead = int(min(end, -(-num_steps * blocks // calls) * block_size)) if calls else end
        together = -(-(num_steps + 1) * blocks // calls) * block_size if calls else end
        together = int(min(end, together + (self.cfg.block_size - 1 if self.cfg.attention == "causal" else 0)))
        self.window = max(LONGEST, together) if window is None else window
        if self.window < together:
            raise ValueError(f"up to {together} latents are evaluated together, and a window of {window} is too small")

        weight = dit.out.weight
        self.model_dtype, dtype = weight.dtype, torch.promote_types(weight.dtype, torch.float32)
        self.generators = generators
        self.z = torch.zeros(len(generators), 0, self.cfg.latent_dim, dtype=dtype, device=weight.device)
        self.spare = self.z  # noise that was drawn and not yet used
        self.times = level_to_time(torch.arange(num_steps + 1, device=weight.device).to(dtype), num_steps)  # (K+1,)
        self.cache = None
        if self.cfg.attention != "bidirectional":
            rows, width = len(generators) * len(self.branches), self.cfg.dim // self.cfg.heads
            self.cache = KeyValueCache(self.cfg.layers, rows, self.cfg.heads, width, self.window, weight.detach())
        self.calls = self.evaluations = 0  # evaluations: latents times branches, over all calls
        self.first = self.finished = 0  # the first latent in z, and how many latents are finished
        self.heard: list[Said] = []  # what each latent in z is told
        nothing = torch.zeros(len(generators), dtype=torch.long, device=weight.device)
        lengths = nothing + torch.as_tensor(lasts, device=weight.device)  # (B,)
        with torch.no_grad():
            self.modulations = dit.modulations(self.times)  # per block (K+1,6*dim)
            # now, and what is to come
            self.said = [Said(0, sentences, nothing, lengths, *self._read(sentences))]
            copies = len(generators) * len(self.branches)
            self.packed = packed(dit, copies * int(min(self.ahead, self.window)))  # for `evaluate` alone

    @property
    def started(self) -> int:
        """How many latents have started; the first one that has not is the next to hear a new prompt."""
        return self.first + len(self.heard)

    @torch.no_grad()
    def listen(self, sentences: list[str | None], at: int | None = None, lasts: int = 0) -> None:
        """From now on, or from latent `at` on, the streams are told these sentences (None: nothing new), B of them.

        Without `at`, "new" lets the latents that have not started hear it, "active" those in flight as well. What had
        been announced for later is forgotten. ValueError: latent `at` has started, or nobody can read a sentence.
        """
        start = self.started if at is None else at
        if start < self.started:
            raise ValueError(f"latent {at} has started already; the next one is {self.started}")
        changed = torch.tensor([sentence is not None for sentence in sentences], device=self.z.device)  # (B,)
        in_flight = at is None and self.new_prompt == "active"
        begin = self.finished if in_flight else start

        def change(old: Said, start: int) -> Said:
            told = [old_one if new is None else new for new, old_one in zip(sentences, old.sentences)]
            lengths = torch.where(changed, lasts, old.lasts)
            return Said(start, told, torch.where(changed, begin, old.begin), lengths, *self._read(told))

        now = [said for said in self.said if said.start <= start][-1]
        new = change(now, start)
        if in_flight:  # where one stream changes and another does not, each latent keeps what the other was told
            flying = self.heard[self.finished - self.first :]
            news = {old: new if bool(changed.all()) else change(old, old.start) for old in dict.fromkeys(flying)}
            self.heard[self.finished - self.first :] = [news[old] for old in flying]
        self.said = [said for said in self.said if said.start < start] + [new]

    @torch.no_grad()
    def step(self) -> Tensor:
        """One call of the denoiser -> the latents that it finished (B,n,C), in order; n is 0 if it finished none."""
        if self.finished == self.num_latents:
            raise ValueError(f"the stream has reached its end, {self.num_latents} latents")
        self._start()
        calls, blocks = self.pace
        wait = calls * ((self.first + np.arange(len(self.heard))) // self.block_size) // blocks  # (n,)
        before, after = (
            np.clip(self.num_steps + wait - call, 0, self.num_steps) for call in (self.calls, self.calls + 1)
        )
        v = self._velocity(before)
        self.z = euler_step(self.z, v, *(self.times[levels].expand(len(self.z), -1) for levels in (before, after)))
        self.calls += 1
        done = self.z[:, (before > 0) & (after == 0)]  # (B,n,C)
        self.finished += done.shape[1]
        if self.cache is not None:
            final = int((before == 0).sum())  # this call has seen them at t = 1
            if self.cfg.attention == "causal":
                final -= final % self.cfg.block_size  # their blocks look both ways
            self.cache.keep(final)
            self._forget(final)
        return done

    def drain(self) -> Tensor:
        """Step to the end, which must be known: all latents from the first one on (B,N,C)."""
        done = []
        while self.finished < self.num_latents:
            done.append(self.step())
        return torch.cat(done, dim=1)

    def _start(self) -> None:
        """Let in the latents that this call moves for the first time, and make room for them."""
        end, (calls, blocks) = self.num_latents, self.pace
        if calls:
            seen = -(-(self.calls + 1) * blocks // calls) * self.block_size  # of the blocks whose wait is over
            end = seen if end is None else min(seen, end)
        for latent in range(self.started, end):
            while len(self.said) > 1 and self.said[1].start <= latent:
                self.said.pop(0)
            self.heard.append(self.said[0])
            if not self.spare.shape[1]:  # whole pages, so that a stream has the dense sampler's noise
                pages = [torch.randn(LONGEST, self.cfg.latent_dim, generator=g) for g in self.generators]
                self.spare = torch.stack(pages).to(self.z)  # (B,LONGEST,C)
            self.z, self.spare = torch.cat([self.z, self.spare[:, :1]], dim=1), self.spare[:, 1:]
        if self.cache is not None:
            self.cache.make_room(len(self.heard))
        elif len(self.heard) > self.window:
            self._forget(len(self.heard) - self.window)

    def _forget(self, count: int) -> None:
        self.z, self.heard, self.first = self.z[:, count:], self.heard[count:], self.first + count

    def _velocity(self, levels: np.ndarray) -> Tensor:
        """What the denoiser, guided, says of the latents in z at these levels (n,). (B,n,C)"""
        n, copies = len(levels), len(self.branches)
        self.evaluations += n * copies
        which = torch.from_numpy(levels).to(self.z.device)  # (n,): the level is its own row of the table
        kept, slot = (0, 0) if self.cache is None else (len(self.cache), self.cache.end)
        mask = self_attention_mask(
            n, self.cfg.block_size, self.cfg.attention, device=which.device, committed=(which == 0)[None]
        )
        mask = F.pad(mask, (kept, 0), value=True)  # everybody sees what is kept

        used = list(dict.fromkeys(self.heard))  # what is told to anybody in z: seldom more than one or two
        owner = torch.tensor([used.index(said) for said in self.heard], device=which.device)  # (n,)
        words = used[0].words
        if len(used) > 1:
            words = [tuple(torch.cat(parts, dim=2) for parts in zip(*block)) for block in zip(*(s.words for s in used))]
        real = torch.cat([said.real for said in used], dim=1)  # (R,S)
        sentence = torch.cat([torch.full((s.real.shape[1],), i, device=which.device) for i, s in enumerate(used)])
        word_mask = real[:, None] & (owner[:, None] == sentence)  # (R,n,S)

        told = None
        if self.cfg.clock:
            begin, lasts = (
                torch.stack([getattr(s, name) for s in used], dim=1)[:, owner] for name in ("begin", "lasts")
            )
            since = self.first + torch.arange(n, device=which.device) - begin  # (B,n)
            again = torch.where(lasts > 0, lasts, since + 1)  # when its time is over, a sentence begins again
            since, left = since % again, torch.where(lasts > 0, lasts - 1 - since % again, -1)
            clock = torch.stack([since, left], dim=-1)  # (B,n,2)
            told = clock_features(self.z[..., 0], clock).to(self.model_dtype).repeat(copies, 1, 1)
        v = self.packed.evaluate(
            self.z.to(self.model_dtype).repeat(copies, 1, 1),
            which.expand(copies * len(self.z), -1),
            self.modulations,
            words,
            self._added(word_mask),
            self._added(mask),
            torch.arange(slot, slot + n, device=which.device),
            told,
            self.cache,
        ).to(self.z)  # (R,n,C)
        if copies == 1:
            return v
        v_text, v_null = v.chunk(2)
        return v_null + self.guidance_scale * (v_text - v_null)

    def _added(self, mask: Tensor) -> Tensor | None:
        """A mask as numbers to add to the scores, once a call rather than once a layer; None if it hides nothing."""
        return None if mask.all() else torch.zeros_like(mask, dtype=self.model_dtype).masked_fill(~mask, -torch.inf)

    def _read(self, sentences: list[str]) -> tuple[list[tuple[Tensor, Tensor]], Tensor]:
        """Every block's keys and values (R,H,S,d) of the sentences, then of "", and which words are real (R,S)."""
        text = self.read(sentences) if "text" in self.branches else None
        null = Words(*(part.expand(len(sentences), *part.shape[1:]) for part in self.null))
        read = [text if branch == "text" else null for branch in self.branches]
        longest = max(words.mask.shape[1] for words in read)
        both = [[F.pad(x, (0, 0) * (x.ndim - 2) + (0, longest - x.shape[1])) for x in words] for words in read]
        embeddings, real = (torch.cat(parts) for parts in zip(*both))  # (R,S,E), (R,S)
        embeddings, real = embeddings.to(self.z.device, self.model_dtype), real.to(self.z.device)
        return self.dit.keys_values(embeddings), real
