"""Wrong answers to the exercises of notebook 00."""

MUTANTS = {
    "00.1": [
        lambda frames, width: ((frames // 4, width), (frames // 4 * 4, 263), (frames, 22, 3)),  # rounds down
        lambda frames, width: ((frames // 4 + 1, width), (frames // 4 * 4 + 4, 263), (frames, 22, 3)),  # one too many
        lambda frames, width: ((-(-frames // 4), width), (frames, 263), (frames, 22, 3)),  # cuts too early
        lambda frames, width: ((-(-frames // 4), width), (-(-frames // 4) * 4, 263), (-(-frames // 4) * 4, 22, 3)),
        lambda frames, width: ((-(-frames // 4), 16), (-(-frames // 4) * 4, 263), (frames, 22, 3)),  # a fixed width
        lambda frames, width: ((30, width), (120, 263), (120, 22, 3)),  # the motion on show
    ],
    "00.2": [
        lambda frame: frame,  # causal to the frame
        lambda frame: frame // 4,  # the latent, not the frame
        lambda frame: -(-frame // 4) * 4,
        lambda frame: max(frame - 3, 0),
        lambda frame: frame // 12 * 12,  # the release's blocks of three latents, which this VAE does not have
        lambda frame: 0,
    ],
}
