"""What `spacerobot bench` measures, each figure beside a peer in the same run."""
