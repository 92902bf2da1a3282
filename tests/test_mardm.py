"""MARDM: what is masked, what the loss hears, in which order latents are drawn, and what an edited motion may know."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from model_helpers import dependencies, randomise

from minicmdm import cli
from minicmdm.config import DiTConfig, MaskedConfig, Preset, TextConfig, TMRConfig, VAEConfig
from minicmdm.data.dataset import make_clip
from minicmdm.data.features import features_to_joints
from minicmdm.diffusion.path import cosine_alpha_bar, interpolate
from minicmdm.editing import GIVEN, encode_kept, kept, kept_latents
from minicmdm.models.text import TextEncoder
from minicmdm.models.vae import MACVAE
from minicmdm.motion import Motion
from minicmdm.pipeline import MotionPipeline
from minicmdm.systems import MaskedTransformer
from minicmdm.systems.mardm import DiffusionHead, corrupt, draw_mask, masked_loss, unmask, unmask_counts
from minicmdm.systems.masked import MaskedPipeline
from minicmdm.training.checkpoints import Checkpoint

C, DIM = 4, 16
PLAN = Preset(
    "tiny",
    VAEConfig(input_dim=67, latent_dim=C, width=16, depth=1, causal=False, deterministic=True),
    TextConfig(dim=16, layers=1, heads=2, vocab_size=100, max_words=24),
    TMRConfig(dim=16, layers=1, heads=2, embed_dim=8, dropout=0.0),
    DiTConfig(
        latent_dim=C, text_dim=16, dim=DIM, layers=2, heads=2, time_dim=16, attention="bidirectional", clock=True
    ),
    system="mardm",
    masked=MaskedConfig(head_dim=16, head_layers=2, iterations=5),
)


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def lengths(*counts):
    """(B,N): which latents of motions of these lengths are no padding."""
    return torch.arange(max(counts)) < torch.tensor(counts)[:, None]


@pytest.fixture(scope="module")
def model():
    return randomise(MaskedTransformer(PLAN)).float()


@pytest.fixture(scope="module")
def pipe(model):
    """A pipeline of random weights, none of them zero."""
    stats = {"feature_mean": torch.zeros(67), "feature_std": torch.ones(67)}
    stats |= {"latent_mean": torch.zeros(C), "latent_std": torch.ones(C)}
    vae = randomise(MACVAE(PLAN.vae)).float()
    text = TextEncoder.from_captions(["a person walks, then jumps twice", "a person sits down and runs"], PLAN.text)
    return MaskedPipeline(Checkpoint(PLAN, vae, model, text.eval(), stats, {}))


# --- training: what is hidden, and what is asked ----------------------------------------------------------------------


def test_two_thirds_are_masked_on_average_at_least_one_and_no_padding():
    counts = [49, 20, 10, 3, 1]
    valid = lengths(*counts).repeat(4000, 1)  # (B,N)
    masked = draw_mask(valid, seeded())
    assert masked.dtype == torch.bool and not (masked & ~valid).any()
    share = (masked.sum(1) / valid.sum(1)).reshape(4000, 5)
    for column, count in zip(share.T, counts):
        assert (column * count).round().min() == 1
        if count >= 10:  # in shorter ones "at least one" weighs more
            assert abs(column.mean() - 2 / math.pi) < 0.02
            assert abs((column < 0.5).float().mean() - 1 / 3) < 0.07  # cos(pi u / 2) < 1/2 where u > 2/3
    often = masked.reshape(4000, 5, 49)[:, 0].float().mean(0)
    assert (often - 2 / math.pi).abs().max() < 0.04  # no place is favoured
    assert torch.equal(draw_mask(valid, seeded()), masked)


def test_masked_latents_become_noise_the_mask_vector_or_stay():
    z = torch.full((200, 300, C), 5.0)
    masked, vector = torch.rand(200, 300, generator=seeded()) < 0.5, torch.arange(10.0, 10 + C)
    shown = corrupt(z, masked, vector, seeded(1))
    assert torch.equal(shown[~masked], z[~masked])
    inside = shown[masked]  # (M,C)
    is_vector, stays = (inside == vector).all(-1), (inside == 5).all(-1)
    noise = inside[~is_vector & ~stays]
    assert ((inside == vector).any(-1) == is_vector).all() and (noise != 5).all()  # a latent as a whole
    for share, found in [(0.792, is_vector), (0.108, stays), (0.1, ~is_vector & ~stays)]:
        assert abs(found.float().mean() - share) < 0.01
    assert abs(noise.mean()) < 0.05 and abs(noise.std() - 1) < 0.05


class Head(torch.nn.Module):
    """A head that is given its formula."""

    def __init__(self, formula):
        super().__init__()
        self.formula = formula

    def forward(self, x, t, conditions):
        return self.formula(x, t[..., None], conditions)


def spied(head, conditions=None):
    """A stand-in for the transformer, and the list of what it was shown."""
    heard = []

    def look(shown, known, *rest):
        heard.append((shown, known, rest))
        return torch.zeros(*shown.shape[:2], DIM) if conditions is None else conditions

    stand_in = SimpleNamespace(
        heard=lambda *_: None, mask_vector=torch.full((C,), 9.0), conditions=look, head=head, cfg=PLAN.dit
    )
    stand_in.masked = PLAN.masked
    return stand_in, heard


def test_the_loss_is_of_masked_latents_alone():
    valid, z = lengths(12, 7), torch.randn(2, 12, C, generator=seeded(7))
    model, heard = spied(Head(lambda x, t, c: 0.3 * x))

    def loss(z, seed):
        return masked_loss(model, z, None, None, valid, None, seeded(seed))

    for seed in range(5):
        before = loss(z, seed)
        shown, known, _ = heard[-1]
        masked = valid & ~known
        assert masked.any(1).all() and not (known & ~valid).any() and torch.equal(shown[known], z[known])
        for where, moves in [(known, False), (~valid, False), (masked, True)]:
            after = loss(z + 3.0 * where[..., None], seed)
            assert moves == (not torch.equal(after, before)) or not where.any()


def test_a_head_that_knows_the_answer_has_no_loss_and_a_silent_one_pays_the_target():
    z, valid = 2 * torch.randn(40, 30, C, generator=seeded()), torch.ones(40, 30, dtype=torch.bool)
    told = torch.cat([z, torch.zeros(40, 30, DIM - C)], -1)
    knows, _ = spied(Head(lambda x, t, c: (c[..., :C] - x) / (1 - t)), told)
    asked = []
    silent, _ = spied(Head(lambda x, t, c: asked.append(x) or 0 * x))
    of_one, of_other = (masked_loss(m, z, None, None, valid, None, seeded(3)) for m in (knows, silent))
    assert of_one < 1e-6  # each latent has its own condition, its own noise and its own time
    assert abs(of_other - (4 + 1)) < 0.3  # E |z - eps|^2
    masked = int(draw_mask(valid, seeded(3)).sum())
    assert asked[0].shape == (1, PLAN.masked.repeats * masked, C)  # each with several noises


def test_padding_and_its_words_reach_no_loss_and_all_weights_learn(model):
    valid, z = lengths(9, 5), torch.randn(2, 9, C, generator=seeded(5))
    words, word_mask = torch.randn(2, 3, DIM, generator=seeded(6)), torch.ones(2, 9, 3, dtype=torch.bool)
    clock = torch.zeros(2, 9, 2)

    def loss(z, words):
        return masked_loss(model, z, words, word_mask, valid, clock, seeded(2))

    before = loss(z, words)
    assert torch.equal(loss(torch.where(valid[..., None], z, 7.0), words), before)
    assert not torch.allclose(loss(z, words + 1), before)
    model.zero_grad()
    before.backward()
    # Only `read`, which was not run, may be silent.
    silent = {name for name, w in model.named_parameters() if w.grad is None or not w.grad.any()}
    assert silent <= {name for name, _ in model.named_parameters() if "embed_words" in name}, silent
    model.zero_grad()


# --- the transformer and the head -------------------------------------------------------------------------------------


def test_every_latent_is_seen_by_all_and_padding_by_none(model):
    valid, place = lengths(5, 8)[:1], torch.arange(8.0)
    clock = torch.stack([place, 4 - place], -1)[None]
    words, word_mask = torch.randn(1, 3, DIM, generator=seeded()), torch.ones(1, 8, 3, dtype=torch.bool)
    shown = torch.randn(1, 8, C, generator=seeded(1))
    moves = dependencies(lambda x: model.conditions(x, valid, words, word_mask, valid, clock), shown)  # (N,N)
    assert moves[:5, :5].all() and not moves[:5, 5:].any()
    before = model.conditions(shown, valid, words, word_mask, valid, clock)
    assert before.shape == (1, 8, DIM)
    for changed in ((words + 1, clock), (words, clock + 1)):
        assert not torch.allclose(model.conditions(shown, valid, changed[0], word_mask, valid, changed[1]), before)


def test_the_head_draws_each_latent_by_itself():
    head = randomise(DiffusionHead(C, DIM, 16, 2))
    x, told = (torch.randn(1, 6, n, generator=seeded(n)).double() for n in (C, DIM))
    t = torch.linspace(0.1, 0.9, 6)[None].double()
    own = torch.eye(6, dtype=torch.bool)
    assert torch.equal(dependencies(lambda x: head(x, t, told), x), own)
    assert torch.equal(dependencies(lambda told: head(x, t, told), told), own)
    assert torch.equal(dependencies(lambda t: head(x, t[..., 0], told), t[..., None]), own)
    alone = torch.stack([head(x[0, n], t[0, n], told[0, n]) for n in range(6)])
    assert torch.allclose(head(x, t, told)[0], alone)


# --- sampling ---------------------------------------------------------------------------------------------------------

OF_49 = [49, 49, 48, 47, 46, 44, 42, 39, 36, 33, 30, 26, 22, 18, 13, 9, 5, 1]  # the released MARDM's 18 iterations
CDAMD_OF_49 = [49, 48, 46, 42, 38, 31, 24, 17, 9, 1]


def test_unmask_counts_are_those_of_the_release():
    assert unmask_counts(torch.tensor([49]), 18)[:, 0].tolist() == OF_49
    assert unmask_counts(torch.tensor([49]), 10)[:, 0].tolist() == CDAMD_OF_49
    counts = unmask_counts(torch.tensor([49, 7, 1, 30]), 18)
    assert counts.shape == (18, 4) and counts[:, 0].tolist() == OF_49
    assert counts[0].tolist() == [49, 7, 1, 30] and counts[-1].tolist() == [1, 1, 1, 1]
    assert (counts.diff(dim=0) <= 0).all()


def looks(seen, *branches):
    """A `look` that writes down what it was shown, and answers with these conditions (dim,) for every latent."""

    def look(shown, known):
        seen.append((shown.clone(), known.clone()))
        return [branch.expand(*shown.shape[:2], -1) for branch in branches]

    return look


def test_latents_leave_the_mask_in_turn_and_then_stay():
    seen, model = [], spied(Head(lambda x, t, c: -0.5 * x))[0]
    wanted = lengths(20, 11)
    z = unmask(looks(seen, torch.zeros(DIM)), model, wanted, [seeded(1), seeded(2)], num_steps=2)
    counts = unmask_counts(torch.tensor([20, 11]), PLAN.masked.iterations)
    assert z.shape == (2, 20, C) and len(seen) == len(counts)
    orders = []
    for (shown, known), count, (_, later) in zip(seen, counts, seen[1:] + [(None, torch.ones_like(wanted))]):
        masked = ~known & wanted
        assert torch.equal(masked.sum(1), count) and torch.equal(known & later, known)  # nobody is masked again
        assert (shown[~known] == 9).all()  # the mask vector
        assert torch.equal(shown[known], z[known])  # what was drawn last is what stays
        orders.append(masked.nonzero().tolist())
    again = []
    unmask(looks(again, torch.zeros(DIM)), model, wanted, [seeded(1), seeded(3)], num_steps=2)
    assert all(torch.equal(a[0], b[0]) for (_, a), (_, b) in zip(seen, again))  # the order is the sample's own
    assert any(not torch.equal(a[1], b[1]) for (_, a), (_, b) in zip(seen, again))  # and random


def test_what_is_given_stays_bit_for_bit(pipe):
    given, keep = torch.randn(1, 14, C, generator=seeded(1)), kept_latents(14, "ends")
    ask = pipe._asked(None, 3, None, None, 3.0, None)
    z = pipe._fill(given, keep, "a person walks", seeded(), ask)
    assert torch.equal(z[0, keep], given[0, keep]) and (z[0, ~keep] != given[0, ~keep]).all()
    other = given.clone()
    other[0, ~keep] = 5.0  # what stood where nothing is given is never read
    assert torch.equal(pipe._fill(other, keep, "a person walks", seeded(), ask), z)
    moved = given + keep[:, None]
    assert not torch.allclose(pipe._fill(moved, keep, "a person walks", seeded(), ask)[0, ~keep], z[0, ~keep])
    all_kept = torch.ones(14, dtype=torch.bool)
    assert torch.equal(pipe._fill(given, all_kept, "a person walks", seeded(), ask), given)


def test_a_motion_does_not_depend_on_its_company(pipe):
    prompts, frames = ["a person walks", "a person jumps twice, then runs", "a person sits down"], [24, 61, 40]
    together = pipe(prompts, frames, seed=[3, 4, 5], num_steps=3)
    for k, motion in enumerate(together):
        alone = pipe(prompts[k], frames[k], seed=3 + k, num_steps=3)
        assert np.allclose(alone.features, motion.features, atol=1e-4)


def test_guidance_is_in_the_head_with_one_noise_for_both(model):
    told, null = torch.randn(2, DIM, generator=seeded())

    def drawn(*branches, scale=1.0):
        one = lengths(10)
        return unmask(looks([], *branches), model, one, [seeded(3)], num_steps=4, guidance_scale=scale)

    assert torch.allclose(drawn(told, null), drawn(told), atol=1e-5)  # scale 1 is no guidance
    assert torch.allclose(drawn(told, null, scale=0.0), drawn(null), atol=1e-5)
    assert torch.allclose(drawn(told, told, scale=7.0), drawn(told), atol=1e-5)  # had each its own noise, it would not
    assert not torch.allclose(drawn(told, null, scale=3.0), drawn(told), atol=1e-2)
    # A head that answers with its condition: the guided velocity is u + s (c - u), so z = noise + that.
    flat, _ = spied(Head(lambda x, t, c: c[..., :C] + 0 * x))
    noise = unmask(looks([], 0 * null), flat, lengths(10), [seeded(3)], num_steps=4)
    guided = unmask(looks([], told, null), flat, lengths(10), [seeded(3)], num_steps=4, guidance_scale=3.0)
    assert torch.allclose(guided - noise, (null + 3 * (told - null))[:C].expand(1, 10, -1), atol=1e-5)


def best_velocity(x, t, mean, std):
    """E[z - eps | x] of z ~ N(mean, std^2)."""
    z = mean + t * std**2 / (t**2 * std**2 + (1 - t) ** 2) * (x - t * mean)
    return (z - x) / (1 - t)


def best_noise(x, t, mean, std):
    """E[eps | x] on the DDPM's path, at level 1 - t."""
    abar = cosine_alpha_bar(1 - t)
    z = mean + abar.sqrt() * std**2 / (abar * std**2 + 1 - abar) * (x - abar.sqrt() * mean)
    return (x - abar.sqrt() * z) / (1 - abar).sqrt()


@pytest.mark.parametrize(("path", "best", "solver"), [("flow", best_velocity, "euler"), ("ddpm", best_noise, "ddpm")])
def test_a_perfect_head_lands_on_mean_and_variance(path, best, solver):
    head = Head(lambda x, t, c: best(x, t, c[..., :1], 0.7))
    stand_in, _ = spied(head)
    stand_in.cfg = SimpleNamespace(latent_dim=C, path=path)
    generators = [seeded(k) for k in range(100)]
    how = dict(num_steps=60, solver=solver)
    z = unmask(looks([], torch.full((DIM,), 2.0)), stand_in, torch.ones(100, 12).bool(), generators, **how)
    assert abs(z.mean() - 2.0) < 0.05 and abs(z.std() - 0.7) < 0.05
    flat = z.reshape(100, -1).T
    assert torch.corrcoef(flat).fill_diagonal_(0).abs().max() < 0.7  # every latent with a noise of its own
    # Guidance towards a higher mean, from a null that is the same but for it.
    branches = torch.full((DIM,), 2.0), torch.full((DIM,), 1.0)
    guided = unmask(
        looks([], *branches),
        stand_in,
        torch.ones(100, 12).bool(),
        [seeded(k) for k in range(100)],
        guidance_scale=2.0,
        **how,
    )
    assert abs(guided.mean() - 3.0) < 0.1 and abs(guided.std() - 0.7) < 0.05


def test_the_clocks_of_loss_and_sampler_agree():
    """A head may be trained and asked on one clock only: t = 0 is noise in both."""
    seen = []

    def formula(x, t, c):
        seen.append((x, t))
        return 0 * x

    model, _ = spied(Head(formula))
    z = torch.full((8, 20, C), 50.0)
    masked_loss(model, z, None, None, torch.ones(8, 20).bool(), None, seeded())
    x, t = seen.pop()
    assert (x - interpolate(torch.full_like(x, 50.0), torch.zeros_like(x), t[..., 0])).abs().max() < 6
    unmask(looks([], torch.zeros(DIM)), model, lengths(6), [seeded()], num_steps=4)
    assert [t.unique().item() for _, t in seen[:4]] == [0.0, 0.25, 0.5, 0.75]


# --- editing ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("given", "twelve", "thirteen"),
    [
        ("first_half", "111111000000", "1111110000000"),
        ("second_half", "000000111111", "0000001111111"),
        ("ends", "111000000111", "1110000000111"),
        ("middle", "000111111000", "0001111111000"),
    ],
)
def test_kept_latents_are_named_by_what_is_given(given, twelve, thirteen):
    for row in (twelve, thirteen):
        assert kept_latents(len(row), given).tolist() == [digit == "1" for digit in row]


def test_two_halves_or_ends_and_middle_make_a_whole():
    for count in range(4, 50):
        for a, b in (("first_half", "second_half"), ("ends", "middle")):
            assert (kept_latents(count, a) ^ kept_latents(count, b)).all() and kept_latents(count, a).any()
    for wrong in ("prefix", "", None):
        with pytest.raises(ValueError, match="first_half, second_half, ends, middle"):
            kept_latents(12, wrong)


@pytest.mark.parametrize("given", GIVEN)
def test_kept_latents_know_nothing_of_what_is_hidden(pipe, given):
    x = torch.randn(1, 48, 67, generator=seeded())
    keep = kept_latents(12, given)
    hidden = ~keep.repeat_interleave(4)
    changed = x.clone()
    changed[:, hidden] += torch.randn(1, int(hidden.sum()), 67, generator=seeded(1))
    z = encode_kept(pipe.encode, x, keep)
    assert z.shape == (1, 12, C) and torch.equal(encode_kept(pipe.encode, changed, keep), z)
    assert not z[0, ~keep].any() and z[0, keep].all()
    released = [pipe.encode(one)[0, keep] for one in (x, changed)]
    assert (released[0] - released[1]).abs().max() > 0.1  # the encoder looks both ways: this one knows the answer
    first, last = keep.nonzero()[[0, -1], 0].tolist()
    if keep[first : last + 1].all():  # one part
        assert torch.equal(z[:, keep], pipe.encode(x[:, 4 * first : 4 * last + 4]))


def wave(seed, frames=48):
    """A motion of the toy world, from its frame 20 on."""
    return features_to_joints(make_clip("val", seed).features)[20 : 20 + frames].astype(np.float32)


@pytest.mark.parametrize("given", GIVEN)
def test_nor_do_they_from_the_joints_on(pipe, given):
    """A smoothed heading looks a second ahead and a step needs the next frame: neither may come of what is hidden."""
    joints = wave(0)
    z, keep = kept(pipe.encode, Motion(joints), given)
    changed, hidden = joints.copy(), ~keep.repeat_interleave(4).numpy()
    changed[hidden] = wave(3)[hidden] + [0.5, 0.0, -0.3]
    again, _ = kept(pipe.encode, Motion(changed), given)
    assert torch.equal(again, z) and z[0, keep].all()
    moved = joints.copy()
    moved[~hidden] = wave(3)[~hidden]
    assert not torch.allclose(kept(pipe.encode, Motion(moved), given)[0], z)


@pytest.mark.parametrize("frames", [16, 17, 41, 50])
def test_any_length_is_kept_to_its_last_frame(pipe, frames):
    z, keep = kept(pipe.encode, Motion(wave(0, frames)), "second_half")
    assert z.shape == (1, -(-frames // 4), C) and len(keep) == z.shape[1] and torch.isfinite(z).all()
    assert len(pipe.edit(Motion(wave(0, frames), caption="a person walks"), "ends")) == frames


def test_263_features_are_encoded_as_their_first_67(pipe):
    x = make_clip("val", 0).features[None, :40]
    assert torch.equal(pipe.encode(x), pipe.encode(x[..., :67]))


# --- the command ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def folder(pipe, tmp_path_factory):
    return str(pipe.save_pretrained(tmp_path_factory.mktemp("mardm") / "tiny"))


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    np.save("source.npy", wave(0))
    np.save("short.npy", wave(0, 15))
    np.save("flat.npy", wave(0).reshape(48, -1))
    (tmp_path / "mine.npy").write_text("mine")
    return tmp_path


def test_the_command_edits_and_repeats_itself(here, folder, capsys):
    command = ["edit", "source.npy", "a person runs", "--checkpoint", folder, "--given", "ends"]
    for name, more in (("a", []), ("b", ["--seed", "0"]), ("c", ["--seed", "1"]), ("d", ["--given", "middle"])):
        assert cli.main([*command, "--out", f"{name}.npy", *more]) == 0
    out, err = capsys.readouterr()
    assert out == "" and "wrote a.npy (48 frames" in err and "ends" in err
    a, b, c, d = (np.load(here / f"{name}.npy") for name in "abcd")
    assert a.shape == (48, 22, 3) and a.dtype == np.float32 and np.array_equal(a, b)
    assert not np.array_equal(a, c) and not np.array_equal(a, d)
    pipe = MotionPipeline.from_pretrained(folder)
    assert np.allclose(pipe.edit(Motion(wave(0)), "ends", "a person runs").joints, a, atol=1e-6)
    assert cli.main([*command, "--out", "mine.npy", "--force"]) == 0 and len(np.load("mine.npy")) == 48


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["source.npy", "walks", "--given", "prefix"], "first_half, second_half, ends, middle"),
        (["short.npy", "walks"], "15 frames"),
        (["source.npy", "walks", "--out", "mine.npy"], "--force"),
        (["source.npy", "walks", "--out", "no/new.npy"], "does not exist"),
        (["source.npy", "walks", "--out", "new.mp3"], ".html"),
        (["source.npy", " "], "prompt is empty"),
        (["source.npy", "walks", "--guidance", "nan"], "guidance"),
        (["source.npy", "walks", "--seed", "-1"], "seed"),
        (["absent.npy", "walks"], "absent.npy"),
        (["flat.npy", "walks"], "(T,22,3)"),
        (["source.npy", "walks", "--checkpoint", "nowhere"], "nowhere"),
        (["source.npy"], "PROMPT"),
    ],
)
def test_bad_requests_end_in_one_line(here, folder, capsys, arguments, message):
    before = {path: path.read_bytes() for path in here.iterdir()}
    assert cli.main(["edit", *(["--out", "new.npy", "--checkpoint", folder] + arguments)]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.count("\n") == 1 and err.startswith("minicmdm: ") and message in err, err
    assert {path: path.read_bytes() for path in here.iterdir()} == before
