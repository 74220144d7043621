"""Results as files: JSON, YAML, trajectories, HTML."""
