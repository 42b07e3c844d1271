"""What moves in a drive: where it has no boxes, found in its lidar, or in its pictures; where it has some, these as they are needed."""
