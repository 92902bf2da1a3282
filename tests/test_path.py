"""The time convention: t = 0 noise, t = 1 data, and conversions that undo each other."""

import pytest
import torch

from minicmdm.diffusion.path import (
    alpha_bar_to_time,
    cosine_alpha_bar,
    cosine_fraction,
    data_to_velocity,
    ddim_step,
    euler_step,
    flow_to_ddpm,
    interpolate,
    level_to_time,
    noise_to_velocity,
    time_to_alpha_bar,
    velocity,
    velocity_to_data,
    velocity_to_noise,
)


@pytest.fixture
def drawn():
    torch.manual_seed(0)
    z, eps = torch.randn(2, 3, 5, 4, dtype=torch.float64)
    t = torch.rand(3, 5, dtype=torch.float64) * 0.9 + 0.05
    return z, eps, t


def test_the_ends_of_the_path(drawn):
    z, eps, _ = drawn
    assert torch.equal(interpolate(z, eps, 0.0), eps)
    assert torch.equal(interpolate(z, eps, 1.0), z)
    assert level_to_time(torch.tensor([20, 0]), 20).tolist() == [0.0, 1.0]  # k = K is noise, k = 0 is clean
    assert torch.allclose(level_to_time(torch.tensor(5), 20), torch.tensor(0.75))


def test_velocity_is_the_time_derivative(drawn):
    z, eps, t = drawn
    h = 1e-6
    slope = (interpolate(z, eps, t + h) - interpolate(z, eps, t - h)) / (2 * h)
    assert torch.allclose(slope, velocity(z, eps), atol=1e-8)


def test_conversions_round_trip(drawn):
    z, eps, t = drawn
    z_t, v = interpolate(z, eps, t), velocity(z, eps)
    assert torch.allclose(velocity_to_data(z_t, v, t), z, rtol=1e-9)
    assert torch.allclose(velocity_to_noise(z_t, v, t), eps, rtol=1e-9)
    assert torch.allclose(data_to_velocity(z_t, z, t), v, rtol=1e-9)
    assert torch.allclose(noise_to_velocity(z_t, eps, t), v, rtol=1e-9)


def test_each_latent_has_its_own_time(drawn):
    z, eps, t = drawn
    z_t = interpolate(z, eps, t)
    assert torch.allclose(z_t[1, 2], t[1, 2] * z[1, 2] + (1 - t[1, 2]) * eps[1, 2])


def test_a_step_along_the_true_velocity_stays_on_the_path(drawn):
    z, eps, t = drawn
    later = t + 0.5 * (1 - t)
    step = euler_step(interpolate(z, eps, t), velocity(z, eps), t, later)
    assert torch.allclose(step, interpolate(z, eps, later), rtol=1e-9)


def test_a_step_of_no_length_copies_bit_for_bit_even_if_the_velocity_is_nan(drawn):
    z, eps, t = drawn
    later = t.clone()
    later[:, 2:] += 0.01
    v = velocity(z, eps)
    v[:, :2] = torch.nan
    out = euler_step(z, v, t, later)
    assert torch.equal(out[:, :2], z[:, :2])
    assert out.isfinite().all() and not torch.isclose(out[:, 2:], z[:, 2:]).all()


# --- the other path -------------------------------------------------------------------------------------------------


def test_the_cosine_is_the_one_of_the_literature_and_reaches_both_ends():
    level = torch.arange(1001, dtype=torch.float64)
    alpha_bar = cosine_alpha_bar(level / 1000)
    written = torch.cos((level / 1000 + 0.008) / 1.008 * torch.pi / 2) ** 2
    assert torch.allclose(alpha_bar, written / written[0], rtol=1e-9, atol=1e-15)
    assert alpha_bar[0] == 1 and alpha_bar[-1] == 0 and (alpha_bar.diff() < 0).all()
    assert torch.allclose(1000 * cosine_fraction(alpha_bar), level, atol=1e-6)
    for dtype in (torch.float32, torch.float64):
        ends = level_to_time(torch.tensor([0, 20], dtype=dtype), 20, "ddpm")
        assert ends.dtype == dtype and ends.tolist() == [1.0, 0.0]


def test_two_paths_that_match_in_signal_to_noise_are_one(drawn):
    z, eps, _ = drawn
    level = torch.linspace(1, 49, 15, dtype=torch.float64).reshape(3, 5)
    alpha_bar, t = cosine_alpha_bar(level / 50), level_to_time(level, 50, "ddpm")
    x = alpha_bar.sqrt()[..., None] * z + (1 - alpha_bar).sqrt()[..., None] * eps  # CMDM Eq. 9
    assert torch.allclose(flow_to_ddpm(interpolate(z, eps, t), t), x, rtol=1e-9)
    assert torch.allclose(time_to_alpha_bar(t), alpha_bar, rtol=1e-9)
    assert torch.allclose(alpha_bar_to_time(alpha_bar) / (1 - t), (alpha_bar / (1 - alpha_bar)).sqrt())
    s = alpha_bar.sqrt() + (1 - alpha_bar).sqrt()
    z_t = x / s[..., None]
    assert torch.allclose(velocity_to_noise(z_t, z - eps, t), eps, rtol=1e-9)  # eps = x_flow - t v
    assert not torch.allclose(velocity_to_noise(x, z - eps, t), eps, atol=0.1)  # the trap


@pytest.mark.parametrize("eta", [0.0, 0.4, 1.0])
def test_a_ddim_step_stays_on_the_path_of_the_truth(drawn, eta):
    z, eps, t = drawn
    later, fresh = t + 0.5 * (1 - t), torch.randn_like(z)
    out = ddim_step(interpolate(z, eps, t), velocity(z, eps), t, later, eta, fresh)
    left = (out - later[..., None] * z) / (1 - later[..., None])  # what is not data
    ratio = (t / (1 - t)) / (later / (1 - later))  # how little is known now of what will be
    anew = eta * (1 - ratio**2).sqrt()[..., None]
    assert torch.allclose(left, (1 - anew**2).sqrt() * eps + anew * fresh, rtol=1e-9)  # unit variance, whatever eta


def test_a_full_ddim_step_forgets_noise_that_carries_no_data_and_adds_none_at_the_end(drawn):
    z, eps, t = drawn
    fresh = torch.randn_like(z)
    from_noise = ddim_step(eps, velocity(z, eps), 0.0, t, 1.0, fresh)
    assert torch.allclose(from_noise, interpolate(z, fresh, t), rtol=1e-9)
    assert torch.allclose(ddim_step(interpolate(z, eps, t), velocity(z, eps), t, 1.0, 1.0, fresh), z, rtol=1e-9)


def test_a_ddim_step_of_no_length_copies_bit_for_bit(drawn):
    z, eps, t = drawn
    t[:, 0], t[:, 1] = 0.0, 1.0
    later = t.clone()
    later[:, 3:] += 0.01
    v = velocity(z, eps)
    v[:, :3] = torch.nan
    out = ddim_step(z, v, t, later, 1.0, eps)
    assert torch.equal(out[:, :3], z[:, :3])
    assert out.isfinite().all() and not torch.isclose(out[:, 3:], z[:, 3:]).all()


def test_an_unknown_path_is_refused():
    with pytest.raises(ValueError, match="'flow' or 'ddpm'"):
        level_to_time(torch.tensor(1), 2, "vp")
