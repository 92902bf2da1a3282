"""Every size in one place: frozen dataclasses, and the presets toy, micro, S, M, L and XL.

A configuration is plain data. It holds no tensor and knows no module, so a checkpoint can carry it as JSON
(`Preset.to_dict`) and a reader can compare two models by comparing two dictionaries.
"""

from collections.abc import Collection
from dataclasses import asdict, dataclass, field, fields, replace

SYSTEMS = ("cmdm", "flood", "mardm", "cdamd", "window")


@dataclass(frozen=True)
class VAEConfig:
    """MAC-VAE: `down` halvings of time, so one latent stands for `2**down` frames (CMDM Sec. 4.1, A.1)."""

    input_dim: int = 263
    latent_dim: int = 64
    width: int = 1024
    down: int = 2  # two stride-2 convolutions: 4 frames per latent
    depth: int = 3  # blocks per residual stack, with dilations growth**(depth-1), ..., growth, 1
    dilation_growth: int = 3
    causal: bool = True  # False: the plain VAE of the ablation, which also looks ahead
    deterministic: bool = False  # True: the autoencoder of MARDM and CDAMD, whose latents have no noise

    @property
    def frames_per_latent(self) -> int:
        return 2**self.down


@dataclass(frozen=True)
class TextConfig:
    """A word-level encoder: a DistilBERT with its own vocabulary (`path=None`), or a pretrained one, which brings its
    own sizes; but `dim` must be its width (`models.text.pretrained_config` reads it)."""

    path: str | None = None  # "minilm", a folder, or a hub name whose files are on this machine
    dim: int = 768
    layers: int = 6
    heads: int = 12
    vocab_size: int = 30522  # an upper bound: a vocabulary trained from few captions ends up smaller
    max_words: int = 128  # word pieces per sentence, [CLS] and [SEP] counted; longer sentences are cut
    dropout: float = 0.0
    frozen: bool = True  # always in eval mode, never trained but for an own one, by the teacher; False: tuned by it


@dataclass(frozen=True)
class TMRConfig:
    """Part-TMR, the teacher that aligns the VAE and teaches the text encoder (CMDM 3.1, A.1)."""

    dim: int = 512
    layers: int = 4
    heads: int = 4
    embed_dim: int = 256
    parts: str = "six"  # or "one": plain TMR, the whole body as one part
    causal: bool = False  # True: frame features that have not seen the future, as the latents they teach
    mean: str = "valid"  # over time; "padded" counts the padding too, as the release does
    dropout: float = 0.1


@dataclass(frozen=True)
class DiTConfig:
    """Causal-DiT (CMDM Table 10). The feed-forward width is always 2 * dim, as the table's counts imply."""

    latent_dim: int = 64
    text_dim: int = 768
    dim: int = 512
    layers: int = 8
    heads: int = 4
    time_dim: int = 256
    block_size: int = 1  # latents that see each other both ways: 1 is the paper's text, 3 the released code
    attention: str = "causal"  # or "bidirectional", or "window"
    path: str = "flow"  # it predicts the velocity, as released; "ddpm": the noise at 1,000 levels, as CMDM Eqs 7-10 say
    text_layers: int = 0  # self-attention among the words of a sentence before latents see them (ours)
    target: str = "v"  # what it predicts on the flow path: "v", "x0" or "eps" (FloodDiffusion's table compares them)
    clock: bool = False  # True (ours): each latent knows how far into its sentence it is, and what is left if known

    @property
    def feedforward_dim(self) -> int:
        return 2 * self.dim


@dataclass(frozen=True)
class MaskedConfig:
    """What MARDM and CDAMD have besides a transformer: a diffusion head and, from `mask` on for CDAMD alone, tokens."""

    head_dim: int = 1792
    head_layers: int = 16
    repeats: int = 4  # noises drawn for every masked latent of a batch: the head is cheap, the transformer is not
    iterations: int = 18  # of unmasking; CDAMD takes 10
    mask: str = "meant"  # the reading of its dual-constrained mask, see systems/cdamd.py
    codes: int = 512  # of each level of the residual quantiser
    code_levels: int = 4  # the paper's; the released default is 6
    prior_drop: float = 0.7  # how often training hides the motion tokens, which sampling never has


@dataclass(frozen=True)
class TrainConfig:
    """How the stages are trained; the defaults are the released recipe where it is known."""

    seed: int = 0
    bfloat16: bool = False  # autocast the forward pass; the weights and the optimiser stay float32
    compile: bool = False  # torch.compile the denoiser's blocks while they train; needs a C++ compiler
    accumulate: int = 1  # micro-batches a step, shared by all processes; every batch below is one of them
    # stage 1: the evaluators
    evaluator_steps: int = 20_000
    evaluator_batch: int = 128
    evaluator_lr: float = 1e-4
    # stage 2: the teacher and the text encoder, by contrast
    tmr_steps: int = 10_000
    tmr_batch: int = 128
    tmr_lr: float = 1e-4
    tmr_warmup: int = 500
    # stage 3: the VAE, on short crops
    vae_steps: int = 150_000
    vae_batch: int = 256
    vae_lr: float = 2e-4
    vae_warmup: int = 2_000
    crop_frames: int = 64
    kl_weight: float = 1e-4  # beta in front of an exact ELBO; see models/vae.py for the release's 8e-5
    root_weight: float = 0.05
    align_weight: float = 0.1  # of the teacher's pull, relative to reconstruction's; 0: no alignment
    matrix_of: str = "latent"  # Eq. 6 compares latents; "projected", as the release does, compares W z
    # stage 4: the denoiser, on whole clips
    dit_steps: int = 150_000
    dit_batch: int = 64
    dit_lr: float = 2e-4
    dit_warmup: int = 2_000
    dit_muon: float = 0.0  # Muon's learning rate for the blocks' matrices (ours); 0: AdamW for all, as the release
    levels: str = "random"  # of the latents: independent (CMDM Alg. 1), "staircase", as FSS will present them, or
    # "triangle", FloodDiffusion's staircase of one height, or "tiled", all triangles of a clip at once (ours)
    overlap: int = 5  # n_s, the latents of that triangle
    time_power: float = 1.0  # random times are u ** time_power: 1 is the paper's, more draws noisy latents more often
    ema: float = 0.9999
    text_drop: float = 0.1  # how often a sample's sentence is replaced by "", the null of guidance
    word_drop: float = 0.0  # how often a word of a sentence is hidden (ours): each has to be understood by itself
    # all
    betas: tuple[float, float] = (0.9, 0.99)
    weight_decay: float = 1e-5
    grad_clip: float = 1.0


@dataclass(frozen=True)
class Preset:
    """A whole system: what is built and how it is trained."""

    name: str
    vae: VAEConfig = field(default_factory=VAEConfig)
    text: TextConfig = field(default_factory=TextConfig)
    tmr: TMRConfig = field(default_factory=TMRConfig)
    dit: DiTConfig = field(default_factory=DiTConfig)
    train: TrainConfig = field(default_factory=TrainConfig)
    system: str = "cmdm"
    masked: MaskedConfig = field(default_factory=MaskedConfig)

    def __post_init__(self):
        if self.system not in SYSTEMS:
            raise ValueError(f"unknown system {self.system!r}: expected one of {', '.join(SYSTEMS)}")
        if self.vae.latent_dim != self.dit.latent_dim:
            raise ValueError(
                f"preset {self.name!r}: the VAE writes {self.vae.latent_dim} channels per latent "
                f"but the DiT reads {self.dit.latent_dim}"
            )
        if self.text.dim != self.dit.text_dim:
            raise ValueError(
                f"preset {self.name!r}: the text encoder writes words of width {self.text.dim} "
                f"but the DiT reads {self.dit.text_dim}"
            )

    def to_dict(self) -> dict:
        """The preset as nested JSON-ready dictionaries (tuples become lists)."""
        out = asdict(self)
        out["train"]["betas"] = list(self.train.betas)
        return out

    @classmethod
    def from_dict(cls, data: dict) -> "Preset":
        """The inverse of `to_dict`. ValueError: an unknown key, or a part missing, named with where it stood.

        A number that an older version did not know yet has its default, which means what was done before there was a
        choice: an old checkpoint stays what it was.
        """
        parts = {"vae": VAEConfig, "text": TextConfig, "tmr": TMRConfig, "dit": DiTConfig, "train": TrainConfig}
        _check_keys(cls, data, "preset", needed={"name", *parts})
        parts |= {"masked": MaskedConfig} if "masked" in data else {}
        for key, part in parts.items():
            _check_keys(part, data[key], key)
        made = {key: part(**data[key]) for key, part in parts.items()}
        train = replace(made["train"], betas=tuple(made["train"].betas))  # JSON has lists only
        return cls(data["name"], system=data.get("system", "cmdm"), **{**made, "train": train})


def _check_keys(cls, data, where: str, needed: Collection[str] = ()):
    if not isinstance(data, dict):
        raise ValueError(f"configuration {where!r}: expected a dictionary, got {type(data).__name__}")
    expected, found = {f.name for f in fields(cls)}, set(data)
    missing, unknown = expected - found, found - expected
    if unknown or missing & set(needed):
        raise ValueError(f"configuration {where!r}: missing keys {sorted(missing)}, unknown keys {sorted(unknown)}")


def _paper(name: str, heads: int, layers: int, dim: int) -> Preset:
    # The folder is looked for on this machine only; models/text.py says how to fill it.
    text = TextConfig(path="distilbert-base-uncased", frozen=False)  # tuned with the teacher, as released
    return Preset(name, text=text, dit=DiTConfig(dim=dim, layers=layers, heads=heads))


PRESETS = {
    # Small enough to ship (under 12 MB in float32) and to train on one core in under 40 minutes.
    "toy": Preset(
        "toy",
        vae=VAEConfig(latent_dim=16, width=128, depth=2),
        text=TextConfig(dim=96, layers=2, heads=4, vocab_size=512, max_words=64),
        tmr=TMRConfig(dim=48, layers=2, heads=1, embed_dim=64, dropout=0.0),
        dit=DiTConfig(latent_dim=16, text_dim=96, dim=128, layers=6, heads=4, text_layers=2, clock=True),
        train=TrainConfig(
            bfloat16=True,
            evaluator_steps=1_200,
            evaluator_batch=64,
            evaluator_lr=1e-3,
            tmr_steps=1_000,
            tmr_batch=48,
            tmr_lr=2e-3,
            tmr_warmup=100,
            vae_steps=4_000,
            vae_batch=48,
            vae_lr=1.5e-3,
            vae_warmup=100,
            kl_weight=1e-2,
            root_weight=10.0,  # a wrong yaw step turns all that follows, so it counts more than the release's 0.05
            dit_steps=6_500,
            dit_batch=48,
            dit_lr=1.5e-3,
            dit_warmup=300,
            ema=0.999,
            weight_decay=0.0,
        ),
    ),
    # For studies with seeds: a whole run in three minutes, on the teacher of another run.
    "micro": Preset(
        "micro",
        vae=VAEConfig(latent_dim=16, width=64, depth=2),
        text=TextConfig(dim=96, layers=2, heads=4, vocab_size=512, max_words=64),
        tmr=TMRConfig(dim=48, layers=2, heads=1, embed_dim=64, dropout=0.0),
        dit=DiTConfig(latent_dim=16, text_dim=96, dim=64, layers=4, heads=2, text_layers=2, clock=True),
        train=TrainConfig(
            bfloat16=True,
            tmr_steps=400,
            tmr_batch=32,
            tmr_lr=2e-3,
            tmr_warmup=50,
            vae_steps=600,
            vae_batch=32,
            vae_lr=2e-3,
            vae_warmup=50,
            kl_weight=1e-2,
            root_weight=10.0,
            dit_steps=1_500,
            dit_batch=32,
            dit_lr=3e-3,
            dit_warmup=100,
            time_power=1.5,  # chosen among 1, 1.5, 2 and 3 on one seed
            ema=0.995,
            weight_decay=0.0,
        ),
    ),
    # CMDM Table 10: heads, layers, dim, and 19.8, 38.7, 129.1, 304.6 million denoiser parameters.
    "S": _paper("S", heads=2, layers=4, dim=512),
    "M": _paper("M", heads=4, layers=8, dim=512),
    "L": _paper("L", heads=6, layers=12, dim=768),
    "XL": _paper("XL", heads=8, layers=16, dim=1024),
}


def preset(name: str, system: str = "cmdm") -> Preset:
    """The preset of that name, as one of the systems has it. ValueError: an unknown name, with the known ones."""
    if name not in PRESETS:
        raise ValueError(f"unknown preset {name!r}: expected one of {', '.join(PRESETS)}")
    return as_system(PRESETS[name], system)


def as_system(plan: Preset, system: str) -> Preset:
    """A plan of CMDM's as another system has it: words, clock, about the minutes and the number of weights stay."""
    plan = replace(plan, system=system)
    if system == "cmdm":
        return plan
    plan = replace(plan, dit=replace(plan.dit, attention="window" if system == "window" else "bidirectional"))
    if system == "window":  # a step sees each clip twice: half the steps, and a tenth more
        return replace(plan, train=replace(plan.train, levels="tiled", dit_steps=plan.train.dit_steps * 36 // 65))
    if system == "flood":
        return replace(plan, train=replace(plan.train, levels="triangle"))
    # An autoencoder that looks both ways. No alignment, and for coordinates no root columns that count again.
    vae = replace(plan.vae, input_dim=67 if system == "mardm" else 66, causal=False, deterministic=True)
    root = plan.train.root_weight if system == "mardm" else 0.0
    steps = plan.train.dit_steps * 3 // 4  # they take a third longer: the same minutes for all
    train = replace(plan.train, align_weight=0.0, kl_weight=0.0, root_weight=root, dit_steps=steps)
    masked = MaskedConfig(iterations=18 if system == "mardm" else 10)
    if plan.dit.dim < 512:  # a third of the transformer's layers for a head: about as many weights as CMDM has
        plan = replace(plan, dit=replace(plan.dit, layers=plan.dit.layers - plan.dit.layers // 3))
        masked = replace(masked, head_dim=plan.dit.dim * 3 // 2, head_layers=3, repeats=2, codes=128)
    return replace(plan, vae=vae, train=train, masked=masked)
