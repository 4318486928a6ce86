"""What a server or a recording holds, in Foxglove and in Rerun."""
