"""Motion-language alignment: what makes the latents of a causal VAE mean something (CMDM Sec. 3.1, Eqs 3-6).

A frozen teacher (models/tmr.py) knows which frames mean what. Its features f, averaged over the frames of each latent,
are matched in two ways: one by one, through a learnt linear map z' = W z (Eq. 4), and by how alike the latents of one
sequence are to each other. Both have a margin: what is alike enough is left alone, so that latents stay free to carry
what a reconstruction needs.

The losses are on another scale than the reconstruction, and both scales move. `adaptive_weight` keeps the balance:

    weight = adaptive_weight(rec, align, vae.encoder[-1].conv.weight)
    loss = rec + beta * kl + share * weight * align
"""

import torch
import torch.nn.functional as F
from torch import Tensor


def group_mean(f: Tensor, group: int = 4) -> Tensor:
    """Teacher frames to latents: the mean of every `group` frames. (B,T,F) -> (B,N,F) with N = T / group.

    ValueError: T is not a positive multiple of `group`.
    """
    if f.ndim != 3 or f.shape[1] == 0 or f.shape[1] % group:
        raise ValueError(f"features must be (batch, a multiple of {group} frames, width), got {tuple(f.shape)}")
    return f.unflatten(1, (-1, group)).mean(2)  # (B,T,F) -> (B,N,group,F) -> (B,N,F)


def marginal_cosine(z_projected: Tensor, f: Tensor, margin: float = 0.5) -> Tensor:
    """CMDM Eq. 5: the mean of ReLU(1 - margin - cos(z', f)) over all latents. Both (B,N,F) -> scalar.

    Beyond a cosine of 1 - margin nothing is asked. ValueError: the shapes differ.
    """
    if z_projected.shape != f.shape:
        raise ValueError(f"z' {tuple(z_projected.shape)} and f {tuple(f.shape)} must have one shape: project z first")
    cosine = F.cosine_similarity(_wide(z_projected), _wide(f), dim=-1)  # (B,N,F) -> (B,N)
    return F.relu(1 - margin - cosine).mean()


def marginal_distance_matrix(z: Tensor, f: Tensor, margin: float = 0.25) -> Tensor:
    """CMDM Eq. 6: the mean of ReLU(|cos(z_i, z_j) - cos(f_i, f_j)| - margin) over the pairs of each sequence.

    z (B,N,C) and f (B,N,F) may differ in width, as only likenesses are compared. Pairs within one sequence, the
    diagonal included: N x N matrices as in the release; no latent meets another clip's. ValueError: B or N differ.
    """
    if z.ndim != 3 or f.ndim != 3 or z.shape[:2] != f.shape[:2]:
        raise ValueError(f"z {tuple(z.shape)} and f {tuple(f.shape)} must agree in (batch, latents, width)'s first two")
    return F.relu((_cosines(z) - _cosines(f)).abs() - margin).mean()  # (B,N,N) -> scalar


def alignment_loss(z: Tensor, z_projected: Tensor, f: Tensor, matrix_of: str = "latent") -> Tensor:
    """CMDM Eq. 3: Eq. 5 plus Eq. 6, with the paper's margins 0.5 and 0.25. The teacher's f gets no gradient.

    z (B,N,C), z_projected (B,N,F), f (B,N,F). Eq. 6 is written for z, and so is the default; the release gives it
    the projected latents ("projected"), whose map W can then do part of the work. ValueError: another `matrix_of`.
    """
    if matrix_of not in ("latent", "projected"):
        raise ValueError(f"matrix_of must be 'latent' or 'projected', got {matrix_of!r}")
    f = f.detach()
    return marginal_cosine(z_projected, f) + marginal_distance_matrix(z if matrix_of == "latent" else z_projected, f)


def adaptive_weight(rec: Tensor, align: Tensor, weight: Tensor, clamp: float = 1e4) -> Tensor:
    """lambda of CMDM Eq. 2: how much weaker the alignment pulls at one parameter than the reconstruction does.

    |d rec / d weight| / |d align / d weight|, in [0, clamp], no gradient of its own. The paper takes "the final layer
    of the encoder"; the release the last convolution, one before the layer that makes the mean and the variance. Once
    all latents are within the margins `align` pulls at nothing; the floor under its norm is the release's. Both graphs
    are kept for the backward pass. rec and align are scalars without weights of their own -> scalar.
    """
    rec_norm, align_norm = (torch.autograd.grad(loss, weight, retain_graph=True)[0].norm() for loss in (rec, align))
    return (rec_norm / align_norm.clamp(min=1e-4)).clamp(0.0, clamp)


def _cosines(x: Tensor) -> Tensor:
    """How alike the vectors of each sequence are: (B,N,F) -> (B,N,N)."""
    with torch.autocast(x.device.type, enabled=False):
        unit = F.normalize(_wide(x), dim=-1)
        return unit @ unit.transpose(1, 2)


def _wide(x: Tensor) -> Tensor:
    # Under autocast x is bfloat16, whose cosines are off by thousandths.
    return x.to(torch.promote_types(x.dtype, torch.float32))
