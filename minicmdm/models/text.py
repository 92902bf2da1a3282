"""Words as vectors: a DistilBERT read word by word, either tiny and our own or the real one from a folder.

The denoiser attends to words, not to one sentence vector, so the encoder returns every word piece's
embedding, [CLS] and [SEP] included, and a mask that is True where a word is and False where the batch was
padded.

The null text of classifier-free guidance is the empty sentence "": its two words [CLS] [SEP] are
embeddings like any others and need no special vector. (The release zeroes the embeddings and keeps the
sentence's mask.)

Nothing here can reach the network: a folder holds `tokenizer.json`, `config.json` and
`model.safetensors`, and those three files are all that is ever read, so nothing is unpickled either.
"""

import json
import string
from collections import Counter
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import NamedTuple

import torch
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from minicmdm.config import TextConfig

SPECIAL = ("[PAD]", "[UNK]", "[CLS]", "[SEP]", "[MASK]")  # in the order of their ids in our own vocabulary
FILES = ("tokenizer.json", "config.json", "model.safetensors")


class Words(NamedTuple):
    """A batch of sentences: embeddings (B,S,E) and mask (B,S), True where there is a word."""

    embeddings: Tensor
    mask: Tensor


class TextEncoder(nn.Module):
    """A tokenizer and the DistilBERT that reads it. Made by `from_captions` or `load`.

    With `cfg.frozen` it stays in eval mode whatever `train()` says (the release forgets this, and its frozen
    encoder drops words at random while the denoiser trains) and `encode` makes no gradient.
    """

    def __init__(self, tokenizer, config: dict, cfg: TextConfig):
        super().__init__()
        from transformers import DistilBertConfig, DistilBertModel  # slow to import: only when text is read

        self.cfg = cfg
        self.tokenizer = tokenizer
        self.config = config  # DistilBertConfig's arguments
        self.bert = DistilBertModel(DistilBertConfig(**config, attn_implementation="eager"))
        limit = min(cfg.max_words, config["max_position_embeddings"])
        self.tokenizer.enable_truncation(limit)
        self.tokenizer.enable_padding(pad_id=self.tokenizer.token_to_id("[PAD]"), pad_token="[PAD]")
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
    def load(cls, folder: str | Path, cfg: TextConfig) -> "TextEncoder":
        """Read an encoder written by `save`, or a DistilBERT checkpoint folder as the hub ships it.

        FileNotFoundError: the folder or one of its three files is missing. ValueError: a file is damaged,
        or the folder holds another model than `cfg` describes.
        """
        from tokenizers import Tokenizer

        folder = Path(folder)
        missing = [name for name in FILES if not (folder / name).is_file()]
        if missing:
            raise FileNotFoundError(
                f"no text encoder in {folder.absolute()}: missing {', '.join(missing)}. "
                "For the real DistilBERT run `hf download distilbert-base-uncased --local-dir FOLDER` "
                "once and give that folder"
            )
        try:
            config = json.loads((folder / "config.json").read_text(encoding="utf-8"))
            tokenizer = Tokenizer.from_file(str(folder / "tokenizer.json"))
            weights = load_file(folder / "model.safetensors")
        except Exception as error:  # tokenizers and safetensors raise their own bare types
            raise ValueError(f"the text encoder in {folder.absolute()} cannot be read: {error}") from error
        if config.get("model_type") != "distilbert" or config.get("dim") != cfg.dim:
            raise ValueError(
                f"{folder / 'config.json'}: expected a distilbert of width {cfg.dim}, "
                f"got {config.get('model_type')!r} of width {config.get('dim')!r}"
            )
        keep = (
            "vocab_size",
            "max_position_embeddings",
            "dim",
            "hidden_dim",
            "n_layers",
            "n_heads",
            "dropout",
        )
        keep += ("attention_dropout", "pad_token_id", "activation", "sinusoidal_pos_embds")
        encoder = cls(tokenizer, {name: config[name] for name in keep if name in config}, cfg)
        # The hub's checkpoint is a masked-language model: our encoder is its "distilbert." part.
        weights = {name.removeprefix("distilbert."): w for name, w in weights.items() if "vocab_" not in name}
        try:
            encoder.bert.load_state_dict(weights)
        except RuntimeError as error:
            raise ValueError(f"{folder / 'model.safetensors'} does not fit its config.json: {error}") from error
        return encoder

    def save(self, folder: str | Path) -> None:
        """Write tokenizer.json, config.json and model.safetensors into an existing folder."""
        folder = Path(folder)
        self.tokenizer.save(str(folder / "tokenizer.json"))
        config = {"model_type": "distilbert", **self.config, "minicmdm": asdict(self.cfg)}
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


class WordCache:
    """A frozen encoder that reads every sentence once, and keeps in memory what it read.

    The sentences are read at the start, sorted, in groups of one size: what a sentence's words come out as then depends
    on the list alone (padding moves the last digits), and a resumed training sees the very same numbers.
    """

    def __init__(self, text: TextEncoder, sentences: Iterable[str], group: int = 256):
        self.text = text.eval()
        self.known: dict[str, Tensor] = {}  # sentence -> its words (S,E)
        ordered = sorted(set(sentences), key=lambda s: (len(s), s))
        for first in range(0, len(ordered), group):
            self._read(ordered[first : first + group])

    @torch.no_grad()
    def _read(self, sentences: list[str]) -> None:
        read = self.text.encode(sentences)
        self.known |= {s: e[m].clone() for s, e, m in zip(sentences, read.embeddings, read.mask)}

    def encode(self, sentences: list[str]) -> Words:
        """As `TextEncoder.encode`, without gradients; a sentence that is new is read by itself."""
        for sentence in sentences:
            if sentence not in self.known:
                self._read([sentence])
        rows = [self.known[s] for s in sentences]
        lengths = torch.tensor([len(row) for row in rows])
        embeddings = nn.utils.rnn.pad_sequence(rows, batch_first=True)  # (B,S,E)
        return Words(embeddings, torch.arange(embeddings.shape[1]) < lengths[:, None])


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
