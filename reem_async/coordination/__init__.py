"""What programs of a robot agree on: parameters, services that are asked and answer, and which programs there are."""
