"""VGGT-Motion: a consistent trajectory and dense map from uncalibrated monocular video, as services over Zenoh."""

import os
from importlib.metadata import PackageNotFoundError, version
from typing import Final

MAX_IMAGE_PIXELS: Final = 2**26  # 8K video has half as many, and most cameras for stills have fewer
# OpenCV reads it once, when it is loaded, and refuses a larger image of whatever format before it takes memory for it.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(MAX_IMAGE_PIXELS))

try:
    __version__ = version("vggt-motion")
except PackageNotFoundError:  # a source tree on the path without installation
    __version__ = "0.0.0"
