"""A camera, an image processor and an actuator, three programs that share frames through REEM."""
