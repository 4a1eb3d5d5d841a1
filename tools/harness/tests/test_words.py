"""Instructions as numbers."""

import numpy as np

from actrm_harness.words import instruction_words


def test_words_are_those_of_the_conversion() -> None:
    """The numbers are those of `crates/dataset/src/words.rs`."""
    words = instruction_words("Pick the CUBE, naïve_1!")
    assert np.array_equal(words[:3], np.array([243, 27, -19]) / 1275.0)
    assert np.array_equal(words, instruction_words("cube naïve 1 the pick"))
    assert not np.array_equal(words, instruction_words("pick the cube"))
    assert np.array_equal(instruction_words(" ,"), np.zeros(32))
