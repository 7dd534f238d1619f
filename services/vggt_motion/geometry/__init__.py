"""Rigid and similarity transforms, projection and point maps: numpy only, no state, no input or output."""
