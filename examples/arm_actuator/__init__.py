"""A controller and an actuator, two programs at two rates that share a set point through REEM."""
