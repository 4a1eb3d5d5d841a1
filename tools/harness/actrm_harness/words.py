"""An instruction as numbers that need no vocabulary, the same as `crates/dataset/src/words.rs` makes of it."""

import hashlib
import re

import numpy as np

from actrm_harness.wire import Array

KEY = "instruction_words"
"""The observation's name."""


def instruction_words(text: str) -> Array:
    """32 numbers from -1 to 1: the mean over the words of (2 b - 255) / 255, b being the bytes of a word's SHA-256.

    Words are ASCII letters, digits and all characters that are not ASCII; capitals are as small letters. A text
    without words gives zeros.
    """
    words = re.findall(rb"[a-z0-9\x80-\xff]+", text.encode().lower())
    sums = np.zeros(hashlib.sha256().digest_size, dtype=np.int64)
    for word in words:
        sums += 2 * np.frombuffer(hashlib.sha256(word).digest(), dtype=np.uint8).astype(np.int64) - 255
    return sums / (255.0 * max(len(words), 1))
