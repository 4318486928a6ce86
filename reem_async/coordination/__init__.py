"""What programs of a robot agree on: parameters."""
