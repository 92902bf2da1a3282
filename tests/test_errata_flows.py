"""FloodDiffusion's formulas as printed, and three lines of its released code, beside the right ones, on Gaussians.

Its alpha is our flow time: x = alpha z + beta eps with beta = 1 - alpha, from noise (0) to data (1), so its v = z - eps
and its Euler step are ours too. Data are one number, N(2, 0.7^2), or correlated latents: every mean given x has a
closed form, each step is affine, and nothing is drawn. Who moves when is counted in fractions, where nothing rounds.
"""

from fractions import Fraction
from math import ceil, floor

import numpy as np
import pytest
import torch

from minicmdm.diffusion.gaussian import MASKS, ar1_covariance, bayes_velocity, run_lab, visible
from minicmdm.diffusion.path import data_to_velocity, interpolate, noise_to_velocity, velocity, velocity_to_noise
from minicmdm.diffusion.schedules import cost, schedule_matrix

MEAN, STD = 2.0, 0.7
X = np.linspace(-3, 4, 15)
ALPHAS = np.linspace(0.05, 0.95, 10)
N, N_S, K = 10, 5, 12  # steps per latent, latents in the window, latents


def posterior(x, a, mean=MEAN, std=STD):
    """E[z | x], E[eps | x] and the score of p(x) for z ~ N(mean, std^2)."""
    off = (x - a * mean) / (a**2 * std**2 + (1 - a) ** 2)
    return mean + a * std**2 * off, (1 - a) * off, -off


def best(x, a, **data):
    """E[v | x], what a perfect network says."""
    z, eps, _ = posterior(x, a, **data)
    return z - eps


def lands(alphas, asked=best, dt=1 / N, **data):
    """Mean and deviation after Euler's steps from N(0, 1), asked at these alphas."""
    mean, gain = 0.0, 1.0
    for a in map(float, alphas):
        at_zero, at_one = asked(0.0, a, **data), asked(1.0, a, **data)
        slope = 1 + dt * (at_one - at_zero)
        mean, gain = slope * mean + dt * at_zero, slope * gain
    return mean, abs(gain)


# --- Proposition 3.2 and its conversions ------------------------------------------------------------------------------


def test_eq_61_has_one_minus_too_many():
    """Eq. 61 prints the noise with -1/beta before x, and it is +1/beta: eps = (x - alpha z) / beta."""
    rng = torch.Generator().manual_seed(0)
    z, eps = torch.randn(2, 3, 5, 4, generator=rng, dtype=torch.float64)
    alpha = 0.05 + 0.9 * torch.rand(3, 5, generator=rng, dtype=torch.float64)
    x, a = interpolate(z, eps, alpha), alpha.unsqueeze(-1)
    printed, right = (-a / (1 - a) * z + sign / (1 - a) * x for sign in (-1, 1))
    torch.testing.assert_close(right, eps)
    torch.testing.assert_close(right, velocity_to_noise(x, velocity(z, eps), alpha))
    torch.testing.assert_close(printed, eps - 2 * x / (1 - a))
    for a in ALPHAS:  # and in the mean over z, which is what Eq. 67 makes of it
        mean_z, mean_eps, _ = posterior(X, a)
        assert np.allclose(-a / (1 - a) * mean_z + X / (1 - a), mean_eps)
        assert np.abs(-a / (1 - a) * mean_z - X / (1 - a) - mean_eps).max() > 5


def test_eqs_8_and_60_have_no_velocity_for_a_finished_latent():
    """Eqs 8, 28 and 60 divide by beta, 0/0 where a latent is finished; alpha' z + beta' eps is the same and 0 there."""
    alpha, rate = np.array([1, 0.6, 0.2, 0]), np.array([0.0, 1, 1, 0])  # finished, two on their way, waiting
    z, eps = np.random.default_rng(0).normal(size=(2, 4))
    beta, x = 1 - alpha, alpha * z + (1 - alpha) * eps
    with np.errstate(invalid="ignore"):
        printed = (rate - -rate / beta * alpha) * z + -rate / beta * x
    right = rate * z - rate * eps
    assert np.isnan(printed[0]) and np.allclose(printed[1:], right[1:])
    assert not right[[0, 3]].any()  # as Theorem 3.8 has it
    assert np.array_equal(right[1:3], velocity(torch.tensor(z), torch.tensor(eps)).numpy()[1:3])


def test_eqs_9_and_16_regress_on_a_target_without_bound():
    """Eq. 16's target (Eq. 9) is -eps / beta: even the best score costs ~1/beta^2 of it, and 0/0 when finished; only
    latents on their way, weighted with beta^2, make a loss."""
    with np.errstate(invalid="ignore"):
        assert np.isnan(-(X - 1.0 * X) / np.zeros(1) ** 2).all()  # Eq. 9 at beta = 0, where x is z

    def loss_that_is_left(beta):  # Var(eps | x), and Var(z | x) is its mirror image
        return (1 - beta) ** 2 * STD**2 / ((1 - beta) ** 2 * STD**2 + beta**2)

    beta = 10.0 ** -np.arange(1, 7)
    printed, right = loss_that_is_left(beta) / beta**2, loss_that_is_left(beta)
    assert (printed[1:] / printed[:-1] > 99).all() and (right <= 1).all()
    for cut in (1e-3, 1e-4):  # over the alphas of training, Eq. 16 costs as much as one cares to look
        grid = np.geomspace(cut, 1, 100_001)
        assert np.trapezoid(loss_that_is_left(grid) / grid**2, grid) * cut == pytest.approx(1, rel=0.02)
        assert np.trapezoid(loss_that_is_left(grid), grid) < 0.6
    for a in ALPHAS:  # the weight moves no optimum: mean target = score either way
        _, eps, score = posterior(X, a)
        assert np.allclose(-eps / (1 - a), score)


def test_eq_17_has_no_velocity_where_every_latent_starts():
    """Eq. 17 makes a velocity of the score by dividing by alpha, 0 at a latent's first step; z - eps, or predicted
    data, has one."""

    def printed(s, x, a, rate=1.0):
        a, rate = np.float64(a), np.float64(rate)
        return ((1 - a) ** 2 * rate / a + rate * (1 - a)) * s + rate / a * x

    for a in ALPHAS:
        assert np.allclose(printed(posterior(X, a)[2], X, a), best(X, a))
    z, _, score = posterior(X, 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        assert np.isnan(printed(score, X, 0.0)).all()
        assert np.isnan(printed(score, X, 0.0, rate=0.0)).all()  # and while it waits, where the velocity is 0
    x, z = (torch.tensor(y).reshape(1, -1, 1) for y in (X, z))
    right = data_to_velocity(x, z, 0.0).numpy().ravel()
    assert np.allclose(right, MEAN - X) and np.allclose(right, best(X, 0.0))
    # Just after the start an error of the score comes out beta / alpha times as large, one of the data 1 / beta times.
    error = printed(score + 1e-3, X, 1e-3) - printed(score, X, 1e-3)
    assert np.allclose(error, 1e-3 * 999)


# --- the window -------------------------------------------------------------------------------------------------------


def ceilings(t):
    """Eqs 23 and 24: the first latent that is not finished, and the first that waits."""
    return ceil((t - 1) * N_S), ceil(t * N_S)


def floors(t):
    """The same, for a step that begins at t."""
    return floor((t - 1) * N_S) + 1, floor(t * N_S) + 1


def truncated(t):
    """The released code's first line: int() takes what is below 0 up, not down."""
    return int((t - 1) * N_S) + 1, int(t * N_S) + 1


def alphas(window, steps=N, clock=None):
    """At which alphas each latent is moved by Alg. 2, up to Eq. 22's end; the clock says t of a step."""
    moved = [[] for _ in range(K)]
    for step in range(steps + steps * K // N_S):
        t = Fraction(step, steps)
        first, end = window(clock(step) if clock else t)
        for k in range(max(first, 0), min(end, K)):
            moved[k].append(min(max(t - Fraction(k, N_S), 0), 1))
    return moved


def test_eqs_23_and_24_with_ceilings_are_one_step_late():
    """Eqs 23-24 print ceilings, so each latent misses its step at alpha = 0 and makes one at beta = 0; the window of a
    step from t is m = max(0, floor((t-1) n_s) + 1), n = min(K, floor(t n_s) + 1)."""
    grid = [Fraction(j, N) for j in range(N + 1)]
    assert all(moved == grid[1:] for moved in alphas(ceilings))
    assert all(moved == grid[:-1] for moved in alphas(floors))
    matrix = schedule_matrix(K, N, kind="triangular", overlap=N_S)
    for k in range(K):
        levels = matrix[:-1, k][matrix[1:, k] < matrix[:-1, k]]
        assert [1 - Fraction(int(level), N) for level in levels] == alphas(floors)[k]
    # Noise that is told that it is alpha = 0.1 never gets back on its path; on it, the mean is right to the last bit.
    assert lands(grid[:-1])[0] == pytest.approx(MEAN, abs=1e-12)
    assert abs(lands(grid[1:])[0] - MEAN) > 0.03
    # As numbers of latents they need bounds, and n is where the window ends, not how many it holds.
    assert ceilings(Fraction(0))[0] == -N_S and ceilings(1 + Fraction(K, N_S))[1] == K + N_S
    assert ceilings(Fraction(2)) == (5, 10)


def test_eq_22_goes_on_when_nothing_moves():
    """Eq. 22 ends at T = 1 + K / n_s, and the last latent is clean at 1 + (K - 1) / n_s; one latent in N / n_s steps is
    so only after the first N."""
    end, printed = 1 + Fraction(K - 1, N_S), 1 + Fraction(K, N_S)
    assert min(end - Fraction(k, N_S) for k in range(K)) == 1  # clean at last, and to the moment
    empty = [s for s in range(int(printed * N)) if floors(Fraction(s, N))[0] >= min(K, floors(Fraction(s, N))[1])]
    assert empty == list(range(int(end * N), int(printed * N))) and len(empty) == N // N_S
    price = cost(schedule_matrix(K, N, kind="triangular", overlap=N_S))
    assert price.calls == end * N
    assert (price.calls_to_first, price.calls_per_further) == (N, N // N_S)


def test_int_leaves_the_first_latent_a_fifth_of_its_noise():
    """The released code truncates (t - 1) n_s toward 0, so latent 0 is finished after 8 of its 10 steps: floor it."""
    printed = alphas(truncated, clock=lambda step: step * (1 / N))
    assert [len(moved) for moved in printed] == [8] + [10] * (K - 1)
    assert [len(moved) for moved in alphas(floors)] == [10] * K
    # If data is one point, Euler's steps are exact: what is left is to be read off.
    assert lands(printed[0], std=0.0) == pytest.approx((0.8 * MEAN, 0.2))
    assert lands(alphas(floors)[0], std=0.0) == pytest.approx((MEAN, 0.0), abs=1e-12)


@pytest.mark.parametrize("steps", [50, 100])
def test_a_clock_in_floats_gives_latent_1_a_step_too_many(steps):
    """The released code's t = step * dt rounds (1.2 - 1) * 5 to less than 1: count in integers, as our matrix does."""
    printed = alphas(floors, steps, clock=lambda step: step * (1 / steps))
    assert len(printed[1]) == steps + 1 and printed[1][-1] == 1  # a step of what is clean already
    assert all(len(moved) == steps for moved in alphas(floors, steps))
    moves = np.diff(schedule_matrix(K, steps, kind="triangular", overlap=N_S), axis=0) < 0
    assert (moves.sum(axis=0) == steps).all()


def test_a_velocity_from_noise_over_alpha_plus_dt():
    """The released code's velocity from predicted noise is (x - eps) / (alpha + dt), where (x - eps) / alpha is exact:
    with a perfect network a single point keeps 1.7 % of the noise and N(0, 1) gets the variance 1.118."""

    def released(x, a, **data):
        return (x - posterior(x, a, **data)[1]) / (a + 1 / N)

    grid = np.arange(N) / N
    for a in grid[1:]:
        x, eps = (torch.tensor(y).reshape(1, -1, 1) for y in (X, posterior(X, a)[1]))
        assert np.allclose(noise_to_velocity(x, eps, a).numpy().ravel(), best(X, a))
        assert np.abs(released(X, a) - best(X, a)).max() > 0.1
    assert lands(grid, released, std=0.0)[1] == pytest.approx(0.017, abs=5e-4)
    assert lands(grid, std=0.0) == pytest.approx((MEAN, 0.0), abs=1e-12)
    variances = [lands(grid, asked, mean=0.0, std=1.0)[1] ** 2 for asked in (released, best)]
    assert variances == pytest.approx([1.118, 0.773], abs=5e-4)
    assert lands(grid[1:], mean=0.0, std=1.0)[1] ** 2 == pytest.approx(0.954, abs=5e-4)  # exact, first step left out


# --- Theorem 3.8 and the remarks --------------------------------------------------------------------------------------

FLIGHT = np.array([1, 1, 0.6, 0.2, 0, 0])  # alphas of two finished latents, two on their way, two that wait
LATENTS = np.array([2.0, 1.5, 1.0, 0.5, 0.3, -0.4])


def joint(alpha, rho=0.9):
    """The covariance of z, that of x, and E[z | x] for correlated latents N(0, rho^distance)."""
    data = ar1_covariance(len(alpha), rho)
    noisy = alpha[:, None] * data * alpha + np.diag((1 - alpha) ** 2)
    return data, noisy, data * alpha @ np.linalg.solve(noisy, LATENTS[: len(alpha)])


def test_eq_83_adds_all_latents_to_those_of_the_window():
    """Eq. 83's last term has X_t where the window's part, X_t^2, belongs; with it, it is what Theorem 3.8 says."""
    data, _, mean_z = joint(FLIGHT)
    window, beta = slice(2, 4), 1 - FLIGHT[2:4]
    drift = (1 + FLIGHT[window] / beta) * mean_z[window]
    with pytest.raises(ValueError, match="broadcast"):
        drift - 1 / beta * LATENTS
    right = drift - LATENTS[window] / beta
    for seen in (6, 4):  # and the latents that wait tell nothing
        weights = bayes_velocity(data[:seen, :seen], FLIGHT[:seen], np.ones((seen, seen), bool))
        assert np.allclose((weights @ LATENTS[:seen])[window], right)


def test_remark_b5_the_mean_of_what_waits_does_not_vanish():
    """Remark B.5 has the score of waiting latents -x because E[z | x] = 0; that mean is not 0, alpha before it is."""
    _, noisy, mean_z = joint(FLIGHT)
    score = -np.linalg.solve(noisy, LATENTS)
    assert (np.abs(mean_z[4:]) > 0.3).all() and np.allclose(mean_z[5], 0.9 * mean_z[4])
    assert np.allclose(score[4:], -LATENTS[4:])
    alpha = np.array([1, 1, 0.65, 0.25, 0.05, 0])  # which of the two it is shows as soon as the first of them moves
    _, noisy, mean_z = joint(alpha)
    score, beta = -np.linalg.solve(noisy, LATENTS)[4], 1 - alpha[4]
    assert score == pytest.approx((alpha[4] * mean_z[4] - LATENTS[4]) / beta**2)
    assert score - -LATENTS[4] / beta**2 > 0.01


@pytest.mark.parametrize("data", [dict(mean=0.0, std=1.0), dict(mean=MEAN, std=STD)])
def test_eqs_85_and_86_put_x_for_its_mean_too_early(data):
    """Eqs 85-86 print the score -x / beta as beta goes to 0, with E[z | x] taken for x; their difference is of the
    order of beta^2, which is divided by it, and the score stays finite: that of the data."""
    of_data = -(X - data["mean"]) / data["std"] ** 2
    errors = []
    for beta in (1e-2, 1e-3, 1e-4):
        mean_z, _, score = posterior(X, 1 - beta, **data)
        printed, right = ((1 - beta) * z - X for z in (X, mean_z))
        assert np.allclose(printed / beta**2, -X / beta)  # the step from Eq. 85 to 86 is right
        assert np.allclose(right / beta**2, score, atol=1e-6)
        errors.append((np.abs(printed / beta**2 - score).max(), np.abs(right / beta**2 - of_data).max()))
    (printed, _), *_, (printed_last, right_last) = errors
    assert printed_last > 90 * printed > 1e4 and right_last < 0.02


@pytest.mark.parametrize("overlap, now", [(1, 2.4), (2, 1.7), (5, 1.3)])
def test_remark_310_a_causal_mask_is_biased(overlap, now):
    """Remark 3.10 calls a causal mask suboptimal; it is worse: with latents in flight together its steps do not add up
    to the flow, whatever their size, and only one latent at a time (n_s = 1) is right."""
    alpha = np.clip(now - np.arange(6) / overlap, 0, 1)
    rate = ((alpha > 0) & (alpha < 1)).astype(float)
    data, noisy, _ = joint(alpha)
    growth = rate[:, None] * data * alpha + alpha[:, None] * data * rate - 2 * np.diag((1 - alpha) * rate)
    for mask in MASKS:
        flow = rate[:, None] * bayes_velocity(data, alpha, visible(1 - alpha, alpha == 0, mask))
        error = np.abs(flow @ noisy + noisy @ flow.T - growth).max()  # d/dt of the covariance, less what it must be
        assert error > 0.03 if mask == "causal" and overlap > 1 else error < 1e-12


def test_remark_310_costs_variance_that_smaller_steps_do_not_bring_back():
    """The same, after all steps: bidirectional errors go with the step's size, causal ones stay."""
    data, found = ar1_covariance(8, 0.9), {}
    for mask in ("causal", "bidirectional"):
        found[mask] = [run_lab(data, schedule_matrix(8, k, kind="triangular", overlap=5), mask) for k in (50, 200)]
    coarse, fine = found["bidirectional"]
    assert fine.w2 < 0.2 * coarse.w2 and fine.variance > 0.98
    coarse, fine = found["causal"]
    assert fine.w2 > 0.6 * coarse.w2 and fine.variance < 0.9
