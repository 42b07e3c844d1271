"""The sub-commands of the front door: one dataclass each, whose fields are its options; heavy packages are imported inside `run`."""
