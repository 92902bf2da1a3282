"""The judges: what they may read and what not, that they learn order as well as words, and benches that cannot lie."""

import json
import shutil
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
import torch

from minicmdm.data.dataset import Clip, MotionDataset, toy_dataset
from minicmdm.data.programs import FIELDS, HELDOUT_PAIRS, Segment, pairs_of, sample_program
from minicmdm.evaluation import evaluators, pairs
from minicmdm.evaluation.evaluators import (
    BENCH,
    Evaluator,
    EvaluatorConfig,
    embed,
    load_bench,
    save_bench,
)
from minicmdm.evaluation.metrics import r_precision
from minicmdm.evaluation.pairs import draw_pairs, near_miss
from minicmdm.models.tmr import contrastive_loss
from minicmdm.training.checkpoints import checksum, load_tensors, save_tensors

TINY = {
    name: EvaluatorConfig(kind, dims, width=16, embed_dim=8)
    for name, kind, dims in (("t2m", "t2m", 263), ("t2m_essential", "t2m", 67), ("clip_essential", "clip", 67))
}
WORDS = ["bows", "jumps", "then", "twice"]
every_kind = pytest.mark.parametrize("name", TINY)


def judge_of(name, dtype=torch.float64):
    torch.manual_seed(0)
    judge = Evaluator(TINY[name], WORDS)
    judge.mean, judge.std = torch.randn(judge.cfg.dims), torch.rand(judge.cfg.dims) + 0.5
    return judge.to(dtype).eval().requires_grad_(False)


def motions(*lengths):
    """Raw features, padded with NaN, which whoever reads past an end would notice."""
    torch.manual_seed(1)
    x = torch.full((len(lengths), max(lengths) + 5, 263), torch.nan, dtype=torch.float64)
    for row, length in zip(x, lengths):
        row[:length] = torch.randn(length, 263)
    return x, torch.tensor(lengths)


# --- what a judge reads -------------------------------------------------------------------------------------------


@every_kind
def test_a_motion_means_the_same_alone_and_in_any_batch(name):
    judge = judge_of(name)
    x, lengths = motions(40, 8, 24)
    together = judge.motion(x, lengths)
    assert together.shape == (3, 8) and together.isfinite().all()
    for row, length, expected in zip(x, lengths, together):
        alone = judge.motion(row[None, :length], length[None])[0]
        torch.testing.assert_close(alone, expected, rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(judge.motion(x[[2, 0, 1]], lengths[[2, 0, 1]]), together[[2, 0, 1]])


@every_kind
def test_every_frame_is_read_and_a_broken_last_group_is_not(name):
    judge = judge_of(name)
    x, _ = motions(22)
    before = judge.motion(x, torch.tensor([22]))
    for frame in range(22):
        moved = x.clone()
        moved[0, frame, :67] += 1
        same = torch.allclose(judge.motion(moved, torch.tensor([22])), before, rtol=1e-9, atol=1e-12)
        assert same == (frame >= 20)  # 22 = 5 groups of four and two frames


@every_kind
def test_the_essential_judges_read_the_first_67_features_only(name):
    judge = judge_of(name)
    x, lengths = motions(16)
    before = judge.motion(x, lengths)
    for feature in (0, 3, 66, 67, 262):
        moved = x.clone()
        moved[..., feature] += 1
        same = torch.equal(judge.motion(moved, lengths), before)
        assert same == (feature >= judge.cfg.dims)
    if judge.cfg.dims == 67:
        assert torch.equal(judge.motion(x[..., :67], lengths), before)


@every_kind
def test_it_normalises_by_its_own_statistics(name):
    judge = judge_of(name)
    x, lengths = motions(16)
    before, kept, dims = judge.motion(x, lengths), x.clone(), judge.cfg.dims
    x[..., :dims] = (x[..., :dims] - judge.mean) / judge.std
    judge.mean, judge.std = torch.zeros(dims), torch.ones(dims)
    torch.testing.assert_close(judge.motion(x, lengths), before)
    untouched = x.clone()
    judge.motion(x, lengths)
    assert torch.equal(x.nan_to_num(), untouched.nan_to_num()) and not torch.equal(x, kept)  # the caller's array is his


@every_kind
def test_words_are_read_in_order_and_nothing_else_is(name):
    judge = judge_of(name)

    def same(a, b, padding="jumps then bows twice then jumps twice"):
        a, _, b = judge.sentences([a, padding, b])  # beside a longer one: padding must not be read
        return torch.allclose(a, b, rtol=1e-9, atol=1e-12)

    assert not same("jumps twice, then bows", "bows twice, then jumps")
    assert not same("jumps", "jumps twice") and not same("jumps", "jumps jumps")
    assert same("Jumps twice, then bows.", "  jumps TWICE then bows")
    assert same("flies twice", "swims twice") and not same("flies twice", "bows twice")  # any unknown word is one
    assert same("", "flies") and same("...", "")
    alone = judge.sentences(["jumps"])
    torch.testing.assert_close(judge.sentences(["jumps", "bows then jumps twice"])[:1], alone, rtol=1e-9, atol=1e-12)


@every_kind
def test_embed_keeps_the_order_and_says_what_the_judge_says(name, monkeypatch):
    judge = judge_of(name, torch.float32)
    x, lengths = motions(40, 8, 24, 12)
    clips = [row[:length].float().numpy() for row, length in zip(x, lengths)]
    text, motion = embed(judge, ["jumps", "bows"], clips)
    assert text.dtype == motion.dtype == np.float64 and text.shape == (2, 8)
    one_by_one = [judge.motion(torch.from_numpy(clip)[None], torch.tensor([len(clip)]))[0] for clip in clips]
    np.testing.assert_allclose(motion, torch.stack(one_by_one), atol=1e-5)
    many = embed(judge, ["jumps"], [clips[i % 4] for i in range(130)])[1]  # several batches
    np.testing.assert_allclose(many, motion[np.arange(130) % 4], atol=1e-5)


# --- what it learns -----------------------------------------------------------------------------------------------


def test_similarity_is_minus_the_squared_distance_or_the_scaled_cosine():
    torch.manual_seed(0)
    motion, text = torch.randn(3, 8, dtype=torch.float64), torch.randn(2, 8, dtype=torch.float64)
    found = judge_of("t2m").similarity(motion, text)
    for i in range(3):
        for j in range(2):
            assert torch.isclose(found[i, j], -sum((motion[i, k] - text[j, k]) ** 2 for k in range(8)))
    judge = judge_of("clip_essential")
    motion, text = judge.motion(*motions(16, 24, 12)), judge.sentences(["jumps", "bows"])
    torch.testing.assert_close(motion.norm(dim=1), torch.ones(3, dtype=torch.float64))
    torch.testing.assert_close(text.norm(dim=1), torch.ones(2, dtype=torch.float64))
    cosines = torch.nn.functional.cosine_similarity(motion[:, None], text, dim=-1)
    torch.testing.assert_close(judge.similarity(motion, text), cosines / 0.07)
    judge.log_scale.fill_(9.0)
    torch.testing.assert_close(judge.similarity(motion, text), cosines * 100)


def test_a_near_miss_says_one_thing_wrong():
    rng = np.random.default_rng(0)
    ways = Counter()
    for _ in range(600):
        program = sample_program(rng)
        miss = near_miss(program, rng)
        if miss is None:  # nothing is stated, and nothing can be exchanged
            assert not any(getattr(s, f) for s in program for f in FIELDS[1:])
            ways["none"] += 1
        elif sorted(map(str, miss)) == sorted(map(str, program)):  # exchanged neighbours
            assert miss != program and not HELDOUT_PAIRS.intersection(pairs_of(miss))
            assert sum(a != b for a, b in zip(miss, program)) == 2
            ways["order"] += 1
        else:
            ((said, asked),) = [(a, b) for a, b in zip(miss, program, strict=True) if a != b]
            (field,) = [f for f in FIELDS if getattr(said, f) != getattr(asked, f)]
            assert getattr(said, field) is not None and getattr(asked, field) is not None  # a stated one, contradicted
            ways[field] += 1
    assert set(ways) == {"none", "order", *FIELDS[1:]} and ways["order"] > 100


def test_pairs_are_of_like_length_with_their_own_words_and_near_misses():
    data = toy_dataset("train", 96)
    lengths = [len(clip.features) for clip in data.clips]
    seen = set()
    for seed in range(12):
        clips, texts, misses, whose = draw_pairs(data, 8, torch.Generator().manual_seed(seed))
        again = draw_pairs(data, 8, torch.Generator().manual_seed(seed))
        assert (texts, misses, whose) == again[1:]
        assert len(clips) == len(texts) == len({clip.name for clip in clips}) == 8
        assert all(text in clip.captions for clip, text in zip(clips, texts))
        assert len(misses) == len(whose) > 0 and not any(m in clips[i].captions for m, i in zip(misses, whose))
        drawn = [len(clip.features) for clip in clips]
        assert max(drawn) - min(drawn) <= (max(lengths) - min(lengths)) / 2
        seen |= {(clip.name, clip.captions.index(text)) for clip, text in zip(clips, texts)}
    assert len({name for name, _ in seen}) > 40 and {which for _, which in seen} == {0, 1, 2}


def test_data_without_programs_or_near_misses_teach_too(fake_data, tmp_path):
    settings = dict(steps=2, batch=6, lr=1e-3, seed=0, progress=False)
    result = evaluators.train_evaluator(TINY["t2m_essential"], fake_data, fake_data, tmp_path, **settings)
    assert all(weight.isfinite().all() for weight in result.ema.parameters())


@every_kind
def test_every_weight_learns(name):
    judge = judge_of(name).requires_grad_(True)
    sentences = ["jumps then bows twice", "bows then jumps", "flies", "bows bows bows"]
    closeness = judge.similarity(judge.motion(*motions(40, 8, 24, 16)), judge.sentences(sentences))
    contrastive_loss(closeness).backward()
    for key, weight in judge.named_parameters():
        assert weight.grad is not None and weight.grad.abs().sum() > 0, key


def plain(rng, program):
    """A smaller language than the grammar's, for lessons of seconds."""
    verbs = {"walk": "walks", "run": "runs", "raise_arms": "reaches up", "clap": "claps"}
    first, second = (verbs[segment.action] for segment in program)
    return (f"a person {first}, then {second}", f"someone {first} and then {second}")[rng.integers(2)]


def world(seed):
    """Twelve motions "a person A, then B": a slow or quick wave in one of two groups of features, then another one.

    For each there is the same the other way round, so that whoever ignores the order finds the right one half the time.
    """
    rng = np.random.default_rng(seed)
    deeds = {"walk": (0.3, 0), "run": (1.0, 0), "raise_arms": (0.3, 1), "clap": (1.0, 1)}
    clips = []
    for first in deeds:
        for second in deeds:
            if first != second:
                program = (Segment(first), Segment(second))
                length = 4 * int(rng.integers(10, 15))
                x = 0.1 * rng.normal(size=(length, 263))
                when = np.arange(length // 2)
                for half, deed in enumerate((first, second)):
                    speed, group = deeds[deed]
                    x[half * length // 2 + when, group::2] += np.sin(speed * when + rng.uniform(0, 6))[:, None]
                said = [plain(rng, program) for _ in range(3)]
                clips.append(Clip(str(len(clips)), x.astype(np.float32), said, [], program))
    stacked = np.concatenate([clip.features for clip in clips])
    return MotionDataset(clips, stacked.mean(0), stacked.std(0), "waves")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    def train(name, steps=120, seed=0, lr=3e-3, out=None, **more):
        clips = [clip for noise in range(24) for clip in world(noise).clips]
        out = out or tmp_path_factory.mktemp("judge")
        data = replace(world(0), clips=clips)
        shape = replace(TINY[name], width=32, embed_dim=16)
        settings = dict(steps=steps, batch=12, lr=lr, seed=seed, progress=False)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(pairs.grammar, "caption", plain)
            return evaluators.train_evaluator(shape, data, world(99), out, **settings, **more)

    return train


@every_kind
def test_it_learns_who_did_what_and_in_which_order(run, name):
    result = run(name)
    judge, fresh = result.ema["evaluator"], world(1234).clips
    assert result.metrics["val_r_at_1"] <= result.metrics["val_r_at_3"] <= 1
    motion = [clip.features for clip in fresh]
    rng = np.random.default_rng(0)
    text, found = embed(judge, [plain(rng, clip.program) for clip in fresh], motion)
    assert r_precision(text, found, pool=12)[0] >= 0.9
    text, _ = embed(judge, [plain(rng, clip.program[::-1]) for clip in fresh], motion)
    assert r_precision(text, found, pool=12)[0] <= 0.1


def test_a_run_is_its_seed_and_its_state_is_nobody_elses(run, tmp_path):
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    first = run("clip_essential", steps=3, out=tmp_path)
    assert torch.equal(torch.rand(3), expected)  # the caller's generator is untouched
    again, other = run("clip_essential", steps=3), run("clip_essential", steps=3, seed=1)
    weights = [torch.cat([w.flatten() for w in result.ema.parameters()]) for result in (first, again, other)]
    assert torch.equal(weights[0], weights[1]) and not torch.allclose(weights[0], weights[2])
    resumed = run("clip_essential", steps=3, out=tmp_path, resume=True)
    assert resumed.metrics == first.metrics
    with pytest.raises(ValueError, match="another run"):
        run("clip_essential", steps=3, lr=5e-3, out=tmp_path, resume=True)
    run("t2m_essential", steps=3, out=tmp_path)  # a state of its own, beside the other's
    assert len(list(tmp_path.glob("state_evaluator_*.safetensors"))) == 2


# --- benches ------------------------------------------------------------------------------------------------------


@pytest.fixture
def bench(tmp_path):
    judges = {name: judge_of(name, torch.float32) for name in TINY}
    save_bench(tmp_path / "bench", judges, {"seed": 3})
    return tmp_path / "bench", judges


def test_a_bench_comes_back_as_it_was_frozen(bench):
    folder, judges = bench
    loaded = load_bench(folder)
    assert list(loaded) == list(TINY) and json.loads((folder / "card.json").read_text())["seed"] == 3
    x, lengths = motions(40, 8)
    for name, judge in loaded.items():
        assert not judge.training and not any(weight.requires_grad for weight in judge.parameters())
        assert judge.cfg == TINY[name] and judge.words == WORDS
        assert torch.equal(judge.motion(x.float(), lengths), judges[name].motion(x.float(), lengths))
        assert torch.equal(judge.sentences(["jumps twice"]), judges[name].sentences(["jumps twice"]))


def test_toy_bench_1_is_small():
    judges = [Evaluator(cfg, [str(i) for i in range(230)]) for cfg in BENCH.values()]
    numbers = sum(tensor.numel() for judge in judges for tensor in judge.state_dict().values())
    assert list(BENCH) == list(TINY) and 4 * numbers < 4e6
    assert all(
        cfg.embed_dim <= 64 and cfg.kind == TINY[n].kind and cfg.dims == TINY[n].dims for n, cfg in BENCH.items()
    )


def edit_card(folder, **changes):
    card = json.loads((folder / "card.json").read_text())
    (folder / "card.json").write_text(json.dumps({**card, **changes}))


def edit_judge(folder, change):
    path = folder / "t2m.safetensors"
    tensors, note = load_tensors(path)
    change(tensors, note)
    save_tensors(path, tensors, note)
    files = json.loads((folder / "card.json").read_text())["files"]
    edit_card(folder, files={**files, "t2m": checksum(path)})


def swap(folder):
    shutil.copy(folder / "clip_essential.safetensors", folder / "t2m.safetensors")


def cut(folder):
    path = folder / "t2m.safetensors"
    path.write_bytes(path.read_bytes()[:-8])


@pytest.mark.parametrize(
    "damage, message",
    [
        (swap, "t2m.safetensors is not the file of card.json"),
        (cut, "cut short"),
        (lambda folder: (folder / "card.json").write_text("{"), "no evaluators"),
        (lambda folder: (folder / "card.json").write_text("[]"), "no evaluators"),
        (lambda folder: edit_card(folder, format="minicmdm-checkpoint-1"), "'minicmdm-bench-1' expected"),
        (lambda folder: edit_card(folder, files=None), "no evaluators"),
        (lambda folder: edit_judge(folder, lambda t, note: note["config"].update(kind="oracle")), "'t2m' or 'clip'"),
        (lambda folder: edit_judge(folder, lambda t, note: note["config"].update(depth=3)), "depth"),
        (lambda folder: edit_judge(folder, lambda t, note: note["words"].append("more")), "embed_words.weight"),
        (lambda folder: edit_judge(folder, lambda t, note: t["mean"].fill_(torch.nan)), "not finite"),
        (lambda folder: edit_judge(folder, lambda t, note: t.pop("std")), "lacks tensor 'std'"),
    ],
)
def test_a_damaged_bench_is_refused(bench, damage, message):
    folder, _ = bench
    damage(folder)
    with pytest.raises(ValueError, match=message):
        load_bench(folder)


def test_what_is_missing_is_named(bench, tmp_path):
    folder, _ = bench
    with pytest.raises(FileNotFoundError, match="no card.json in .*--stage evaluator"):
        load_bench(tmp_path / "nowhere")
    (folder / "t2m_essential.safetensors").unlink()
    with pytest.raises(FileNotFoundError, match="t2m_essential.safetensors"):
        load_bench(folder)


# --- errors -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("change", [dict(kind="tmr"), dict(dims=66), dict(width=12)])
def test_configs_that_make_no_judge(change):
    with pytest.raises(ValueError, match="expected 't2m' or 'clip'"):
        Evaluator(replace(TINY["t2m"], **change), WORDS)


@pytest.mark.parametrize(
    "shape, lengths",
    [
        ((2, 8, 66), [8, 8]),
        ((8, 263), [8]),
        ((2, 8, 263), [8]),
        ((2, 8, 263), [8, 9]),
        ((2, 8, 263), [8, 3]),
        ((0, 8, 263), []),
    ],
)
@every_kind
def test_motions_that_do_not_fit(name, shape, lengths):
    with pytest.raises(ValueError, match="B,T,263"):
        judge_of(name).motion(torch.zeros(shape, dtype=torch.float64), torch.tensor(lengths))
