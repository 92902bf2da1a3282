"""The teacher: its six parts, its attention against the library's, causality, padding, and the contrastive loss."""

import math
from dataclasses import replace

import pytest
import torch
from model_helpers import dependencies, randomise
from torch import nn

from minicmdm.config import TextConfig, TMRConfig
from minicmdm.data.dataset import toy_dataset
from minicmdm.data.features import CONTACT_JOINTS
from minicmdm.models.layers import sinusoid
from minicmdm.models.text import TextEncoder, Words
from minicmdm.models.tmr import PARTS, MotionTeacher, PartBlock, contrastive_loss, masked_mean

TINY = TMRConfig(dim=16, layers=2, heads=2, embed_dim=8, dropout=0.0)
TEXT = TextConfig(dim=12, layers=1, heads=2, vocab_size=120, max_words=16, frozen=False)
CAPTIONS = ["a person walks forward", "a person waves with the left hand", "someone jumps twice, then sits down"]


def make_teacher(**changes) -> MotionTeacher:
    torch.manual_seed(0)
    return MotionTeacher(replace(TINY, **changes), TextEncoder.from_captions(CAPTIONS, TEXT)).eval()


def test_the_parts_are_the_joints_they_are_named_after():
    joint_of = [0] * 4  # the owner of each column, written down from the layout of the features
    joint_of += [joint for joint in range(1, 22) for _ in range(3)]
    joint_of += [joint for joint in range(1, 22) for _ in range(6)]
    joint_of += [joint for joint in range(22) for _ in range(3)] + list(CONTACT_JOINTS)
    joints = {
        "root": {0},
        "right_leg": {2, 5, 8, 11},
        "left_leg": {1, 4, 7, 10},
        "backbone": {3, 6, 9, 12, 15},
        "right_arm": {9, 14, 17, 19, 21},
        "left_arm": {9, 13, 16, 18, 20},
    }
    assert list(PARTS) == list(joints)
    for name, own in joints.items():
        assert PARTS[name] == tuple(column for column in range(263) if joint_of[column] in own), name
    assert [len(columns) for columns in PARTS.values()] == [7, 50, 50, 60, 60, 60]


@pytest.mark.parametrize("causal", [True, False])
def test_a_block_is_the_librarys_attention_part_by_part(causal):
    parts, batch, frames, dim, heads = 3, 2, 5, 8, 2
    torch.manual_seed(0)
    block = randomise(PartBlock(parts, dim, heads, dropout=0.0))
    x = torch.randn(parts, batch, frames, dim, dtype=torch.float64)
    hidden = torch.full((frames, frames), causal).triu(1)
    out = block(x.flatten(1, 2), hidden[None].to(x.dtype) * torch.finfo(x.dtype).min).unflatten(1, (batch, frames))
    for part in range(parts):
        attention = nn.MultiheadAttention(dim, heads, batch_first=True).double()
        weights = {
            "in_proj_weight": block.qkv.weight[part].T,
            "in_proj_bias": block.qkv.bias[part, 0],
            "out_proj.weight": block.out.weight[part].T,
            "out_proj.bias": block.out.bias[part, 0],
        }
        attention.load_state_dict(weights)
        norm = nn.LayerNorm(dim, elementwise_affine=False)
        own = x[part]
        h = norm(own)
        own = own + attention(h, h, h, attn_mask=hidden)[0]
        up = nn.functional.gelu(norm(own) @ block.up.weight[part] + block.up.bias[part])
        assert torch.allclose(out[part], own + up @ block.down.weight[part] + block.down.bias[part], atol=1e-9)


@pytest.mark.parametrize("parts", ["six", "one"])
def test_a_causal_teacher_never_looks_ahead_and_the_papers_does(parts):
    x = torch.randn(1, 6, 263, dtype=torch.float64)
    causal = randomise(make_teacher(parts=parts, causal=True))
    assert torch.equal(dependencies(causal.frames, x), torch.ones(6, 6, dtype=torch.bool).tril())
    both_ways = randomise(make_teacher(parts=parts))
    assert dependencies(both_ways.frames, x).all()
    assert causal.frames(x).shape == both_ways.frames(x).shape == (1, 6, 8)


def test_frames_are_the_mean_of_six_bodies_that_never_met_then_the_head():
    teacher = randomise(make_teacher(layers=1))
    x = torch.randn(2, 4, 263, dtype=torch.float64)
    total = 0.0
    for part, columns in enumerate(PARTS.values()):
        alone = PartBlock(1, 16, 2, dropout=0.0).double()
        alone.load_state_dict({k: w[part : part + 1] for k, w in teacher.blocks[0].state_dict().items()})
        h = teacher.embed[part](x[..., columns]) + sinusoid(torch.arange(4.0), 16)
        total = total + alone(h.reshape(1, 8, 16), torch.zeros(1, 4, 4)).reshape(2, 4, 16)
    h = teacher.narrow(total / 6)
    assert torch.allclose(teacher.frames(x), teacher.norm(h + teacher.refine(nn.functional.gelu(h))), atol=1e-9)


def test_every_column_is_read():
    teacher = randomise(make_teacher())
    x = torch.randn(1, 3, 263, dtype=torch.float64, requires_grad=True)
    teacher.frames(x).square().sum().backward()
    assert (x.grad != 0).all()


def test_a_frame_knows_when_it_is():
    teacher = randomise(make_teacher())
    x = torch.randn(1, 1, 263, dtype=torch.float64).expand(1, 4, 263)
    f = teacher.frames(x)[0]
    assert min((f[i] - f[j]).abs().max() for i in range(4) for j in range(i)) > 1e-3


@pytest.mark.parametrize("causal", [True, False])
def test_padding_never_leaks(causal):
    teacher = randomise(make_teacher(causal=causal))
    x = torch.randn(2, 7, 263, dtype=torch.float64)
    valid = torch.tensor([[True] * 4 + [False] * 3, [False] * 2 + [True] * 5])
    x[~valid] = math.nan  # whatever stands there
    f = teacher.frames(x, valid)
    assert f.isfinite().all()
    assert torch.allclose(f[0, :4], teacher.frames(x[:1, :4])[0], atol=1e-9)
    x[~valid] = 5.0
    assert torch.equal(teacher.frames(x, valid), f)


def test_the_two_means():
    teacher, released = randomise(make_teacher()), randomise(make_teacher(mean="padded"))
    x = torch.randn(1, 7, 263, dtype=torch.float64)
    valid = torch.arange(7)[None] < 4
    f = teacher.frames(x, valid)
    assert torch.allclose(teacher.motion(x, valid), f[:, :4].mean(1))
    assert torch.allclose(released.motion(x, valid), f.mean(1))
    # What that means: ours is the same clip's vector in any batch, the release's is not.
    assert torch.allclose(teacher.motion(x, valid), teacher.motion(x[:, :4]))
    assert not torch.allclose(released.motion(x, valid), released.motion(x[:, :4]), atol=1e-3)


def test_masked_mean_by_hand():
    x = torch.tensor([[[2.0], [4.0], [9.0]], [[1.0], [1.0], [1.0]]])
    mask = torch.tensor([[True, True, False], [False, False, False]])
    assert masked_mean(x, mask).tolist() == [[3.0], [0.0]]
    assert masked_mean(x, None).tolist() == [[5.0], [1.0]]
    assert masked_mean(x.bfloat16(), mask).dtype == torch.float32


def test_a_sentence_is_the_mean_of_all_its_words(monkeypatch):
    teacher = make_teacher()
    embeddings, mask = torch.randn(2, 5, 12, requires_grad=True), torch.arange(5) < torch.tensor([[3], [5]])
    monkeypatch.setattr(teacher.text, "encode", lambda sentences: Words(embeddings, mask))
    out = teacher.sentences(["three words", "five"])
    expected = torch.stack([teacher.embed_words(embeddings[0, :3]).mean(0), teacher.embed_words(embeddings[1]).mean(0)])
    assert torch.allclose(out, expected, atol=1e-6)
    out.square().sum().backward()
    assert torch.equal(embeddings.grad.abs().sum(-1) > 0, mask)  # each word is taught, and no padding


def test_a_sentence_is_the_same_in_any_batch():
    teacher = make_teacher()
    alone, empty = teacher.sentences(CAPTIONS[:1]), teacher.sentences([""])
    together = teacher.sentences([*CAPTIONS, ""])
    assert torch.allclose(torch.cat([alone, empty]), together[[0, 3]], atol=1e-5)


def test_similarity_is_a_scaled_cosine():
    teacher = make_teacher()
    motion, text = torch.tensor([[3.0, 4.0], [1.0, 0.0]]), torch.tensor([[0.0, 2.0], [5.0, 0.0], [-1.0, 0.0]])
    expected = torch.tensor([[0.8, 0.6, -0.6], [0.0, 1.0, -1.0]]) / 0.07
    with torch.autocast("cpu", torch.bfloat16):  # which would round these to 11.4375 and so on
        assert torch.allclose(teacher.similarity(motion, text), expected, atol=1e-4)


def test_the_scale_stops_at_100_and_can_come_back():
    teacher = make_teacher()
    nn.init.constant_(teacher.log_scale, 9.0)
    similarity = teacher.similarity(torch.eye(2), torch.eye(2))
    assert torch.allclose(similarity, 100 * torch.eye(2), rtol=1e-5)
    similarity.sum().backward()
    assert teacher.log_scale.grad > 0


def slow_loss(similarity, same):
    """InfoNCE read aloud: -log of the right pair's share among itself and the pairs that say something else."""
    total, count = 0.0, len(similarity)
    for table, alike in ((similarity, same), (similarity.T, same.T)):
        for i in range(count):
            others = [table[i, j].exp() for j in range(count) if j == i or not alike[i, j]]
            total -= math.log(table[i, i].exp() / sum(others)) / (2 * count)
    return total


def test_contrastive_loss_against_a_slow_loop():
    torch.manual_seed(0)
    similarity = torch.randn(5, 5, dtype=torch.float64)
    nobody, some = torch.eye(5, dtype=torch.bool), torch.eye(5, dtype=torch.bool)
    some[0, 3] = some[3, 0] = some[1, 4] = True  # the last one way only, so that a transposed mask is found out
    assert math.isclose(contrastive_loss(similarity), slow_loss(similarity, nobody), rel_tol=1e-9)
    assert math.isclose(contrastive_loss(similarity, some), slow_loss(similarity, some), rel_tol=1e-9)
    assert not math.isclose(slow_loss(similarity, some), slow_loss(similarity, some.T), rel_tol=1e-3)


def test_contrastive_loss_at_its_ends():
    assert math.isclose(contrastive_loss(torch.zeros(7, 7)), math.log(7), rel_tol=1e-6)  # knows nothing
    assert contrastive_loss(100 * torch.eye(7)) < 1e-6  # knows all
    alike = torch.randn(3, 3, requires_grad=True)
    loss = contrastive_loss(alike, torch.ones(3, 3, dtype=torch.bool))
    loss.backward()
    assert loss == 0 and alike.grad.abs().max() == 0  # all say the same: nothing to tell apart


@pytest.mark.parametrize("parts", ["six", "one"])
def test_it_learns_to_retrieve_in_bfloat16(parts):
    """Sixteen sentences of two words each, sixteen motions; sixty steps later fresh noisy copies find their own."""
    verbs, sides = ["walks", "runs", "jumps", "waves"], ["left", "right", "forward", "back"]
    sentences = [f"a person {verb} {side}" for verb in verbs for side in sides]
    torch.manual_seed(0)
    text = TextEncoder.from_captions(sentences, replace(TEXT, dim=32))
    teacher = MotionTeacher(TMRConfig(dim=32, layers=1, heads=2, embed_dim=16, parts=parts), text).train()
    generator = torch.Generator().manual_seed(0)
    verb, side = torch.randn(2, 4, 1, 263, generator=generator)
    clean = torch.cat([torch.cat([verb[i], side[j]]).repeat_interleave(8, 0)[None] for i in range(4) for j in range(4)])
    valid = torch.arange(16) < torch.randint(12, 17, (16, 1), generator=generator)

    def noisy():
        return clean + torch.randn(clean.shape, generator=generator)

    def found():
        teacher.eval()
        with torch.no_grad():
            best = teacher.similarity(teacher.motion(noisy(), valid), teacher.sentences(sentences)).argmax(1)
        teacher.train()
        return (best == torch.arange(16)).float().mean().item()

    assert found() < 0.3
    optimiser = torch.optim.AdamW(teacher.parameters(), lr=3e-3)
    for _ in range(60):
        with torch.autocast("cpu", torch.bfloat16):
            similarity = teacher.similarity(teacher.motion(noisy(), valid), teacher.sentences(sentences))
        loss = contrastive_loss(similarity)
        optimiser.zero_grad()
        loss.backward()
        assert all(p.grad is not None and p.grad.isfinite().all() for p in teacher.parameters())
        optimiser.step()
    assert found() > 0.9


@pytest.mark.parametrize("changes", [{"parts": "seven"}, {"mean": "median"}, {"dim": 15}, {"heads": 3}])
def test_a_configuration_that_cannot_be(changes):
    with pytest.raises(ValueError, match="must be"):
        make_teacher(**changes)


def test_shape_errors_teach():
    teacher = make_teacher()
    for shape in [(2, 4, 67), (4, 263), (2, 0, 263)]:
        with pytest.raises(ValueError, match="frames >= 1, 263"):
            teacher.frames(torch.zeros(shape))
    with pytest.raises(ValueError, match=r"valid: expected shape \(2, 4\)"):
        teacher.frames(torch.zeros(2, 4, 263), torch.ones(2, 5, dtype=torch.bool))
    with pytest.raises(ValueError, match="square"):
        contrastive_loss(torch.zeros(2, 3))
    with pytest.raises(ValueError, match="same must be of shape"):
        contrastive_loss(torch.zeros(2, 2), torch.zeros(3, 3, dtype=torch.bool))


def test_the_shipped_teacher_finds_the_sentence():
    """R@1 of at least 0.9 among 32 distinct programs of the toy test set, its unseen words and pairs included."""
    from minicmdm.pipeline import ASSETS
    from minicmdm.training import checkpoints
    from minicmdm.training.representation import teacher_retrieval

    folder = ASSETS / "toy"
    card = checkpoints.read_card(folder)
    teacher = checkpoints.load_teacher(folder, checkpoints.read_preset(card, folder))
    data = toy_dataset("test", 288)
    distinct = list({clip.program: clip for clip in data.clips}.values())[:256]
    data = replace(data, clips=distinct)
    assert len(data) == 256
    stats, _ = checkpoints.load_tensors(folder / "stats.safetensors")
    train = replace(data, mean=stats["feature_mean"].numpy(), std=stats["feature_std"].numpy())
    assert teacher_retrieval(teacher, train, data)[0] >= 0.9
