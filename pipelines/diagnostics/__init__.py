"""What an estimate is worth: observability, consistency, causes."""
