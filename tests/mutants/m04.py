"""Wrong answers to the exercises of notebook 04."""

import torch
import torch.nn.functional as F


def cosines(x):
    x = F.normalize(x, dim=-1)
    return x @ x.transpose(1, 2)


def norm(loss, weight):
    return torch.autograd.grad(loss, weight, retain_graph=True)[0].norm()


def by_backward(rec, align, weight):
    """Reads .grad, and so leaves it behind."""
    norms = []
    for loss in (rec, align):
        before = 0 if weight.grad is None else weight.grad.clone()
        loss.backward(retain_graph=True)
        norms.append((weight.grad - before).norm())
    return (norms[0] / norms[1].clamp(min=1e-4)).clamp(0, 1e4)


MUTANTS = {
    "04.1": [
        lambda z, f, margin: (1 - margin - F.cosine_similarity(z, f, dim=-1)).mean(),  # no ReLU
        lambda z, f, margin: F.relu(1 - margin - F.cosine_similarity(z, f, dim=-1)).sum(),  # a sum
        lambda z, f, margin: F.relu(1 - margin - (z * f).sum(-1)).mean(),  # dot product
        lambda z, f, margin: F.relu(1 - margin - F.cosine_similarity(z, f, dim=1)).mean(),  # over time
        lambda z, f, margin: F.relu(margin - F.cosine_similarity(z, f, dim=-1)).mean(),  # the margin of another paper
        lambda z, f, margin: F.relu(1 - margin - F.cosine_similarity(z, f, dim=-1).mean()),  # ReLU of the mean
    ],
    "04.2": [
        lambda z, f, margin: F.relu(cosines(z) - cosines(f) - margin).mean(),  # no absolute value
        lambda z, f, margin: (cosines(z) - cosines(f)).abs().mean(),  # no margin
        lambda z, f, margin: F.relu((z @ z.transpose(1, 2) - f @ f.transpose(1, 2)).abs() - margin).mean(),  # lengths
        lambda z, f, margin: F.relu((cosines(z) - cosines(f)).abs() - margin).sum() / len(z),  # a sum over pairs
        lambda z, f, margin: F.relu((cosines(z) - cosines(f)).abs().mean() - margin),  # the mean, then the margin
        lambda z, f, margin: F.relu(  # every sequence of the batch meets every other
            (cosines(z.flatten(0, 1)[None]) - cosines(f.flatten(0, 1)[None])).abs() - margin
        ).mean(),
    ],
    "04.3": [
        lambda rec, align, weight: (norm(align, weight) / norm(rec, weight).clamp(min=1e-4)).clamp(0, 1e4),  # inverted
        lambda rec, align, weight: norm(rec, weight) / norm(align, weight),  # neither floor nor clamp
        lambda rec, align, weight: (rec / align.clamp(min=1e-4)).clamp(0, 1e4),  # of the losses
        lambda rec, align, weight: (norm(rec, weight) / norm(align, weight).clamp(min=1e-4)).clamp(0, 1),
        by_backward,
    ],
}
