"""Causal motion diffusion, compact but complete: a sentence in, a moving skeleton out.

    from minicmdm import MotionPipeline
    motion = MotionPipeline.from_pretrained("toy")("a person walks, then waves")
    motion.save("walk.html")

Names are looked up on first use, so that `import minicmdm` is instant and torch is loaded only when something needs it.
"""

from importlib import import_module

__version__ = "0.1.0"

_HOME = {  # public name -> the module it lives in
    "MotionPipeline": "pipeline",
    "Motion": "motion",
    "PRESETS": "config",
    "Preset": "config",
    "preset": "config",
    "joints_to_features": "data.features",
    "features_to_joints": "data.features",
    "essential": "data.features",
    "coordinates": "data.features",
    "canonicalize": "data.features",
    "retarget": "data.features",
    "mirror_joints": "data.features",
    "mirror_caption": "data.features",
    "read_motion": "data.oracle",
    "load_dataset": "data.folders",
    "toy_dataset": "data.dataset",
    "MACVAE": "models.vae",
    "TextEncoder": "models.text",
    "CausalDiT": "models.dit",
    "schedule_matrix": "diffusion.schedules",
    "cost": "diffusion.schedules",
    "sample": "diffusion.sampling",
    "sample_steps": "diffusion.sampling",
    "guided": "diffusion.sampling",
    "diffusion_forcing_loss": "diffusion.forcing",
    "load_checkpoint": "training.checkpoints",
    "train": "training.stages",
    "metrics": "evaluation.metrics",
    "evaluate": "evaluation.protocols",
    "html_page": "viz.player",
    "pose_strip": "viz.plots",
    "save_gif": "viz.plots",
}
__all__ = ["__version__", *_HOME]


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module 'minicmdm' has no attribute {name!r}")
    home = import_module(f"minicmdm.{_HOME[name]}")
    value = globals()[name] = home if _HOME[name].endswith(f".{name}") else getattr(home, name)  # `metrics` is a module
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
