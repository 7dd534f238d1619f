"""Sim(3) constraints between submaps from shared anchor frames (paper section 3.2)."""
