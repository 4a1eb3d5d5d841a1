"""What is done before and after the policy: nothing, since an entry normalises on its own."""

from __future__ import annotations

from typing import Any

from lerobot.processor import PolicyAction, PolicyProcessorPipeline, make_default_pre_post_processors
from torch import Tensor

from .configuration_actrm import ActrmConfig


def make_actrm_pre_post_processors(
    config: ActrmConfig, dataset_stats: dict[str, dict[str, Tensor]] | None = None
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]:
    """LeRobot's pipelines with every feature left as it is."""
    return make_default_pre_post_processors(config, dataset_stats)
