"""Steps as papers print them, beside the right ones, with the best predictor there is: who misses has a wrong formula.

Data is one number, N(2, 0.7^2), so E[eps | x] and E[v | x] are known, each step is affine, and mean and variance can be
followed without sampling error. 50 steps of the cosine schedule with beta <= 0.999, which MARDM's code uses.
"""

import numpy as np
import pytest
import torch

from minicmdm.diffusion.path import alpha_bar_to_time, ddim_step, euler_step
from minicmdm.diffusion.schedules import schedule_matrix

MEAN, STD, K = 2.0, 0.7, 50


def cosine(num_steps):
    """abar for k = 0..K and alpha for k = 1..K (alpha[0] is 1, as nothing comes before level 0)."""
    f = np.cos((np.arange(num_steps + 1) / num_steps + 0.008) / 1.008 * np.pi / 2) ** 2
    alpha = np.concatenate([[1.0], np.maximum(f[1:] / f[:-1], 1 - 0.999)])
    return np.cumprod(alpha), alpha


ABAR, ALPHA = cosine(K)


def predict_noise(x, k):
    """E[eps | x_k] on x_k = sqrt(abar) z + sqrt(1 - abar) eps: the trained network of our dreams."""
    signal, noise = np.sqrt(ABAR[k]), np.sqrt(1 - ABAR[k])
    return noise * (x - signal * MEAN) / (signal**2 * STD**2 + noise**2)


def predict_data(x, k):
    return (x - np.sqrt(1 - ABAR[k]) * predict_noise(x, k)) / np.sqrt(ABAR[k])


def lands(step, levels=range(K, 0, -1)):
    """Mean and deviation after all steps from N(0, 1); step(x, k) -> (mean of x_{k-1}, deviation of its new noise)."""
    mean, variance = 0.0, 1.0
    for k in levels:
        (at_zero, at_one), (_, added) = (step(x, k)[0] for x in (0.0, 1.0)), step(0.0, k)
        slope = at_one - at_zero
        mean, variance = at_zero + slope * mean, slope**2 * variance + added**2
    return mean, np.sqrt(variance)


def small_beta(k):
    """The posterior's variance, (1 - abar_{k-1}) / (1 - abar_k) beta_k: 0 at the last step."""
    return (1 - ABAR[k - 1]) / (1 - ABAR[k]) * (1 - ALPHA[k])


def large_beta(k):
    """The other choice of Ho et al., with nothing added at the last step."""
    return 1 - ALPHA[k] if k > 1 else 0.0


def ancestral(x, k, factor=lambda k: (1 - ALPHA[k]) / np.sqrt(1 - ABAR[k]), sigma=small_beta):
    """CMDM Alg. 2's update, which is Ho et al.'s and right. MARDM Eq. 18 and CDAMD Eq. 4 print another factor."""
    return (x - factor(k) * predict_noise(x, k)) / np.sqrt(ALPHA[k]), np.sqrt(sigma(k))


def from_data(x, k, kept=lambda k: np.sqrt(ALPHA[k]), sigma=small_beta):
    """The same step by way of predicted data (MARDM Eq. 2, mended)."""
    old = kept(k) * (1 - ABAR[k - 1]) / (1 - ABAR[k])
    return old * x + np.sqrt(ABAR[k - 1]) * (1 - ALPHA[k]) / (1 - ABAR[k]) * predict_data(x, k), np.sqrt(sigma(k))


def is_right(landed):
    mean, std = landed
    return abs(mean - MEAN) < 0.02 and abs(std / STD - 1) < 0.06


def test_the_right_steps_land_and_leave_a_little_too_little_variance():
    for step in (ancestral, from_data):
        assert is_right(lands(step)) and np.allclose(lands(step), (2.0, 0.663), atol=1e-3)
    large = lands(lambda x, k: ancestral(x, k, sigma=large_beta))
    assert is_right(large) and np.allclose(large, (2.0, 0.705), atol=1e-3)


def test_our_ddpm_step_is_the_right_one():
    x = np.linspace(-3, 3, 7)
    for k in range(K, 0, -1):
        t_from, t_to = (alpha_bar_to_time(torch.tensor(ABAR[j])) for j in (k, k - 1))
        s, s_to = (np.sqrt(ABAR[j]) + np.sqrt(1 - ABAR[j]) for j in (k, k - 1))
        eps = predict_noise(x, k)
        z_t, v = (torch.tensor(y).reshape(7, 1, 1) for y in (x / s, predict_data(x, k) - eps))
        fresh = torch.linspace(-1, 1, 7).double().reshape(7, 1, 1)
        ours = s_to * ddim_step(z_t, v, t_from, t_to, eta=1.0, fresh=fresh).numpy().ravel()
        mean, added = ancestral(x, k)
        assert np.allclose(ours, mean + added * fresh.numpy().ravel(), rtol=1e-6, atol=1e-6)
        assert np.allclose(mean, from_data(x, k)[0], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("sigma, std", [(small_beta, 0.113), (large_beta, 0.145)])
def test_mardm_18_and_cdamd_4_lose_the_variance(sigma, std):
    """Printed sqrt(1 - alpha_t) / sqrt(1 - abar_t) takes away more noise than a step has: 1 - alpha_t needs no root."""
    printed = lands(lambda x, k: ancestral(x, k, lambda k: np.sqrt(1 - ALPHA[k]) / np.sqrt(1 - ABAR[k]), sigma))
    assert np.allclose(printed, (2.0, std), atol=1e-3) and not is_right(printed)


def test_mardm_2_misses_the_mean():
    """Printed sqrt(abar_t) in front of x_t: it should be sqrt(alpha_t)."""
    printed = lands(lambda x, k: from_data(x, k, kept=lambda k: np.sqrt(ABAR[k])))
    assert np.isclose(printed[0], 0.88, atol=0.01) and not is_right(printed)


def test_mardm_2_adds_too_much_noise():
    """Printed sqrt(1 - abar_t) eps: that is all the noise x_t had. A step may put back the posterior's share only."""
    printed = lands(lambda x, k: from_data(x, k, sigma=lambda k: 1 - ABAR[k]))
    assert np.allclose(printed, (2.0, 1.82), atol=0.01) and not is_right(printed)


@pytest.mark.parametrize("sign, landed", [(1, (-2.0, 1.45)), (-1, (2.0, 0.68))])
def test_mardm_19_and_cdamd_5_go_the_wrong_way(sign, landed):
    """With x_t = (1 - t) x_0 + t eps (MARDM Eq. 9) and v = eps - x_0, a step to less noise is x - dt v."""

    def step(x, k):
        t = k / K
        gain = (t - (1 - t) * STD**2) / ((1 - t) ** 2 * STD**2 + t**2)  # Cov(v, x) / Var(x)
        return x + sign / K * (gain * (x - (1 - t) * MEAN) - MEAN), 0.0

    assert np.allclose(lands(step), landed, atol=0.01) and is_right(lands(step)) == (sign == -1)


def test_our_sign_is_plus_because_our_clock_runs_the_other_way():
    """t = 0 is noise here, so v = z - eps points to the data. Same numbers as the mended Eq. 19."""

    def step(x, k):
        t = 1 - k / K
        gain = (t * STD**2 - (1 - t)) / (t**2 * STD**2 + (1 - t) ** 2)
        v = torch.tensor(MEAN + gain * (x - t * MEAN), dtype=torch.float64).reshape(1, 1, 1)
        return euler_step(torch.full_like(v, x), v, t, t + 1 / K).item(), 0.0

    assert np.allclose(lands(step), (2.0, 0.68), atol=0.01)


# --- CMDM Alg. 2: the formula is right, the loop around it is not -----------------------------------------------------


def test_cmdm_algorithm_2_read_literally_breaks_what_is_finished():
    """Every row of the matrix steps every latent from K_{m,t} to one less, also those that are at 0 and stay there."""
    matrix = schedule_matrix(3, K, 2)
    first = matrix[:-1, 0]  # the levels at which the first latent stands when a row's call is made
    assert is_right(lands(ancestral, first[first > 0]))  # stepping only who moves
    with np.errstate(invalid="ignore", divide="ignore"):
        finished = lands(ancestral, first)  # 1 - abar_0 = 0: the step divides nothing by nothing
    assert not np.isfinite(finished).all()


def test_cmdm_algorithm_2_takes_waiting_latents_off_their_level():
    """Latents that wait would be stepped K -> K-1 at each row, and be told that they are still at K."""
    waiting = lands(ancestral, [K] * 4)
    once = lands(ancestral, [K])
    noise = lands(ancestral, [])
    assert noise == (0.0, 1.0)
    # They forget most of what they were at each step, so little harm is done, for nothing in return.
    for mean, std in (waiting, once):
        assert 0.02 < mean / MEAN < 0.05 and abs(std - 1) < 0.02


def test_cmdm_algorithm_2_needs_the_alphas_of_its_own_50_steps():
    """The paper trains on 1000 levels and samples 50 of them: alpha_k must be the ratio of two abars that are 20 levels
    apart. With the 1000 levels' own alpha_k the latent is still mostly noise after 50 steps."""
    abar, alpha = cosine(1000)

    def step(x, k):
        j = 20 * k
        eps = np.sqrt(1 - abar[j]) * (x - np.sqrt(abar[j]) * MEAN) / (abar[j] * STD**2 + 1 - abar[j])
        mean = (x - (1 - alpha[j]) / np.sqrt(1 - abar[j]) * eps) / np.sqrt(alpha[j])
        return mean, np.sqrt((1 - abar[j - 1]) / (1 - abar[j]) * (1 - alpha[j]))

    mean, std = lands(step)
    assert mean < 0.3 and std > 0.9
