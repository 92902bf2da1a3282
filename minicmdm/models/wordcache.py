"""A frozen encoder's words, read once: in memory for a training's sake, on disk for the next one's."""

import hashlib
import json
import zlib
from collections.abc import Iterable
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from tqdm import tqdm

from minicmdm.files import cache_folder, whole_file
from minicmdm.models.text import TextEncoder, Words


class WordCache:
    """A frozen encoder that reads every sentence once, and keeps in memory what it read.

    The sentences are read at the start, sorted, in groups of one size: what a sentence's words come out as then depends
    on the list alone (padding moves the last digits), and a resumed training sees the very same numbers.

    What a pretrained encoder read is also kept on disk, under ~/.cache/minicmdm/words or `MINICMDM_CACHE`: the whole
    list in one file, named by all that its numbers depend on. An encoder of our own has new weights in every run and
    reads in seconds: its file would lie there for ever and serve nobody.
    """

    def __init__(self, text: TextEncoder, sentences: Iterable[str], group: int = 256, progress: bool = False):
        self.text, self.cfg = text.eval(), text.cfg
        self.known: dict[str, Tensor] = {}  # sentence -> its words (S,E)
        ordered = sorted(set(sentences), key=lambda s: (len(s), s))
        lasting = bool(ordered) and text.cfg.frozen and text.cfg.path is not None
        file = _words_file(text, ordered, group) if lasting else None
        if file is not None and (rows := _kept_words(file, len(ordered))):
            self.known = dict(zip(ordered, rows))
            return
        quiet = not (progress and lasting)
        for first in tqdm(range(0, len(ordered), group), desc="reading captions", disable=quiet):
            self._read(ordered[first : first + group])
        if file is not None:
            _keep_words(file, list(self.known.values()))

    def __deepcopy__(self, memo: dict) -> "WordCache":
        return self  # gigabytes that nobody changes: a model's running average shares them with the model

    @torch.no_grad()
    def _read(self, sentences: list[str]) -> None:
        read = self.text.encode(sentences)
        self.known |= {s: e[m].cpu().clone() for s, e, m in zip(sentences, read.embeddings, read.mask)}

    def encode(self, sentences: list[str]) -> Words:
        """As `TextEncoder.encode`, on the CPU and without gradients; a sentence that is new is read by itself."""
        for sentence in sentences:
            if sentence not in self.known:
                self._read([sentence])
        rows = [self.known[s] for s in sentences]
        lengths = torch.tensor([len(row) for row in rows])
        embeddings = nn.utils.rnn.pad_sequence(rows, batch_first=True)  # (B,S,E)
        return Words(embeddings, torch.arange(embeddings.shape[1]) < lengths[:, None])


def _words_file(text: TextEncoder, sentences: list[str], group: int) -> Path:
    """The file for a list of sentences: its name is a hash of weights, tokenizer, list and what moves last digits."""
    import transformers

    device, versions = text.bert.device.type, [torch.__version__, transformers.__version__]
    moving = [text.config, text.tokenizer.to_str(), sentences, group, device, torch.get_num_threads(), versions]
    key = hashlib.sha256(json.dumps(moving).encode())
    for name, weight in sorted(text.bert.state_dict().items()):
        key.update(name.encode())
        key.update(weight.cpu().contiguous().numpy())
    return cache_folder() / "words" / f"{key.hexdigest()[:32]}.safetensors"


def _keep_words(file: Path, rows: list[Tensor]) -> None:
    embeddings, lengths = torch.cat(rows), torch.tensor([len(row) for row in rows])  # (sum S,E), (B,)
    kept = {"embeddings": embeddings, "lengths": lengths, "crc32": torch.tensor(zlib.crc32(embeddings.numpy()))}
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(file) as temporary:
            save_file(kept, temporary)
    except (OSError, SafetensorError):
        pass  # no room or no right to write: the words are in memory, and only the next run has to read again


def _kept_words(file: Path, count: int) -> list[Tensor]:
    """The words of each sentence (S,E) as `_keep_words` left them; an empty list if they are not there or not whole."""
    try:
        kept = load_file(file)
        rows = kept["embeddings"].split(kept["lengths"].tolist())
        whole = len(rows) == count and zlib.crc32(kept["embeddings"].numpy()) == int(kept["crc32"])
    except (OSError, SafetensorError, KeyError, RuntimeError, TypeError):
        return []
    return list(rows) if whole else []
