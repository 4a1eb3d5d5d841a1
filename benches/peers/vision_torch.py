"""LeRobot's ACT with two cameras on PyTorch, driven step by step (`orders.py`).

Lines: {"work": "train" | "predict", "size": "d256", "batch": 8, "threads": 1, "times": 3}
Sizes: "d512" (LeRobot's defaults), "d256", both on torchvision's ResNet18 with frozen norm, and "narrow": width 128,
and a ResNet18 of 16 channels with GroupNorm, which LeRobot takes by its name in torchvision.
"""

from typing import Any

import torch
import torchvision
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from orders import Work, answer
from torchvision.models.resnet import BasicBlock, ResNet

SIZES = {
    "narrow": {"dim_model": 128, "dim_feedforward": 512, "chunk_size": 16, "vision_backbone": "resnet18_narrow"},
    "d256": {"dim_model": 256, "dim_feedforward": 1024, "chunk_size": 32},
    "d512": {"dim_model": 512, "dim_feedforward": 3200, "chunk_size": 100},
}
CAMERAS = ("observation.images.agentview", "observation.images.robot0_eye_in_hand")
SIDE = 84
NARROW = 16


class Narrow(ResNet):
    """ResNet18 with `NARROW` channels in its first layer and GroupNorm, groups of 16 channels."""

    def __init__(self, **_: Any) -> None:
        super().__init__(BasicBlock, [2, 2, 2, 2], norm_layer=lambda c: torch.nn.GroupNorm(max(1, c // 16), c))
        self.inplanes = NARROW
        self.conv1 = torch.nn.Conv2d(3, NARROW, 7, 2, 3, bias=False)
        self.bn1 = torch.nn.GroupNorm(1, NARROW)
        for index in range(4):
            layer = self._make_layer(BasicBlock, NARROW << index, 2, stride=1 if index == 0 else 2)
            setattr(self, f"layer{index + 1}", layer)
        self.fc = torch.nn.Linear(8 * NARROW, 1000)


torchvision.models.resnet18_narrow = lambda **options: Narrow(**options)


def policy(size: str) -> ACTPolicy:
    settings = SIZES[size]
    pictures = {name: PolicyFeature(FeatureType.VISUAL, (3, SIDE, SIDE)) for name in CAMERAS}
    config = ACTConfig(
        input_features={"observation.state": PolicyFeature(FeatureType.STATE, (9,)), **pictures},
        output_features={"action": PolicyFeature(FeatureType.ACTION, (7,))},
        n_action_steps=settings["chunk_size"],
        pretrained_backbone_weights=None,
        device="cpu",
        **settings,
    )
    return ACTPolicy(config)


class Peer:
    def __init__(self, size: str, batch: int) -> None:
        self.policy = policy(size)
        self.optimiser = torch.optim.AdamW(self.policy.get_optim_params(), lr=1e-4, weight_decay=1e-4)
        chunk = SIZES[size]["chunk_size"]
        self.batch = {
            "observation.state": torch.randn(batch, 9),
            **{name: torch.randn(batch, 3, SIDE, SIDE) for name in CAMERAS},
            "action": torch.randn(batch, chunk, 7),
            "action_is_pad": torch.zeros(batch, chunk, dtype=torch.bool),
        }
        self.one = {name: value[:1] for name, value in self.batch.items() if "observation" in name}

    def train(self) -> None:
        self.policy.train()
        loss, _ = self.policy(self.batch)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.policy.parameters(), 10.0)
        self.optimiser.step()
        self.optimiser.zero_grad()

    def predict(self) -> None:
        self.policy.eval()
        with torch.inference_mode():
            self.policy.predict_action_chunk(self.one)


def works(size: str, batch: int) -> Work:
    peer = Peer(size, batch)
    return {"train": peer.train, "predict": peer.predict}


if __name__ == "__main__":
    answer(works)
