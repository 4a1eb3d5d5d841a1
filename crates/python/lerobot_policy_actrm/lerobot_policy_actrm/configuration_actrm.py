"""The configuration: which entry, and what it reads and gives."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import actrm
from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature, PreTrainedConfig
from lerobot.optim import OptimizerConfig

FEATURES = {"observation.state": FeatureType.STATE, "observation.environment_state": FeatureType.ENV}


@PreTrainedConfig.register_subclass("actrm")
@dataclass
class ActrmConfig(PreTrainedConfig):
    """An entry of a zoo.

    Attributes:
        entry: the entry's folder (`zoo/stack-act`), or its name in the zoo of `$ACTRM_ZOO_DIR`.
        seed: of the episodes; the n-th row of a batch has the n-th after it, and the next episode those after them.
    """

    entry: str = ""
    seed: int = 0
    # the entry normalises on its own
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: dict.fromkeys(("VISUAL", "STATE", "ENV", "ACTION"), NormalizationMode.IDENTITY)
    )

    def __post_init__(self) -> None:
        """Take the features from the entry, unless they are there."""
        # it thinks on the processor, whatever else there is
        self.device = "cpu"
        super().__post_init__()
        # a saved configuration has them, and is read before LeRobot says where it was saved
        if not self.entry or self.input_features:
            return
        policy = actrm.load_policy(self.place())
        self.n_obs_steps = policy.n_obs_steps
        self.input_features = {
            name: PolicyFeature(FEATURES.get(name, FeatureType.VISUAL if len(shape) == 3 else FeatureType.STATE), shape)
            for name, shape in policy.input_features.items()
        }
        self.output_features = {
            name: PolicyFeature(FeatureType.ACTION, shape) for name, shape in policy.output_features.items()
        }

    def place(self) -> str:
        """Where the entry is: a path inside a saved folder is one from there."""
        inside = Path(self.pretrained_path or "") / self.entry
        return str(inside) if self.pretrained_path and inside.is_dir() else self.entry

    @property
    def observation_delta_indices(self) -> None:
        """It remembers what it looks back to."""
        return None

    @property
    def action_delta_indices(self) -> None:
        """It is not trained here."""
        return None

    @property
    def reward_delta_indices(self) -> None:
        """It is not trained here."""
        return None

    def get_optimizer_preset(self) -> OptimizerConfig:
        """It is not trained here."""
        raise NotImplementedError("an entry of actrm is trained by actrm-zoo train")

    def get_scheduler_preset(self) -> None:
        """It is not trained here."""
        return None

    def validate_features(self) -> None:
        """The entry checks what it is shown."""
