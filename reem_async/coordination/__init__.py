"""What programs of a robot agree on: parameters, services, ownership, and which programs there are."""
