"""The stream is the dense sampler for every schedule, block size and mask, with prompts that change; then it slides."""

import copy
import io
import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import make_tiny_preset
from hypothesis import given, settings
from hypothesis import strategies as st
from model_helpers import randomise

from minicmdm import cli
from minicmdm.config import DiTConfig
from minicmdm.data.features import features_to_joints, retarget
from minicmdm.diffusion.sampling import guided, sample
from minicmdm.diffusion.schedules import cost, schedule_matrix
from minicmdm.diffusion.streaming import LONGEST, LatentStream, pace
from minicmdm.live import MotionStream, latents_before
from minicmdm.models.dit import CausalDiT
from minicmdm.models.text import TextEncoder, Words
from minicmdm.models.vae import MACVAE
from minicmdm.pipeline import MotionPipeline
from minicmdm.training.checkpoints import Checkpoint

TINY = DiTConfig(latent_dim=3, text_dim=5, dim=16, layers=2, heads=2, time_dim=8, clock=True)


def read(sentences):
    """A text encoder of sorts: as many words as the sentence has letters, the same ones for the same letters."""
    words = [
        torch.randn(len(s), 16, generator=torch.Generator().manual_seed(sum(map(ord, s)))).double() for s in sentences
    ]
    longest = max(map(len, sentences))
    mask = torch.tensor([[place < len(s) for place in range(longest)] for s in sentences])
    return Words(torch.nn.utils.rnn.pad_sequence(words, batch_first=True), mask)


NULL = read(["--"])


def make_stream(model, sentences, **kwargs):
    generators = [torch.Generator().manual_seed(seed) for seed in range(len(sentences))]
    return LatentStream(model, read, NULL, sentences, generators, **kwargs)


def run(stream, num_latents, says=()):
    """The first latents of a stream; says = {call: (sentences, at, lasts)} is said before that call."""
    says, out = dict(says), []
    while sum(z.shape[1] for z in out) < num_latents:
        if stream.calls in says:
            stream.listen(*says[stream.calls])
        out.append(stream.step())
    return torch.cat(out, dim=1)[:, :num_latents]


def noise(batch, num_latents):
    pages = [torch.randn(LONGEST, 3, generator=torch.Generator().manual_seed(seed)) for seed in range(batch)]
    return torch.stack(pages)[:, :num_latents]


def dense(model, sentences, matrix, scale, reach="new", says=()):
    """The dense sampler, told the same at the same time: who hears what is worked out here once more, the slow way.

    owner[b][n] = (sentence, begin, lasts) of latent n in stream b, at every call; all latents are computed always.
    """
    batch, total = len(sentences), matrix.shape[1]
    owner = [[(sentence, 0, 0)] * total for sentence in sentences]
    says, call = dict(says), -1
    texts = {*sentences, *(s for said in says.values() for s in said[0] if s is not None)}
    texts = sorted(texts)
    read_all = read(texts)
    dtype = next(model.parameters()).dtype
    words = read_all.embeddings.to(dtype).flatten(0, 1).expand(batch, -1, -1)  # all sentences side by side
    length = read_all.mask.shape[1]

    def denoise(z, t):
        nonlocal call
        call += 1
        if call in says:
            spoken, at, lasts = (*says[call], None, 0)[:3]
            waiting = matrix[call] == matrix[0, 0]
            waiting &= matrix[max(call - 1, 0)] == matrix[0, 0]  # what moved in the call before has started
            first = int(waiting.argmax()) if waiting.any() else total
            if reach == "active" and at is None:
                unfinished = matrix[call] > 0
                first = int(unfinished.argmax())
            first = first if at is None else at
            for b, sentence in enumerate(spoken):
                if sentence is not None:
                    owner[b][first:] = [(sentence, first, lasts)] * (total - first)
        mask = torch.zeros(batch, total, words.shape[1], dtype=torch.bool)
        clock = torch.zeros(batch, total, 2)
        for b in range(batch):
            for n, (sentence, begin, lasts) in enumerate(owner[b]):
                k = texts.index(sentence)
                mask[b, n, k * length : (k + 1) * length] = read_all.mask[k]
                since = n - begin
                while lasts and since >= lasts:  # again and again
                    since -= lasts
                clock[b, n] = torch.tensor([since, lasts - 1 - since if lasts else -1])
        null_words, null_mask = (
            NULL.embeddings.to(dtype).expand(batch, -1, -1),
            NULL.mask[:, None].expand(batch, total, -1),
        )
        return guided(model, words, mask, null_words, null_mask, scale, clock=clock)(z, t)

    return sample(denoise, matrix, noise(batch, total).to(dtype))


@st.composite
def cases(draw):
    attention = draw(st.sampled_from(["causal", "bidirectional", "window"]))
    cfg = replace(TINY, attention=attention, block_size=draw(st.integers(1, 3)), clock=draw(st.booleans()))
    cfg = replace(cfg, layers=draw(st.integers(1, 3)), heads=draw(st.sampled_from([1, 2, 4])))
    num_steps = draw(st.integers(1, 6))
    how = dict(schedule=draw(st.sampled_from(["full", "fss", "autoregressive", "triangular"])), num_steps=num_steps)
    how |= dict(uncertainty=draw(st.integers(0, num_steps)), block_size=draw(st.integers(1, 4)))
    how |= dict(
        guidance_scale=draw(st.sampled_from([0.0, 1.0, 2.5])), new_prompt=draw(st.sampled_from(["new", "active"]))
    )
    batch = draw(st.integers(1, 2))
    says = {}
    for call in sorted(draw(st.sets(st.integers(0, 20), max_size=3))):
        spoken = draw(st.lists(st.sampled_from([None, "sit", "walk on", "turn"]), min_size=batch, max_size=batch))
        says[call] = (spoken, None, draw(st.sampled_from([0, 5])))
    return cfg, how, batch, draw(st.integers(1, 12)), says


@settings(max_examples=30, deadline=None, derandomize=True)
@given(cases())
def test_the_stream_is_the_dense_sampler(case):
    cfg, how, batch, num_latents, says = case
    model = randomise(CausalDiT(cfg))
    sentences = ["run fast", "jump"][:batch]
    matrix = schedule_matrix(num_latents, how["num_steps"], how["uncertainty"], how["block_size"], how["schedule"])
    stream = make_stream(model, sentences, num_latents=num_latents, **how)
    ahead = stream.ahead
    with torch.no_grad():
        expected = dense(model, sentences, matrix, how["guidance_scale"], how["new_prompt"], says)
    found = run(stream, num_latents, says)
    torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-9)
    assert stream.calls == len(matrix) - 1 and stream.finished == num_latents
    assert ahead >= cost(matrix).latents_in_flight  # so early must a prompt be known


@pytest.mark.parametrize("block_size", [1, 3])
@pytest.mark.parametrize("how", [dict(schedule="fss", uncertainty=2), dict(schedule="autoregressive")])
def test_an_endless_causal_stream_begins_like_a_motion_of_any_length(block_size, how):
    """Nobody has told it where it ends, and under a causal mask it need not know. In float32 this time."""
    model = randomise(CausalDiT(replace(TINY, block_size=block_size))).float()
    stream = make_stream(model, ["walk", "sit"], num_steps=5, block_size=block_size, guidance_scale=3.0, **how)
    found = run(stream, 30)
    matrix = schedule_matrix(30, 5, how.get("uncertainty", 2), block_size, how["schedule"])
    with torch.no_grad():
        expected = dense(model, ["walk", "sit"], matrix, 3.0)
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-4 * expected.abs().max().item())


def test_prompts_announced_for_later_begin_where_they_were_announced():
    model = randomise(CausalDiT(replace(TINY, attention="window")))
    how = dict(num_steps=4, uncertainty=2, guidance_scale=2.0, num_latents=12)
    says = {0: (["sit"], 3, 4), 1: (["turn"], 7, 5)}
    with torch.no_grad():
        expected = dense(model, ["walk"], schedule_matrix(12, 4, 2), 2.0, says=says)
    stream = make_stream(model, ["walk"], **how)
    torch.testing.assert_close(run(stream, 12, says), expected, rtol=1e-9, atol=1e-9)
    # said at once, it replaces what was announced, and what has started cannot be told any more
    stream = make_stream(model, ["walk"], **how)
    stream.listen(["sit"], 3)
    stream.listen(["turn"])
    assert [said.sentences for said in stream.said] == [["turn"]]
    stream.step()
    with pytest.raises(ValueError, match="started already"):
        stream.listen(["walk"], 0)


def test_a_changed_prompt_is_heard_and_where():
    model = randomise(CausalDiT(TINY))
    how = dict(num_steps=6, uncertainty=2, num_latents=10)
    before = run(make_stream(model, ["walk"], **how), 10)
    for reach, first in (("new", 4), ("active", 1)):  # after 7 calls one latent is finished and three are in flight
        stream = make_stream(model, ["walk"], new_prompt=reach, **how)
        change = (run(stream, 10, {7: (["sit"],)}) - before).abs().amax(dim=(0, 2))
        assert (change[:first] == 0).all() and (change[first:] > 1e-6).all()


class Uncached(LatentStream):
    """A stream whose cache is read and never written: a mutant."""

    def step(self):
        done = super().step()
        self.cache.values[..., : self.cache.end, :] = 0
        return done


class Hasty(LatentStream):
    """A stream that keeps the keys of a latent's last step, which were made at another level: a mutant."""

    def step(self):
        done = super().step()
        self.cache.keep(done.shape[1])
        self._forget(done.shape[1])
        return done


@pytest.mark.parametrize("mutant", [Uncached, Hasty])
def test_the_property_would_notice_a_wrong_cache(mutant):
    model = randomise(CausalDiT(TINY))
    generators = [torch.Generator().manual_seed(0)]
    stream = mutant(model, read, NULL, ["walk"], generators, num_steps=4, num_latents=12)
    with torch.no_grad():
        expected = dense(model, ["walk"], schedule_matrix(12, 4, 2), 3.0)
    assert not torch.allclose(run(stream, 12), expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("attention", ["causal", "bidirectional", "window"])
@pytest.mark.parametrize("block_size", [1, 2])
def test_beyond_the_window_memory_and_work_stay_what_they_are(attention, block_size):
    model = randomise(CausalDiT(replace(TINY, attention=attention, block_size=block_size)))
    stream = make_stream(model, ["walk"], num_steps=4, uncertainty=2, block_size=block_size, window=12)
    sizes, work = set(), []
    for latents in range(20, 101, 20):
        before = stream.evaluations
        while stream.finished < latents:
            stream.step()
        storage = stream.z.untyped_storage().nbytes() + stream.spare.untyped_storage().nbytes()
        sizes.add((stream.z.shape, 0 if stream.cache is None else stream.cache.keys.numel(), storage < 10_000))
        work.append(stream.evaluations - before)
        assert stream.cache is None or len(stream.cache) + len(stream.heard) <= 12 and stream.cache.end <= 24
    assert len(sizes) == 1 and len(set(work[1:])) == 1 and len(stream.said) == 1
    assert stream.z.isfinite().all()


def test_where_the_slots_lie_changes_nothing():
    """A cache that never moves to the front, so that rotary positions count on, gives the same stream."""
    model = randomise(CausalDiT(TINY))
    moving, still = (make_stream(model, ["walk"], num_steps=4, window=8) for _ in range(2))
    cache = still.cache
    cache.keys, cache.values = (x.new_zeros(*x.shape[:3], 200, x.shape[4]) for x in (cache.keys, cache.values))
    torch.testing.assert_close(run(moving, 100), run(still, 100), rtol=1e-9, atol=1e-9)
    assert moving.cache.end <= 16 and still.cache.end > 90
    # the control: within the window both are the dense sampler, beyond it they are not
    with torch.no_grad():
        whole = dense(model, ["walk"], schedule_matrix(40, 4, 2), 3.0)
    change = (run(make_stream(model, ["walk"], num_steps=4, window=8), 40) - whole).abs().amax(dim=(0, 2))
    assert change[:4].max() < 1e-9 and change[20:].max() > 1e-6


def test_an_hour_of_changing_prompts_keeps_no_record():
    model = randomise(CausalDiT(replace(TINY, layers=1)))
    stream = make_stream(model, ["walk", "sit"], num_steps=2, window=8, new_prompt="active")
    for turn in range(30):
        stream.listen(["sit", None] if turn % 2 else [None, "turn"])
        stream.step(), stream.step()
    assert len(stream.said) == 1 and len(set(stream.heard)) <= 2


def test_work_that_is_saved():
    """Token evaluations in closed form: every latent K times and once more for the cache; waiting ones never."""
    model = randomise(CausalDiT(TINY))
    for kind, uncertainty in (("fss", 2), ("autoregressive", 6)):
        stream = make_stream(model, ["walk"], schedule=kind, num_steps=6, uncertainty=2, num_latents=20)
        run(stream, 20)
        assert stream.evaluations == 2 * (20 * 6 + 20 - min(20, -(-1 // uncertainty)))  # the last one needs no keys
        assert stream.calls == cost(schedule_matrix(20, 6, uncertainty)).calls
    stream = make_stream(model, ["walk"], num_steps=6, guidance_scale=1.0, num_latents=20)
    run(stream, 20)
    assert stream.evaluations == 20 * 6 + 19


@pytest.mark.parametrize("kind", ["full", "fss", "autoregressive", "triangular"])
def test_the_pace_goes_on_as_the_matrix_does(kind):
    for num_steps in (1, 4, 7):
        for uncertainty in range(num_steps + 1):
            matrix = schedule_matrix(20, num_steps, uncertainty, kind=kind)
            calls, blocks = pace(kind, num_steps, uncertainty)
            waits = (matrix == num_steps).sum(axis=0) - 1
            assert waits.tolist() == [calls * block // blocks for block in range(20)]


def test_what_cannot_stream_is_said():
    model = CausalDiT(TINY)
    with pytest.raises(ValueError, match="needs an end"):
        make_stream(model, ["walk"], schedule="full")
    with pytest.raises(ValueError, match="from left to right"):
        make_stream(model, ["walk"], schedule="trapezoid", num_latents=5)
    with pytest.raises(ValueError, match="too small"):
        make_stream(model, ["walk"], num_steps=20, uncertainty=2, window=9)
    with pytest.raises(ValueError, match="new, active"):
        make_stream(model, ["walk"], new_prompt="old")
    stream = make_stream(model, ["walk"], num_latents=1, num_steps=1, uncertainty=1)
    stream.step()
    with pytest.raises(ValueError, match="reached its end"):
        stream.step()


def test_bfloat16_streams_too():
    model = randomise(CausalDiT(TINY)).bfloat16()
    z = run(make_stream(model, ["walk"], num_steps=4), 8)
    assert z.dtype == torch.float32 and z.isfinite().all()


# ---- frames


@pytest.fixture(scope="module")
def pipe():
    """A whole system that was never trained, with no weight at zero."""
    plan = make_tiny_preset()
    sentences = ["a person walks", "a person jumps twice and waves", "a person sits down"]
    text = TextEncoder.from_captions(sentences, plan.text)
    ones = {"feature": torch.ones(263), "latent": torch.ones(plan.dit.latent_dim)}
    stats = {f"{name}_{key}": one * value for name, one in ones.items() for key, value in (("mean", 0.1), ("std", 0.5))}
    vae, dit = (randomise(module).float() for module in (MACVAE(plan.vae), CausalDiT(plan.dit)))
    return MotionPipeline(Checkpoint(plan, vae, dit, text, stats, {}))


def in_float64(pipe):
    """The same system in double precision; its frames are float32 still."""
    vae, dit, text = (copy.deepcopy(module).double() for module in (pipe.vae, pipe.dit, pipe.text))
    stats = {name: value.double() for name, value in pipe.stats.items()}
    return MotionPipeline(Checkpoint(pipe.preset, vae, dit, text, stats, {}))


@pytest.mark.parametrize("schedule", ["fss", "autoregressive", "full"])
def test_a_streamed_motion_is_the_pipelines_motion(pipe, schedule):
    pipe, how = in_float64(pipe), dict(schedule=schedule, num_steps=4, uncertainty=2, seed=5)
    for tell_length, lasts in ((False, None), (True, 64)):
        expected = pipe("a person walks", 64, tell_length=tell_length, **how).joints
        frames = list(pipe.stream("a person walks", num_frames=64, lasts=lasts, **how))
        assert frames[0].shape == (22, 3) and frames[0].dtype == np.float32
        np.testing.assert_allclose(np.stack(frames), expected, rtol=1e-6, atol=1e-6)
    assert len(list(pipe.stream("a person walks", num_frames=6, **how))) == 6


def test_streams_in_step_are_streams_alone(pipe):
    pipe = in_float64(pipe)  # in float32 a batch of two rounds otherwise than one, and 120 steps of the root add it up
    prompts, how = ["a person walks", "a person jumps twice and waves"], dict(num_steps=4)
    stream = pipe.stream(prompts, seed=[1, 2], **how)
    alone = [pipe.stream(prompt, seed=seed, **how) for prompt, seed in zip(prompts, (1, 2))]
    for frame in range(120):
        if frame == 50:
            stream.prompt([None, "a person sits down"])
            alone[1].prompt("a person sits down")
        np.testing.assert_allclose(next(stream), np.stack([next(one) for one in alone]), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("reach", ["new", "active"])
def test_the_reaction_is_as_long_as_it_says(pipe, reach):
    first, second = (pipe.stream("a person walks", num_steps=6, new_prompt=reach) for _ in range(2))
    for _ in range(42):
        next(first), next(second)
    reaction = second.reaction
    second.prompt("a person jumps")
    change = [np.abs(next(first) - next(second)).max() for _ in range(reaction + 4)]
    assert max(change[:reaction], default=0) < 1e-5 and max(change[reaction:]) > 1e-3  # rounding, and another motion
    assert reaction == {"new": 2 + 4 * 2, "active": 2}[reach]  # two frames of a latent are left, two latents in flight


def test_the_horizon_is_early_enough_for_any_schedule(pipe):
    for how in (dict(num_steps=5, uncertainty=2), dict(num_steps=4, block_size=3), dict(schedule="autoregressive")):
        stream = pipe.stream("a person walks", **{"num_steps": 3, **how})
        for frame in range(40):
            stream.prompt("a person sits", at=frame + stream.horizon, lasts=20)  # never too late
            next(stream)
        with pytest.raises(ValueError, match="started already"):  # and what is too late is refused
            stream.prompt("a person sits", at=36)


def test_joints_in_pieces_are_joints_in_one_go():
    rng = np.random.default_rng(0)
    features = torch.from_numpy(rng.normal(size=(2, 60, 263)))
    pieces = iter(features.split([4, 4, 20, 12, 20], dim=1))
    stream = MotionStream.__new__(MotionStream)
    stream._before, stream._yaw, stream._place = None, 0.0, 0.0
    found = np.concatenate([stream._recover(piece) for piece in pieces], axis=1)
    np.testing.assert_allclose(found, features_to_joints(features.numpy()), rtol=1e-5, atol=1e-5)


def test_which_latents_belong_to_what_comes_before_a_frame():
    """A latent belongs to the sentence that has begun by its middle frame, as in training."""
    for frame in range(40):
        assert latents_before(frame) == sum(4 * latent + 2 < frame for latent in range(20))


@pytest.mark.parametrize(
    "kwargs, message",
    [
        (dict(prompt=" "), "empty"),
        (dict(schedule="sideways"), "unknown schedule"),
        (dict(schedule="full"), "needs an end"),
        (dict(seed=-1), "seed"),
        (dict(guidance_scale=float("nan")), "guidance_scale"),
        (dict(window=2), "too small"),
        (dict(num_frames=0), "num_frames"),
    ],
)
def test_what_cannot_be_asked_is_said_before_any_frame(pipe, kwargs, message):
    with pytest.raises(ValueError, match=message):
        pipe.stream(**{"prompt": "a person walks", **kwargs})


def test_a_bad_prompt_leaves_the_stream_as_it_was(pipe):
    stream, other = (pipe.stream("a person walks", num_steps=3) for _ in range(2))
    for bad in ("", 3, ["a person walks"]):
        with pytest.raises((ValueError, TypeError)):
            stream.prompt(bad)
    assert np.array_equal(next(stream), next(other)) and stream.latents.said[0].sentences == ["a person walks"]


# ---- the command


@pytest.fixture
def here(pipe, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(MotionPipeline, "from_pretrained", lambda name: pipe)
    return tmp_path


def listen_to(text, monkeypatch):
    monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(text.encode())))


TIMELINE = "1.5\ta person walks\n\n0.25\ta person jumps twice\n2\ta person sits down\n"
FLAGS = ["--steps", "4", "--seed", "3"]


def test_a_timeline_becomes_frames_each_with_its_prompt(here, monkeypatch, capsys, pipe):
    listen_to(TIMELINE, monkeypatch)
    assert cli.main(["stream", *FLAGS]) == 0
    said = capsys.readouterr()
    frames = [json.loads(line) for line in said.out.splitlines()]
    assert [frame["frame"] for frame in frames] == list(range(75)) and said.err == ""
    prompts = ["a person walks"] * 30 + ["a person jumps twice"] * 5 + ["a person sits down"] * 40
    assert [frame["prompt"] for frame in frames] == prompts
    # every prompt is heard from its own time on, whenever it was read
    stream = pipe.stream("a person walks", num_steps=4, seed=3, lasts=30)
    stream.prompt("a person jumps twice", at=30, lasts=5)
    stream.prompt("a person sits down", at=35, lasts=40)
    expected = np.stack([next(stream) for _ in range(75)])
    np.testing.assert_allclose([frame["joints"] for frame in frames], expected, atol=2e-4)

    (here / "plan.tsv").write_text(TIMELINE)
    for name in ("walk.npy", "walk.jsonl"):
        assert cli.main(["stream", "plan.tsv", "--out", name, *FLAGS]) == 0
        assert f"wrote {name} (75 frames, 3.8 s)" in capsys.readouterr().err
    np.testing.assert_allclose(np.load("walk.npy", allow_pickle=False), expected, atol=1e-4)
    assert [json.loads(line) for line in open("walk.jsonl")] == frames
    assert sorted(path.name for path in here.iterdir()) == ["plan.tsv", "walk.jsonl", "walk.npy"]
    assert cli.main(["stream", "plan.tsv", "--out", "walk.npy", "--rigid", "--force", *FLAGS]) == 0
    np.testing.assert_allclose(np.load("walk.npy", allow_pickle=False), retarget(expected, scale_path=False), atol=1e-4)


def test_lines_are_read_no_sooner_than_needed(here, monkeypatch, capsys):
    """Whoever types the next line sees the frames of the last one first, but for those that must hear the next."""
    printed = []

    def typed():
        for line in TIMELINE.splitlines(keepends=True) * 2:
            printed.append(capsys.readouterr().out.count("\n"))
            yield line

    monkeypatch.setattr("sys.stdin", typed())
    assert cli.main(["stream", "--steps", "6", "--uncertainty", "6"]) == 0  # one latent in flight: 4 frames ahead
    waits = np.cumsum(printed)
    assert waits.tolist() == [0, 27, 27, 32, 72, 102, 102, 107]


@pytest.mark.parametrize(
    "arguments, text, message",
    [
        ([], "", "no prompt came"),
        ([], "a person walks", "line 1: expected seconds"),
        ([], "1\twalk\n-3\twalk\n", "line 2"),
        ([], "inf\twalk", "line 1"),
        ([], "nan\twalk", "line 1"),
        ([], "2\t ", "line 1"),
        (["missing.tsv"], "", "no file missing.tsv"),
        (["bad.tsv", "--out", "new.npy"], "", "line 2"),
        (["--out", "walk.gif"], TIMELINE, ".jsonl, .npy"),
        (["--schedule", "full"], TIMELINE, "needs an end"),
        (["--window", "3"], TIMELINE, "too small"),
    ],
)
def test_what_cannot_be_streamed_ends_in_one_line(here, monkeypatch, capsys, arguments, text, message):
    (here / "bad.tsv").write_text("1\ta person walks\nwalk on\n")
    listen_to(text, monkeypatch)
    assert cli.main(["stream", *arguments]) == 2
    said = capsys.readouterr().err
    assert said.startswith("minicmdm: ") and said.count("\n") == 1 and message in said
    assert [path.name for path in here.iterdir()] == ["bad.tsv"]
