"""VGGT-Motion: a consistent trajectory and dense map from uncalibrated monocular video, as services over Zenoh."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("vggt-motion")
except PackageNotFoundError:  # a source tree on the path without installation
    __version__ = "0.0.0"
