"""MAC-VAE without its alignment losses: a causal convolutional VAE from frames to latents and back.

Encoder, from (B,T,D) to a Gaussian per latent:
    k3 convolution -> `down` x { k4 stride-2 convolution -> residual stack } -> k3 convolution -> linear
Decoder, from latents (B,N,C) to (B,T,D):
    linear -> k3 convolution -> `down` x { residual stack -> repeat each frame twice -> k3 convolution }
    -> 2 x k3
A residual stack has `depth` blocks with dilations growth^(depth-1), ..., growth, 1.

Causality holds in groups of `2**down` frames: latent i sees frames up to the end of its own group, and the
frames of group i see latents up to i. (CMDM Eq. 1 wants each frame to see its own past only; a latent that
stands for four frames cannot.)

Latents come out as the encoder likes them. Whoever trains a denoiser on them normalises them by measured
statistics.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from minicmdm.config import TrainConfig, VAEConfig
from minicmdm.models.layers import CausalConv1d, ResidualBlock, States

ROOT_DIMS = 4  # the first features of both the 263 and the essential 67: yaw and planar velocity, height


@dataclass
class VAEOutput:
    """What one pass leaves behind. Alignment losses (CMDM Eqs 3-6) read `z` or, without its noise, `mean`."""

    recon: Tensor  # (B,T,D)
    mean: Tensor  # (B,N,C)
    logvar: Tensor  # (B,N,C)
    z: Tensor  # (B,N,C), sampled


class MACVAE(nn.Module):
    """The causal VAE: `encode`, `decode` and the sampled pass between them."""

    def __init__(self, cfg: VAEConfig):
        super().__init__()
        self.cfg = cfg
        width = cfg.width

        def conv(in_channels: int, out_channels: int, kernel_size: int = 3, stride: int = 1) -> nn.Module:
            return CausalConv1d(in_channels, out_channels, kernel_size, stride, causal=cfg.causal)

        def stack() -> list[nn.Module]:
            dilations = [cfg.dilation_growth**i for i in reversed(range(cfg.depth))]  # 9, 3, 1
            return [ResidualBlock(width, dilation, cfg.causal) for dilation in dilations]

        down, up = [], []
        for _ in range(cfg.down):
            down += [conv(width, width, 4, stride=2), *stack()]
            up += [*stack(), nn.Upsample(scale_factor=2, mode="nearest"), conv(width, width)]
        self.encoder = nn.Sequential(conv(cfg.input_dim, width), nn.ReLU(), *down, conv(width, width))
        self.to_gaussian = nn.Linear(width, 2 * cfg.latent_dim)
        self.from_latent = nn.Linear(cfg.latent_dim, width)
        self.decoder = nn.Sequential(
            conv(width, width), nn.ReLU(), *up, conv(width, width), nn.ReLU(), conv(width, cfg.input_dim)
        )

    def encode(self, x: Tensor, states: States | None = None) -> tuple[Tensor, Tensor]:
        """Normalised features (B,T,D) -> mean and log-variance (B,N,C) of each latent, N = T / 2**down.

        `states`, as in `decode`, lets a motion come in pieces.
        ValueError: T is not a positive multiple of `2**down`, or D is not the width this VAE was built for.
        """
        group = self.cfg.frames_per_latent
        if x.ndim != 3 or x.shape[-1] != self.cfg.input_dim or x.shape[1] == 0 or x.shape[1] % group:
            raise ValueError(
                f"the VAE encodes (batch, frames, {self.cfg.input_dim}) with frames a positive multiple of "
                f"{group}, got {tuple(x.shape)}"
            )
        hidden = _in_pieces(self.encoder, x.transpose(1, 2), states).transpose(1, 2)  # (B,T,D) -> (B,N,width)
        mean, logvar = self.to_gaussian(hidden).chunk(2, dim=-1)  # 2 x (B,N,C)
        if self.cfg.deterministic:  # an autoencoder: a Gaussian of no width
            return mean, torch.full_like(logvar, -30.0)
        return mean, logvar.clamp(-30, 20)

    def decode(self, z: Tensor, states: States | None = None) -> Tensor:
        """Latents (B,N,C) -> normalised features (B,T,D), T = N * 2**down.

        With `states`, a dictionary that is empty at first, z continues the z of the call before: every layer keeps the
        end of its input, so the pieces together are what one call on all latents would give. ValueError: not a
        latent's shape, or pieces for a VAE that looks ahead.
        """
        if z.ndim != 3 or z.shape[-1] != self.cfg.latent_dim or z.shape[1] == 0:
            raise ValueError(f"the VAE decodes (batch, latents >= 1, {self.cfg.latent_dim}), got {tuple(z.shape)}")
        return _in_pieces(self.decoder, self.from_latent(z).transpose(1, 2), states).transpose(1, 2)

    def forward(self, x: Tensor, generator: torch.Generator | None = None) -> VAEOutput:
        """Encode, sample with the generator's noise, decode. (B,T,D) -> VAEOutput."""
        mean, logvar = self.encode(x)
        device = generator.device if generator is not None else mean.device
        noise = torch.randn(mean.shape, generator=generator, device=device, dtype=mean.dtype).to(mean.device)
        z = mean + (0.5 * logvar).exp() * noise
        return VAEOutput(recon=self.decode(z), mean=mean, logvar=logvar, z=z)


@dataclass
class VAELoss:
    """The loss and its terms, all scalars, in nats per feature and frame."""

    total: Tensor
    recon: Tensor
    root: Tensor
    kl: Tensor  # before its weight


def vae_loss(output: VAEOutput, x: Tensor, cfg: TrainConfig) -> VAELoss:
    """The sigma-VAE bound per feature and frame: 0.5 log MSE + root term + beta KL. x is (B,T,D).

    A Gaussian decoder whose one variance is the best possible, the batch's own MSE, has the negative
    log-likelihood 0.5 (log MSE + 1 + log 2 pi) per element; only the first term matters. It is scale-free: to
    halve an error is worth the same at the start and at the end of training. The root features (yaw, planar
    velocity and height, which add up along a path) are counted again, `root_weight` times; the paper does not
    mention this term, the release gives it 0.05.

    `kl_weight` is beta, in front of the whole KL of a sequence over the T*D numbers that it explains: 1
    is the exact bound. The paper prints beta = 1; the release multiplies by 0.01 a KL averaged over a
    batch of 128 while its reconstruction is a *sum* over that batch, so its beta is 0.01 / 128 = 8e-5.
    """
    num_frames, num_features = x.shape[1:]
    error = (output.recon - x).square()  # (B,T,D)
    recon = _half_log(error.mean())
    root = _half_log(error[..., :ROOT_DIMS].mean()) * ROOT_DIMS / num_features
    # KL( N(mean, exp(logvar)) || N(0,1) ), summed over a sequence's latents, in nats
    mean, logvar = output.mean.to(x.dtype), output.logvar.to(x.dtype)  # bfloat16 under autocast: too coarse to sum
    kl = 0.5 * (mean.square() + logvar.exp() - 1 - logvar).sum(dim=(1, 2)).mean()
    kl = kl / (num_frames * num_features)
    return VAELoss(recon + cfg.root_weight * root + cfg.kl_weight * kl, recon, root, kl)


def _in_pieces(layers: nn.Sequential, x: Tensor, states: States | None) -> Tensor:
    """Run the layers; those that look back over time find and leave their past in `states`. (B,C,T) -> (B,C',T')"""
    for layer in layers:
        x = layer(x, states) if isinstance(layer, (CausalConv1d, ResidualBlock)) else layer(x)
    return x


def _half_log(mse: Tensor) -> Tensor:
    # The floor is a sigma of e^-6, the release's: a perfect reconstruction must not run to minus infinity.
    return 0.5 * (mse + math.exp(-12)).log()
