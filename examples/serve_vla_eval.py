"""A model server of vla-eval that asks a server of openpi's protocol, such as `actrm-zoo serve`, about LIBERO.

pip install vla-eval==0.8.0 && pip install --no-deps openpi-client==0.1.2
python serve_vla_eval.py --address 127.0.0.1:9001 --args.port=8000
vla-eval run --config CONFIG --no-docker  # server.url: ws://127.0.0.1:9001
"""

from typing import Any

import numpy as np
from openpi_client.websocket_client_policy import WebsocketClientPolicy
from vla_eval.model_servers.predict import PredictModelServer
from vla_eval.model_servers.serve import run_server
from vla_eval.specs import GRIPPER_CLOSE_POS, IMAGE_RGB, LANGUAGE, POSITION_DELTA, ROTATION_AA, STATE_EEF_POS_AA_GRIP


class OpenpiServer(PredictModelServer):
    """Passes observations on under the names that openpi's LIBERO has."""

    def __init__(self, host: str = "127.0.0.1", port: int = 8000, chunk_size: int = 5) -> None:
        super().__init__(chunk_size=chunk_size)
        self.policy = WebsocketClientPolicy(host, port)

    def predict(self, obs: dict[str, Any], ctx: Any) -> dict[str, Any]:
        seen = {
            "observation/image": np.asarray(obs["images"]["agentview"]),
            "observation/wrist_image": np.asarray(obs["images"]["wrist"]),
            "observation/state": np.asarray(obs["states"], np.float32),
            "prompt": obs["task_description"],
        }
        return {"actions": self.policy.infer(seen)["actions"]}

    def get_action_spec(self) -> dict[str, Any]:
        return {"position": POSITION_DELTA, "rotation": ROTATION_AA, "gripper": GRIPPER_CLOSE_POS}

    def get_observation_spec(self) -> dict[str, Any]:
        return {"agentview": IMAGE_RGB, "wrist": IMAGE_RGB, "state": STATE_EEF_POS_AA_GRIP, "language": LANGUAGE}


if __name__ == "__main__":
    run_server(OpenpiServer)
