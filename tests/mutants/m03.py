"""Wrong answers to the exercises of notebook 03."""

import torch
import torch.nn.functional as F


def piece(x, past, weight, dilation, keep=None, front=None):
    joined = torch.cat([past if front is None else front, x], dim=-1)
    return F.conv1d(joined, weight, dilation=dilation), joined[..., keep:] if keep is not None else x


MUTANTS = {
    "03.1": [
        lambda mean, logvar, noise: mean + logvar.exp() * noise,  # stretched by the variance
        lambda mean, logvar, noise: mean + logvar * noise,  # by the logarithm
        lambda mean, logvar, noise: mean - (0.5 * logvar).exp() * noise,  # mirrored noise
        lambda mean, logvar, noise: mean + (0.5 * logvar).exp().detach() * noise,  # no gradient to the variance
        lambda mean, logvar, noise: mean,  # no sample
        lambda mean, logvar, noise: (0.5 * logvar).exp() * (mean + noise),  # the mean is stretched too
    ],
    "03.2": [
        lambda mean, logvar: 0.5 * (mean.square() + logvar.exp() - 1 - logvar).sum(),  # over the batch, too
        lambda mean, logvar: 0.5 * (mean.square() + logvar.exp() - 1 - logvar).mean(dim=(1, 2)),  # a mean
        lambda mean, logvar: (mean.square() + logvar.exp() - 1 - logvar).sum(dim=(1, 2)),  # twice
        lambda mean, logvar: 0.5 * (mean.square() + logvar.exp() - 1 + logvar).sum(dim=(1, 2)),  # a sign
        lambda mean, logvar: -0.5 * (mean.square() + logvar.exp() - 1 - logvar).sum(dim=(1, 2)),  # negative
        lambda mean, logvar: 0.5 * (mean.square() + (2 * logvar).exp() - 1 - 2 * logvar).sum(dim=(1, 2)),  # log std
    ],
    "03.3": [
        lambda x, past, weight, dilation: (  # every piece begins at zeros
            piece(x, past, weight, dilation, front=torch.zeros_like(past))[0],
            x[..., x.shape[-1] - past.shape[-1] :],
        ),
        lambda x, past, weight, dilation: piece(x, past, weight, dilation, keep=-past.shape[-1]),  # -0 keeps all
        lambda x, past, weight, dilation: (piece(x, past, weight, dilation)[0], past),  # the first past for ever
        lambda x, past, weight, dilation: piece(x, past, weight, dilation),  # keeps the piece, however short
        lambda x, past, weight, dilation: piece(x, past, weight, dilation, keep=0),  # keeps everything
        lambda x, past, weight, dilation: piece(x, past, weight, 1, keep=0),  # forgets the dilation
        lambda x, past, weight, dilation: (F.conv1d(x, weight, dilation=dilation), past),  # no past at all
    ],
}
