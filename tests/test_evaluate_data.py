"""A folder in a data set's own layout is read, trained on for ten steps, and evaluated with judges of its own."""

import json
from dataclasses import replace

import numpy as np
import pytest
from kit_helpers import write_kit

from minicmdm.cli import main
from minicmdm.data.clips import MotionDataset
from minicmdm.data.dataset import toy_dataset
from minicmdm.data.features import features_to_joints
from minicmdm.data.folders import load_dataset, write_folder
from minicmdm.motion import load_joints
from minicmdm.pipeline import MotionPipeline
from minicmdm.training import stages

LAYOUTS = {"humanml3d": (263, 22, 20), "babel": (263, 22, 20), "kit": (251, 21, 12.5)}  # features, joints, fps


@pytest.fixture(scope="module", params=LAYOUTS)
def run(request, tmp_path_factory):
    """A mini folder without programs, one kind of words each, and a small system trained on it by the command line."""
    root = tmp_path_factory.mktemp(request.param)
    if request.param == "kit":
        write_kit(root / "data")
    else:
        toy = toy_dataset("train", count=14, progress=False)
        clips = [replace(clip, program=None, realised=None) for clip in toy.clips]
        splits = {"train": clips[:6], "val": clips[6:8], "test": clips[8:]}
        write_folder({k: MotionDataset(v, toy.mean, toy.std, "mini") for k, v in splits.items()}, root / "data")
    if request.param == "babel":  # labels of stretches take the captions' place
        for split, some in splits.items():
            entries = {}
            for clip in some:
                rows = [{"start_t": a / 20, "end_t": b / 20, "proc_label": words} for a, b, words in clip.labels]
                entries[clip.name] = {"frame_ann": {"labels": rows}}
            (root / "data" / f"{split}.json").write_text(json.dumps(entries), encoding="utf-8")
        (root / "data" / "programs.jsonl").unlink(missing_ok=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("minicmdm.viz.plots.save_loss_curves", lambda table, picture: picture.touch())  # slow to draw
        patch.setattr(stages, "FAST", {f"{name}_steps": 10 for name in stages.RUN} | {"dit_batch": 4, "vae_batch": 4})
        order = ["train", "--preset", "micro", "--fast", "--data", str(root / "data"), "--out", str(root / "run")]
        assert main(order) == 0
    return root


def test_the_words_are_those_of_the_layout(run):
    clips = load_dataset(run / "data", "test").clips
    assert all(clip.program is None and clip.captions for clip in clips)
    assert any(clip.labels for clip in clips) == ("babel" in run.name)


def test_what_it_generates_has_the_data_sets_body_rate_and_size(run, tmp_path):
    width, joints, fps = LAYOUTS[run.name.rstrip("0")]
    pipe = MotionPipeline.from_pretrained(run / "run")
    assert pipe.preset.vae.input_dim == width  # that of the preset is 263
    motion = pipe("a person walks", num_frames=24)
    assert motion.joints.shape == (24, joints, 3) and motion.features.shape == (24, width) and motion.fps == fps
    standing = np.tile(load_dataset(run / "data").mean, (2, 1))
    assert 0.7 < features_to_joints(standing)[0, 0, 1] < 1.1  # the pelvis is so many metres above the floor
    for ending in (".npy", ".html", ".gif"):
        assert motion.save(tmp_path / f"x{ending}").stat().st_size > 1000
    if joints == 21:
        with pytest.raises(ValueError, match="22, 3"):
            motion.save(tmp_path / "x.bvh")
    (tmp_path / "plan.tsv").write_text("2\ta person walks\n", encoding="utf-8")
    order = ["stream", str(tmp_path / "plan.tsv"), "--checkpoint", str(run / "run"), "--out", str(tmp_path / "s.npy")]
    assert main(order) == 0
    assert load_joints(tmp_path / "s.npy").shape == (2 * fps, joints, 3)  # two seconds


def test_it_is_judged_by_its_own_judges(run, capsys):
    order = ["evaluate", "--checkpoint", str(run / "run"), "--data", str(run / "data")]
    assert main([*order, "--repeats", "2", "--steps", "3", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["clips"] == found["pool"] == 6
    assert found["fingerprint"] == load_dataset(run / "data", "test").fingerprint
    assert found["protocol"] == "t2m+recon"
    shared = {"r_at_1", "r_at_2", "r_at_3", "mm_dist", "fid", "diversity", "clip_score", "skating_ratio"}
    assert shared | {"multimodality", "mpjpe_mm"} <= set(found["metrics"])
    assert not [key for key in found["metrics"] if "oracle" in key] and not found["fields"]
    for key, entry in found["metrics"].items():
        assert entry["floor"] is None and entry["mean"] == entry["mean"] and entry["ci95"] >= 0
        assert key == "multimodality" or entry["gt"] is not None
    fid = found["metrics"]["fid"]
    assert abs(fid["gt"]) < 1e-6 < fid["mean"]
    assert main([*order, "--protocol", "recon"]) == 0  # as a table
    assert "oracle" not in capsys.readouterr().out


@pytest.mark.parametrize(
    "more, said",
    [
        (["--checkpoint", "toy"], "train --stage evaluator"),  # the shipped judges know toy features alone
        (["--protocol", "long"], "made of toy programs"),
        (["--quick"], "leave out --data"),
        (["--data", "nowhere"], "no test.txt in nowhere"),
    ],
)
def test_what_cannot_be_judged_is_one_line(more, said, run, capsys):
    order = ["evaluate", "--checkpoint", str(run / "run"), "--data", str(run / "data"), "--limit", "32"]
    assert main([*order, *more]) == 2
    assert said in capsys.readouterr().err
