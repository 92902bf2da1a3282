"""The bench times runs that give the same latents, counts what they evaluate, and keeps its contract."""

import json
from dataclasses import replace
from functools import partial

import pytest
import torch

from minicmdm import cli
from minicmdm.config import DiTConfig
from minicmdm.diffusion.sampling import guided, sample
from minicmdm.diffusion.schedules import closed_form_cost, schedule_matrix
from minicmdm.diffusion.streaming import LONGEST, LatentStream
from minicmdm.evaluation import bench
from minicmdm.evaluation.bench import GUIDANCE, UNCERTAINTY, WORDS, Sizes, as_released, dense, lean, samplers

TINY = DiTConfig(latent_dim=4, text_dim=6, dim=16, layers=2, heads=2, time_dim=8, block_size=3)
SIZES = Sizes(TINY, latents=8, num_steps=5, rounds=2, ages=(1, 2, 3))  # eight: the last block is cut short
NUMBERS = (
    "m.fss_time_ratio m.ar_time_ratio m.full_time_ratio m.fss_eval_ratio m.ar_eval_ratio m.bf16_time_ratio".split()
)
NUMBERS += "m.bf16_error m.stream_error m.fss_time_ratio_lean m.ar_time_ratio_lean toy.realtime_factor".split()
NUMBERS += "toy.realtime_factor_k10 toy.realtime_factor_k50 toy.first_frame_ms toy.ms_per_latent".split()
NUMBERS += "matmul_share matmul_gflops threads".split()


@pytest.fixture(autouse=True)
def no_peak(monkeypatch):
    monkeypatch.setattr(bench, "matmul_gflops", lambda: 100.0)


@pytest.fixture
def model():
    return bench.random_model(TINY)


@torch.no_grad()
def latents(run):
    return torch.cat(list(run()), dim=1)


def far(z, truth):
    return float((z - truth).norm() / truth.norm())


@torch.no_grad()
@pytest.mark.parametrize("schedule", ["fss", "autoregressive", "full"])
def test_released_lean_and_streamed_are_the_dense_sampler(model, schedule):
    matrix = schedule_matrix(8, 5, UNCERTAINTY, 3, schedule)
    noise = torch.randn(LONGEST, 4, generator=torch.Generator().manual_seed(0))[None, :8]
    words = torch.randn(2, WORDS, 6, generator=torch.Generator().manual_seed(1))
    words[1] = 0
    seen = torch.ones(1, 8, WORDS, dtype=torch.bool)
    text, null = model.embed_words(words).split(1)  # without word layers, that is all there is to read
    truth = sample(guided(model, text, seen, null, seen, GUIDANCE), matrix, noise)
    for velocity in (partial(as_released, model, words, 5), lean(model, words, 5)):
        assert far(latents(lambda v=velocity: dense(v, matrix, noise, 3)), truth) < 1e-4
    name = {"autoregressive": "ar"}.get(schedule, schedule)
    assert far(latents(samplers(model, SIZES)[name]), truth) < 1e-4
    assert far(truth, noise) > 0.1  # the model moves them


def test_the_comparator_evaluates_everything_and_the_stream_as_little_as_its_schedule_allows(model):
    count = []
    model.out.register_forward_pre_hook(lambda _, x: count.append(x[0].shape[:2].numel()))
    # 3 + 3 + 2 latents: each is evaluated K times and, unless it is in the last block to be finished, once more.
    once_more = {"fss": 6, "ar": 6, "full": 0}
    for name in ("comparator", "lean", "fss", "ar", "full"):
        count.clear()
        latents(samplers(model, SIZES)[name])
        calls = {"ar": 15, "full": 5}.get(name, 5 + 2 * UNCERTAINTY)
        assert len(count) == calls
        assert sum(count) == 2 * (8 * 5 + once_more[name] if name in once_more else 8 * calls)


def test_the_papers_sizes_promise_the_evaluation_ratios():
    """30 latents, blocks of three, K = 50: what the full run counts, without the run."""
    cfg = bench.FULL.dit
    assert (cfg.dim, cfg.layers, cfg.heads, cfg.block_size) == (512, 8, 4, 3)
    stream = 30 * 50 + 27
    fss, ar = (closed_form_cost(30, 50, stagger, 3).calls for stagger in (UNCERTAINTY, 50))
    assert (fss, ar) == (68, 500)
    tiny = replace(bench.FULL, dit=replace(TINY, layers=1), rounds=1)
    result = bench.model_numbers(tiny)
    assert result["m.fss_eval_ratio"] == pytest.approx(30 * fss / stream) and 30 * fss / stream >= 1.3
    assert result["m.ar_eval_ratio"] == pytest.approx(30 * ar / stream) and 30 * ar / stream >= 9
    assert result["m.full_eval_ratio"] == 1
    assert result["m.stream_error"] < 1e-5 < result["m.bf16_error"] < 0.1


def forgets_the_last_look(monkeypatch):
    """Latents are cached as their last step saw them, and not once more at t = 1."""
    step = LatentStream.step

    def hasty(self):
        done = step(self)
        if self.cache is not None and done.shape[1] and self.finished < self.num_latents:
            self.cache.keep(done.shape[1])
            self._forget(done.shape[1])
        return done

    monkeypatch.setattr(LatentStream, "step", hasty)


def modulates_all_alike(monkeypatch):
    """The comparator takes the first latent's level for everybody's."""

    def alike(dit, words, num_steps, z, levels, mask):
        return as_released(dit, words, num_steps, z, levels[:, :1].expand_as(levels), mask)

    monkeypatch.setattr(bench, "as_released", alike)


def hides_the_past(monkeypatch):
    monkeypatch.setattr(bench, "self_attention_mask", lambda n, *_: torch.eye(n, dtype=torch.bool))


@pytest.mark.parametrize("mutant", [forgets_the_last_look, modulates_all_alike, hides_the_past])
def test_a_sampler_that_does_less_is_found_out(mutant, monkeypatch):
    mutant(monkeypatch)
    assert bench.model_numbers(replace(SIZES, rounds=1))["m.stream_error"] > 1e-3


def test_contract(monkeypatch, tmp_path, tiny_run, capsys):
    monkeypatch.setattr(bench, "QUICK", replace(SIZES, rounds=1, checkpoint=str(tiny_run)))
    monkeypatch.setattr(bench, "LONGEST", 10)
    assert cli.main(["bench", "--quick", "--json", "--out", str(tmp_path / "bench.txt")]) == 0
    result = json.loads(capsys.readouterr().out)
    for name in NUMBERS:
        group, _, leaf = name.rpartition(".")
        number = (result[group] if group else result)[leaf]  # a dot means nesting
        assert isinstance(number, (int, float)) and number > 0, name
    growth = result["growth"]
    assert growth["seconds"] == [1, 2, 3] and all(ms > 0 for ms in growth["ms_per_latent"])
    assert len(growth["peak_mb"]) == 3 and growth["peak_mb"] == sorted(growth["peak_mb"])
    assert "times their calls" in result["note"]  # what was not run whole is said
    lines = (tmp_path / "bench.txt").read_text().splitlines()
    assert any(line.split()[0] == "m.fss_time_ratio" for line in lines)
    assert bench.FULL.ages == (6, 60, 600) and bench.FULL.num_steps == 50


def test_refusals_come_before_the_work(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(bench, "model_numbers", lambda sizes: pytest.fail("worked"))
    assert cli.main(["bench", "--out", str(tmp_path / "bench.csv")]) == 2
    monkeypatch.setattr(bench, "FULL", replace(SIZES, checkpoint="nowhere"))
    assert cli.main(["bench"]) == 2
    assert "nowhere" in capsys.readouterr().err
