"""Optical flow, motion state, keyframes and submap partition (paper section 3.1)."""
