"""Frames in: one file per kind of source, one registry."""
