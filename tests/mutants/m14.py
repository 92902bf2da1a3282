"""Wrong answers to the exercises of notebook 14."""

import torch


def codes(z, books, residual=True, book=lambda books, level: books[level], nearest="l2", total="sum", start=0):
    left, named, found = z, [], []
    for level in range(start, len(books)):
        rows = book(books, level)
        difference = left[:, None] - rows
        score = {
            "l2": difference.square().sum(-1),
            "l1": difference.abs().sum(-1),
            "dot": -(left @ rows.T),
            "farthest": -difference.square().sum(-1),
        }[nearest]
        index = score.argmin(-1)
        if residual:
            left = left - rows[index]
        named.append(index)
        found.append(rows[index])
    made = {"sum": sum(found), "last": found[-1], "first": found[0], "mean": sum(found) / len(found), "left": left}
    return torch.stack(named, -1), made[total]


def in_place(z, books):
    left, named = z, []
    before = z.clone()
    for book in books:
        index = torch.cdist(left, book).argmin(-1)
        left -= book[index]
        named.append(index)
    return torch.stack(named, -1), before - left


def best_of_all(z, books):
    """The best sum there is, over all combinations: better, and not what Eq. 8 says."""
    every = torch.cartesian_prod(*[torch.arange(books.shape[1])] * len(books)).reshape(-1, len(books))[:4096]
    sums = sum(book[index] for book, index in zip(books, every.T))
    choice = torch.cdist(z, sums).argmin(-1)
    return every[choice], sums[choice]


def each_level(z, books):
    """As released: every level has a bridge of its own."""
    left, out = z, 0
    for book in books:
        found = book[torch.cdist(left, book).argmin(-1)].detach()
        out = out + left + (found - left).detach()
        left = left - found
    return out


def quantised(z, books):
    return codes(z.detach(), books)[1]


def mask(known, reading, back=True, swap=None, change=None):
    place = torch.arange(known.shape[1])
    looks = (place[:, None] >= place) if back else (place[:, None] > place)
    looks = looks.expand(len(known), -1, -1)
    row, column = known.unsqueeze(2), known.unsqueeze(1)
    masks = {
        "run": looks,
        "trained": (row & column) | (~row & looks),
        "meant": (row & column) | (~row & (looks | column)),
    }
    if change:
        masks |= change(row, column, looks)
    return masks[(swap or {}).get(reading, reading)]


MUTANTS = {
    "14.1": [
        lambda z, b: codes(z, b, residual=False),  # every level names z itself
        lambda z, b: codes(z, b, book=lambda books, level: books[0]),  # one book for all levels
        lambda z, b: codes(z, b, book=lambda books, level: books[-1 - level]),  # the finest level first
        lambda z, b: codes(z, b, nearest="farthest"),
        lambda z, b: codes(z, b, nearest="dot"),  # the longest code, not the nearest
        lambda z, b: codes(z, b, nearest="l1"),
        lambda z, b: codes(z, b, total="last"),
        lambda z, b: codes(z, b, total="first"),
        lambda z, b: codes(z, b, total="mean"),
        lambda z, b: codes(z, b, total="left"),  # what is left instead of what was named
        lambda z, b: (codes(z, b)[0].T, codes(z, b)[1]),
        lambda z, b: (codes(z, b)[0], z),  # never quantised
        in_place,
        best_of_all,
    ],
    "14.2": [
        each_level,
        quantised,  # no bridge: the gradient goes to the codebooks
        lambda z, b: quantised(z, b).detach(),
        lambda z, b: z + 0 * quantised(z, b),  # a bridge without quantising
        lambda z, b: z + quantised(z, b) - z.detach(),  # the codebooks learn too
        lambda z, b: (z + (quantised(z, b) - z).detach()) / 2 + quantised(z, b).detach() / 2,  # half the gradient
        lambda z, b: z - z.detach() + each_level(z, b) if len(b) > 1 else each_level(z, b),  # one too many
    ],
    "14.3": [
        lambda known, reading: mask(known, "run"),  # one mask for all
        lambda known, reading: mask(known, "meant"),
        lambda known, reading: mask(known, reading, back=False),  # nobody sees itself
        lambda known, reading: mask(known, reading).transpose(1, 2),
        lambda known, reading: mask(known, reading, swap={"trained": "meant", "meant": "trained"}),
        lambda known, reading: mask(known, reading, swap={"meant": "run"}),  # Eq. 11 to the letter
        lambda known, reading: mask(~known, reading),  # known and masked confused
        lambda known, reading: mask(known, reading)[0],  # one matrix for the whole batch
        lambda known, reading: mask(  # known rows look back at what is made
            known, reading, change=lambda row, column, back: {"meant": back | column}
        ),
        lambda known, reading: mask(  # known rows are causal among themselves
            known, reading, change=lambda row, column, back: {"trained": (row & column & back) | (~row & back)}
        ),
        lambda known, reading: mask(  # what is made sees what is known only
            known, reading, change=lambda row, column, back: {"meant": column.expand_as(back)}
        ),
        lambda known, reading: mask(  # what is made sees everything
            known, reading, change=lambda row, column, back: {"meant": (row & column) | ~row.expand_as(back)}
        ),
    ],
}
