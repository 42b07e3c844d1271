"""Objects in boxes: classes and tracks, which points are whose, and what the shape of vehicles tells of sides that nobody saw."""
