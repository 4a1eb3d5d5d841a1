"""The policy: LeRobot's interface over `actrm.Policy`."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import actrm
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies.pretrained import PreTrainedPolicy
from torch import Tensor

from .configuration_actrm import ActrmConfig
from .processor_actrm import make_actrm_pre_post_processors

INSIDE = "entry"


class ActrmPolicy(PreTrainedPolicy):
    """An entry of a zoo, asked as LeRobot asks its policies."""

    config_class = ActrmConfig
    name = "actrm"

    def __init__(self, config: ActrmConfig, **_: Any) -> None:
        super().__init__(config)
        self.policy = actrm.load_policy(config.place())
        self.next_seed = config.seed
        self.rows = 1
        self.reset()

    def reset(self) -> None:
        """Begin the next episodes."""
        self.policy.reset(seed=self.next_seed)
        self.begun = False

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **_: Any) -> Tensor:
        """(rows, action_dim)"""
        observation = {key: batch[key] for key in self.policy.input_features if key in batch}
        return self._begin(torch.from_numpy(self.policy.select_action(observation)))

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Tensor], **_: Any) -> Tensor:
        """(rows, action_horizon, action_dim)"""
        observation = {key: batch[key] for key in self.policy.input_features if key in batch}
        return self._begin(torch.from_numpy(self.policy.predict_action_chunk(observation)))

    def _begin(self, answer: Tensor) -> Tensor:
        """An answer as it is; its rows' episodes have begun, and the next ones get the seeds after theirs."""
        if not self.begun:
            self.begun = True
            self.next_seed += len(answer)
        return answer

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, Any] | None]:
        """It is not trained here."""
        raise NotImplementedError("an entry of actrm is trained by actrm-zoo train")

    def get_optim_params(self) -> dict[str, Any]:
        """It is not trained here."""
        raise NotImplementedError("an entry of actrm is trained by actrm-zoo train")

    def _save_pretrained(self, save_directory: Path, state_dict: dict[str, Tensor] | None = None) -> None:
        """The entry as it is, with its hashes, and what LeRobot wants beside it."""
        name, version = self.policy.id.split("@")
        own, place = Path(self.policy.path), save_directory / INSIDE / name / version
        if own.resolve() != place.resolve():
            # what was saved there before may be another entry of that name
            shutil.rmtree(place, ignore_errors=True)
            shutil.copytree(own, place)
        entry, self.config.entry = self.config.entry, f"{INSIDE}/{name}/{version}"
        try:
            self.config._save_pretrained(save_directory)
        finally:
            self.config.entry = entry
        for pipeline in make_actrm_pre_post_processors(self.config):
            pipeline.save_pretrained(save_directory)

    @classmethod
    def from_pretrained(
        cls, pretrained_name_or_path: str | Path, *, config: PreTrainedConfig | None = None, **_: Any
    ) -> ActrmPolicy:
        """The policy of a folder that `save_pretrained` wrote."""
        if config is None:
            config = PreTrainedConfig.from_pretrained(pretrained_name_or_path)
        config.pretrained_path = Path(pretrained_name_or_path)
        assert isinstance(config, ActrmConfig)
        policy = cls(config)
        policy.eval()
        return policy
