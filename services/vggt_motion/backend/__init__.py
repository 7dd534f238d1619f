"""Planner, pose graph, trajectory and map (paper section 3.3)."""
