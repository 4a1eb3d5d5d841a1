"""LeRobot's own encoding of the images of a robomimic file as AV1 videos, a video for each demonstration and camera.

Prints images, bytes of the videos and CPU seconds of encoding as JSON; writing the PNG files that LeRobot's encoder
reads is not counted.
"""

import json
import os
import sys
import tempfile
from pathlib import Path

import h5py
from lerobot.datasets.video_utils import encode_video_frames
from PIL import Image


def cpu_seconds() -> float:
    """Processor time of this process and of its children."""
    return sum(os.times()[:4])


def main() -> None:
    source, out = Path(sys.argv[1]), Path(sys.argv[2])
    out.mkdir(parents=True, exist_ok=True)
    images, size, seconds = 0, 0, 0.0
    with h5py.File(source) as file:
        for name, demo in file["data"].items():
            for key in (key for key in demo["obs"] if key.endswith("_image")):
                with tempfile.TemporaryDirectory(dir=out) as folder:
                    for frame, pixels in enumerate(demo["obs"][key][()]):
                        Image.fromarray(pixels).save(Path(folder) / f"frame-{frame:06d}.png", compress_level=1)
                        images += 1
                    video = out / f"{name}_{key}.mp4"
                    start = cpu_seconds()
                    encode_video_frames(folder, video, fps=20, overwrite=True)
                    seconds += cpu_seconds() - start
                    size += video.stat().st_size
    print(json.dumps({"images": images, "bytes": size, "cpu_seconds": seconds}))


if __name__ == "__main__":
    main()
