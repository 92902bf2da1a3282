"""The exercises of notebook 15: a denoiser's parameters, a schedule under a budget, the clips of a folder."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from minicmdm.config import DiTConfig
from minicmdm.data.folders import read_clips
from minicmdm.data.programs import MAX_FRAMES, MIN_FRAMES
from minicmdm.data.skeleton import FPS
from minicmdm.diffusion.schedules import closed_form_cost
from minicmdm.exercises.frame import Exercise, must
from minicmdm.models.dit import CausalDiT

LONG = 1000  # latents: for a schedule, a stream without an end


def dit_parameters(dim: int, layers: int, latent_dim: int, text_dim: int, time_dim: int) -> int:
    """The parameters of the paper's Causal-DiT: no word blocks and no clock, feed-forward 2 * dim."""

    def linear(inputs: int, outputs: int) -> int:
        return inputs * outputs + outputs

    attention = 4 * linear(dim, dim) + 2 * dim  # query, key, value, out; RMSNorm of queries and keys
    feedforward = linear(dim, 2 * dim) + linear(2 * dim, dim)
    block = linear(dim, 6 * dim) + 2 * attention + feedforward + 2 * dim  # modulation first, the one LayerNorm last
    time = linear(time_dim, dim) + linear(dim, dim)
    return linear(latent_dim, dim) + linear(text_dim, dim) + time + layers * block + linear(dim, latent_dim)


def _prove_parameters(answer: Callable) -> None:
    rng = np.random.default_rng(15)
    shapes = [tuple(int(size) for size in rng.integers(1, 9, 5)) for _ in range(4)]
    cases = [(1, 0, 1, 1, 1), (1, 1, 1, 1, 1), (2, 1, 1, 1, 1), (2, 2, 1, 1, 1)] + sorted(shapes)
    for half, layers, latent, text, time in [*cases, (256, 8, 64, 768, 256)]:  # the last is M
        dim = 2 * half
        with torch.device("meta"):
            model = CausalDiT(DiTConfig(latent, text, dim, layers, heads=1, time_dim=time))
        parts = {name: sum(w.numel() for w in part.parameters()) for name, part in model.named_children()}
        guess, right = answer(dim, layers, latent, text, time), sum(parts.values())
        must(guess == right, f"The built model has {right}: {', '.join(f'{n} {c}' for n, c in parts.items() if c)}.")


def pick_schedule(
    call_ms: Callable[[int], float], first_ms: float, latent_ms: float, most_steps: int = 50
) -> tuple[int, int] | None:
    """(K, L) of the FSS within both budgets: most steps first, then the largest stagger; None if there is none.

    `call_ms(n)` is what a call costs that moves n latents.
    """
    for num_steps in range(most_steps, 0, -1):
        for stagger in range(num_steps, 0, -1):
            price = closed_form_cost(LONG, num_steps, stagger)
            call = call_ms(price.latents_in_flight)
            if price.calls_to_first * call <= first_ms and price.calls_per_further * call <= latent_ms:
                return num_steps, stagger
    return None


def _prove_pick(answer: Callable) -> None:
    rng = np.random.default_rng(16)
    cases = [(10, 0, 9, 9, 4), (10, 0, 10, 10, 4), (10, 0, 40, 10, 4), (10, 0, 40, 40, 4), (10, 0, 40, 30, 4)]
    cases += [(10, 0, 40, 5, 4), (10, 10, 90, 60, 4), (10, 5, 400, 40, 12), (77, 1.5, 3500, 200, 50)]
    for _ in range(6):
        fixed, each = int(rng.integers(1, 50)), int(rng.integers(0, 4))
        cases.append((fixed, each, int(rng.integers(2, 30)) * fixed, int(rng.integers(1, 8)) * fixed, 20))
    for fixed, each, first, latent, most in cases:

        def call_ms(n: int, fixed=fixed, each=each) -> float:
            return fixed + each * n

        said = f"A call costs {fixed} + {each} n ms, budgets are {first} and {latent}, K is at most {most}: "
        guess, right = answer(call_ms, first, latent, most), pick_schedule(call_ms, first, latent, most)
        must((guess is None) == (right is None), f"{said}{'nothing' if right is None else right} keeps both budgets.")
        if right is None:
            continue
        K, L = guess
        must(1 <= L <= K <= most, "A stagger is at least 1, at most K; K is at most `most_steps`.")
        call = call_ms(-(-K // L))
        must(K * call <= first, f"{said}with {guess} the first latent comes after {K * call} ms.")
        must(L * call <= latent, f"{said}with {guess} each further latent takes {L * call} ms.")
        must(K == right[0], f"{said}{right[0]} steps are affordable, and {K} are fewer.")
        must(
            L == right[1], f"{said}of the staggers that keep both budgets with {K} steps take the largest, {right[1]}."
        )


def pieces(num_frames: int, marks: list[tuple[float, float]]) -> list[tuple[int, int]]:
    """The clips of one motion, (first frame, end) each, by its captions' (start, end) in seconds; 0, 0: the whole."""
    found = [(0, num_frames)] if (0, 0) in marks else []
    stretches = [(int(FPS * start), min(int(FPS * end), num_frames)) for start, end in marks if (start, end) != (0, 0)]
    found += dict.fromkeys(stretches)  # several captions of one stretch are one clip
    cut = [(first, min(end, first + MAX_FRAMES)) for first, end in found]
    return [(first, end) for first, end in cut if end - first >= MIN_FRAMES]


def _prove_pieces(answer: Callable) -> None:
    rng = np.random.default_rng(17)
    cases = [(39, [(0, 0)]), (40, [(0, 0)]), (196, [(0, 0)]), (199, [(0, 0), (0, 0)]), (100, [(1, 3)])]
    cases += [
        (100, [(1, 2.95)]),
        (100, [(0, 0), (2.48, 4.6)]),
        (100, [(1, 8)]),
        (100, [(4, 9)]),
        (100, [(7, 9), (0, 0)]),
    ]
    cases += [(100, [(1, 4), (1, 4)]), (300, [(0, 0), (2, 14)]), (120, [(0, 2), (0, 0), (2, 6)])]
    for _ in range(4):
        starts = rng.uniform(0, 10, 3).round(2).tolist()
        cases.append(
            (int(rng.integers(40, 260)), [(0, 0), *((a, a + round(float(rng.uniform(1, 12)), 2)) for a in starts)])
        )
    with tempfile.TemporaryDirectory() as home:
        for name in ("new_joint_vecs", "texts"):
            (Path(home) / name).mkdir()
        for frames, marks in cases:
            features = np.zeros((frames, 263), np.float32)
            features[:, 0] = np.arange(frames)  # each row says which frame it is
            np.save(Path(home) / "new_joint_vecs" / "x.npy", features)
            (Path(home) / "texts" / "x.txt").write_text("".join(f"a person walks#x/X#{a}#{b}\n" for a, b in marks))
            clips = [clip.features[:, 0] for clip in read_clips(Path(home), "x", {})]  # the library reads a folder
            right = [(int(x[0]), int(x[-1]) + 1) for x in clips]
            guess = [(int(first), int(end)) for first, end in answer(frames, list(marks))]
            must(len(guess) >= len(right), f"The reader finds {len(right)} clips, {right}.")
            must(len(guess) <= len(right), f"The reader finds {len(right)}, {right}: under 40 frames nothing is kept.")
            must(sorted(guess) == sorted(right), f"The reader finds {right}: int(20 s), cut at 196 frames.")


EXERCISES = (
    Exercise(
        "15.1",
        "write linear(inputs, outputs) first, then a block as in section 1, then what stands before and after.",
        dit_parameters,
        _prove_parameters,
    ),
    Exercise(
        "15.2",
        "two loops, from the most steps down and from the largest stagger down; the first pair within both budgets.",
        pick_schedule,
        _prove_pick,
    ),
    Exercise(
        "15.3",
        "first the list of (first, end) in frames, whole and stretches; then cut each at 196; then drop what is short.",
        pieces,
        _prove_pieces,
    ),
)
