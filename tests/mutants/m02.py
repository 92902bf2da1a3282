"""Wrong answers to the exercises of notebook 02."""

import torch


def moves(layer, x, changes, before=lambda out, t: out[:, :t], close=1e-9):
    """A detector that tries only some changes: (frame, another input) pairs."""
    whole = layer(x)
    return any(not torch.allclose(before(layer(y), t), before(whole, t), rtol=0, atol=close) for t, y in changes(x))


def nudged(x, t, by=1.0, stop=None, channel=slice(None)):
    y = x.clone()
    y[:, t:stop, channel] += by
    return y


def everywhere(x):
    return [(t, nudged(x, t, 100.0)) for t in range(1, x.shape[1])]


def cut(x):
    return [(t, x[:, :t]) for t in range(1, x.shape[1])]


def both(x):
    return everywhere(x) + cut(x)


def in_place(layer, x):
    whole, found = layer(x), False
    for t in reversed(range(1, x.shape[1])):
        x[:, t:] += 100.0
        found |= not torch.allclose(layer(x)[:, :t], whole[:, :t])
    return found or moves(layer, x, cut)


MUTANTS = {
    "02.1": [
        lambda k, s, d: (k - 1) * d,  # forgets the stride: the group's last frames come too late
        lambda k, s, d: (k - 1) * d // 2,  # both sides
        lambda k, s, d: k - s,  # forgets the dilation
        lambda k, s, d: (k - s) * d,
        lambda k, s, d: k * d - s,
        lambda k, s, d: (k - 1) * d + s - 1,
    ],
    "02.2": [
        lambda layer, x: moves(layer, x, lambda x: [(x.shape[1] - 1, nudged(x, x.shape[1] - 1))]),  # the last only
        lambda layer, x: moves(layer, x, lambda x: [(1, nudged(x, 1, 100.0))]),  # from one frame on only
        lambda layer, x: moves(layer, x, everywhere),  # never cuts
        lambda layer, x: moves(layer, x, cut),  # only cuts
        lambda layer, x: moves(layer, x, both, close=1e-2),  # too lenient
        lambda layer, x: moves(layer, x, both, lambda out, t: out[:, :1]),  # output 0
        lambda layer, x: moves(layer, x, both, lambda out, t: out[:, :t, :1]),  # one channel
        lambda layer, x: moves(layer, x, both, lambda out, t: out[:, : t + 1]),  # the present
        lambda layer, x: moves(layer, x, lambda x: [(t, nudged(x, t - 1, 100.0)) for t in range(1, x.shape[1])]),
        lambda layer, x: True,
        lambda layer, x: False,
        in_place,
    ],
    "02.3": [
        lambda layers: 1 + sum((k - 1) * d for k, s, d in layers),  # forgets the strides
        lambda layers: sum(k * d for k, s, d in layers),
        lambda layers: 1 + sum(k - 1 for k, s, d in layers),  # forgets the dilations
        lambda layers: max((k - 1) * d + 1 for k, s, d in layers),  # the widest layer alone
        lambda layers: strides_too_early(layers),
        lambda layers: 1 + sum((k - 1) * d for k, s, d in layers) * max(s for k, s, d in layers),
    ],
}


def strides_too_early(layers):
    field, apart = 1, 1
    for kernel, stride, dilation in layers:
        apart *= stride  # a layer's own stride does not spread its own taps
        field += (kernel - 1) * dilation * apart
    return field
