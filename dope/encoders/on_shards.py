"""An encoder made ready for the views of a folder of shards, and what its result rows say of it."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import torch

from dope.encoders.embedder import EncoderEmbedder, MaskChoice
from dope.encoders.load import load_encoder
from dope.lowshot.encoding import to_tensor
from dope.lowshot.subjects import Subject, encoder_subject
from dope.lowshot.views import ViewShards
from dope.storage import Shards

SAMPLE = 4
"""Views that are encoded together and alone before anything is evaluated."""


def encoder_on_shards(
    text: str, shards: Shards, *, mask: MaskChoice = "none", device: torch.device | str = "cpu"
) -> Subject:
    """Load `--encoder TEXT`, try it on a few views, and give it with the columns that say which encoder it is.

    Raises:
        UsageError, BadInput: as `load_encoder` and `EncoderEmbedder`; or the shards cannot be read.
    """
    views = ViewShards(shards)
    encoder = load_encoder(text, device)
    some = np.unique(np.linspace(0, len(views) - 1, SAMPLE).astype(np.int64))
    (images,) = views.batches(some, SAMPLE)
    embedder = EncoderEmbedder(encoder, to_tensor(images, device), mask=mask)
    return encoder_subject(embedder, label=encoder.name, sha256=encoder.sha256 or None, config_hash=encoder.config_hash)


def default_folder(name: str) -> Path:
    """eval/NAME in the current directory, where the rows of an encoder go that has no run: "hf:a/b" -> eval/hf_a_b."""
    return Path("eval") / (re.sub(r"[^\w.+-]+", "_", name).strip("._") or "encoder")
