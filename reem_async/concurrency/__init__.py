"""What tasks and threads wait for and are woken by: bounded queues, time limits, scheduling."""
