"""Self-calibrating structure from motion on the keyframes of one submap: the predictor that runs on any CPU."""
