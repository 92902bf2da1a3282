"""Scheduling matrices: invariant 4 over random arguments, closed forms, a slow reference and the errors."""

import itertools
import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from minicmdm.diffusion.schedules import (
    KINDS,
    check_matrix,
    closed_form_cost,
    cost,
    literal_matrix,
    schedule_matrix,
)


@st.composite
def arguments(draw):
    num_steps = draw(st.integers(1, 25))
    return dict(
        num_latents=draw(st.integers(1, 30)),
        num_steps=num_steps,
        uncertainty=draw(st.integers(0, num_steps)),
        block_size=draw(st.integers(1, 6)),
    )


@st.composite
def any_kind(draw):
    args = draw(arguments()) | dict(kind=draw(st.sampled_from(KINDS)))
    if args["kind"] == "triangular":
        args["overlap"] = draw(st.none() | st.integers(1, args["num_steps"]))
    return args


def slow_matrix(waits, num_steps):
    """Walk step by step: a latent moves once its wait is over, one level per step, until it is clean."""
    levels, rows, step = [num_steps] * len(waits), [[num_steps] * len(waits)], 0
    while any(levels):
        for n, wait in enumerate(waits):
            if step >= wait and levels[n] > 0:
                levels[n] -= 1
        step += 1
        rows.append(list(levels))
    return np.array(rows)


@given(any_kind())
@settings(deadline=None)
def test_invariants_of_every_kind(args):
    matrix = schedule_matrix(**args)
    K, N, b = args["num_steps"], args["num_latents"], args["block_size"]
    assert matrix.dtype == np.int64 and matrix.shape[1] == N
    assert (matrix[0] == K).all() and (matrix[-1] == 0).all() and matrix[-2].any()
    assert set(np.diff(matrix, axis=0).ravel().tolist()) <= {0, -1}  # never rises, never jumps
    assert (np.diff(matrix, axis=0).min(axis=1) == -1).all()  # no call for nothing
    assert all((matrix[:, n] == matrix[:, n // b * b]).all() for n in range(N))  # a block shares its level
    assert check_matrix(matrix) is not None


@given(arguments())
@settings(deadline=None)
def test_fss_is_its_slow_walk(args):
    matrix = schedule_matrix(**args)
    K, L, N, b = args["num_steps"], args["uncertainty"], args["num_latents"], args["block_size"]
    assert len(matrix) == K + L * (math.ceil(N / b) - 1) + 1
    assert np.array_equal(matrix, slow_matrix([L * (n // b) for n in range(N)], K))


@given(any_kind())
@settings(deadline=None)
def test_the_closed_form_is_what_the_matrix_costs(args):
    assert closed_form_cost(**args) == cost(schedule_matrix(**args))


@pytest.mark.parametrize("kind", KINDS)
def test_the_closed_form_in_every_small_case(kind):  # broken blocks and lone middles are too rare to be drawn
    for N, K, b in itertools.product(range(1, 10), range(1, 5), range(1, 4)):
        for L in range(K + 1):
            assert closed_form_cost(N, K, L, b, kind) == cost(schedule_matrix(N, K, L, b, kind))


@given(arguments())
@settings(deadline=None)
def test_cost_of_fss_in_words(args):
    K, L, N, b = args["num_steps"], args["uncertainty"], args["num_latents"], args["block_size"]
    blocks = math.ceil(N / b)
    counted = cost(schedule_matrix(**args))
    assert counted.rows == counted.calls + 1 == K + L * (blocks - 1) + 1
    assert counted.latents_in_flight == (min(N, b * math.ceil(K / L)) if L else N)
    assert counted.calls_to_first == K
    assert counted.calls_per_further == (L if blocks > 1 else 0)


@given(arguments())
@settings(deadline=None)
def test_the_named_ends_of_the_family(args):
    K, N, b = args["num_steps"], args["num_latents"], args["block_size"]
    full = schedule_matrix(**args, kind="full")
    assert np.array_equal(full, schedule_matrix(N, K, 0, b))
    assert (full == full[:, :1]).all()  # everything moves together
    turn = schedule_matrix(**args, kind="autoregressive")
    assert np.array_equal(turn, schedule_matrix(N, K, K, b))
    for n in range(b, N):  # a block leaves noise only when the one before it is clean
        assert (turn[turn[:, n] < K][:, n - b] == 0).all()
    assert cost(turn).latents_in_flight == min(N, b)


def test_the_papers_numbers():
    # 30 latents at K = 50 (6 s): the released blocks of 3, then the paper's wording of single latents.
    for block_size, calls in ((3, (50, 68, 500)), (1, (50, 108, 1500))):
        assert tuple(cost(schedule_matrix(30, 50, 2, block_size, kind)).calls for kind in ("full", "fss")) == calls[:2]
        assert cost(schedule_matrix(30, 50, 2, block_size, "autoregressive")).calls == calls[2]
    assert schedule_matrix(3, 4, 2)[[0, 2, 4]].tolist() == [[4, 4, 4], [2, 4, 4], [0, 2, 4]]


# --- FloodDiffusion's triangle ---------------------------------------------------------------------------------------


@given(st.integers(1, 25), st.integers(1, 8), st.data())
@settings(deadline=None)
def test_the_triangle_is_eq_19_on_the_grid_of_steps(blocks, block_size, data):
    K = data.draw(st.integers(1, 20))
    n_s = data.draw(st.integers(1, K))
    matrix = schedule_matrix(blocks * block_size, K, block_size=block_size, kind="triangular", overlap=n_s)
    for (m, n), level in np.ndenumerate(matrix):  # alpha = clamp(t - k / n_s, 0, 1) at t = m / K
        alpha = min(max(Fraction(int(m), K) - Fraction(n // block_size, n_s), 0), 1)
        assert level == math.floor(K * (1 - alpha))  # whole whenever n_s divides K
    moving = (np.diff(matrix, axis=0) < 0).sum(axis=1)
    if blocks >= n_s:
        started = math.floor(Fraction(K * (n_s - 1), n_s))
        assert (moving[started : K + K * (blocks - n_s) // n_s] == n_s * block_size).all()  # and never any other number


@given(arguments())
@settings(deadline=None)
def test_the_triangle_is_fss_under_another_name(args):
    K, L = args["num_steps"], args["uncertainty"]
    if L == 0 or K % L == 0:
        fss = schedule_matrix(**args)
        assert np.array_equal(schedule_matrix(**args, kind="triangular"), fss)
        if L:
            assert np.array_equal(schedule_matrix(**args, kind="triangular", overlap=K // L), fss)
    else:  # the triangle keeps the number in flight, FSS the stagger
        n_s = math.ceil(K / L)
        assert closed_form_cost(**args, kind="triangular").calls <= closed_form_cost(**args).calls
        wide = args | dict(num_latents=n_s * args["block_size"] + 30)
        assert cost(schedule_matrix(**wide, kind="triangular")).latents_in_flight == n_s * args["block_size"]


def test_floods_own_numbers():
    price = cost(schedule_matrix(50, 10, kind="triangular", overlap=5))
    assert (price.calls_to_first, price.calls_per_further, price.latents_in_flight) == (10, 2, 5)
    assert price.calls == 10 + 2 * 49  # t = 1 + (K - 1) / n_s, where Eq. 22 goes on to 1 + K / n_s
    assert np.array_equal(schedule_matrix(50, 10, kind="triangular", overlap=5), schedule_matrix(50, 10, 2))


def test_floods_window_with_ceilings_moves_each_latent_one_step_late():
    K, n_s, N = 10, 5, 12
    asked = [set() for _ in range(N)]  # at which levels each latent is in the window of Eqs 23-24
    for m in range(K + K * N // n_s + 1):
        t = Fraction(m, K)
        for k in range(max(0, math.ceil((t - 1) * n_s)), min(N, math.ceil(t * n_s))):
            asked[k].add(K * (1 - min(max(t - Fraction(k, n_s), 0), 1)))
    assert all(levels == set(range(K)) for levels in asked)  # never at pure noise, and once when clean
    matrix = schedule_matrix(N, K, kind="triangular", overlap=n_s)
    moves = matrix[1:] < matrix[:-1]
    assert all(set(matrix[:-1, k][moves[:, k]].tolist()) == set(range(1, K + 1)) for k in range(N))


# --- the trapezoid ---------------------------------------------------------------------------------------------------


def circulating_trapezoid(num_latents, num_steps, uncertainty):
    """The one in circulation: column n is mirrored to -n, where column 0 is its own mirror."""
    half = math.ceil(num_latents / 2)
    matrix = np.zeros((num_steps + uncertainty * half, num_latents), np.int64)
    for m, t in np.ndindex(len(matrix), half):
        matrix[m, t] = matrix[m, -t] = min(max(num_steps + t * uncertainty - m, 0), num_steps)
    return matrix


@given(arguments())
@settings(deadline=None)
def test_the_trapezoid_is_two_stairs_that_meet(args):
    K, L, N, b = args["num_steps"], args["uncertainty"], args["num_latents"], args["block_size"]
    blocks = math.ceil(N / b)
    matrix = schedule_matrix(**args, kind="trapezoid")
    columns = matrix[:, ::b]  # one of each block
    assert np.array_equal(columns, columns[:, ::-1])
    assert np.array_equal(columns[:, : math.ceil(blocks / 2)], schedule_matrix(math.ceil(blocks / 2), K, L))
    assert len(matrix) == K + L * (math.ceil(blocks / 2) - 1) + 1  # about half the calls of FSS


@pytest.mark.parametrize("num_latents", [2, 4, 6, 20])
def test_the_trapezoid_in_circulation_leaves_a_column_at_zero(num_latents):
    wrong, right = circulating_trapezoid(num_latents, 8, 2), schedule_matrix(num_latents, 8, 2, kind="trapezoid")
    assert not wrong[:, num_latents // 2].any() and right[0].all()
    with pytest.raises(ValueError, match="start at the same level"):
        check_matrix(wrong)


def test_with_an_odd_number_of_columns_it_is_merely_lopsided():
    waits = (circulating_trapezoid(5, 8, 2) == 8).sum(axis=0) - 1
    assert waits.tolist() == [0, 2, 4, 4, 2]
    assert ((schedule_matrix(5, 8, 2, kind="trapezoid") == 8).sum(axis=0) - 1).tolist() == [0, 2, 4, 2, 0]


# --- the two readings of Eq. 13 --------------------------------------------------------------------------------------


@given(arguments())
@settings(deadline=None)
def test_the_literal_reading_is_a_coarser_fss(args):
    K, N, b = args["num_steps"], args["num_latents"], args["block_size"]
    L = max(args["uncertainty"], 1)
    matrix = literal_matrix(N, K, L, b)
    blocks, jumps = math.ceil(N / b), math.ceil(K / L)
    assert np.array_equal(check_matrix(matrix), np.maximum(0, K - L * (jumps - schedule_matrix(N, jumps, 1, b))))
    assert cost(matrix).calls == jumps + blocks - 1
    if L == 1:
        assert np.array_equal(matrix, schedule_matrix(N, K, 1, b))


def test_one_sentence_of_the_paper_fits_both_readings_and_the_steps_in_between_do_not():
    K, L = 50, 2
    both = schedule_matrix(30, K, L), literal_matrix(30, K, L)
    for matrix in both:  # "the next frame starts at K - L of this one"
        for n in range(1, 30):
            assert matrix[(matrix[:, n] == K).sum() - 1, n - 1] == K - L
    assert [len(set(matrix[:, 7].tolist())) - 1 for matrix in both] == [50, 25]  # steps that a latent gets
    assert [cost(matrix).calls for matrix in both] == [108, 54]
    assert literal_matrix(3, 4, 2).tolist() == [[4, 4, 4], [2, 4, 4], [0, 2, 4], [0, 0, 2], [0, 0, 0]]
    with pytest.raises(ValueError, match="uncertainty"):
        literal_matrix(3, 4, 0)  # would never move


# --- errors ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "bad, word",
    [
        (dict(kind="spiral"), "spiral"),
        (dict(num_latents=0), "num_latents"),
        (dict(num_latents=2.0), "num_latents"),
        (dict(num_steps=0), "num_steps"),
        (dict(num_steps=True), "num_steps"),
        (dict(uncertainty=-1), "uncertainty"),
        (dict(uncertainty=7), "at most num_steps"),
        (dict(uncertainty=None), "uncertainty"),
        (dict(block_size=0), "block_size"),
        (dict(kind="triangular", overlap=0), "overlap"),
        (dict(kind="triangular", overlap=7), "at most num_steps"),
        (dict(overlap=3), "triangular"),
    ],
)
@pytest.mark.parametrize("function", [schedule_matrix, closed_form_cost])
def test_errors_teach(function, bad, word):
    with pytest.raises(ValueError, match=word):
        function(**{**dict(num_latents=4, num_steps=6, uncertainty=2, block_size=1, kind="fss"), **bad})


def test_unknown_kind_lists_the_known_ones():
    with pytest.raises(ValueError, match=", ".join(KINDS)):
        schedule_matrix(4, 6, kind="")


@pytest.mark.parametrize(
    "matrix",
    [
        [[2, 1], [1, 0], [0, 0]],  # does not start together
        [[2, 2], [1, 1]],  # does not end clean
        [[2, 2], [1, 1], [2, 0], [0, 0]],  # rises
        [[0, 0], [0, 0]],  # no step to make
        [[1.0, 1.0], [0.0, 0.0]],
        [2, 1, 0],
        [[2, 2]],
    ],
)
def test_a_matrix_that_is_no_schedule_is_refused(matrix):
    with pytest.raises(ValueError):
        check_matrix(np.array(matrix))
