"""What moves in a drive that has no boxes, found in its lidar, or in its pictures where it has none."""
