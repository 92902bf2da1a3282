"""Wrong answers to the exercises of notebook 09."""

import torch


def _in_place(z_t, v, t_from, t_to):
    move = t_to != t_from
    z_t[move] += (t_to - t_from)[move][:, None] * v[move]
    return z_t


def _two_calls(model, z_t, t, words, null_words, scale):
    v_text, v_null = model(z_t, t, words), model(z_t, t, null_words)
    return v_null + scale * (v_text - v_null)


def _batch(rule, swapped=False, interleaved=False):
    """Guidance in one batch, with a wrong rule or order."""

    def answer(model, z_t, t, words, null_words, scale):
        halves = [null_words, words] if swapped else [words, null_words]
        both = model(torch.cat([z_t, z_t]), torch.cat([t, t]), torch.cat(halves))
        v_text, v_null = (both[::2], both[1::2]) if interleaved else both.chunk(2)
        return rule(v_text, v_null, scale)

    return answer


def _right(v_text, v_null, scale):
    return v_null + scale * (v_text - v_null)


MUTANTS = {
    "09.1": [
        lambda z_t, v, a, b: z_t + (b - a).unsqueeze(-1) * v,  # zero times NaN
        lambda z_t, v, a, b: z_t + (b - a).unsqueeze(-1) * v.nan_to_num(0, 0, 0) + 1e-9,  # nearly itself
        lambda z_t, v, a, b: torch.where((b != a)[..., None], z_t + (b - a).max() * v, z_t),  # one step for all
        lambda z_t, v, a, b: torch.where((b != a)[..., None], z_t + b.unsqueeze(-1) * v, z_t),  # from t = 0
        lambda z_t, v, a, b: torch.where((b != a)[..., None], z_t - (b - a).unsqueeze(-1) * v, z_t),  # the wrong way
        lambda z_t, v, a, b: torch.where((b < 1)[..., None], z_t + (b - a).unsqueeze(-1) * v, z_t),  # who waits, moves
        _in_place,
    ],
    "09.2": [
        _two_calls,
        _batch(_right, swapped=True),
        _batch(_right, interleaved=True),  # not how cat lays them
        _batch(lambda text, null, s: text + s * (text - null)),  # s = 0 would be the plain model
        _batch(lambda text, null, s: null + 3.0 * (text - null)),  # a fixed scale
        _batch(lambda text, null, s: torch.cat([text, null])),  # forgets to mix
    ],
    "09.3": [
        lambda cached, count, window: cached[-(window - count) :],  # -0 keeps everything
        lambda cached, count, window: cached[len(cached) + count - window :],  # a negative start
        lambda cached, count, window: cached[max(0, len(cached) - window) :],  # forgets those in flight
        lambda cached, count, window: cached[: window - count],  # the youngest leave
        lambda cached, count, window: cached[max(0, len(cached) + count - window + 1) :],  # one too many leaves
        lambda cached, count, window: cached if len(cached) + count <= window else [],  # all or nothing
    ],
    "09.4": [
        lambda K, L, b: 4 * b * (K // L - 1),  # rounds down
        lambda K, L, b: 4 * b * -(-K // L),  # counts the finished block too
        lambda K, L, b: b * (-(-K // L) - 1),  # latents, not frames
        lambda K, L, b: 4 * (-(-K // L) - 1),  # blocks of one
        lambda K, L, b: 4 * b * (K - L),
        lambda K, L, b: 4 * b * (K // L),  # right unless L divides K
    ],
}
