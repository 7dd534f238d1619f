"""Accuracy against ground truth, and the report of a run."""
