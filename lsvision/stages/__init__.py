"""The data flow, one arrow a file: pure functions with a config dataclass beside each."""
