"""MCAP recording and replay."""
