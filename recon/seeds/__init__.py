"""Where splats begin, and what their depth is held to: lidar's points, ground between them, and what pictures show of the rest."""
