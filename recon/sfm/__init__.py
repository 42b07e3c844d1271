"""Structure from motion by COLMAP: of pictures without poses (solve.py), and of posed ones (posed.py)."""
