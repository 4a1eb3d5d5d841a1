"""LeRobot's own training, `lerobot-train`, with its options: python train_lerobot.py --policy.type=act ...

Nothing is changed but this: what the data set gives for a frame is kept and given again. Without pictures it is the
same each time, and reading a batch of frames with their chunks took LeRobot twice as long as the step itself.
robomimic's loader keeps what it read, too.
"""

from typing import Any

import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.scripts.lerobot_train import main

read = LeRobotDataset.__getitem__
kept: dict[int, Any] = {}


def frame(dataset: LeRobotDataset, index: int) -> Any:
    """What was read before, or is read now."""
    place = int(index)
    if place not in kept:
        kept[place] = read(dataset, place)
    return kept[place]


if __name__ == "__main__":
    torch.set_num_threads(1)
    # one data set, no transforms by chance: the batches are what they would have been
    LeRobotDataset.__getitem__ = frame
    main()
