"""Entries of an actrm zoo as policies of LeRobot's, and actrm's tasks as its environments.

LeRobot imports every installed package whose name begins with `lerobot_policy_`; this one, whose wheel `make wheel`
writes too, makes the policy type `actrm` and the environment type `actrm` known to it:

    lerobot-eval --policy.type=actrm --policy.entry=zoo/stack-act --env.type=actrm --env.task=Stack

An entry with image inputs needs an environment that renders them: `--env.entry=` the same entry.
`ActrmPolicy.save_pretrained` writes a folder that `--policy.path` takes.
"""

from .configuration_actrm import ActrmConfig
from .environment_actrm import ActrmEnv

__all__ = ["ActrmConfig", "ActrmEnv"]
