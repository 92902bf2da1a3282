"""Wrong answers to the exercises of notebook 08."""

import numpy as np


def fss(latents, steps, stagger, rows=0, jump=1, clip=True, turned=False):
    m, n = np.arange(steps + stagger * (latents - 1) + 1 + rows)[:, None], np.arange(latents)
    levels = steps + stagger * n - jump * m
    levels = np.clip(levels, 0, steps) if clip else levels
    return levels[:, ::-1] if turned else levels


def laws(*wanted):
    """A check that knows only some of the laws."""
    each = {
        "first": lambda m: (m[0] == m[0, 0]).all(),
        "noise": lambda m: m[0, 0] >= 1,
        "all noise": lambda m: (m[0] >= 1).all(),
        "fall": lambda m: (np.diff(m, axis=0) <= 0).all(),
        "fall at all": lambda m: (m[-1] <= m[0]).all(),
        "unit": lambda m: (np.diff(m, axis=0) >= -1).all(),
        "busy": lambda m: (np.diff(m, axis=0) < 0).any(axis=1).all(),
        "last": lambda m: (m[-1] == 0).all(),
        "one last": lambda m: m[-1, 0] == 0,
    }
    return lambda matrix: bool(all(each[name](matrix) for name in wanted))


def price(latents, steps, stagger, block, up=True, last=1, flight=None):
    blocks = -(-latents // block) if up else latents // block
    default = min(latents, block * -(-steps // stagger)) if stagger else latents
    flying = default if flight is None else flight(latents, steps, stagger, block)
    return steps + stagger * (blocks - last), flying, steps


def circulating(latents, steps, stagger, mirror=lambda n, latents: -n, rows=0):
    half = -(-latents // 2)
    levels = np.zeros((steps + stagger * (half - 1) + 1 + rows, latents), int)
    for m in range(len(levels)):
        for n in range(half):
            levels[m, n] = levels[m, mirror(n, latents)] = np.clip(steps + stagger * n - m, 0, steps)
    return levels


MUTANTS = {
    "08.1": [
        lambda N, K, L: fss(N, K, L, rows=-1) if K + L * (N - 1) > 1 else fss(N, K, L),  # the last row is missing
        lambda N, K, L: fss(N, K, L, rows=3),  # three calls that move nothing
        lambda N, K, L: fss(N, K, L, clip=False),
        lambda N, K, L: fss(N, K, L, turned=True),  # the last latent first
        lambda N, K, L: fss(N, K, L, jump=max(L, 1)),  # Eq. 13 read as jumps of L
        lambda N, K, L: fss(N, K, 2 if K > 1 else L),  # the paper's L, whatever is asked
        lambda N, K, L: fss(N, K, L).T,
        lambda N, K, L: K - fss(N, K, L),  # the release's direction of time
        lambda N, K, L: np.clip(fss(N, K, L), 1, K),  # nothing is ever clean
    ],
    "08.2": [
        laws("first", "noise", "fall"),  # nothing about the end
        laws("first", "noise", "fall", "one last"),  # only the first latent's end
        laws("noise", "fall", "last"),  # the circulating trapezoid passes
        laws("all noise", "fall", "last"),  # and so does this one's own K for each column
        laws("first", "fall", "last"),  # a motion that is clean before it begins
        laws("first", "noise", "fall at all", "last"),  # looks at the ends only
        laws("first", "noise", "fall", "unit", "last"),  # refuses steps of more than one level
        laws("first", "noise", "fall", "busy", "last"),  # refuses a pause
        lambda matrix: True,
    ],
    "08.3": [
        lambda N, K, L, b: price(N, K, L, b, last=0),  # rows of N waits instead of N - 1
        lambda N, K, L, b: price(N, K, L, b, up=False),  # the started block at the end is forgotten
        lambda N, K, L, b: price(N, K, L, 1),  # blocks ignored
        lambda N, K, L, b: price(N, K, L, b, flight=lambda N, K, L, b: min(N, b * (K // L)) if L else N),  # rounds down
        lambda N, K, L, b: price(N, K, L, b, flight=lambda N, K, L, b: b * -(-K // L) if L else N),  # too many
        lambda N, K, L, b: price(N, K, L, b, flight=lambda N, K, L, b: min(N, -(-K // L)) if L else N),  # counts blocks
        lambda N, K, L, b: price(N, K, L, b, flight=lambda N, K, L, b: min(N, b * -(-K // L))),  # divides by zero
        lambda N, K, L, b: (*price(N, K, L, b)[:2], K + L),  # the first latent waits
    ],
    "08.4": [
        circulating,  # the one in circulation
        lambda N, K, L: circulating(N, K, L, mirror=lambda n, N: -n - 1, rows=L) if L else circulating(N, K, L),
        lambda N, K, L: circulating(N, K, L, mirror=lambda n, N: (N - n) % N),  # the same hole, without the sign
        lambda N, K, L: np.maximum(circulating(N, K, L), fss(N, K, L)[: K + L * (-(-N // 2) - 1) + 1]),
        lambda N, K, L: fss(N, K, L),  # no mirror at all
        lambda N, K, L: circulating(N, K, L, mirror=lambda n, N: -n - 1)[::-1],
    ],
}
