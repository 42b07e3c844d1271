"""The network that repairs rendered frames, and its weights on disk."""
