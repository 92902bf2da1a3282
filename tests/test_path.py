"""The time convention: t = 0 noise, t = 1 data, and conversions that undo each other."""

import pytest
import torch

from minicmdm.diffusion.path import (
    data_to_velocity,
    euler_step,
    interpolate,
    level_to_time,
    noise_to_velocity,
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
