"""Wrong answers to the exercises of notebook 15."""

import math


def count(dim, layers, latent, text, time, norms=1, qk=2, heads_bias=True, ff=2, mod=6, out=True):
    lin = lambda a, b: a * b + b * heads_bias  # noqa: E731
    attention = 4 * lin(dim, dim) + qk * dim
    block = lin(dim, mod * dim) + 2 * attention + lin(dim, ff * dim) + lin(ff * dim, dim) + norms * 2 * dim
    ends = lin(latent, dim) + lin(text, dim) + lin(time, dim) + lin(dim, dim)
    return ends + layers * block + (lin(dim, latent) if out else 0)


def pick(call_ms, first, latent, most, order="steps", flight=lambda K, L: -(-K // L), strict=False, smallest=False):
    def fits(K, L):
        call = call_ms(flight(K, L))
        return K * call < first and L * call < latent if strict else K * call <= first and L * call <= latent

    found = [(K, L) for K in range(1, most + 1) for L in range(1, K + 1) if fits(K, L)]
    key = {"steps": lambda p: (p[0], -p[1] if smallest else p[1]), "stagger": lambda p: (p[1], p[0])}[order]
    return max(found, key=key, default=None)


def cut(frames, marks, least=40, most=196, rounded=int, drop=False, once=True, whole=True, end=True):
    found = [(0, frames)] if (0, 0) in marks and whole else []
    for a, b in marks:
        if (a, b) != (0, 0):
            stretch = rounded(20 * a), min(rounded(20 * b), frames) if end else rounded(20 * b)
            found += [] if once and stretch in found else [stretch]
    if drop:  # too long is left out
        return [(a, b) for a, b in found if least <= b - a <= most]
    return [(a, min(b, a + most)) for a, b in found if b - a >= least]


MUTANTS = {
    "15.1": [
        lambda *sizes: count(*sizes, heads_bias=False),  # no biases
        lambda *sizes: count(*sizes, norms=3),  # the two modulated norms have no weights of their own
        lambda *sizes: count(*sizes, norms=0),
        lambda *sizes: count(*sizes, qk=0),  # no norms of queries and keys
        lambda *sizes: count(*sizes, ff=4),  # the usual feed-forward
        lambda *sizes: count(*sizes, mod=4),  # no gates
        lambda *sizes: count(*sizes, out=False),
        lambda dim, layers, *_: 18 * dim * dim * layers,  # the leading term
    ],
    "15.2": [
        lambda c, f, b, m: pick(c, f, b, m, order="stagger"),  # the largest stagger first
        lambda c, f, b, m: pick(c, f, b, m, smallest=True),  # most overlap
        lambda c, f, b, m: pick(c, f, b, m, flight=lambda K, L: 1),  # as if a call moved one latent
        lambda c, f, b, m: pick(c, f, b, m, flight=lambda K, L: K // L),  # rounds down
        lambda c, f, b, m: pick(c, f, b, m, strict=True),
        lambda c, f, b, m: pick(c, math.inf, b, m),  # forgets the first latent
        lambda c, f, b, m: pick(c, f, math.inf, m),  # forgets the further ones
        lambda c, f, b, m: pick(c, f, b, 50),  # its own limit
        lambda c, f, b, m: pick(c, f, b, m) or (1, 1),  # always something
    ],
    "15.3": [
        lambda frames, marks: cut(frames, marks, least=41),
        lambda frames, marks: cut(frames, marks, least=1),
        lambda frames, marks: cut(frames, marks, most=200),
        lambda frames, marks: cut(frames, marks, rounded=round),
        lambda frames, marks: cut(frames, marks, drop=True),  # as common loaders: too long is left out
        lambda frames, marks: cut(frames, marks, once=False),  # a clip for each caption
        lambda frames, marks: cut(frames, marks, whole=False),
        lambda frames, marks: cut(frames, marks, end=False),  # past the end of the motion
        lambda frames, marks: [(0, min(frames, 196))],  # ignores the marks
    ],
}
