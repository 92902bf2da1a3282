"""The exercises of notebook 03: a sample that lets gradients through, a latent's price, a convolution in pieces."""

from __future__ import annotations

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

from minicmdm.exercises.frame import Exercise, must

SHAPES = [(1, 1, 1), (1, 2, 3), (2, 3, 4), (3, 5, 2), (4, 8, 16)]  # (B,N,C), growing


def _gaussians():
    """Means and log-variances (B,N,C) of growing shape, and a generator for whatever else a case needs."""
    for seed, shape in enumerate(SHAPES):
        generator = torch.Generator().manual_seed(seed)
        draw = lambda: torch.randn(shape, generator=generator, dtype=torch.float64)  # noqa: B023, E731
        yield draw(), draw(), draw()


def reparameterise(mean: Tensor, logvar: Tensor, noise: Tensor) -> Tensor:
    """A sample of N(mean, exp(logvar)) out of a sample of N(0, 1), as in `MACVAE.forward`. All (B,N,C)."""
    return mean + (0.5 * logvar).exp() * noise  # half the log-variance is the log of the standard deviation


def _prove_reparameterise(answer: Callable) -> None:
    for mean, logvar, noise in _gaussians():
        mean.requires_grad_(), logvar.requires_grad_()
        z, still = answer(mean, logvar, noise), answer(mean, logvar, torch.zeros_like(noise))
        must(z.shape == mean.shape, f"A sample has the mean's shape, {tuple(mean.shape)}.")
        must(torch.allclose(still, mean), "Noise of zero gives the mean.")
        std = (z - mean) / noise  # by how much each number stretches its noise
        must((std > 0).all(), "Noise is stretched by a positive number, the standard deviation.")
        must(torch.allclose(2 * std.log(), logvar), "The noise is stretched by the standard deviation of exp(logvar).")
        grads = torch.autograd.grad(z.sum(), (mean, logvar), allow_unused=True)
        must(all(g is not None for g in grads), "Gradients reach the mean and the log-variance.")
        must(torch.allclose(grads[0], torch.ones_like(mean)), "Moving the mean moves the sample by as much.")


def kl_per_clip(mean: Tensor, logvar: Tensor) -> Tensor:
    """KL( N(mean, exp(logvar)) || N(0, 1) ) in nats, summed over a clip's latents and channels. (B,N,C) -> (B,)"""
    return 0.5 * (mean.square() + logvar.exp() - 1 - logvar).sum(dim=(1, 2))


def _prove_kl(answer: Callable) -> None:
    for mean, logvar, _ in _gaussians():
        zero, (batch, latents, channels) = torch.zeros_like(mean), mean.shape
        at_prior = answer(zero, zero)
        must(at_prior.shape == (batch,), f"One number for each of the {batch} clips.")
        must(torch.allclose(at_prior, zero.sum((1, 2))), "A posterior equal to the prior costs nothing.")
        one = answer(zero + 1, zero)
        must(torch.allclose(one, zero.sum((1, 2)) + latents * channels / 2), "A mean of 1 costs half a nat a channel.")
        q = torch.distributions.Normal(mean, (0.5 * logvar).exp())
        wanted = torch.distributions.kl_divergence(q, torch.distributions.Normal(0.0, 1.0)).sum((1, 2))
        must(torch.allclose(answer(mean, logvar), wanted), "torch.distributions gives another KL divergence.")


def convolve_piece(x: Tensor, past: Tensor, weight: Tensor, dilation: int) -> tuple[Tensor, Tensor]:
    """Convolve a piece x (B,C,T) after its past (B,C,P), P = (k-1) * dilation. -> output (B,C',T), the next past.

    weight (C',C,k). The past of the first piece is zeros: the padding.
    """
    x = torch.cat([past, x], dim=-1)  # (B,C,P+T)
    return F.conv1d(x, weight, dilation=dilation), x[..., x.shape[-1] - past.shape[-1] :]


def _prove_convolve_piece(answer: Callable) -> None:
    cases = [(1, 1, 1, [1, 1]), (2, 1, 1, [1, 1, 1]), (3, 1, 2, [2, 1, 3]), (3, 3, 2, [1, 4, 1, 2]), (4, 9, 3, [5, 30])]
    for kernel, dilation, channels, pieces in cases:
        generator = torch.Generator().manual_seed(kernel)
        draw = lambda *shape: torch.randn(shape, generator=generator, dtype=torch.float64)  # noqa: B023, E731
        x, weight = draw(2, channels, sum(pieces)), draw(channels + 1, channels, kernel)
        left = (kernel - 1) * dilation
        whole, past = F.conv1d(F.pad(x, (left, 0)), weight, dilation=dilation), x.new_zeros(2, channels, left)
        begun, case = 0, f"Kernel {kernel}, dilation {dilation}, pieces of {pieces} frames: "
        for piece in x.split(pieces, dim=-1):
            y, past = answer(piece, past, weight, dilation)
            wanted = whole[..., begun : begun + piece.shape[-1]]
            must(y.shape == wanted.shape, case + "each piece gives as many frames as it has.")
            must(torch.allclose(y, wanted), case + "together they give what the whole gives in one go.")
            must(past.shape[-1] == left, case + f"what is kept is always {left} frames, or the stream's memory grows.")
            begun += piece.shape[-1]


EXERCISES = (
    Exercise(
        "03.1",
        "the standard deviation is the square root of exp(logvar); move and stretch the noise by mean and deviation.",
        reparameterise,
        _prove_reparameterise,
    ),
    Exercise(
        "03.2",
        "for one number, half of (mean squared + variance - 1 - log variance); sum over latents and channels only.",
        kl_per_clip,
        _prove_kl,
    ),
    Exercise(
        "03.3",
        "put the past in front of the piece, convolve without padding, and keep the end of what you convolved. "
        "A kernel of one frame keeps nothing: what does x[..., -0:] give?",
        convolve_piece,
        _prove_convolve_piece,
    ),
)
