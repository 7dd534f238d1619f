"""VGGT (Wang et al., CVPR 2025): our own implementation, for inference, in torch.

Importing this package does not import torch, an optional dependency; :func:`create` does.
"""
