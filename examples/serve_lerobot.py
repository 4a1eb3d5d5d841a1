"""Serves a LeRobot checkpoint to `actrm-zoo eval --policy ws://127.0.0.1:8000 --name theirs --task Lift`.

pip install lerobot==0.6.1 websockets msgpack && pip install --no-deps openpi-client==0.1.2  # it asks for NumPy 1
python serve_lerobot.py CHECKPOINT [PORT]
"""

import sys

import torch
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.factory import make_pre_post_processors
from openpi_client import msgpack_numpy
from websockets.sync.server import ServerConnection, serve

policy = ACTPolicy.from_pretrained(sys.argv[1]).eval()
before, after = make_pre_post_processors(policy.config, pretrained_path=sys.argv[1])


def answer(client: ServerConnection) -> None:
    """One client: its metadata, then a chunk of actions for each observation."""
    client.send(msgpack_numpy.packb({"n_action_steps": policy.config.n_action_steps}))
    for message in client:
        seen = {key: torch.tensor(value)[None] for key, value in msgpack_numpy.unpackb(message).items()}
        with torch.inference_mode():
            actions = after(policy.predict_action_chunk(before(seen)))
        client.send(msgpack_numpy.packb({"actions": actions[0].cpu().numpy()}))


port = int(sys.argv[2]) if len(sys.argv) > 2 else 8000
with serve(answer, "127.0.0.1", port, compression=None, max_size=None) as server:
    server.serve_forever()
