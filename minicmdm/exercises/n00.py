"""The exercises of notebook 00: shapes, and how far back an edit reaches."""

from __future__ import annotations

from collections.abc import Callable

import torch

from minicmdm.config import VAEConfig
from minicmdm.exercises.frame import Exercise, must, sizes
from minicmdm.models.vae import MACVAE


def motion_shapes(num_frames: int, latent_dim: int) -> tuple[tuple, tuple, tuple]:
    """Shapes of one motion of T frames: latents (N,C), decoded features (4N,263), joints (T,22,3)."""
    num_latents = -(-num_frames // 4)  # rounded up: the last latent may stand for frames that nobody asked for
    return (num_latents, latent_dim), (4 * num_latents, 263), (num_frames, 22, 3)


def _prove_shapes(answer: Callable) -> None:
    for frames in sizes(4, 196):
        width = 8 + frames % 3 * 4
        latents, features, joints = (tuple(shape) for shape in answer(frames, width))
        must(len(latents) == 2 and latents[1] == width, f"A latent has {width} channels: the shape is (N, {width}).")
        must(4 * latents[0] >= frames, f"{latents[0]} latents draw {4 * latents[0]} frames, fewer than {frames}.")
        must(4 * latents[0] < frames + 4, f"One latent fewer would still draw all {frames} frames.")
        must(features == (4 * latents[0], 263), "The decoder draws four frames of 263 features for every latent.")
        must(joints == (frames, 22, 3), "You get as many frames as you asked for, each of 22 joints in space.")


def first_frame_moved(frame: int) -> int:
    """The first frame of the VAE's output that can move when this frame of its input does."""
    return frame // 4 * 4  # the group of four that one latent stands for moves as one, and nothing before it


def _prove_first_moved(answer: Callable) -> None:
    torch_state = torch.random.get_rng_state()
    torch.manual_seed(0)
    vae = MACVAE(VAEConfig(latent_dim=4, width=8, depth=2)).double().eval()
    torch.random.set_rng_state(torch_state)
    cases = [(8, frame) for frame in range(8)] + [(20, 11), (28, 18), (36, 33)]
    for frames, frame in cases:
        clip = torch.randn(1, frames, 263, dtype=torch.float64, generator=torch.Generator().manual_seed(frames))
        edited = clip.clone()
        edited[0, frame] += 1
        with torch.no_grad():
            change = vae.decode(vae.encode(edited)[0]) - vae.decode(vae.encode(clip)[0])  # (1,T,263)
        first = int((change.abs().amax(-1)[0] > 1e-9).nonzero()[0])
        guess = answer(frame)
        law = f"In a random VAE an edit of frame {frame} of {frames} "
        must(guess <= first, law + f"moves output before frame {guess}, too: a latent stands for a group of frames.")
        must(guess >= first, law + f"leaves output frame {guess} alone: causality guards all before the edited group.")


EXERCISES = (
    Exercise(
        "00.1",
        "one latent stands for four frames, and a started group of four needs a latent of its own. "
        "The decoder draws whole groups; what was not asked for is cut from the joints.",
        motion_shapes,
        _prove_shapes,
    ),
    Exercise(
        "00.2",
        "which latent does the frame belong to, and which is the first frame that this latent draws?",
        first_frame_moved,
        _prove_first_moved,
    ),
)
