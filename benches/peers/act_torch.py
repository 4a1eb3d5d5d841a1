"""LeRobot's ACT on PyTorch, driven step by step (`orders.py`).

Lines: {"work": "train" | "predict" | "plan", "size": "d256" | "d512", "threads": 1, "times": 3}
"plan" predicts as the original ACTRM does: the encoder is a recursion of 336 calls, the rest is ACT's.
"""

import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from orders import Work, answer

SIZES = {
    "d128": {"dim_model": 128, "dim_feedforward": 512, "chunk_size": 16},
    "d256": {"dim_model": 256, "dim_feedforward": 1024, "chunk_size": 32},
    "d512": {"dim_model": 512, "dim_feedforward": 3200, "chunk_size": 100},
}
BATCH = 64
# 16 supervision steps of 3 rounds of 6 + 1
PLAN_CALLS = 336


def policy(size: str) -> ACTPolicy:
    settings = SIZES[size]
    config = ACTConfig(
        input_features={
            "observation.state": PolicyFeature(FeatureType.STATE, (9,)),
            "observation.environment_state": PolicyFeature(FeatureType.ENV, (10,)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (7,))},
        n_action_steps=settings["chunk_size"],
        device="cpu",
        **settings,
    )
    return ACTPolicy(config)


class Recursion(torch.nn.Module):
    """ACT's encoder, called again and again on its own output and the observation."""

    def __init__(self, encoder: torch.nn.Module) -> None:
        super().__init__()
        self.encoder = encoder

    def forward(self, tokens: torch.Tensor, pos_embed: torch.Tensor) -> torch.Tensor:
        state = torch.zeros_like(tokens)
        for _ in range(PLAN_CALLS):
            state = self.encoder(state + tokens, pos_embed=pos_embed)
        return state


class Peer:
    def __init__(self, size: str) -> None:
        self.policy = policy(size)
        self.optimiser = torch.optim.AdamW(self.policy.parameters(), lr=1e-4, weight_decay=1e-4)
        chunk = SIZES[size]["chunk_size"]
        self.batch = {
            "observation.state": torch.randn(BATCH, 9),
            "observation.environment_state": torch.randn(BATCH, 10),
            "action": torch.randn(BATCH, chunk, 7),
            "action_is_pad": torch.zeros(BATCH, chunk, dtype=torch.bool),
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
            self.policy.model(self.one)

    def plan(self) -> None:
        model = self.policy.model
        encoder = model.encoder
        model.encoder = Recursion(encoder)
        try:
            self.predict()
        finally:
            model.encoder = encoder


def works(size: str) -> Work:
    peer = Peer(size)
    return {"train": peer.train, "predict": peer.predict, "plan": peer.plan}


if __name__ == "__main__":
    answer(works)
