"""The VAE: shapes, causality in groups of four frames, and its loss against closed forms."""

import math
from dataclasses import replace

import pytest
import torch
from model_helpers import dependencies, lower_triangle, randomise

from minicmdm.config import TrainConfig, VAEConfig, preset
from minicmdm.models.vae import MACVAE, VAEOutput, vae_loss

TINY = VAEConfig(input_dim=6, latent_dim=3, width=8, depth=2)


@pytest.mark.parametrize("latent_dim", [16, 32, 64])
@pytest.mark.parametrize("down", [2, 3])
@pytest.mark.parametrize("causal", [True, False])
def test_shapes(latent_dim, down, causal):
    vae = MACVAE(VAEConfig(latent_dim=latent_dim, width=8, depth=2, down=down, causal=causal))
    x = torch.randn(2, 24, 263)
    out = vae(x)
    latents = (2, 24 // 2**down, latent_dim)
    assert out.recon.shape == x.shape
    assert out.mean.shape == out.logvar.shape == out.z.shape == latents
    assert vae.decode(torch.randn(1, 1, latent_dim)).shape == (1, 2**down, 263)


@pytest.mark.parametrize("down", [2, 3])
def test_nothing_before_its_own_group_moves(down):
    vae = randomise(MACVAE(replace(TINY, down=down)))
    group, frames = 2**down, 4 * 2**down
    x = torch.randn(1, frames, 6, dtype=torch.float64)
    latent, frame = torch.arange(frames // group), torch.arange(frames) // group

    sees = dependencies(lambda x: torch.cat(vae.encode(x), dim=-1), x)  # (N,T)
    assert not (sees & (latent[:, None] < frame[None, :])).any()
    assert sees[latent[:, None] == frame[None, :]].all()  # the control: the whole own group is seen

    sees = dependencies(vae.decode, torch.randn(1, 4, 3, dtype=torch.float64))  # (T,N)
    assert not (sees & (frame[:, None] < latent[None, :])).any()
    assert sees[frame[:, None] == latent[None, :]].all()

    sees = dependencies(lambda x: vae.decode(vae.encode(x)[0]), x)  # (T,T)
    assert not (sees & ~lower_triangle(frames, group)).any()
    assert sees[-1].all()


@pytest.mark.parametrize("down", [2, 3])
def test_a_vae_in_pieces_is_the_whole_vae(down):
    vae = randomise(MACVAE(replace(TINY, down=down)))
    z, group = torch.randn(2, 30, 3, dtype=torch.float64), 2**down
    whole = vae.decode(z)
    for sizes in ([1] * 30, [7, 1, 2, 20]):
        states = {}
        pieces = [vae.decode(piece, states) for piece in z.split(sizes, dim=1)]
        assert torch.allclose(torch.cat(pieces, dim=1), whole, rtol=1e-9, atol=1e-12)
        states = {}
        pieces = [vae.encode(x, states)[0] for x in whole.split([group * n for n in sizes], dim=1)]
        assert torch.allclose(torch.cat(pieces, dim=1), vae.encode(whole)[0], rtol=1e-9, atol=1e-12)
    # the control: pieces that begin anew are something else
    assert not torch.allclose(vae.decode(z[:, 7:8]), whole[:, 7 * group : 8 * group])


def test_what_a_stream_keeps_of_the_past_does_not_grow():
    vae, states, sizes = randomise(MACVAE(TINY)), {}, set()
    for _ in range(3):
        vae.decode(torch.zeros(1, 5, 3, dtype=torch.float64), states)
        sizes.add(sum(state.numel() for state in states.values()))
    assert (
        len(sizes) == 1
        and len(states) == len([m for m in vae.decoder.modules() if type(m).__name__ == "CausalConv1d"]) - 2 * 2
    )


def test_a_vae_that_looks_ahead_cannot_stream():
    with pytest.raises(ValueError, match="looks ahead"):
        MACVAE(replace(TINY, causal=False)).decode(torch.zeros(1, 2, 3), {})


def test_the_plain_vae_looks_ahead():
    vae = randomise(MACVAE(replace(TINY, causal=False)))
    x = torch.randn(1, 16, 6, dtype=torch.float64)
    assert dependencies(lambda x: vae.encode(x)[0], x)[0, 4:].any()
    assert dependencies(vae.decode, vae.encode(x)[0])[:4, 1:].any()


def test_the_same_noise_gives_the_same_latents():
    vae, x = randomise(MACVAE(TINY)), torch.randn(2, 8, 6, dtype=torch.float64)
    first, again, other = (vae(x, torch.Generator().manual_seed(seed)) for seed in (1, 1, 2))
    assert torch.equal(first.z, again.z) and not torch.allclose(first.z, other.z)
    deviation = (first.z - first.mean) / (0.5 * first.logvar).exp()
    expected = torch.randn(2, 2, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    assert torch.allclose(deviation, expected)


def test_the_papers_size():
    with torch.device("meta"):
        count = sum(p.numel() for p in MACVAE(preset("M").vae).parameters())
    assert abs(count / 76.3e6 - 1) < 0.01


@pytest.mark.parametrize("shape", [(2, 6, 6), (2, 0, 6), (2, 8, 5), (8, 6)])
def test_encode_errors_teach(shape):
    with pytest.raises(ValueError, match="multiple of 4"):
        MACVAE(TINY).encode(torch.zeros(shape))


def test_decode_errors_teach():
    with pytest.raises(ValueError, match="latents >= 1, 3"):
        MACVAE(TINY).decode(torch.zeros(1, 2, 4))


def output(recon, mean=None, logvar=None):
    mean = torch.zeros(len(recon), recon.shape[1] // 4, 3, dtype=recon.dtype) if mean is None else mean
    return VAEOutput(recon, mean, torch.zeros_like(mean) if logvar is None else logvar, mean)


def test_reconstruction_is_half_the_log_of_the_mean_squared_error():
    torch.manual_seed(0)
    x, recon = torch.randn(2, 5, 8, 6, dtype=torch.float64)
    cfg = TrainConfig(root_weight=0.0, kl_weight=0.0)
    loss = vae_loss(output(recon), x, cfg).total
    assert math.isclose(loss, 0.5 * math.log((recon - x).square().mean()), rel_tol=1e-5)
    # ten times the error costs the same log 10 wherever one stands
    worse = vae_loss(output(x + 10 * (recon - x)), x, cfg).total
    assert math.isclose(worse - loss, math.log(10), rel_tol=1e-5)


def test_it_is_the_gaussian_likelihood_at_its_best_variance():
    torch.manual_seed(0)
    x, recon = torch.randn(2, 2, 8, 6, dtype=torch.float64)
    sigma = (recon - x).square().mean().sqrt()
    nll = -torch.distributions.Normal(recon, sigma).log_prob(x).mean()
    loss = vae_loss(output(recon), x, TrainConfig(root_weight=0.0, kl_weight=0.0)).total
    assert math.isclose(nll, loss + 0.5 + 0.5 * math.log(2 * math.pi), rel_tol=1e-5)


def test_a_perfect_reconstruction_is_finite():
    x = torch.randn(1, 8, 6).requires_grad_()
    loss = vae_loss(output(x), x.detach(), TrainConfig()).total
    loss.backward()
    assert loss.isfinite() and x.grad.isfinite().all()


def test_kl_is_the_libraries_sum_over_a_sequence_per_number_explained():
    torch.manual_seed(0)
    x, recon = torch.randn(2, 5, 8, 6, dtype=torch.float64)
    mean, logvar = torch.randn(2, 5, 2, 3, dtype=torch.float64)
    normal = torch.distributions.Normal(mean, (0.5 * logvar).exp())
    expected = torch.distributions.kl_divergence(normal, torch.distributions.Normal(0.0, 1.0)).sum() / 5 / (8 * 6)
    losses = [vae_loss(output(recon, mean, logvar), x, TrainConfig(kl_weight=w)) for w in (0.0, 0.5)]
    assert torch.allclose(losses[0].kl, expected, rtol=1e-6)
    assert torch.allclose(losses[1].total - losses[0].total, 0.5 * expected, rtol=1e-6)


def test_the_root_term_hears_the_first_four_features_only():
    torch.manual_seed(0)
    x, recon = torch.randn(2, 5, 8, 6, dtype=torch.float64)
    root = vae_loss(output(recon), x, TrainConfig()).root
    assert math.isclose(root, 4 / 6 * 0.5 * math.log((recon - x)[..., :4].square().mean()), rel_tol=1e-5)
    recon[..., 4:] += 1
    assert torch.equal(vae_loss(output(recon), x, TrainConfig()).root, root)
