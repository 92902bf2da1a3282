"""The lab: its denoiser by orthogonality, its masks and steps against the model's own, and then what it says."""

import math
from functools import cache

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from minicmdm.diffusion.gaussian import (
    MASKS,
    ar1_covariance,
    bayes_velocity,
    count_evaluations,
    run_lab,
    sample_covariance,
    visible,
    wasserstein2,
)
from minicmdm.diffusion.sampling import sample
from minicmdm.diffusion.schedules import KINDS, literal_matrix, schedule_matrix
from minicmdm.models.dit import self_attention_mask

N, K = 24, 50
SCHEDULES = {  # from no overlap to full overlap: the number of latents in flight
    "1": dict(kind="autoregressive"),
    "2": dict(kind="triangular", overlap=2),
    "5": dict(kind="triangular", overlap=5),
    "25": dict(kind="fss", uncertainty=2),  # the paper's
    "full": dict(kind="full"),
}


@cache
def lab(overlap, mask, block_size=1, rho=0.9, num_steps=K):
    return run_lab(ar1_covariance(N, rho), schedule_matrix(N, num_steps, **SCHEDULES[overlap]), mask, block_size)


def random_covariance(rng, size):
    half = rng.normal(size=(size, size))
    return half @ half.T + 0.1 * np.eye(size)


# --- the parts -------------------------------------------------------------------------------------------------------


def worst_correlation(covariance, t, sees, weights):
    """How far the error of W x is from being uncorrelated with what each row sees; 0 for the best linear guess only."""
    size = len(t)
    joint = np.block([[covariance, np.zeros((size, size))], [np.zeros((size, size)), np.eye(size)]])  # of (z, eps)
    x = np.hstack([np.diag(t), np.diag(1 - t)])
    error = np.hstack([np.eye(size), -np.eye(size)]) - weights @ x  # of v = z - eps
    return np.abs((error @ joint @ x.T)[sees]).max(initial=0)


@given(st.integers(0, 10**6))
@settings(deadline=None, max_examples=50)
def test_no_better_guess_than_the_denoisers(seed):
    rng = np.random.default_rng(seed)
    size = int(rng.integers(1, 7))
    covariance, sees = random_covariance(rng, size), rng.random((size, size)) < 0.6
    t = np.where(rng.random(size) < 0.3, rng.integers(0, 2, size), rng.random(size))  # noise and data are among them
    weights = bayes_velocity(covariance, t, sees)
    assert not weights[~sees].any()  # what is not seen is not used
    assert worst_correlation(covariance, t, sees, weights) < 1e-9
    if sees.any():
        assert worst_correlation(covariance, t, sees, weights + 1e-3 * sees) > 1e-9  # and any other guess is caught


def calls(matrix):
    """What each call of a matrix knows: levels, who waits, who moves."""
    for before, after in zip(matrix, matrix[1:]):
        yield before, after == matrix[0, 0], after < before


@given(st.sampled_from(KINDS), st.integers(1, 9), st.integers(1, 4), st.integers(1, 4))
@settings(deadline=None, max_examples=60)
def test_the_labs_masks_are_the_models(kind, num_latents, num_steps, block_size):
    for levels, waiting, _ in calls(schedule_matrix(num_latents, num_steps, 1, block_size, kind)):
        for mask in MASKS:
            found = visible(levels, waiting, mask, block_size)
            committed, valid = torch.from_numpy(levels == 0)[None], torch.from_numpy(~waiting)[None]
            model = self_attention_mask(num_latents, block_size, mask, valid, committed=committed)[0].numpy()
            assert np.array_equal(found[~waiting], model[~waiting])
            assert not found[waiting].any()


def test_the_window_mask_by_hand():
    sees = visible(np.array([0, 0, 2, 3, 3]), np.array([False, False, False, False, True]), "window")
    assert sees.astype(int).tolist() == [
        [1, 0, 0, 0, 0],  # finished: it and what came before
        [1, 1, 0, 0, 0],
        [1, 1, 1, 1, 0],  # in flight: the finished and each other
        [1, 1, 1, 1, 0],  # about to start
        [0, 0, 0, 0, 0],  # waiting
    ]


def test_latents_that_wait_would_tell_nothing():
    covariance = random_covariance(np.random.default_rng(0), 6)
    for kind in ("fss", "trapezoid"):
        for levels, waiting, moving in calls(schedule_matrix(6, 4, 3, kind=kind)):
            hidden = visible(levels, waiting, "bidirectional") & moving[:, None]
            everything = np.ones((6, 6), dtype=bool) & moving[:, None]
            found = (bayes_velocity(covariance, 1 - levels / 4, sees) for sees in (hidden, everything))
            np.testing.assert_allclose(*found, atol=1e-10)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("mask", ["causal", "bidirectional"])
def test_the_covariance_is_that_of_the_projects_sampler(mask, kind):
    covariance, matrix = random_covariance(np.random.default_rng(1), 5), schedule_matrix(5, 7, 3, kind=kind)

    def denoise(z_t, t):  # (B,n,1), (B,n): least squares, latent by latent
        t, size = t[0].numpy(), t.shape[1]
        x = np.hstack([np.diag(t) @ np.linalg.cholesky(covariance[:size, :size]), np.diag(1 - t)])
        v = np.hstack([np.linalg.cholesky(covariance[:size, :size]), -np.eye(size)])
        weights = np.zeros((size, size))
        for n in range(size):
            seen = n + 1 if mask == "causal" else size
            weights[n, :seen] = np.linalg.lstsq(x[:seen].T, v[n], rcond=None)[0]
        return torch.from_numpy(weights) @ z_t

    units = torch.eye(5, dtype=torch.float64).unsqueeze(-1)  # the sampler is linear: its columns, one per unit of noise
    linear = sample(denoise, matrix, units)[..., 0].numpy().T
    np.testing.assert_allclose(sample_covariance(covariance, matrix, mask), linear @ linear.T, atol=1e-9)


def test_distance_of_gaussians_in_closed_form():
    rng = np.random.default_rng(2)
    a, b = rng.random(4) + 0.1, rng.random(4) + 0.1
    turn = np.linalg.qr(rng.normal(size=(4, 4)))[0]
    commuting = [turn @ np.diag(x) @ turn.T for x in (a, b)]
    assert wasserstein2(*commuting) == pytest.approx(np.square(np.sqrt(a) - np.sqrt(b)).mean(), abs=1e-12)
    c, d = random_covariance(rng, 2), random_covariance(rng, 2)  # these do not commute
    root = math.sqrt(np.trace(c @ d) + 2 * math.sqrt(np.linalg.det(c @ d)))  # the trace of a 2x2 root
    assert wasserstein2(c, d) == pytest.approx((np.trace(c) + np.trace(d) - 2 * root) / 2, abs=1e-10)
    assert wasserstein2(c, c) == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("num_steps, variance", [(10, 0.773), (20, 0.879), (100, 0.975)])
def test_one_latent_loses_what_eulers_steps_lose(num_steps, variance):
    found = run_lab(np.eye(1), schedule_matrix(1, num_steps), "causal")
    slope = math.prod(1 + (2 * t - 1) / (t**2 + (1 - t) ** 2) / num_steps for t in np.arange(num_steps) / num_steps)
    assert found.variance == pytest.approx(slope**2, rel=1e-12)
    assert found.variance == pytest.approx(variance, abs=5e-4)
    assert found.w2 == pytest.approx((1 - slope) ** 2, abs=1e-12) and math.isnan(found.jitter)


# --- what it must show -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mask", ["bidirectional", "window"])
def test_bidirectional_and_window_do_not_depend_on_the_schedule(mask):
    results = [lab(overlap, mask) for overlap in SCHEDULES]
    assert max(r.w2 for r in results) - min(r.w2 for r in results) < 2e-3
    assert all(r.w2 < 2e-3 and 0.93 < r.variance < 1 and 0.92 < r.jitter < 1 for r in results)
    both_ends = run_lab(ar1_covariance(N, 0.9), schedule_matrix(N, K, 10, kind="trapezoid"), mask)
    assert both_ends.w2 < 2e-3  # even from both ends to the middle


@pytest.mark.parametrize("overlap", SCHEDULES)
def test_window_is_bidirectional_at_the_price_of_causal(overlap):
    window, bidirectional, causal = (lab(overlap, mask) for mask in ("window", "bidirectional", "causal"))
    assert window.w2 == pytest.approx(bidirectional.w2, abs=1e-10)
    assert window.evaluations == causal.evaluations <= bidirectional.evaluations
    if overlap in ("1", "2", "5"):
        assert bidirectional.evaluations > 3 * window.evaluations


def test_all_masks_agree_when_autoregressive():
    covariance, matrix = ar1_covariance(N, 0.9), schedule_matrix(N, K, kind="autoregressive")
    causal, *others = (sample_covariance(covariance, matrix, mask) for mask in MASKS)
    for other in others:
        np.testing.assert_allclose(causal, other, atol=1e-8)


def test_causal_bias_grows_with_overlap():
    results = [lab(overlap, "causal") for overlap in SCHEDULES]
    for less, more in zip(results, results[1:]):
        assert more.w2 > 1.5 * less.w2 and more.variance < less.variance and more.jitter > less.jitter
    assert results[-1].w2 > 100 * results[0].w2


@pytest.mark.parametrize(
    "overlap, bidirectional, blocks, causal",  # squared W2, variance, jitter: facts/flooddiffusion.md, 2.2
    [
        ("1", (0.0009, 0.94, 0.94), (0.0009, 0.94, 0.94), (0.0009, 0.94, 0.94)),
        ("2", (0.0008, 0.94, 0.94), (0.0016, 0.92, 0.95), (0.0046, 0.87, 0.97)),
        ("5", (0.0007, 0.95, 0.93), (0.0063, 0.88, 1.03), (0.0261, 0.75, 1.21)),
        ("25", (0.0009, 0.94, 0.93), (0.0342, 0.81, 1.29), (0.0723, 0.67, 1.78)),
        ("full", (0.0012, 0.93, 0.93), (0.0777, 0.77, 1.47), (0.1183, 0.65, 2.09)),
    ],
)
def test_the_table_of_an_independent_trial(overlap, bidirectional, blocks, causal):
    for expected, how in ((bidirectional, ("bidirectional",)), (blocks, ("causal", 3)), (causal, ("causal",))):
        found = lab(overlap, *how)
        assert (found.w2, found.variance, found.jitter) == pytest.approx(expected, abs=6e-3)
        assert found.w2 == pytest.approx(expected[0], abs=6e-5)


def test_smaller_steps_mend_everything_but_the_causal_mask():
    for mask in ("bidirectional", "window"):
        assert lab("5", mask, num_steps=100).w2 < 0.3 * lab("5", mask).w2
    assert lab("5", "causal", num_steps=100).w2 > 0.85 * lab("5", "causal").w2


def test_blocks_cut_the_bias_and_blocks_in_turn_have_none():
    for overlap in ("2", "5", "25", "full"):
        assert lab(overlap, "bidirectional").w2 < lab(overlap, "causal", 3).w2 < 0.7 * lab(overlap, "causal").w2
    covariance, matrix = ar1_covariance(N, 0.9), schedule_matrix(N, K, block_size=3, kind="autoregressive")
    found = [sample_covariance(covariance, matrix, mask, 3) for mask in ("causal", "bidirectional")]
    np.testing.assert_allclose(*found, atol=1e-8)
    assert run_lab(covariance, matrix, "causal", 1).w2 > 2 * run_lab(covariance, matrix, "causal", 3).w2


def test_it_is_correlation_that_causal_masks_get_wrong():
    biases = [lab("5", "causal", rho=rho).w2 - lab("5", "bidirectional", rho=rho).w2 for rho in (0.0, 0.5, 0.9)]
    assert abs(biases[0]) < 1e-12 and biases[0] + 1e-3 < biases[1] < 0.5 * biases[2]


def test_with_little_data_a_causal_mask_can_win():
    truth, errors = ar1_covariance(N, 0.5), []
    for seed in range(3):
        z = np.random.default_rng(seed).normal(size=(60, N)) @ np.linalg.cholesky(truth).T
        believed = z.T @ z / len(z)
        masks = (("bidirectional", 1), ("causal", 1), ("causal", 3))
        errors.append([run_lab(truth, schedule_matrix(N, K, 1), *mask, believed).w2 for mask in masks])
    bidirectional, _, blocks = np.mean(errors, axis=0)
    assert blocks < 0.9 * bidirectional  # of believing what is not so
    assert bidirectional > 10 * lab("full", "bidirectional", rho=0.5).w2


def test_the_literal_reading_of_eq_13_takes_too_few_steps():
    for mask in ("causal", "bidirectional"):
        coarse, fine = literal_matrix(N, K, 10), schedule_matrix(N, K, 10)
        found = [run_lab(ar1_covariance(N, 0.9), matrix, mask).w2 for matrix in (coarse, fine)]
        assert found[0] > 3 * found[1]


# --- what it costs ---------------------------------------------------------------------------------------------------


@given(st.integers(1, 12), st.integers(1, 6), st.data())
@settings(deadline=None)
def test_evaluations_in_closed_form(num_latents, num_steps, data):
    later = data.draw(st.integers(0, num_steps))
    matrix = schedule_matrix(num_latents, num_steps, later)
    last = min(num_latents, 1) if later else num_latents  # finished by the last call: nobody needs their keys
    cached = num_latents * num_steps + num_latents - last
    assert count_evaluations(matrix, "causal") == count_evaluations(matrix, "window") == cached
    dense = sum(num_steps + later * n for n in range(num_latents))  # from its start, each to the end of all
    assert count_evaluations(matrix, "bidirectional") == dense


def test_blocks_are_final_together_and_the_trapezoid_waits_for_its_middle():
    # Latents of one block at different levels: 0 and 1 are final after call 3 (from row 3 on), 2 and 3 never.
    matrix = np.array([[2, 2, 2, 2], [1, 2, 2, 2], [0, 1, 2, 2], [0, 0, 1, 2], [0, 0, 0, 1], [0, 0, 0, 0]])
    assert count_evaluations(matrix, "causal", 2) == 1 + 2 + 3 + 4 + 2
    assert count_evaluations(matrix, "causal", 1) == count_evaluations(matrix, "window", 2) == 4 * 2 + 3
    matrix = schedule_matrix(3, 2, 2, kind="trapezoid")  # 222 121 020 010 000: the last latent is never final
    assert count_evaluations(matrix, "window") == 2 + 2 + 3 + 2


# --- errors ----------------------------------------------------------------------------------------------------------


def test_errors_teach():
    matrix = schedule_matrix(4, 5)
    with pytest.raises(ValueError, match="causal, bidirectional, window"):
        run_lab(np.eye(4), matrix, "diagonal")
    with pytest.raises(ValueError, match="4 latents"):
        run_lab(np.eye(3), matrix, "causal")
    with pytest.raises(ValueError, match="symmetric"):
        run_lab(np.triu(np.ones((4, 4))), matrix, "causal")
    with pytest.raises(ValueError, match="positive definite"):
        run_lab(np.ones((4, 4)), matrix, "causal")
    with pytest.raises(ValueError, match="positive definite"):
        run_lab(np.eye(4), matrix, "causal", believed=np.ones((4, 4)))
    with pytest.raises(ValueError, match="between -1 and 1"):
        ar1_covariance(4, 1.0)
    with pytest.raises(ValueError, match="end clean"):
        run_lab(np.eye(4), matrix[:3], "causal")
