"""``python -m vggt_motion``: the same as the command ``vggt-motion``."""

from vggt_motion.cli import main

if __name__ == "__main__":
    main()
