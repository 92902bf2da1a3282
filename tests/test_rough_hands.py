"""Rough hands: bad inputs to every command end in one line and exit code 2, and leave every file as it was.

Each row says how the situation is built, what is typed, and a piece of what must be answered. `test_cli.py` and
`test_folders.py` have rows of their own, which are not repeated here.
"""

import errno
import hashlib
import io
import json
import os
import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest

from minicmdm import cli
from minicmdm.data.bvh_out import write_bvh
from minicmdm.data.dataset import make_clip
from minicmdm.data.features import features_to_joints
from minicmdm.files import write_text
from minicmdm.pipeline import ASSETS
from minicmdm.training.checkpoints import save_tensors

EXPLODED = "minicmdm-exploded"


class Bomb:
    """What a pickle runs when somebody opens it: here, it leaves a file in the working folder."""

    def __reduce__(self):
        return (Path(EXPLODED).touch, ())


# --- how the situations are built ------------------------------------------------------------------------------------


def nothing():
    """An empty working folder."""


def put(name, content):
    """A file of bytes or text."""

    def build():
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Path(name).write_bytes(content if isinstance(content, bytes) else content.encode())

    return build


def folder(name):
    return lambda: Path(name).mkdir(parents=True)


def checkpoint(spoil):
    """A copy of a trained checkpoint, spoilt."""

    def build():
        shutil.copytree(ASSETS / "toy", "mine")
        spoil(Path("mine"))

    return build


def overwrite(name, content):
    return checkpoint(lambda mine: (mine / name).write_bytes(content))


def cut(name, keep):
    return checkpoint(lambda mine: (mine / name).write_bytes((mine / name).read_bytes()[:keep]))


def card(change):
    """A checkpoint whose card is valid JSON and says something else."""

    def spoil(mine):
        told = json.loads((mine / "card.json").read_text("utf-8"))
        change(told)
        write_text(mine / "card.json", json.dumps(told))

    return checkpoint(spoil)


def data(spoil=lambda set: None):
    """A data set of three clips in HumanML3D's layout, spoilt."""

    def build():
        for part in ("new_joint_vecs", "texts"):
            Path("set", part).mkdir(parents=True)
        for k in range(3):
            features = np.random.default_rng(k).normal(size=(64, 263)).astype(np.float32)
            np.save(f"set/new_joint_vecs/{k}.npy", features)
            write_text(f"set/texts/{k}.txt", "a man walks.#a/DET man/NOUN walk/VERB#0.0#0.0\n")
        for split in ("train", "val", "test"):
            write_text(f"set/{split}.txt", "0\n1\n2\n")
        spoil(Path("set"))

    return build


def features(value, **how):
    return data(lambda set: np.save(set / "new_joint_vecs" / "1.npy", value, **how))


def in_set(name, content):
    return data(lambda set: (set / name).write_bytes(content if isinstance(content, bytes) else content.encode()))


def program(**record):
    """A data set whose first clip's program is told wrongly."""
    return in_set("programs.jsonl", json.dumps({"name": "0", **record}))


BVH = """HIERARCHY
ROOT hips
{
  OFFSET 0 0 0
  CHANNELS 3 Xposition Yposition Zposition
  End Site
  {
    OFFSET 0 1 0
  }
}
MOTION
Frames: 2
Frame Time: 0.05
0 1 0
0 1 0.1
"""


def bvh(old="", new="", text=BVH):
    """A folder with one BVH file in which something is replaced."""
    assert old in text
    return put("bvh/a.bvh", text.replace(old, new))


def good_bvh(*more):
    """A folder with one good BVH file, and other things."""

    def build():
        Path("bvh").mkdir()
        write_bvh("bvh/walk.bvh", features_to_joints(make_clip("test", 0).features[:48]))
        for also in more:
            also()

    return build


def state(write):
    """A run in the folder "mine" that got as far as a state, and the data set that it is to go on with."""

    def build():
        data()()
        Path("mine").mkdir()
        write(Path("mine", "state_evaluator_t2m_263.safetensors"))

    return build


def safetensors(header):
    """The bytes of a safetensors file of no tensors, with a header of its own."""
    raw = json.dumps(header).encode()
    return len(raw).to_bytes(8, "little") + raw


OPEN_HEADER = b"\x93NUMPY\x01\x00\x08\x00{'descr'"
LINES = "1\ta person walks\n2\ta person jumps\n"
GENERATE = ["generate", "a person walks", "--out", "new.npy", "--checkpoint", "toy"]
STREAM = ["stream", "plan.tsv", "--out", "new.npy", "--checkpoint", "toy"]
MINE = ["generate", "a person walks", "--out", "new.npy", "--checkpoint", "mine"]
EVALUATE = ["evaluate", "--checkpoint", "toy"]
TRAIN = ["train", "--preset", "micro", "--out", "run", "--fast", "--data", "set"]
RESUME = ["train", "--preset", "micro", "--out", "mine", "--fast", "--data", "set", "--resume"]
IMPORT = ["import-bvh", "bvh", "--out", "set"]
plan = put("plan.tsv", LINES)
LONG = "walk " * 300

ROWS = {
    # generate: numbers
    "frames below zero": (nothing, [*GENERATE, "--frames", "-8"], "whole number from 4"),
    "frames and a half": (nothing, [*GENERATE, "--frames", "40.5"], "invalid int value"),
    "frames nan": (nothing, [*GENERATE, "--frames", "nan"], "--frames"),
    "frames 197": (nothing, [*GENERATE, "--frames", "197"], "196"),
    "frames beyond any integer": (nothing, [*GENERATE, "--frames", "9" * 40], "196"),
    "frames with nothing": (nothing, [*GENERATE, "--frames"], "expected one argument"),
    "guidance below zero": (nothing, [*GENERATE, "--guidance=-1"], "guidance_scale must be"),
    "guidance minus infinity": (nothing, [*GENERATE, "--guidance=-inf"], "guidance_scale must be"),
    "guidance 1e9": (nothing, [*GENERATE, "--guidance", "1e9"], "from 0 to 100"),
    "guidance in words": (nothing, [*GENERATE, "--guidance", "much"], "invalid float value"),
    "steps below zero": (nothing, [*GENERATE, "--steps", "-1"], "num_steps"),
    "steps beyond sense": (nothing, [*GENERATE, "--steps", "1001"], "from 1 to 1000"),
    "uncertainty below zero": (nothing, [*GENERATE, "--uncertainty", "-1"], "uncertainty"),
    "uncertainty and a half": (nothing, [*GENERATE, "--uncertainty", "2.5"], "--uncertainty"),
    "block 0": (nothing, [*GENERATE, "--block", "0"], "block_size"),
    "block below zero": (nothing, [*GENERATE, "--block", "-4"], "block_size"),
    "block beyond the longest": (nothing, [*GENERATE, "--block", "50"], "from 1 to 49"),
    "seed beyond 63 bits": (nothing, [*GENERATE, "--seed", str(2**63)], "seed must be"),
    "seed in words": (nothing, [*GENERATE, "--seed", "lucky"], "--seed"),
    "schedule empty": (nothing, [*GENERATE, "--schedule", ""], "fss"),
    "schedule in capitals": (nothing, [*GENERATE, "--schedule", "FSS"], "fss"),
    # generate: prompts and outputs
    "two prompts": (nothing, ["generate", "walk", "jump", "--out", "new.npy"], "unrecognized arguments: jump"),
    "prompt of tabs": (nothing, ["generate", "\t\n", "--out", "new.npy"], "prompt is empty"),
    "prompt that is no text": (nothing, ["generate", "w\udcff", *GENERATE[2:]], "bytes that are no text"),
    "prompt of one endless word": (nothing, ["generate", "walk," * 400, *GENERATE[2:]], "too long"),
    "output is .": (nothing, ["generate", "walk", "--out", "."], "is a folder"),
    "output ends in a slash": (nothing, ["generate", "walk", "--out", "new.npy/"], "is a folder"),
    "output is an ending": (nothing, ["generate", "walk", "--out", ".npy"], "must end in"),
    "output has another ending": (nothing, ["generate", "walk", "--out", "new.npy.exe"], "ends in .exe"),
    "output name too long": (nothing, ["generate", "walk", "--out", "n" * 300 + ".npy"], "too long"),
    "output is a folder, forced": (folder("a.html"), ["generate", "walk", "--out", "a.html", "--force"], "is a folder"),
    "output exists as .bvh": (put("a.bvh", "mine"), ["generate", "walk", "--out", "a.bvh"], "--force"),
    # checkpoints
    "pickle as weights": (overwrite("dit.safetensors", pickle.dumps(Bomb())), MINE, "not a whole safetensors"),
    "pickle as card": (overwrite("card.json", pickle.dumps(Bomb())), MINE, "not a whole JSON"),
    "pickle as tokenizer": (overwrite("text/tokenizer.json", pickle.dumps(Bomb())), MINE, "cannot be read"),
    "pickle as text config": (overwrite("text/config.json", pickle.dumps(Bomb())), MINE, "config.json"),
    "weights empty": (overwrite("dit.safetensors", b""), MINE, "not a whole safetensors"),
    "weights cut in the header": (cut("vae.safetensors", 40), MINE, "not a whole safetensors"),
    "weights boast of a header": (overwrite("vae.safetensors", b"\xff" * 64), MINE, "not a whole safetensors"),
    "weights with a note of nothing": (
        overwrite("dit.safetensors", safetensors({"__metadata__": None})),
        MINE,
        "not a whole safetensors",
    ),
    "weights with a note without end": (
        overwrite("dit.safetensors", safetensors({"__metadata__": {"note": "[" * 100000}})),
        MINE,
        "not a whole safetensors",
    ),
    "weights of another part": (
        checkpoint(lambda mine: shutil.copy(mine / "vae.safetensors", mine / "dit.safetensors")),
        MINE,
        "not the file that the card describes",
    ),
    "statistics gone": (checkpoint(lambda m: (m / "stats.safetensors").unlink()), MINE, "lacks stats.safetensors"),
    "card empty": (overwrite("card.json", b""), MINE, "not a whole JSON"),
    "card cut": (cut("card.json", 200), MINE, "not a whole JSON"),
    "card not UTF-8": (overwrite("card.json", b"\xff\xfe{\x00}\x00"), MINE, "not a whole JSON"),
    "card nested without end": (overwrite("card.json", b"[" * 100000), MINE, "not a whole JSON"),
    "card of a later format": (card(lambda told: told.update(format="minicmdm-checkpoint-9")), MINE, "checkpoint-9"),
    "card whose files lead out": (card(lambda told: told["files"].update({"../x": "0"})), MINE, "under 'files'"),
    "card without a preset": (card(lambda told: told.pop("preset")), MINE, "describes no preset"),
    "card with a preset of words": (card(lambda told: told.update(preset="big")), MINE, "describes no preset"),
    "card of no heads": (card(lambda told: told["preset"]["dit"].update(heads=0)), MINE, "card.json"),
    "card of a monstrous size": (card(lambda told: told["preset"]["dit"].update(dim=10**12)), MINE, "cannot be built"),
    "checkpoint name too long": (nothing, [*MINE[:-1], "c" * 300], "too long"),
    "folder that is empty": (folder("mine"), MINE, "no card.json"),
    "training that has not ended": (put("mine/state_tmr.safetensors", ""), MINE, "--resume"),
    "stream from a cut checkpoint": (
        lambda: (plan(), cut("dit.safetensors", 999)()),
        ["stream", "plan.tsv", "--out", "new.npy", "--checkpoint", "mine"],
        "not a whole safetensors",
    ),
    "evaluate a pickle": (
        overwrite("dit.safetensors", pickle.dumps(Bomb())),
        ["evaluate", "--checkpoint", "mine"],
        "not a whole safetensors",
    ),
    # stream
    "stream a folder": (folder("plan.tsv"), STREAM, "no file plan.tsv"),
    "stream nothing": (put("plan.tsv", b""), STREAM, "no prompt came"),
    "stream blank lines": (put("plan.tsv", b"\n \n"), STREAM, "no prompt came"),
    "stream no UTF-8": (put("plan.tsv", b"1\twalk\n1\tcaf\xe9\n"), STREAM, "line 2 is not UTF-8"),
    "stream two days": (put("plan.tsv", "172800\twalk\n"), STREAM, "line 1"),
    "stream 0 seconds": (put("plan.tsv", "1\twalk\n0\trun\n"), STREAM, "line 2"),
    "stream spaces for a tab": (put("plan.tsv", "1    walk\n"), STREAM, "a tab and a prompt"),
    "stream a long prompt": (put("plan.tsv", f"1\t{LONG}\n"), STREAM, "too long"),
    "stream a long prompt at last": (put("plan.tsv", f"0.2\twalk\n1\t{LONG}\n"), STREAM, "too long"),
    "stream window 0": (plan, [*STREAM, "--window", "0"], "window"),
    "stream window below zero": (plan, [*STREAM, "--window", "-5"], "window"),
    "stream steps 0": (plan, [*STREAM, "--steps", "0"], "num_steps"),
    "stream uncertainty": (plan, [*STREAM, "--uncertainty", "-2"], "uncertainty"),
    "stream block": (plan, [*STREAM, "--block", "0"], "block_size"),
    "stream guidance": (plan, [*STREAM, "--guidance", "nan"], "guidance_scale"),
    "stream seed": (plan, [*STREAM, "--seed", "-1"], "seed"),
    "stream schedule": (plan, [*STREAM, "--schedule", "zigzag"], "zigzag"),
    "stream over a file": (
        lambda: (plan(), put("a.jsonl", "mine")()),
        ["stream", "plan.tsv", "--out", "a.jsonl"],
        "--force",
    ),
    # inspect and schedule
    "inspect a pickle": (put("a.npy", pickle.dumps(Bomb())), ["inspect", "a.npy"], "not a whole .npy"),
    "inspect a cut header": (put("a.npy", OPEN_HEADER), ["inspect", "a.npy"], "not a whole .npy"),
    "inspect nothing": (nothing, ["inspect"], "FILE"),
    "inspect two": (nothing, ["inspect", "a.npy", "b.npy"], "unrecognized arguments"),
    "inspect another body": (
        lambda: np.save("a.npy", np.zeros((8, 21, 3))),  # KIT-ML's, which the oracle does not know
        ["inspect", "a.npy", "--json"],
        "(T, 22, 3)",
    ),
    "inspect two joints short": (
        lambda: np.save("a.npy", np.zeros((8, 20, 3))),
        ["inspect", "a.npy", "--json"],
        "(T,22,3)",
    ),
    "inspect an infinity": (lambda: np.save("a.npy", np.full((8, 22, 3), np.inf)), ["inspect", "a.npy"], "frame 0"),
    "schedule latents": (nothing, ["schedule", "--latents", "-3"], "num_latents"),
    "schedule steps": (nothing, ["schedule", "--steps", "-3"], "num_steps"),
    "schedule block": (nothing, ["schedule", "--block", "-1", "--json"], "block"),
    "schedule empty kind": (nothing, ["schedule", "--kind", ""], "fss"),
    "schedule latents in words": (nothing, ["schedule", "--latents", "x"], "invalid int value"),
    # data
    "info of nothing": (nothing, ["data", "info"], "DIR"),
    "info of a file": (put("set", "x"), ["data", "info", "set"], "no folder set"),
    "info of an empty folder": (folder("set"), ["data", "info", "set", "--json"], "holds none of train.txt"),
    "info, unknown option": (data(), ["data", "info", "set", "--fix"], "--fix"),
    "make without a name": (nothing, ["data", "make"], "--out"),
    "make an empty name": (nothing, ["data", "make", "--out", " "], "must be a folder"),
    "make over a stranger's data": (data(), ["data", "make", "--out", "set", "--force"], "something else"),
    "an action that is none": (nothing, ["data", "drop", "--out", "set"], "drop"),
    # train: data
    "features nan": (features(np.full((64, 263), np.nan)), TRAIN, "frame 0"),
    "features too wide": (features(np.zeros((64, 264))), TRAIN, "got shape (64, 264)"),
    "features of no frames": (features(np.zeros((0, 263))), TRAIN, "got shape (0, 263)"),
    "features of bools": (features(np.zeros((64, 263), bool)), TRAIN, "bool"),
    "features pickled": (features(np.array([Bomb()], object), allow_pickle=True), TRAIN, "no whole .npy"),
    "features with a cut header": (in_set("new_joint_vecs/1.npy", OPEN_HEADER), TRAIN, "no whole .npy"),
    "features in an archive": (
        data(lambda set: np.savez(open(set / "new_joint_vecs" / "1.npy", "wb"), a=np.zeros((64, 263)))),
        TRAIN,
        "an archive",
    ),
    "captions blank": (in_set("texts/2.txt", "\n\n"), TRAIN, "holds no caption"),
    "captions in UTF-16": (in_set("texts/2.txt", "he walks".encode("utf-16")), TRAIN, "not UTF-8"),
    "clips too short": (
        data(lambda set: [np.save(set / "new_joint_vecs" / f"{k}.npy", np.zeros((39, 263))) for k in range(3)]),
        TRAIN,
        "leaves no clip of at least 40 frames",
    ),
    "split names a stranger": (in_set("train.txt", "0\n9\n"), TRAIN, "9.npy is not there"),
    "split leads out": (in_set("val.txt", "0\n../../0\n"), TRAIN, "leads to no other folder"),
    "no validation split": (data(lambda set: (set / "val.txt").unlink()), TRAIN, "no val.txt"),
    "mean empty": (data(lambda set: (put("set/Mean.npy", "")(), np.save(set / "Std.npy", 1.0))), TRAIN, "Mean.npy"),
    "std pickled": (
        data(lambda set: (np.save(set / "Mean.npy", np.zeros(263)), put("set/Std.npy", pickle.dumps(Bomb()))())),
        TRAIN,
        "Std.npy",
    ),
    "mean in an archive": (
        data(lambda set: (np.savez(open(set / "Mean.npy", "wb"), a=1.0), np.save(set / "Std.npy", np.ones(263)))),
        TRAIN,
        "Mean.npy is an archive",
    ),
    "features beyond float32": (features(np.full((64, 263), 1e300)), TRAIN, "frame 0 is not"),
    "caption without an end": (in_set("texts/1.txt", "he walks#x#0.0#inf\n"), TRAIN, "from 0.0 to inf seconds"),
    "a split that is a folder": (
        data(lambda set: ((set / "train.txt").unlink(), (set / "train.txt").mkdir())),
        TRAIN,
        "no train.txt",
    ),
    "a clip's name too long": (in_set("train.txt", "a" * 300), TRAIN, "too long"),
    "programs of colours": (program(asked=[{"colour": 1}]), TRAIN, "is no list of programs"),
    "programs of nothing": (program(labels=None), TRAIN, "is no list of programs"),
    "program labels in words": (program(labels=[["a", "b", "walk"]]), TRAIN, "is no list of programs"),
    "program labels of two": (program(labels=[[0, 40]]), TRAIN, "is no list of programs"),
    "program labels of numbers": (program(labels=[[0, 40, 5]]), TRAIN, "is no list of programs"),
    "programs nested without end": (in_set("programs.jsonl", "[" * 100000), TRAIN, "is no list of programs"),
    "a BABEL label without an end": (
        in_set(
            "train.json",
            '{"1": {"frame_ann": {"labels": [{"start_t": 0, "end_t": Infinity, "raw_label": "walk"}]}}}',
        ),
        TRAIN,
        "is no BABEL file",
    ),
    "run inside a file": (data(), [*TRAIN, "--out", "set/train.txt/run"], "Not a directory"),
    "run's name too long": (data(), [*TRAIN, "--out", "r" * 300], "too long"),
    "device without numbers": (data(), [*TRAIN, "--device", "meta"], "no device 'meta'"),
    "data in a file": (put("set", "x"), TRAIN, "no train.txt"),
    "data nowhere": (nothing, TRAIN, "no train.txt"),
    # train: options
    "accumulate 0": (data(), [*TRAIN, "--accumulate", "0"], "--accumulate must be at least 1"),
    "accumulate below zero": (data(), [*TRAIN, "--accumulate", "-2"], "--accumulate must be at least 1"),
    "workers below zero": (data(), [*TRAIN, "--workers", "-1"], "workers must not be negative"),
    "threads below zero": (data(), [*TRAIN, "--threads", "-4"], "--threads must be at least 1"),
    "threads beyond any integer": (data(), [*TRAIN, "--threads", "9" * 40], "--threads must be at least 1"),
    "training seed in words": (data(), [*TRAIN, "--seed", "x"], "--seed"),
    "device unknown": (data(), [*TRAIN, "--device", "abacus"], "no device 'abacus'"),
    "device empty": (data(), [*TRAIN, "--device", ""], "no device ''"),
    "device not here": (data(), [*TRAIN, "--device", "cuda:99"], "no device 'cuda:99'"),
    "stage empty": (data(), [*TRAIN, "--stage", ""], "unknown stage ''"),
    "stage unknown": (data(), [*TRAIN, "--stage", "gan"], "unknown stage 'gan'"),
    "preset in small letters": (data(), ["train", "--preset", "xl", "--out", "run"], "xl"),
    "dry run of no preset": (nothing, ["train", "--preset", "huge", "--out", "run", "--dry-run"], "huge"),
    "teacher missing": (data(), [*TRAIN, "--stage", "vae"], "tmr.safetensors"),
    "run without a name": (data(), ["train", "--out", " ", "--fast"], "--out is empty"),
    "train, unknown option": (data(), [*TRAIN, "--epochs", "3"], "--epochs"),
    # train --resume
    "state half-written": (
        state(lambda path: path.write_bytes(b"\x20\0\0\0\0\0\0\0{")),
        RESUME,
        "not a whole safetensors",
    ),
    "state empty": (state(lambda path: path.write_bytes(b"")), RESUME, "not a whole safetensors"),
    "state pickled": (state(lambda path: path.write_bytes(pickle.dumps(Bomb()))), RESUME, "not a whole safetensors"),
    "state of another run": (state(lambda path: save_tensors(path, {}, {"identity": {}})), RESUME, "another run"),
    "card cut, then resumed": (
        state(lambda path: path.with_name("card.json").write_bytes(b'{"format')),
        RESUME,
        "not a whole JSON",
    ),
    # import-bvh
    "no bvh folder": (nothing, IMPORT, "no folder bvh"),
    "bvh folder is a file": (put("bvh", BVH), IMPORT, "no folder bvh"),
    "bvh folder is empty": (folder("bvh"), IMPORT, "no .bvh file"),
    "bvh is binary": (put("bvh/a.bvh", bytes(range(256))), IMPORT, "no text"),
    "bvh in UTF-16": (put("bvh/a.bvh", BVH.encode("utf-16")), IMPORT, "no text"),
    "bvh lies upwards": (bvh("Frames: 2", "Frames: 3"), IMPORT, "says that it has 3 frames"),
    "bvh lies downwards": (bvh("Frames: 2", "Frames: 1"), IMPORT, "says that it has 1 frames"),
    "bvh of minus two": (bvh("Frames: 2", "Frames: -2"), IMPORT, "says that it has -2 frames"),
    "bvh frames in words": (bvh("Frames: 2", "Frames: two"), IMPORT, "number of frames is no number"),
    "bvh no frames": (bvh("Frames: 2", "Frames: 0", BVH[: BVH.index("0 1 0\n0 1 0.1")]), IMPORT, "at least one frame"),
    "bvh time stands": (bvh("0.05", "0"), IMPORT, "0.0001"),
    "bvh time nan": (bvh("0.05", "nan"), IMPORT, "not finite"),
    "bvh frame nan": (bvh("0 1 0.1", "0 nan 0.1"), IMPORT, "frame 1 holds a NaN"),
    "bvh frame in words": (bvh("0 1 0.1", "0 up 0.1"), IMPORT, "no number"),
    "bvh frame too short": (bvh("0 1 0.1", "0 1"), IMPORT, "frame 1 has 2 numbers"),
    "bvh brace open": (bvh("  }\n}", "  }"), IMPORT, "closed braces"),
    "bvh two roots": (bvh("MOTION", "ROOT b { OFFSET 0 0 0 CHANNELS 0 }\nMOTION"), IMPORT, "one tree"),
    "bvh channels below zero": (bvh("CHANNELS 3", "CHANNELS -2"), IMPORT, "a.bvh"),
    "bvh channels without end": (bvh("CHANNELS 3", "CHANNELS 999999"), IMPORT, "in the middle of a joint"),
    "bvh channel unknown": (bvh("Yposition", "Yscale"), IMPORT, "unknown channel 'Yscale'"),
    "bvh offset infinite": (bvh("OFFSET 0 0 0", "OFFSET 0 inf 0"), IMPORT, "OFFSET is not finite"),
    "bvh of one joint": (bvh(), IMPORT, "none of the joint maps"),
    "bvh good and bad": (good_bvh(bvh("Frames: 2", "Frames: 9")), IMPORT, "a.bvh says"),
    "bvh map is a folder": (good_bvh(folder("map")), [*IMPORT, "--map", "map"], "no joint map"),
    "bvh map is a list": (good_bvh(put("map.json", "[1]")), [*IMPORT, "--map", "map.json"], "is no joint map"),
    "bvh map nested without end": (
        good_bvh(put("map.json", "[" * 100000)),
        [*IMPORT, "--map", "map.json"],
        "is no joint map",
    ),
    "bvh that is a folder": (folder("bvh/a.bvh"), IMPORT, "no file bvh/a.bvh"),
    "bvh captions not UTF-8": (
        good_bvh(put("c.csv", b"name,caption\nwalk,caf\xe9\n")),
        [*IMPORT, "--captions", "c.csv"],
        "not UTF-8",
    ),
    "bvh captions empty": (good_bvh(put("c.csv", "")), [*IMPORT, "--captions", "c.csv"], "name and caption"),
    "bvh over a data set": (good_bvh(data()), IMPORT, "--force"),
    # evaluate, bench, doctor, demo
    "evaluate repeats": (nothing, [*EVALUATE, "--repeats", "-1"], "repeats"),
    "evaluate limit": (nothing, [*EVALUATE, "--quick", "--limit", "-5"], "--limit"),
    "evaluate limit in words": (nothing, [*EVALUATE, "--limit", "few"], "--limit"),
    "evaluate compositions": (nothing, [*EVALUATE, "--protocol", "long", "--compositions", "-1"], "-1 of 8"),
    "evaluate prompts each": (nothing, [*EVALUATE, "--protocol", "mtt", "--prompts-each", "0"], "64 of 0"),
    "evaluate an empty judge": (nothing, [*EVALUATE, "--evaluator", ""], "t2m_essential"),
    "evaluate into a folder": (folder("a.json"), [*EVALUATE, "--out", "a.json", "--force"], "is a folder"),
    "evaluate steps": (nothing, [*EVALUATE, "--quick", "--limit", "1", "--steps", "0"], "num_steps"),
    "evaluate guidance": (nothing, [*EVALUATE, "--quick", "--limit", "1", "--guidance", "nan"], "guidance_scale"),
    "evaluate uncertainty": (nothing, [*EVALUATE, "--quick", "--limit", "1", "--uncertainty=-1"], "uncertainty"),
    "evaluate schedule": (nothing, [*EVALUATE, "--quick", "--limit", "1", "--schedule", "zigzag"], "zigzag"),
    "bench ending": (nothing, ["bench", "--quick", "--out", "a.html"], ".json, .txt"),
    "bench over a file": (put("a.txt", "mine"), ["bench", "--quick", "--out", "a.txt"], "--force"),
    "bench into a folder": (folder("a.json"), ["bench", "--out", "a.json", "--force"], "is a folder"),
    "bench nowhere": (nothing, ["bench", "--out", "no/a.json"], "does not exist"),
    "bench, unknown option": (nothing, ["bench", "--quickly"], "--quickly"),
    "doctor, unknown option": (nothing, ["doctor", "--cure"], "--cure"),
    "doctor of something": (nothing, ["doctor", "me"], "unrecognized arguments: me"),
    "demo, unknown option": (nothing, ["demo", "--frames", "8"], "unrecognized arguments"),
}

PROGRESS = ("reading the data", "to validate on")


def digest(root):
    """Every path under a folder with the hash of what it holds (None for a folder)."""
    return {
        str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else None
        for path in root.rglob("*")
    }


def refused(arguments, capsys):
    """Run a command that must be refused, and return its one line; what is under way may be said before it."""
    capsys.readouterr()
    code = cli.main(arguments)
    out, err = capsys.readouterr()
    lines = [line for line in err.splitlines() if line.startswith("minicmdm: ") and not line.endswith(PROGRESS)]
    assert code == 2 and out == "", (code, out, err)
    assert len(lines) == 1 and err.endswith(lines[0] + "\n") and "Traceback" not in err, err
    return lines[0]


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.stdin", io.StringIO(""))
    return tmp_path


@pytest.mark.parametrize("name", ROWS)
def test_rough_hands_break_nothing(name, here, capsys):
    build, arguments, message = ROWS[name]
    build()
    before = digest(here)
    line = refused(arguments, capsys)
    assert message in line
    assert digest(here) == before and not Path(EXPLODED).exists()


@pytest.mark.skipif(os.name == "nt" or os.geteuid() == 0, reason="root may write anywhere")
@pytest.mark.parametrize("arguments", [["generate", "walk", "--out", "shut/a.npy"], ["bench", "--out", "shut/a.json"]])
def test_a_folder_that_takes_no_files(arguments, here, capsys):
    Path("shut").mkdir(mode=0o555)
    assert "takes no files" in refused(arguments, capsys)


# --- a full disk -----------------------------------------------------------------------------------------------------

FULL = {f"generate {end}": ([*GENERATE[:3], f"old{end}", *GENERATE[4:]], f"old{end}") for end in (".npy", ".bvh")}
FULL |= {f"generate {end}": ([*GENERATE[:3], f"old{end}", *GENERATE[4:]], f"old{end}") for end in (".gif", ".html")}
FULL |= {f"stream {end}": ([*STREAM[:3], f"old{end}", *STREAM[4:]], f"old{end}") for end in (".npy", ".jsonl")}


@pytest.mark.parametrize("name", FULL)
def test_on_a_full_disk_the_old_file_survives(name, here, capsys, monkeypatch):
    """Bytes that the system took and cannot store after all are told when they are pushed to the disk: at fsync."""
    arguments, old = FULL[name]
    plan()
    Path(old).write_text("mine")
    before = digest(here)

    def full(number):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("minicmdm.files.os.fsync", full)
    short = ["--frames", "8"] if arguments[0] == "generate" else []
    line = refused([*arguments, "--steps", "2", *short, "--force"], capsys)
    assert "No space left on device" in line
    assert digest(here) == before and Path(old).read_text() == "mine"


def test_on_a_full_disk_the_old_data_set_survives(here, capsys, monkeypatch):
    good_bvh()()
    data()()
    before, real = digest(here), np.save

    def full(path, array, **how):
        if "Mean" in str(path):  # the last but one that is written
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        real(path, array, **how)

    monkeypatch.setattr("minicmdm.data.folders.np.save", full)
    assert "No space left on device" in refused([*IMPORT, "--force"], capsys)
    assert digest(here) == before


def test_a_training_that_a_full_disk_stopped_goes_on(here, capsys, monkeypatch):
    from minicmdm.training import stages

    data()()
    monkeypatch.setattr(stages, "FAST", {"evaluator_steps": 2, "evaluator_batch": 2})
    order, real, left = [*TRAIN, "--stage", "evaluator"], os.fsync, [1]

    def full(number):
        if not left:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        left.pop()
        real(number)

    with monkeypatch.context() as patch:
        patch.setattr("minicmdm.files.os.fsync", full)
        assert "No space left on device" in refused(order, capsys)
    assert not list(here.rglob(".minicmdm-*"))  # no half of a file
    assert cli.main([*order, "--resume"]) == 0
