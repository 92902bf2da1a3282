"""The lab: what each attention mask and each schedule can reach at best, with no training at all.

Let the latents of a motion be N numbers z ~ N(0, S). Then the best possible denoiser is known: E[z - eps | what it
sees] is linear in what it sees. Euler's steps are linear too, so the covariance of the samples follows exactly from
that of the noise, row after row of a scheduling matrix. What is left at the end is no error of a network, of its
training or of its noise levels: only the mask and the step size are to blame.

What comes out:

* "bidirectional" is right under every schedule. A flow keeps the marginals if each velocity is the mean of z - eps
  given *all* that is known (FloodDiffusion Theorem 3.8; latents that wait are pure noise and tell nothing).
* "causal" gives each latent the mean given its past. If the latent after it has begun to move, that one knows something
  that is ignored here, the steps no longer add up to the flow, and variance is lost while neighbours drift apart: less
  motion and more jitter, the more latents are in flight together. Exact is only autoregressive sampling, one latent or
  one block of the mask after the other.
* "window": finished latents look back, those in flight look at all finished ones and at each other. Who moves sees what
  it sees under "bidirectional", so it is as exact; finished latents see nothing that still changes, so their keys and
  values can be cached, as under "causal". `evaluations` counts what that saves.

A caution: with a denoiser fitted to few motions (`believed`), a causal mask is also a restraint, and with weakly
correlated latents it can win. FloodDiffusion and CMDM may both be right about their own data.
"""

from dataclasses import dataclass

import numpy as np

from minicmdm.diffusion.schedules import check_matrix

MASKS = ("causal", "bidirectional", "window")


@dataclass(frozen=True)
class LabResult:
    """How far samples are from N(0, S), and what they cost."""

    w2: float  # squared 2-Wasserstein distance per latent; 0 is perfect
    variance: float  # the samples' variance over the data's; 1 is perfect, less is too little motion
    jitter: float  # the energy of steps from latent to latent, over the data's; 1 is perfect; nan for one latent
    evaluations: int  # latents evaluated, over all calls


def ar1_covariance(num_latents: int, rho: float) -> np.ndarray:
    """Unit variances, and rho ** distance between latents: (N,N). ValueError: rho outside (-1, 1)."""
    if not -1 < rho < 1:
        raise ValueError(f"the correlation of neighbours must be between -1 and 1, got {rho}")
    place = np.arange(num_latents)
    return np.float64(rho) ** np.abs(place[:, None] - place)


def visible(levels: np.ndarray, waiting: np.ndarray, mask: str, block_size: int = 1) -> np.ndarray:
    """Which latent (row) sees which (column) in a call at these levels (N,): (N,N) bool.

    Those that wait (N,) bool, pure noise and not moved by this call, see nothing and are not seen, whatever the mask.
    `block_size` is the mask's own: under "causal" the latents of one block see each other. ValueError: an unknown mask.
    """
    if mask == "causal":
        sees = _back(len(levels), block_size)
    elif mask == "bidirectional":
        sees = np.ones((len(levels), len(levels)), dtype=bool)
    elif mask == "window":
        finished = levels == 0
        sees = ~finished[:, None] | (finished & _back(len(levels)))
    else:
        raise ValueError(f"unknown mask {mask!r}: expected one of {', '.join(MASKS)}")
    return sees & ~waiting[:, None] & ~waiting


def bayes_velocity(covariance: np.ndarray, t: np.ndarray, sees: np.ndarray) -> np.ndarray:
    """The best denoiser's weights W (N,N): (W x)_n = E[z_n - eps_n | what row n sees of x], for x = t z + (1-t) eps.

    covariance (N,N) of z, t (N,) one flow time per latent, sees (N,N) bool. A row that sees nothing stays 0.
    """
    observed = t[:, None] * covariance * t + np.diag((1 - t) ** 2)  # cov(x, x)
    wanted = covariance * t - np.diag(1 - t)  # cov(z - eps, x)
    weights = np.zeros_like(observed)
    for n in np.flatnonzero(sees.any(axis=1)):
        seen = sees[n]
        weights[n, seen] = np.linalg.solve(observed[np.ix_(seen, seen)], wanted[n, seen])
    return weights


def sample_covariance(
    covariance: np.ndarray, matrix: np.ndarray, mask: str, block_size: int = 1, believed: np.ndarray | None = None
) -> np.ndarray:
    """The exact covariance (N,N) of Euler's samples under a scheduling matrix (M,N), for data N(0, covariance).

    `believed` (N,N): what the denoiser takes for the data's covariance, if not the truth.
    ValueError: no schedule, an unknown mask, or covariances that are not symmetric, positive definite and (N,N).
    """
    matrix = check_matrix(matrix)
    believed = _check(covariance if believed is None else believed, matrix.shape[1])
    num_steps = matrix[0, 0]  # K
    samples = np.eye(len(believed))  # pure noise
    for before, after in zip(matrix, matrix[1:]):
        sees = visible(before, after == num_steps, mask, block_size) & (after < before)[:, None]  # of those who move
        step = (before - after) / num_steps  # (N,), how much flow time each latent gains
        euler = np.eye(len(believed)) + step[:, None] * bayes_velocity(believed, 1 - before / num_steps, sees)
        samples = euler @ samples @ euler.T
    return samples


def count_evaluations(matrix: np.ndarray, mask: str, block_size: int = 1) -> int:
    """How many latents a sampler evaluates over all calls of a matrix (M,N), if it caches all that is final.

    Waiting latents are never evaluated; the others in every call, until all that they depend on is finished. From the
    next call on, in which their final keys are made, they come from the cache. Under "bidirectional" nothing is final.
    """
    matrix = check_matrix(matrix)
    back = _back(matrix.shape[1], block_size if mask == "causal" else 1)
    cached, evaluated = np.zeros(matrix.shape[1], dtype=bool), 0
    for before, after in zip(matrix, matrix[1:]):
        awake = visible(before, after == matrix[0, 0], mask, block_size).any(axis=1)
        evaluated += int((awake & ~cached).sum())
        if mask != "bidirectional":
            cached = ~(back & (before > 0)).any(axis=1)
    return evaluated


def wasserstein2(a: np.ndarray, b: np.ndarray) -> float:
    """The squared 2-Wasserstein distance of N(0, a) and N(0, b) per latent, Tr(a + b - 2 (a^1/2 b a^1/2)^1/2) / N."""
    values, vectors = np.linalg.eigh(a)
    root = (vectors * np.sqrt(values.clip(min=0))) @ vectors.T
    overlap = np.sqrt(np.linalg.eigvalsh(root @ b @ root).clip(min=0)).sum()
    return max(float(np.trace(a) + np.trace(b) - 2 * overlap) / len(a), 0.0)


def run_lab(
    covariance: np.ndarray, matrix: np.ndarray, mask: str, block_size: int = 1, believed: np.ndarray | None = None
) -> LabResult:
    """Sample N(0, covariance) with the best denoiser under this mask and schedule. Arguments: `sample_covariance`."""
    covariance = _check(covariance, np.shape(matrix)[-1])
    samples = sample_covariance(covariance, matrix, mask, block_size, believed)
    differences = np.diff(np.eye(len(covariance)), axis=0)  # (N-1,N)
    found, true = (np.trace(differences @ c @ differences.T) for c in (samples, covariance))
    return LabResult(
        w2=wasserstein2(covariance, samples),
        variance=float(np.trace(samples) / np.trace(covariance)),
        jitter=float(found / true) if len(differences) else float("nan"),
        evaluations=count_evaluations(matrix, mask, block_size),
    )


def _back(num_latents: int, block_size: int = 1) -> np.ndarray:
    block = np.arange(num_latents) // block_size
    return block[:, None] >= block


def _check(covariance: np.ndarray, num_latents: int) -> np.ndarray:
    covariance = np.asarray(covariance, dtype=np.float64)
    if covariance.shape != (num_latents, num_latents) or not np.allclose(covariance, covariance.T):
        raise ValueError(f"a covariance of {num_latents} latents is a symmetric matrix, got shape {covariance.shape}")
    smallest, largest = np.linalg.eigvalsh(covariance)[[0, -1]]
    if not smallest > 1e-10 * largest:
        raise ValueError(f"a covariance must be positive definite, and this one has eigenvalues from {smallest:.3g} on")
    return covariance
