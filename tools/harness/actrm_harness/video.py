"""Write a video: `python -m actrm_harness.video OUT.mp4 WIDTH HEIGHT FPS`, RGB frames on standard input.

The frames come one after the other, row-major from the top, three bytes a pixel. The file is MPEG-4, which every player
knows; OpenCV brings the encoder along, so nothing has to be installed.
"""

import sys

import numpy as np


def main() -> int:
    """Encode what standard input holds; the exit code."""
    path, width, height, rate = sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), float(sys.argv[4])
    try:
        import cv2
    except ImportError as error:
        print(f"no encoder: {error}; pip install opencv-python-headless brings one", file=sys.stderr)
        return 1

    code = cv2.VideoWriter.fourcc(*"mp4v")
    writer = cv2.VideoWriter(path, code, rate, (width, height))
    if not writer.isOpened():
        print(
            f"OpenCV {cv2.__version__} cannot write MPEG-4 video to {path}; the wheel opencv-python-headless can",
            file=sys.stderr,
        )
        return 1
    size = width * height * 3
    while frame := sys.stdin.buffer.read(size):
        if len(frame) < size:
            print(f"a frame of {len(frame)} bytes, expected {size}", file=sys.stderr)
            return 1
        image = np.frombuffer(frame, dtype=np.uint8).reshape(height, width, 3)
        writer.write(np.ascontiguousarray(image[:, :, ::-1]))
    writer.release()
    return 0


if __name__ == "__main__":
    sys.exit(main())
