"""What else MARDM, CDAMD and CMDM print, in formulas and in words, beside what is right, computed and not sampled.

The steps of MARDM Eqs 2, 18, 19 and CDAMD Eqs 4, 5 and CMDM's Alg. 2 are in test_errata.py, FloodDiffusion in
test_errata_flows.py. MARDM and CDAMD count time the other way: x_t = (1 - t) x_0 + t eps, from data (0) to noise (1).
"""

from fractions import Fraction

import numpy as np
import pytest
import torch

from minicmdm.diffusion.gaussian import ar1_covariance, bayes_velocity, run_lab, sample_covariance
from minicmdm.diffusion.path import cosine_alpha_bar, noise_to_velocity
from minicmdm.diffusion.schedules import literal_matrix, schedule_matrix
from minicmdm.evaluation.metrics import mpjpe
from minicmdm.models.layers import Attention

MEAN, STD = 2.0, 0.7

# --- MARDM: the error of predicted noise, in terms of data ------------------------------------------------------------


@pytest.mark.parametrize("k, ratio", [(6, 0.0407), (21, 0.620), (41, 12.05)])  # steps 5, 20, 40 counted from 0
def test_mardm_4_squares_a_factor_that_is_squared_already(k, ratio):
    """Eq. 4 prints ((1 - abar) / abar)^2 between the squared errors of noise and data; Eq. 23 is right, unsquared."""
    abar = cosine_alpha_bar(torch.tensor(k / 50, dtype=torch.float64)).item()
    # The best predictor's squared errors, Var(eps | x) and Var(x_0 | x), from the covariances with x.
    of_x = abar * STD**2 + 1 - abar
    of_noise = 1 - (1 - abar) / of_x
    of_data = STD**2 - abar * STD**4 / of_x
    right = (1 - abar) / abar
    assert right == pytest.approx(ratio, rel=2e-3) and of_data == pytest.approx(right * of_noise)
    assert abs(right**2 * of_noise / of_data - 1) > 0.3


@pytest.mark.parametrize("phi", [0.2, 3.0, 25.0])
def test_mardm_5_a_squared_error_scales_with_the_square(phi):
    """Eq. 5 multiplies the squared error by phi when data and prediction are, and leaves the other side alone: phi^2
    belongs on both."""
    abar, (x_0, eps, off) = 0.4, np.random.default_rng(0).normal(size=(3, 50))
    x_t = np.sqrt(abar) * x_0 + np.sqrt(1 - abar) * eps
    predicted = (x_t - np.sqrt(1 - abar) * (eps + off)) / np.sqrt(abar)
    of_data, of_noise, scaled = (np.sum(e**2) for e in (predicted - x_0, off, phi * predicted - phi * x_0))
    right = phi**2 * (1 - abar) / abar * of_noise
    assert scaled == pytest.approx(phi**2 * of_data) and scaled == pytest.approx(right)
    assert scaled != pytest.approx(phi * of_data, rel=0.1)
    assert phi * of_data != pytest.approx((1 - abar) / abar * of_noise, rel=0.1)  # Eq. 5's two sides


# --- MARDM: the factorisations ----------------------------------------------------------------------------------------

JOINT = np.random.default_rng(0).dirichlet(np.ones(27), size=2).reshape(2, 3, 3, 3)  # p(x^1, x^2, x^3 | c), two texts c
NO_TEXT = JOINT.mean(axis=0, keepdims=True)  # the same with c left out


def p(table, new, given=()):
    """p(x^new | x^given) of a table, shaped to multiply."""

    def over(kept):
        return table.sum(axis=tuple({1, 2, 3} - set(kept)), keepdims=True)

    return over((*new, *given)) / over(given)


def is_the_joint(product):
    return np.allclose(product, JOINT, rtol=1e-12)


def test_mardm_12_counts_the_first_latent_twice_and_forgets_the_text():
    """Eq. 12's product runs from i = 1 without c: it starts at 2, and every factor is given c."""
    right = p(JOINT, (1,)) * p(JOINT, (2,), (1,)) * p(JOINT, (3,), (1, 2))
    chain = p(NO_TEXT, (2,), (1,)) * p(NO_TEXT, (3,), (1, 2))
    printed = p(JOINT, (1,)) * p(NO_TEXT, (1,)) * chain
    assert is_the_joint(right)
    assert (printed.sum(axis=(1, 2, 3)) < 0.6).all()  # no distribution at all
    begun_at_2 = p(JOINT, (1,)) * chain
    assert np.allclose(begun_at_2.sum(axis=(1, 2, 3)), 1) and not is_the_joint(begun_at_2)  # one, of another thing


def test_mardm_13_multiplies_one_factor_with_itself():
    """Eq. 13 prints p(m | c) prod_j p(m | um), where j is in no factor: each step k fills in its own m_k, given all
    that is filled in and c."""
    first, then = (2,), (1, 3)  # two steps in an order of their own, the second for two latents at once
    right = p(JOINT, first) * p(JOINT, then, first)
    printed = p(JOINT, then) * p(NO_TEXT, then, first) ** 2
    kindly = p(JOINT, first) * p(NO_TEXT, first) * p(NO_TEXT, then, first)  # with an index, from 1 as in Eq. 12
    assert is_the_joint(right)
    for product in (printed, kindly):
        assert np.abs(product.sum(axis=(1, 2, 3)) - 1).min() > 0.3 and not is_the_joint(product)


# --- MARDM and CDAMD: the flow ----------------------------------------------------------------------------------------


def moments(t):
    """Var(x_t), Cov(x_0, x_t) and Cov(v, x_t) of x_t = (1 - t) x_0 + t eps and v = eps - x_0."""
    return (1 - t) ** 2 * STD**2 + t**2, (1 - t) * STD**2, t - (1 - t) * STD**2


def test_mardm_17_and_cdamd_3_integrate_past_the_end_of_the_path():
    """Both integrate the velocity's loss from 0 to T, and the path (Eq. 9) ends at t = 1: from there on it would come
    back from the noise, upside down."""
    variance, with_data, _ = moments(1.0)
    assert (variance, with_data) == (1, 0)  # the noise that sampling starts from
    variance, with_data, _ = moments(50.0)  # T of its DDPM
    assert variance > 3000 and with_data / np.sqrt(variance * STD**2) < -0.5

    def loss_that_is_left(start, end):  # the integral of Var(v | x_t)
        t = np.linspace(start, end, 400_001)
        variance, _, with_v = moments(t)
        return np.trapezoid(1 + STD**2 - with_v**2 / variance, t)

    right, beyond = loss_that_is_left(0, 1), loss_that_is_left(1, 50)
    assert right == pytest.approx(STD * np.pi / 2, rel=1e-6)
    assert beyond == pytest.approx(STD * np.arctan(49 / 50 * STD), rel=1e-3) and beyond > 0.3 * right


def test_cdamd_2_and_3_are_two_names_of_one_target():
    """Section III-A adds a loss of coordinates (Eq. 2) to one of velocities (Eq. 3); they are noise and flow of one
    latent, and the mean of one says that of the other: MARDM takes either."""
    x = np.linspace(-3, 4, 15)
    for t in np.linspace(0.1, 0.9, 9):
        variance, _, with_v = moments(t)
        off = x - (1 - t) * MEAN
        mean_eps, mean_v = t / variance * off, with_v / variance * off - MEAN
        ours = (torch.tensor(y).reshape(1, -1, 1) for y in (x, mean_eps))
        assert np.allclose(-noise_to_velocity(*ours, 1 - t).numpy().ravel(), mean_v)  # our clock runs the other way


# --- CDAMD: masks, shares, widths -------------------------------------------------------------------------------------


def constrained(known, reading):
    """Who (row) sees whom (column) in CDAMD's self-attention, known (N,) bool: "printed" in Eq. 11, or "said"."""
    past = np.tri(len(known), dtype=bool)
    if reading == "printed":
        return past & (known | past)
    return np.where(known[:, None], known, past | known)


def filled_in(covariance, known, sees):
    """The exact covariance when each unknown latent, left to right, is drawn from p(z_n | what its row sees)."""
    drawn, ready = np.where(known[:, None] & known, covariance, 0.0), known.copy()
    for n in np.flatnonzero(~known):
        seen = np.flatnonzero(sees[n] & ready)
        weights = np.linalg.solve(covariance[np.ix_(seen, seen)], covariance[seen, n])
        drawn[n] = drawn[:, n] = drawn[:, seen] @ weights
        drawn[n, n] = weights @ drawn[seen, n] + covariance[n, n] - weights @ covariance[seen, n]
        ready[n] = True
    return drawn


def test_cdamd_11_and_13_intersect_a_mask_with_a_larger_one():
    """Eq. 11 intersects j <= i with (known or j <= i), which leaves j <= i, and Eq. 13 inherits it; the text wants
    known latents seen by all and seeing only one another."""
    data = ar1_covariance(8, 0.9)
    for bits in range(2**8):
        known = np.array([bits >> n & 1 for n in range(8)], dtype=bool)
        printed, said = (constrained(known, reading) for reading in ("printed", "said"))
        assert np.array_equal(printed, np.tri(8, dtype=bool))
        assert said[:, known].all() and not said[np.ix_(known, ~known)].any()
        assert np.array_equal(said[np.ix_(~known, ~known)], np.tri((~known).sum(), dtype=bool))
        assert np.allclose(filled_in(data, known, said), data)
    # With the second half given, what is drawn under Eq. 11 knows nothing of it, and the seam is a jump.
    known = np.arange(8) >= 4
    seam = [
        float(np.diff(np.diff(filled_in(data, known, constrained(known, reading))[3:5, 3:5], axis=0), axis=1)[0, 0])
        for reading in ("printed", "said")
    ]
    assert seam == pytest.approx([2, 2 * (1 - 0.9)])  # the energy of the step from latent 3 to 4
    # With the first half given there is nothing to see ahead, and causal is enough.
    assert np.allclose(filled_in(data, ~known, constrained(~known, "printed")), data)


def test_cdamds_10_and_88_per_cent_are_taken_one_after_the_other():
    """Section IV-B2 replaces masked latents by noise (10 %) or [MASK] (88 %); 88 % is of what noise has left, so the
    shares are 10, 79.2 and 10.8 % kept clean, and not 2."""
    noise, mask = Fraction(10, 100), Fraction(88, 100)
    right = (noise, (1 - noise) * mask, (1 - noise) * (1 - mask))
    assert [float(100 * share) for share in right] == [10, 79.2, 10.8] and sum(right) == 1
    # Two draws per latent on a grid of all their outcomes, the second looked at where the first said no.
    outcomes = [("noise" if a < 10 else "mask" if b < 88 else "kept") for a in range(100) for b in range(100)]
    assert [Fraction(outcomes.count(name), 10_000) for name in ("noise", "mask", "kept")] == list(right)
    assert 1 - noise - mask == Fraction(2, 100)  # what the two printed shares would keep


def test_cdamds_six_heads_do_not_divide_its_width():
    """Section V-A2 prints width 1024 and 6 heads, 170 2/3 numbers each; the released run has 512 and 8."""
    with pytest.raises(ValueError, match="1024 and 6"):
        Attention(1024, 6)
    assert Attention(512, 8).heads == 8


# --- CMDM: the schedule -----------------------------------------------------------------------------------------------


def test_cmdm_13_read_to_the_letter_takes_steps_of_l():
    """Eq. 13 prints rows K, K-L, K-2L; L is how many unit steps lie between neighbours, not the size of a step, or
    autoregressive sampling (L = K) would be one step from noise to the mean."""
    data = ar1_covariance(6, 0.9)
    assert np.allclose(sample_covariance(data, literal_matrix(6, 50, 50), "causal"), 0, atol=1e-12)
    assert run_lab(data, schedule_matrix(6, 50, 50), "causal").w2 < 2e-3
    for matrix, steps in ((literal_matrix(6, 50, 2), 25), (schedule_matrix(6, 50, 2), 50)):
        moves = matrix[1:] < matrix[:-1]
        assert (moves.sum(axis=0) == steps).all()  # of the K = 50 that Section 4.1 gives each latent
    literal, right = (of(6, 50, 10) for of in (literal_matrix, schedule_matrix))
    assert run_lab(data, literal, "bidirectional").w2 > 10 * run_lab(data, right, "bidirectional").w2


def excess(data, levels, n):
    """By how much a guess of latent n's velocity that takes the past for clean misses the best one, squared."""
    t = 1 - levels / 50
    told = np.where(np.arange(len(t)) < n, 1.0, t)
    right, printed = (bayes_velocity(data, times, np.tri(len(t), dtype=bool))[n] for times in (t, told))
    noisy = t[:, None] * data * t + np.diag((1 - t) ** 2)
    return (printed - right) @ noisy @ (printed - right)


def test_cmdm_12_is_only_true_of_autoregressive_sampling():
    """Eq. 12 gives every step a clean past, z^0_{<t}; under FSS the past is noisy and its own levels must be told."""
    data, K = ar1_covariance(4, 0.9), 50
    one_by_one, fss = schedule_matrix(4, K, K), schedule_matrix(4, K, 2)
    for n in range(1, 4):
        for matrix, is_clean in ((one_by_one, True), (fss, False)):
            moving = matrix[:-1][matrix[1:, n] < matrix[:-1, n]]  # the rows whose calls move latent n
            assert (not moving[:, :n].any()) == is_clean
        assert all(excess(data, row, n) < 1e-12 for row in one_by_one[:-1] if 0 < row[n] < K)
        assert excess(data, fss[fss[:, n] == K // 2][0], n) > 0.05


# --- units and tables -------------------------------------------------------------------------------------------------


def test_cmdm_tables_8_and_9_are_in_metres():
    """Both say that 0.012 is in millimetres; joints are in metres, so is their distance, and 0.012 of them is 12 mm."""
    joints = np.random.default_rng(0).normal(size=(5, 22, 3))
    error = mpjpe(joints, joints + [0.012, 0, 0], root_align=False)
    assert error == pytest.approx(0.012) and error * 1000 == pytest.approx(12)
    # MARDM's Table A1, in millimetres: a VAE and its own autoencoder. 12 is of their kind, a thousandth of it is not.
    assert 1.0 < error * 1000 < 13.7 and error < 1.0 / 80


def test_sentences_that_their_own_tables_contradict():
    """FloodDiffusion 4.1 calls its peak jerk the closest to real motion (Table 1: the farthest), CMDM smaller L
    smoother (Table 4: L = 5 is smoothest, more than its own 2), and CDAMD's Table III has FID better when larger."""
    jerk = {"PRIMAL": 1.304, "MotionStreamer": 0.912, "FloodDiffusion": 0.713}
    assert sorted(jerk, key=lambda name: abs(jerk[name] - 1.100)) == ["MotionStreamer", "PRIMAL", "FloodDiffusion"]
    area_under_jerk = {1: 0.43, 2: 0.42, 5: 0.38, 10: 0.45, 50: 0.48}
    assert min(area_under_jerk, key=area_under_jerk.get) == 5
    suffix = {"BAMM": 0.201, "MARDM": 0.138, "CDAMD": 0.090}  # where the text has CDAMD ahead
    assert max(suffix, key=suffix.get) == "BAMM" and min(suffix, key=suffix.get) == "CDAMD"
