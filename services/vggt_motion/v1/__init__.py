"""Generated from ``proto/vggt_motion/v1`` by ``proto/generate.py``; only ``bus`` imports it."""
