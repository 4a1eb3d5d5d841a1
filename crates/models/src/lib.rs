//! ACT, ACTRM, TRM and baselines, their losses, optimisers and training step, on candle.
