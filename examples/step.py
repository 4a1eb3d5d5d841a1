"""STEP's decision between two results of `actrm-zoo eval`: which policy succeeds more often.

pip install sequentialized-barnard-tests==0.0.9 pyarrow && python step.py zoo/results/ONE zoo/results/OTHER

The test is that of Snyder et al. (RSS 2025), from its authors' package, which is CC BY-NC 4.0. N-SCORE and SAVI are in
`actrm-zoo compare`.
"""

import sys

import pyarrow.parquet as parquet
from sequentialized_barnard_tests import Decision, Hypothesis, MirroredStepTest

EPISODES, ALPHA = 200, 0.05  # for which the package brings its tables; others it computes, which takes minutes


def outcomes(folder: str) -> dict[int, bool]:
    """Success by seed."""
    table = parquet.read_table(f"{folder}/outcomes.parquet", columns=["seed", "success"])
    return {row["seed"]: row["success"] for row in table.to_pylist()}


one, other = outcomes(sys.argv[1]), outcomes(sys.argv[2])
seeds = sorted(one.keys() & other.keys())[:EPISODES]
test = MirroredStepTest(Hypothesis.P0LessThanP1, EPISODES, ALPHA, random_seed=0)
test.reset()
better = {Decision.AcceptAlternative: "the second", Decision.AcceptNull: "the first"}
for count, seed in enumerate(seeds, start=1):
    decision = test.step(one[seed], other[seed]).decision
    if decision in better:
        print(f"{better[decision]} succeeds more often: decided after {count} episodes of each, alpha {ALPHA}")
        break
else:
    print(f"not decided after {len(seeds)} episodes of each, alpha {ALPHA}")
