"""Wrong answers to the exercises of notebook 10."""

import numpy as np

from minicmdm.evaluation.metrics import ARROWS


def parts(a, b, ddof=1):
    shift = np.square(a.mean(0) - b.mean(0)).sum()
    return shift, *(np.atleast_2d(np.cov(x, rowvar=False, ddof=ddof)) for x in (a, b))


def roots(product):
    return np.sqrt(np.linalg.eigvals(product).real.clip(0)).sum()


def biased(a, b):
    shift, x, y = parts(a, b, ddof=0)  # covariances divided by N
    return shift + np.trace(x) + np.trace(y) - 2 * roots(x @ y)


def rooted(a, b):
    shift, x, y = parts(a, b)
    return np.sqrt(shift) + np.trace(x) + np.trace(y) - 2 * roots(x @ y)  # the means' distance not squared


def number_by_number(a, b):
    shift, x, y = parts(a, b)
    return shift + np.trace(x + y - 2 * np.sqrt((x @ y).clip(0)))  # the root of each number


def diagonal(a, b):
    shift, x, y = parts(a, b)
    return shift + np.square(np.sqrt(np.diag(x)) - np.sqrt(np.diag(y))).sum()  # correlations forgotten


def retrieval(text, motion, pool, cosine=False, turned=False, rest=False, single=False):
    hits, count = np.zeros(3), 0
    for first in range(0, len(text) if rest else len(text) // pool * pool, pool):
        t, m = text[first : first + pool], motion[first : first + pool]
        if cosine:
            t, m = (x / np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-9) for x in (t, m))
        distance = np.linalg.norm(t[:, None] - m[None], axis=-1)
        distance = distance.T if turned else distance
        rank = (distance < np.diag(distance)[:, None]).sum(1)
        hits += [(rank == k).sum() if single else (rank <= k).sum() for k in range(3)]
        count += len(t)
    return hits / count


def statue(motion, truth, measure, up="↑", near=True, ties=False, frame=0):
    frozen = np.repeat(motion[frame : frame + 1] if frame >= 0 else motion[-1:], len(motion), axis=0)
    a, b, t = measure(frozen, truth), measure(motion, truth), measure(truth, truth)
    won = set()
    for name in a:
        arrow = ARROWS[name]
        gap = b[name] - a[name]
        if arrow == up:
            gap = -gap
        if arrow == "→" and near:
            gap = abs(b[name] - t[name]) - abs(a[name] - t[name])
        if gap > 0 or (ties and gap == 0):
            won.add(name)
    return won


MUTANTS = {
    "10.1": [
        biased,
        rooted,
        number_by_number,
        diagonal,
        lambda a, b: parts(a, b)[0],  # the means alone
        lambda a, b: parts(a, b)[0] + np.trace(parts(a, b)[1]) + np.trace(parts(a, b)[2]),  # the overlap forgotten
    ],
    "10.2": [
        lambda t, m, pool: retrieval(t, m, pool, cosine=True),
        lambda t, m, pool: retrieval(t, m, pool, turned=True),  # each motion ranks the texts
        lambda t, m, pool: retrieval(t, m, pool, rest=True),  # the last, smaller pool is easier
        lambda t, m, pool: retrieval(t, m, pool, single=True),  # exactly second, exactly third
        lambda t, m, pool: retrieval(t, m, len(t)),  # one pool of all
        lambda t, m, pool: retrieval(t, m, pool)[0],  # R@1 alone
    ],
    "10.3": [
        lambda *a: {"skating_ratio"},  # one name for every motion
        lambda *a: statue(*a, up=""),  # smaller is always better
        lambda *a: statue(*a, near=False),  # "→" read as "↓"
        lambda *a: statue(*a, ties=True),  # as good counts as better
        lambda *a: statue(*a, frame=-1),  # the last pose
        lambda *a: set(a[2](a[0], a[1])) - statue(*a),  # the measures that the statue loses
    ],
}
