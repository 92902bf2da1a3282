"""`minicmdm doctor`: what is installed, how fast this machine is, and what will not work on it."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import shutil
import tempfile
import time
from pathlib import Path

from minicmdm.files import cache_folder
from minicmdm.models.text import find_encoder, pretrained_config

NEEDED = ("torch", "numpy", "scipy", "matplotlib", "pillow", "safetensors", "transformers", "tokenizers", "tqdm")
OPTIONAL = {  # package -> what is missing without it
    "ipywidgets": "no sliders in notebooks: pip install 'minicmdm[notebooks]'",
    "anywidget": "no skeleton player in notebooks: pip install 'minicmdm[notebooks]'",
    "jupyterlab": "no notebooks: pip install 'minicmdm[notebooks]'",
    "pytest": "the tests cannot run: pip install 'minicmdm[dev]'",
}
TEXT_ENCODERS = {  # name -> what is missing without it; the presets toy and micro make their own
    "minilm": "no `train --text minilm`",
    "distilbert-base-uncased": "presets S to XL want another --text",
}
ENOUGH_DISK = 2e9  # bytes: the toy set takes 0.7 GB, a run's states 0.1


def examine() -> tuple[dict[str, object], list[str]]:
    """Facts about this machine and installation, and what will not work, a line each."""
    import torch

    wrong = []
    facts: dict[str, object] = {
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.machine()}",
    }
    for name in (*NEEDED, *OPTIONAL):
        try:
            facts[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            facts[name] = "missing"
            wrong.append(f"{name} is missing: {OPTIONAL.get(name, 'pip install minicmdm')}")
    facts["cores"] = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    facts["threads"] = torch.get_num_threads()
    facts["gpus"] = [torch.cuda.get_device_name(k) for k in range(torch.cuda.device_count())]
    if not facts["gpus"]:
        wrong.append("no GPU: the toy and micro presets train here, S to XL would take weeks")
    facts["compiler"] = shutil.which("c++") or shutil.which("g++") or shutil.which("clang++") or "none"
    if facts["compiler"] == "none":
        wrong.append("no C++ compiler: train without --compile")
    from minicmdm.models.packed import can_pack

    facts["packed_weights"] = can_pack(torch.zeros(1))
    facts["matmul_gflops"] = round(_gflops(torch), 1)
    facts["bfloat16_gflops"] = round(_gflops(torch, torch.bfloat16), 1)
    if facts["bfloat16_gflops"] < facts["matmul_gflops"]:
        wrong.append("bfloat16 is slower than float32 here: the toy preset, which trains in it, takes longer than told")
    for name in TEXT_ENCODERS:
        try:
            facts[name.partition("-")[0]] = f"{pretrained_config(name).dim} wide, in {find_encoder(name)}"
        except (FileNotFoundError, ValueError) as error:
            facts[name.partition("-")[0]] = "missing"
            wrong.append(f"{TEXT_ENCODERS[name]}: {error}")
    cache = cache_folder()
    facts["cache"] = str(cache)
    wrong += _folder_troubles(cache)
    if not (Path(__file__).parent / "assets" / "toy" / "card.json").is_file():
        wrong.append("the shipped checkpoint is not here: reinstall minicmdm")
    return facts, wrong


def _gflops(torch, dtype=None) -> float:
    """How fast one thread multiplies matrices of 512, best of five, in 1e9 operations a second."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    a, best = torch.ones(512, 512, dtype=dtype or torch.float32), float("inf")
    for _ in range(5):
        start = time.perf_counter()
        a @ a
        best = min(best, time.perf_counter() - start)
    torch.set_num_threads(threads)
    return 2e-9 * 512**3 / best


def _folder_troubles(folder: Path) -> list[str]:
    """What keeps a folder from being written to."""
    while not folder.exists():
        folder = folder.parent
    troubles = []
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        troubles.append(f"{folder} cannot be written to ({error.strerror}): set MINICMDM_CACHE to a folder that can")
    if (free := shutil.disk_usage(folder).free) < ENOUGH_DISK:
        troubles.append(f"only {free / 1e9:.1f} GB are free under {folder}: training wants {ENOUGH_DISK / 1e9:.0f}")
    return troubles
