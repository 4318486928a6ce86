"""What programs of a robot agree on: parameters, and services that are asked and answer."""
