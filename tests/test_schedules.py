"""Scheduling matrices: invariant 4 over random arguments, closed forms, a slow reference and the errors."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from minicmdm.diffusion.schedules import KINDS, check_matrix, cost, schedule_matrix


@st.composite
def arguments(draw):
    num_steps = draw(st.integers(1, 25))
    return dict(
        num_latents=draw(st.integers(1, 30)),
        num_steps=num_steps,
        uncertainty=draw(st.integers(0, num_steps)),
        block_size=draw(st.integers(1, 6)),
    )


def slow_matrix(num_latents, num_steps, uncertainty, block_size):
    """Walk step by step: block b moves from step L*b on, one level per step, until it is clean."""
    levels, rows, step = [num_steps] * num_latents, [[num_steps] * num_latents], 0
    while any(levels):
        for n in range(num_latents):
            if step >= uncertainty * (n // block_size) and levels[n] > 0:
                levels[n] -= 1
        step += 1
        rows.append(list(levels))
    return np.array(rows)


@given(arguments())
@settings(deadline=None)
def test_invariants_of_fss(args):
    matrix = schedule_matrix(**args)
    K, L, N, b = args["num_steps"], args["uncertainty"], args["num_latents"], args["block_size"]
    blocks = math.ceil(N / b)
    assert matrix.dtype == np.int64 and matrix.shape == (K + L * (blocks - 1) + 1, N)
    assert (matrix[0] == K).all() and (matrix[-1] == 0).all()
    assert set(np.diff(matrix, axis=0).ravel().tolist()) <= {0, -1}  # never rises, never jumps
    assert all((matrix[:, n] == matrix[:, n // b * b]).all() for n in range(N))  # a block shares its level
    assert np.array_equal(matrix, slow_matrix(N, K, L, b))


@given(arguments())
@settings(deadline=None)
def test_cost_matches_closed_forms(args):
    K, L, N, b = args["num_steps"], args["uncertainty"], args["num_latents"], args["block_size"]
    blocks = math.ceil(N / b)
    counted = cost(schedule_matrix(**args))
    assert counted.rows == K + L * (blocks - 1) + 1
    assert counted.calls == counted.rows - 1
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
    ],
)
def test_errors_teach(bad, word):
    with pytest.raises(ValueError, match=word):
        schedule_matrix(**{**dict(num_latents=4, num_steps=6, uncertainty=2, block_size=1, kind="fss"), **bad})


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
